"""The batch of one gradient step: demonstrations, then relabelled replay rows, then original replay rows.

steps = read_steps(episodes, rows, steps, n_step)              # as recorded
steps = relabel(key, replay, steps, chosen, source, test)      # another goal, and its rewards
batch = transitions(steps, achieved_goal, config, ...)         # n-step returns
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from hindrl_jax.base.environments import Environment, RelabelsObservations, holds_goal
from hindrl_jax.base.types import Array, Episodes, Transition, tree_where
from hindrl_jax.config import BatchConfig, TrainConfig
from hindrl_jax.core.goals import GoalTest
from hindrl_jax.core.guidance import Guidance
from hindrl_jax.core.hindsight import goal_source
from hindrl_jax.core.randomness import uniform_index
from hindrl_jax.core.relabel import num_relabelled, relabel, relabel_observations
from hindrl_jax.core.replay import ReplayState, sample_episodes, sample_steps
from hindrl_jax.core.steps import as_occupancy, read_steps, transitions


class Rows(NamedTuple):
    """Transitions that were drawn from the replay."""

    row: Array  # (B,) int32, episode
    step: Array  # (B,) int32
    relabelled: Array  # (B,) bool, which are to be relabelled


def num_demo_rows(env_steps: Array, config: BatchConfig) -> Array:
    """Demonstration rows of a batch after `env_steps` environment steps: floor(max(r (1 - steps / reach_zero), 0) B) (thesis eq. 4.9)."""
    if config.reach_zero is None:
        return jnp.asarray(config.max_demo_rows)
    remaining = jnp.maximum(1.0 - env_steps / config.reach_zero, 0.0)
    # The minimum is for float32, whose product may round up where that of Python's floats, `max_demo_rows`, does not.
    return jnp.minimum(jnp.floor(config.max_demo_ratio * config.batch_size * remaining).astype(jnp.int32), config.max_demo_rows)


def sample_batch(key: Array, replay: ReplayState, guidance: Guidance, env_steps: Array, env: Environment, config: TrainConfig) -> Transition:
    """Draws the batch of one gradient step.

    Of B rows, `num_demo_rows` come from the demonstrations; of the rest, n / (n + 1) (rounded down) are relabelled, or fewer where intersections
    are empty.

    Args:
      key: random key.
      replay: at least one complete episode.
      guidance: its demonstrations are drawn uniformly by episode, then by step, and never relabelled.
      env_steps: () int32, environment steps so far.
      env: says what goals are; see `rows_of_replay`.
      config: batch size, shares, strategy, n-step.

    Returns:
      A batch of `batch_size` rows in that order.
    """
    key_demo, key_demo_step, key_episode, key_step, key_goal = jax.random.split(key, 5)
    size, max_demo_rows, demonstrations = config.batch.batch_size, config.batch.max_demo_rows, guidance.demonstrations
    demo_rows = num_demo_rows(env_steps, config.batch)
    row = sample_episodes(key_episode, replay, size)
    index = jnp.arange(size)
    relabelled = (index >= demo_rows) & (index < demo_rows + num_relabelled(size - demo_rows, config.batch.relabelled_per_original))
    rows = Rows(row=row, step=sample_steps(key_step, replay.episodes, row), relabelled=relabelled)
    batch = rows_of_replay(key_goal, replay, rows, guidance, env, config)
    if max_demo_rows == 0:
        return batch

    demo = uniform_index(key_demo, (max_demo_rows,), demonstrations.lengths.shape[0])
    demo_batch = rows_of_demonstrations(demonstrations, demo, sample_steps(key_demo_step, demonstrations, demo), env, config)
    head = jax.tree.map(lambda leaf: leaf[:max_demo_rows], batch)
    head = tree_where(index[:max_demo_rows] < demo_rows, demo_batch, head)
    return jax.tree.map(lambda leaf, first: leaf.at[:max_demo_rows].set(first), batch, head)


def rows_of_replay(key: Array, replay: ReplayState, rows: Rows, guidance: Guidance, env: Environment, config: TrainConfig) -> Transition:
    """Reads B rows of the replay, and relabels those that are to be: their goals, or their observations (`RelabelsObservations`)."""
    steps = read_steps(replay.episodes, rows.row, rows.step, config.batch.n_step)
    test = goal_test(guidance, env, config)
    if config.batch.sources:
        source = goal_source(guidance.goals, config.batch)
        if isinstance(env, RelabelsObservations):
            steps = relabel_observations(key, replay, steps, rows.relabelled, source, env)
        else:
            steps = relabel(key, replay, steps, rows.relabelled, source, test)
    if holds_goal(env):
        steps = as_occupancy(steps, config.batch.gamma)
    return transitions(steps, env.achieved_goal, config, is_demonstration=False)


def rows_of_demonstrations(demonstrations: Episodes, rows: Array, steps: Array, env: Environment, config: TrainConfig) -> Transition:
    """Reads rows of the demonstrations, which are never relabelled: rows and steps (B,) int32 -> the batch."""
    recorded = read_steps(demonstrations, rows, steps, config.batch.n_step)
    if holds_goal(env):  # that a demonstration ends at the goal does not say that the hand would have stayed there
        recorded = as_occupancy(recorded.replace(terminated=jnp.zeros_like(recorded.terminated)), config.batch.gamma)
    return transitions(recorded, env.achieved_goal, config, is_demonstration=True)


def sample_demonstrations(key: Array, demonstrations: Episodes, env: Environment, config: TrainConfig) -> Transition:
    """A batch of demonstration rows alone."""
    key_demo, key_step = jax.random.split(key)
    rows = uniform_index(key_demo, (config.batch.batch_size,), demonstrations.lengths.shape[0])
    return rows_of_demonstrations(demonstrations, rows, sample_steps(key_step, demonstrations, rows), env, config)


def goal_test(guidance: Guidance, env: Environment, config: TrainConfig) -> GoalTest:
    """When a goal counts as reached, wherever a reward is computed from goals."""
    return GoalTest(
        achieved_goal=env.achieved_goal,
        epsilon=guidance.epsilon,
        inclusive=not config.quirks.strict_goal_test,
        ends_return=not (config.quirks.bootstrap_past_relabelled_goals or holds_goal(env)),
        own_goals=config.own_goals,
    )
