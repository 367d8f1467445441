"""Relabelling: rows of a batch get another goal in hindsight, and the reward that goes with it.

Which rows: of those that come from the replay, n / (n + 1) (`num_relabelled`). Which goal: one that a source draws (`hindsight`). Which reward: 1
where the goal is reached by the box test, else 0 (`reward_by_goal`; thesis eq. 2.29 and 4.8). What the return makes of it is in `steps.transitions`.

Where the task's parameters are part of the observation and do not affect the dynamics, hindsight rewrites observations in place of goals
(`relabel_observations`).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from hindrl_jax.base.environments import RelabelsObservations
from hindrl_jax.base.types import Array
from hindrl_jax.core.goals import GoalTest
from hindrl_jax.core.hindsight import GoalSource
from hindrl_jax.core.replay import ReplayState
from hindrl_jax.core.steps import Steps


def num_relabelled(num_replay_rows: Array, relabelled_per_original: float) -> Array:
    """Of the rows that come from the replay n / (n + 1), rounded down; n is `relabelled_per_original`."""
    share = relabelled_per_original / (relabelled_per_original + 1)
    return jnp.floor(num_replay_rows * share + 1e-3).astype(jnp.int32)  # the margin is for float32's rounding


def relabel(key: Array, replay: ReplayState, steps: Steps, chosen: Array, source: GoalSource, test: GoalTest) -> Steps:
    """Gives rows another goal, and the rewards of reaching it.

    Where episodes have goals of their own, one that ended because its goal was reached goes on for another goal: its last state is not worth nothing.

    Args:
      key: random key.
      replay: where the rows come from, and the source may look for goals.
      steps: B rows of n steps, as recorded.
      chosen: (B,) bool, the rows to relabel; the others stay as they are, and so do those for which the source finds no goal.
      source: draws states whose achieved goals are the new ones.
      test: when a goal counts as reached.
    """
    observations, found = source(key, replay, steps.row, steps.step)
    chosen = chosen & found
    if test.own_goals:
        solved = jnp.any(steps.is_last & (steps.rewards > 0.0), axis=1)
        steps = steps.replace(terminated=steps.terminated & ~(chosen & solved))
    goals = jnp.where(chosen[:, None], test.achieved_goal(observations), steps.desired_goal)
    return reward_by_goal(steps.replace(desired_goal=goals, is_relabelled=chosen), test)


def reward_by_goal(steps: Steps, test: GoalTest) -> Steps:
    """Rewards relabelled rows for reaching their new goals, rather than as recorded; unless `test` says otherwise they end there."""
    chosen = steps.is_relabelled
    reached = test.reached(steps.next_observations, steps.desired_goal[:, None]) & chosen[:, None]
    return steps.replace(
        rewards=jnp.where(chosen[:, None], reached.astype(jnp.float32), steps.rewards),
        ends=steps.ends | reached if test.ends_return else steps.ends,
    )


def relabel_observations(key: Array, replay: ReplayState, steps: Steps, chosen: Array, source: GoalSource, env: RelabelsObservations) -> Steps:
    """Replaces the task's parameters in the observations of chosen rows, and rewards them where the task is then solved.

    A solved state always ends the return, whatever the goal test says: no row starts in one, so its value is never trained.

    Args:
      key: random key.
      replay: where the rows come from, and the source may look for states.
      steps: B rows of n steps, as recorded.
      chosen: (B,) bool, the rows to relabel; the others stay as they are.
      source: draws J states for each row.
      env: says what would have been observed.
    """
    key_source, key_relabel = jax.random.split(key)
    num_rows = steps.row.shape[0]
    keys = jax.random.split(key_relabel, num_rows)
    rows, first_steps = (jnp.broadcast_to(index[:, None], (num_rows, env.num_subgoals)) for index in (steps.row, steps.step))
    subgoals, _ = source(key_source, replay, rows, first_steps)
    recorded = jnp.concatenate([steps.observation[:, None], steps.next_observations], axis=1)
    observations, solved = jax.vmap(env.relabel_observations)(keys, recorded, subgoals)
    solved &= chosen[:, None]
    return steps.replace(
        observation=jnp.where(chosen[:, None], observations[:, 0], steps.observation),
        next_observations=jnp.where(chosen[:, None, None], observations[:, 1:], steps.next_observations),
        rewards=jnp.where(chosen[:, None], solved.astype(jnp.float32), steps.rewards),
        terminated=steps.terminated & ~chosen,  # where the recorded task was solved, the relabelled one may go on
        ends=steps.ends | solved,
        is_relabelled=chosen,
    )
