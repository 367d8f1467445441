"""Stepping many environments side by side, for experience and for evaluation."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
from flax import struct

from hindrl_jax.base.environments import Restorable, Steppable, action_to_env
from hindrl_jax.base.types import Array, Episodes, TimeStep, tree_where
from hindrl_jax.core import curriculum
from hindrl_jax.core.curriculum import Curriculum, Origin
from hindrl_jax.core.goals import GoalTable, sample_goals
from hindrl_jax.core.randomness import uniform_in_groups

Act = Callable[[Array, Array, Array], Array]
"""(key, observations (E, D), desired goals (E, G)) -> actions (E, A) in [-1, 1]."""


class RolloutState(struct.PyTreeNode, kw_only=True):
    """E environments in the middle of their episodes."""

    env_state: Any  # leaves (E, ...)
    observation: Array  # (E, D)
    desired_goal: Array  # (E, G), the behavioural goals
    origin: Origin | None = None  # where the episodes began; None where none begins in a demonstrated state


class StartTable(struct.PyTreeNode, kw_only=True):
    """Demonstrated states in which an episode may begin: all but the last of each demonstration, where nothing is left to do."""

    states: Array  # (N, T + 1, S) as vectors, see `Restorable`; padded
    lengths: Array  # (N,) int32, number of transitions


def sample_starts(key: Array, table: StartTable, num_starts: int) -> Origin:
    """Draws uniformly from all states of N demonstrations but the last ones."""
    demo, steps_left = uniform_in_groups(key, num_starts, table.lengths)
    return Origin(demo=demo, step=table.lengths[demo] - steps_left)


class DemoResets(NamedTuple):
    """That some episodes begin in demonstrated states instead of the environment's own."""

    starts: StartTable
    ratio: float
    """The probability with which one does."""
    curriculum: Curriculum | None = None
    """Where in the demonstrations; None draws from all of their states."""


def reset(key: Array, env: Steppable, behavioural_goals: GoalTable, num_envs: int, demo_resets: DemoResets | None = None) -> RolloutState:
    """Starts `num_envs` episodes, each with a goal drawn from the table (thesis algorithm 5).

    Args:
      key: random key.
      env: static; `Restorable`, too, if there are `demo_resets`.
      behavioural_goals: the table.
      num_envs: E.
      demo_resets: whether and where some episodes begin in demonstrated states.
    """
    key_env, key_goal = jax.random.split(key)
    env_state, observation = jax.vmap(env.reset)(jax.random.split(key_env, num_envs))
    origin = None
    if demo_resets is not None:
        restorable = cast(Restorable, env)
        key_choice, key_start, key_states = jax.random.split(jax.random.fold_in(key, 2), 3)  # 2: split has used what 0 and 1 give
        origin, vectors = _demonstrated_starts(key_start, demo_resets, num_envs)
        demonstrated = jax.vmap(restorable.vector_to_state)(jax.random.split(key_states, num_envs), vectors)
        chosen = jax.random.bernoulli(key_choice, demo_resets.ratio, (num_envs,))
        env_state = tree_where(chosen, demonstrated, env_state)
        observation = jax.vmap(restorable.observe)(env_state)
        origin = origin.replace(demo=jnp.where(chosen, origin.demo, -1))
    return RolloutState(
        env_state=env_state,
        observation=observation,
        desired_goal=sample_goals(key_goal, behavioural_goals, num_envs),
        origin=origin,
    )


def _demonstrated_starts(key: Array, demo_resets: DemoResets, num_envs: int) -> tuple[Origin, Array]:
    """Where in the demonstrations episodes begin, and the states there, as vectors (E, S)."""
    starts = demo_resets.starts
    if demo_resets.curriculum is None:
        origin = sample_starts(key, starts, num_envs)
    else:
        origin = curriculum.sample(key, demo_resets.curriculum, starts.lengths, num_envs)
    return origin, starts.states[origin.demo, origin.step]


def step(rollout: RolloutState, restarted: RolloutState, action: Array, env: Steppable) -> tuple[RolloutState, TimeStep]:
    """Steps every environment, and goes on from a new episode where one has ended.

    Args:
      rollout: E environments.
      restarted: E new episodes from `reset`; those that are not needed are dropped.
      action: (E, A) in [-1, 1].
      env: static.

    Returns:
      The new state, and the time steps (E, ...) before the resets: their observation is the true next one.
    """
    env_state, time_step = jax.vmap(env.step)(rollout.env_state, action_to_env(action, env))
    continued = rollout.replace(env_state=env_state, observation=time_step.observation)
    return tree_where(time_step.terminated | time_step.truncated, restarted, continued), time_step


class Evaluation(struct.PyTreeNode, kw_only=True):
    """What became of a number of fresh episodes."""

    success: Array  # (episodes,) bool
    length: Array  # (episodes,) int32, steps taken


def evaluate(key: Array, env: Steppable, behavioural_goals: GoalTable, act: Act, num_episodes: int) -> Evaluation:
    """Plays fresh episodes to their end; an episode is a success if any of its rewards is positive.

    Args:
      key: random key.
      env: static.
      behavioural_goals: each episode draws its goal from here.
      act: the policy; it is given keys, and may ignore them.
      num_episodes: played side by side.
    """
    key_reset, key_play = jax.random.split(key)
    begun = reset(key_reset, env, behavioural_goals, num_episodes)

    def outcome(observation: Array, action: Array, time_step: TimeStep, over: Array) -> tuple[Array, Array]:
        return ~over & (time_step.reward > 0.0), ~over

    (rewarded, taken), _ = _to_the_end(key_play, env, begun, act, outcome)
    return Evaluation(success=jnp.any(rewarded, axis=0), length=jnp.sum(taken, axis=0, dtype=jnp.int32))


def play(key: Array, env: Steppable, begun: RolloutState, act: Act) -> Episodes:
    """Plays episodes from where they have begun to their end, and records them, without states.

    Args:
      key: random key.
      env: static.
      begun: the beginnings of E episodes.
      act: the policy.
    """

    def row(observation: Array, action: Array, time_step: TimeStep, over: Array) -> tuple[Array, ...]:
        return observation, action, jnp.where(over, 0.0, time_step.reward), ~over, time_step.terminated & ~over

    rows, last = _to_the_end(key, env, begun, act, row)
    observations, actions, rewards, taken, terminated = jax.tree.map(lambda leaf: jnp.swapaxes(leaf, 0, 1), rows)
    return Episodes(
        observations=jnp.concatenate([observations, last[:, None]], axis=1),
        actions=actions,
        rewards=rewards,
        lengths=jnp.sum(taken, axis=1, dtype=jnp.int32),
        terminated=jnp.any(terminated, axis=1),
        desired_goals=begun.desired_goal,
    )


def _to_the_end(key: Array, env: Steppable, begun: RolloutState, act: Act, note: Callable[[Array, Array, TimeStep, Array], Any]) -> tuple[Any, Array]:
    """What `note` makes of each step (observation, action, time step, whether the episode was over before), leaves (T, E, ...), and where it ends."""

    def one_step(carry: tuple[Array, Any, Array, Array], _: None) -> tuple[tuple[Array, Any, Array, Array], Any]:
        key, env_state, observation, over = carry
        key, key_act = jax.random.split(key)
        action = act(key_act, observation, begun.desired_goal)
        env_state, time_step = jax.vmap(env.step)(env_state, action_to_env(action, env))
        after = (key, env_state, time_step.observation, over | time_step.terminated | time_step.truncated)
        return after, note(observation, action, time_step, over)

    carry = (key, begun.env_state, begun.observation, jnp.zeros(begun.observation.shape[0], bool))
    (_, _, last, _), notes = jax.lax.scan(one_step, carry, length=env.horizon)
    return notes, last
