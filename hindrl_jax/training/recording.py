"""Recording demonstrations: an expert plays, and the episodes that solve the task are kept."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hindrl_jax.base.environments import RestorableEnvironment, action_from_env, compiler_options, on_host
from hindrl_jax.base.errors import UserError
from hindrl_jax.base.types import Array, Episodes, tree_where
from hindrl_jax.experts.robosuite_arm import play_in_robosuite

Expert = Any
"""A frozen dataclass with a method act(key, env, state) -> (A,) action in the environment's own units."""


Act = Callable[[Array, Any, Array], Array]
"""(key, state, observation (D,)) -> action (A,) in the environment's own units."""


def play(key: Array, env: RestorableEnvironment, act: Act, num_episodes: int) -> Episodes:
    """Plays episodes to their end, solved or not, and notes the states on the way, which are repeated after the end.

    The desired goal of an episode is the goal that it reached at its end.

    Args:
      key: random key.
      env: static.
      act: the policy.
      num_episodes: N, played side by side.
    """

    def step(carry: tuple[Array, Any, Array, Array], _: None) -> tuple[tuple[Array, Any, Array, Array], tuple[Array, ...]]:
        key, state, observation, over = carry
        key, key_act = jax.random.split(key)
        action = act(key_act, state, observation)
        next_state, time_step = env.step(state, action)
        next_state = tree_where(over, state, next_state)
        next_observation = jnp.where(over, observation, time_step.observation)
        done = jnp.clip(action_from_env(action, env), -1.0, 1.0)  # what the environment makes of an action beyond its bounds
        row = (observation, env.state_to_vector(state), done, time_step.reward, over, time_step.terminated)
        return (key, next_state, next_observation, over | time_step.terminated | time_step.truncated), row

    def episode(key: Array) -> Episodes:
        key_reset, key_play = jax.random.split(key)
        state, observation = env.reset(key_reset)
        start = (key_play, state, observation, jnp.asarray(False))
        (_, state, observation, _), rows = jax.lax.scan(step, start, length=env.horizon)
        observations, states, actions, rewards, over, terminated = rows
        return Episodes(
            observations=jnp.concatenate([observations, observation[None]]),
            actions=actions,
            rewards=jnp.where(over, 0.0, rewards),
            lengths=jnp.sum(~over),
            terminated=jnp.any(terminated & ~over),
            desired_goals=env.achieved_goal(observation),
            states=jnp.concatenate([states, env.state_to_vector(state)[None]]),
        )

    return jax.vmap(episode)(jax.random.split(key, num_episodes))


def player(env: RestorableEnvironment, act: Act, num_episodes: int) -> Callable[[Array], Episodes]:
    """`play` as a program, key -> episodes, on whatever simulates the environment. It is compiled once.

    Args:
      env, act, num_episodes: as for `play`.

    Raises:
      UserError: from the program, if the environment is simulated by robosuite and that is missing or unusable.
    """
    if on_host(env):
        arm: Any = env
        return lambda key: play_in_robosuite(key, arm, act, num_episodes)
    return jax.jit(lambda key: play(key, env, act, num_episodes), compiler_options=compiler_options(env))


@functools.cache
def _expert_player(env: RestorableEnvironment, expert: Expert, num_episodes: int) -> Callable[[Array], Episodes]:
    """`player` of an expert; cached because a run records for each of its seeds."""
    return player(env, lambda key, state, observation: expert.act(key, env, state), num_episodes)


def record(key: Array, env: RestorableEnvironment, expert: Expert, num_demos: int, *, max_attempts: int | None = None) -> Episodes:
    """Records `num_demos` demonstrations that solve the task; unsolved episodes are discarded.

    Args:
      key: random key; equal keys give equal demonstrations.
      env, expert: who plays what.
      num_demos: N, at least 1.
      max_attempts: episodes to play before giving up; by default 100 times `num_demos`.

    Raises:
      UserError: if `num_demos` is below 1, or the expert solves too few episodes, or the environment's back end is unusable.
    """
    if num_demos < 1:
        raise UserError(f"num_demos = {num_demos} is too few: record at least 1 demonstration")
    max_attempts = 100 * num_demos if max_attempts is None else max_attempts
    batch_size = 1 if on_host(env) else max(num_demos, 16)
    play_batch = _expert_player(env, expert, batch_size)
    kept: list[Episodes] = []
    attempts = 0
    while sum(len(batch.lengths) for batch in kept) < num_demos:
        if attempts >= max_attempts:
            found = sum(len(batch.lengths) for batch in kept)
            raise UserError(
                f"the expert solved only {found} of {attempts} episodes of {env.name} within the horizon of {env.horizon} steps, "
                f"but {num_demos} demonstrations are wanted: raise the horizon or ask for fewer"
            )
        key, key_batch = jax.random.split(key)
        batch = jax.device_get(play_batch(key_batch))
        kept.append(jax.tree.map(lambda leaf, solved=batch.terminated: leaf[solved], batch))
        attempts += batch_size
    return jax.tree.map(lambda *leaves: jnp.asarray(np.concatenate(leaves)[:num_demos]), *kept)
