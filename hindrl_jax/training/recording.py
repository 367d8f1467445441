"""Recording demonstrations: an expert plays, and the episodes that solve the task are kept."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hindrl_jax.base.compilation import in_float32
from hindrl_jax.base.environments import Environment, state_dim
from hindrl_jax.base.errors import UserError
from hindrl_jax.base.steppers import Watchable, can_be_watched
from hindrl_jax.base.types import Array, Episodes
from hindrl_jax.tasks.registry import task
from hindrl_jax.training.checks import check_demonstrations, check_dimensions, check_expert
from hindrl_jax.training.devices import free_memory, seed_mesh
from hindrl_jax.training.host_playing import as_episode, played_action
from hindrl_jax.training.playing import player, plays_one_by_one

Expert = Any
"""A frozen dataclass with a method act(key, env, state) -> (A,) action in the environment's own units."""
Demonstrator = Callable[[Any, np.random.Generator], np.ndarray]
"""(an observation as the environment's own code gives it, randomness) -> action (A,) in the environment's own units."""


@in_float32
def record_demonstrations(env: Environment, num_demos: int, *, seed: int = 0, expert: Any = None) -> Episodes:
    """Records demonstrations with the task's own expert.

    Args:
      env: from `make`.
      num_demos: at least 1; only solved episodes are kept.
      seed: equal seeds give equal demonstrations.
      expert: another expert: a frozen dataclass with a method act(key, env, state), for Gymnasium's environments act(observation, rng).

    Raises:
      UserError: if `num_demos` is below 1, the expert cannot solve the task within its horizon, or there is none.
    """
    if expert is None:
        expert_class = task(env.name).expert
        if expert_class is None:
            raise UserError(f"no expert is known for {env.name}: give one, or demonstrations from a file, which hindrl_jax.record_gymnasium can make")
        expert = expert_class()
    if can_be_watched(env):
        policy = expert.acting_in(env) if hasattr(expert, "acting_in") else expert.act
        return record_gymnasium(env, policy, num_demos, seed=seed)
    return record(jax.random.fold_in(jax.random.key(seed), 1), env, expert, num_demos)


@functools.cache
def _expert_player(env: Environment, expert: Expert, num_episodes: int) -> Callable[[Array], Episodes]:
    """`player` of an expert; cached because a run records for each of its seeds."""
    return player(env, lambda key, state, observation: expert.act(key, env, state), num_episodes)


def record(key: Array, env: Environment, expert: Expert, num_demos: int, *, max_attempts: int | None = None) -> Episodes:
    """Records `num_demos` demonstrations that solve the task; unsolved episodes are discarded.

    Args:
      key: random key; equal keys give equal demonstrations.
      env, expert: who plays what.
      num_demos: N, at least 1.
      max_attempts: episodes to play before giving up; by default 100 times `num_demos`.

    Raises:
      UserError: if `num_demos` is below 1, or the expert solves too few episodes, or the environment's back end is unusable, or its dimensions or
        the expert's actions are not what it states.
    """
    check_demonstrations(num_demos)
    check_dimensions(env)
    check_expert(env, expert)
    max_attempts = 100 * num_demos if max_attempts is None else max_attempts
    batch_size = 1 if plays_one_by_one(env) else max(num_demos, 16)
    needed, free = 4 * batch_size * env.horizon * (env.observation_dim + env.action_dim + state_dim(env)), free_memory(seed_mesh(jax.process_count()))
    if free is not None and needed > free:
        raise UserError(
            f"{batch_size} episodes of {env.horizon} steps side by side take {needed / 2**30:,.1f} GiB of memory, and {free / 2**30:,.1f} GiB are "
            "free: lower horizon, or the number of demonstrations"
        )
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


@in_float32
def record_gymnasium(env: Watchable, policy: Demonstrator, num_demos: int, *, seed: int = 0, max_attempts: int | None = None) -> Episodes:
    """Records demonstrations that solve the task; others are discarded. `terminated` says of all that they are solved.

    Each ends where its episode does: at the goal, or where the goal is to be held, at the horizon.

    Args:
      env: for example from `hindrl_jax.make("gymnasium:...")`.
      policy: from an observation, as the environment gives it, and a numpy generator, the action in the environment's own units.
      num_demos: N, at least 1.
      seed: equal seeds give equal demonstrations.
      max_attempts: episodes to play before giving up; by default 100 times `num_demos`.

    Raises:
      UserError: if `num_demos` is below 1, or the policy reaches too few goals.
    """
    check_demonstrations(num_demos)
    max_attempts = 100 * num_demos if max_attempts is None else max_attempts
    rng = np.random.default_rng(seed)
    kept: list[Episodes] = []
    with contextlib.closing(env.watched(with_pictures=False)) as stepper:
        observation, goal = stepper.begin(rng.integers(2**32, size=1))
        for _ in range(max_attempts):
            observations, actions, solved, ended = [observation], [], [], False
            while not ended:
                action = _checked(policy(stepper.raw_observation(), rng), env)
                actions.append(played_action(env, action))
                outcome = stepper.step(action[None])
                observations.append(outcome.next_observation)
                solved.append(outcome.success[0])
                ended = outcome.ended[0]
            if outcome.success[0]:
                reached = np.asarray(env.achieved_goal(outcome.next_observation)) if goal is None else goal
                kept.append(as_episode(env, np.concatenate(observations), np.stack(actions), np.array(solved), reached[0]))
            observation, goal = outcome.observation, outcome.desired_goal
            if len(kept) == num_demos:
                return jax.tree.map(lambda *leaves: np.stack(leaves), *kept)
    raise UserError(
        f"the policy reached its goal in only {len(kept)} of {max_attempts} episodes of {env.name}, but {num_demos} demonstrations are wanted: "
        "ask for fewer, or give a better one"
    )


def _checked(action: Any, env: Environment) -> np.ndarray:
    """What a policy has chosen, as float32, if it is an action (A,) at all.

    Raises:
      UserError: if it is not.
    """
    action = np.asarray(action, np.float32)
    if action.shape != (env.action_dim,) or not np.isfinite(action).all():
        raise UserError(f"the policy chose {action.tolist()} in {env.name}, which takes {env.action_dim} finite numbers: mend the policy")
    return action
