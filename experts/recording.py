"""Recording demonstrations: an expert plays, and the episodes that solve the task are kept."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from hindrl_jax.errors import UserError
from hindrl_jax.types import Array, Environment, Episodes, action_from_env, tree_where

Expert = Any
"""A frozen dataclass with a method act(key, env, state) -> (A,) action in the environment's own units."""


class RecordableEnvironment(Environment, Protocol):
    """An environment whose state can be written down as a vector, and read back to be drawn."""

    @property
    def state_dim(self) -> int: ...

    def state_to_vector(self, state: Any) -> Array: ...

    def vector_to_state(self, key: Array, vector: Array) -> Any: ...


@struct.dataclass(kw_only=True)
class Recording:
    """Demonstrations, and the environment states that they went through."""

    episodes: Episodes  # N episodes
    states: Array  # (N, T + 1, S) states as vectors, repeated after the end of an episode


def play(key: Array, env: RecordableEnvironment, act: Callable[[Array, Any, Array], Array], num_episodes: int) -> Recording:
    """Plays episodes to their end, solved or not, and notes the states on the way.

    The desired goal of an episode is the goal that it reached at its end.

    Args:
      key: random key.
      env: static.
      act: (key, state, observation (D,)) -> action (A,) in the environment's own units.
      num_episodes: N, played side by side.
    """

    def step(carry: tuple[Array, Any, Array, Array], _: None) -> tuple[tuple[Array, Any, Array, Array], tuple[Array, ...]]:
        key, state, observation, over = carry
        key, key_act = jax.random.split(key)
        action = act(key_act, state, observation)
        next_state, time_step = env.step(state, action)
        next_state = tree_where(over, state, next_state)
        next_observation = jnp.where(over, observation, time_step.observation)
        row = (observation, env.state_to_vector(state), action_from_env(action, env), time_step.reward, over, time_step.terminated)
        return (key, next_state, next_observation, over | time_step.terminated | time_step.truncated), row

    def episode(key: Array) -> Recording:
        key_reset, key_play = jax.random.split(key)
        state, observation = env.reset(key_reset)
        start = (key_play, state, observation, jnp.asarray(False))
        (_, state, observation, _), rows = jax.lax.scan(step, start, length=env.horizon)
        observations, states, actions, rewards, over, terminated = rows
        return Recording(
            episodes=Episodes(
                observations=jnp.concatenate([observations, observation[None]]),
                actions=actions,
                rewards=jnp.where(over, 0.0, rewards),
                lengths=jnp.sum(~over),
                terminated=jnp.any(terminated & ~over),
                desired_goals=env.achieved_goal(observation),
            ),
            states=jnp.concatenate([states, env.state_to_vector(state)[None]]),
        )

    return jax.vmap(episode)(jax.random.split(key, num_episodes))


@functools.partial(jax.jit, static_argnames=("env", "expert", "num_episodes"))
def _play_expert(key: Array, env: RecordableEnvironment, expert: Expert, num_episodes: int) -> Recording:
    return play(key, env, lambda key, state, observation: expert.act(key, env, state), num_episodes)


def record(key: Array, env: RecordableEnvironment, expert: Expert, num_demos: int, *, max_attempts: int | None = None) -> Recording:
    """Records `num_demos` demonstrations that solve the task; unsolved episodes are discarded.

    Args:
      key: random key; equal keys give equal demonstrations.
      env, expert: who plays what.
      num_demos: N, at least 1.
      max_attempts: episodes to play before giving up; by default 100 times `num_demos`.

    Raises:
      UserError: if `num_demos` is below 1, or the expert solves too few episodes.
    """
    if num_demos < 1:
        raise UserError(f"num_demos = {num_demos} is too few: record at least 1 demonstration")
    max_attempts = 100 * num_demos if max_attempts is None else max_attempts
    batch_size = max(num_demos, 16)
    kept, attempts = [], 0
    while sum(len(batch.states) for batch in kept) < num_demos:
        if attempts >= max_attempts:
            found = sum(len(batch.states) for batch in kept)
            raise UserError(
                f"the expert solved only {found} of {attempts} episodes of {env.name} within the horizon of {env.horizon} steps, "
                f"but {num_demos} demonstrations are wanted: raise the horizon or ask for fewer"
            )
        key, key_batch = jax.random.split(key)
        batch = jax.device_get(_play_expert(key_batch, env, expert, batch_size))
        kept.append(jax.tree.map(lambda leaf, solved=batch.episodes.terminated: leaf[solved], batch))
        attempts += batch_size
    return jax.tree.map(lambda *leaves: jnp.asarray(np.concatenate(leaves)[:num_demos]), *kept)
