"""Sources of goals for relabelling (Andrychowicz et al., HER, 2017; Davchev et al., HinDRL, 2021; thesis sections 2.3.3 and 4.1.2):

    final               the last goal reached in the transition's own episode
    future              a goal reached later in that episode; the thesis's "rollout-conditioned" (eq. 4.3)
    episode             any goal reached in that episode
    random              any goal reached in any episode of the replay
    task_conditioned    any goal reached in the demonstrations (eq. 4.2)
    joint_intersection  a goal reached later in that episode that lies within epsilon of a demonstrated one, or the demonstrated one itself

The strategy joint_union takes task_conditioned with probability `union_sampling_ratio`, else future (eq. 4.4). A row whose intersection is empty
is not relabelled. For intersections, the replay notes for each transition a demonstrated goal near its end (`NEARBY_GOAL`), which makes them,
"exceptionally slow" in the thesis, nearly as cheap as the others. Difference from HinDRL in the form that takes demonstrated goals: one goal near
each state is noted for good, so a goal is drawn by the states that it lies near.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal

import jax
import jax.numpy as jnp

from hindrl_jax.base.types import Array, tree_where
from hindrl_jax.config import BatchConfig, Source
from hindrl_jax.core.goals import GoalTable
from hindrl_jax.core.randomness import uniform_index
from hindrl_jax.core.replay import ReplayState, sample_episodes

GoalSource = Callable[[Array, ReplayState, Array, Array], tuple[Array, Array]]
"""(key, replay, rows, steps) -> (observations, found): for transitions, given by episode and step, (...) int32, states (..., D) whose achieved goals
are to be the new goals, and (...) bool whether there are such. Several states of one row, (B, J), that come from its own episode are in order of
time."""

NEARBY_GOAL = "nearby_goal"
"""The note of the replay that intersections need: a row of the goal table that is near the transition's end, or -1."""


def goal_source(table: GoalTable, config: BatchConfig) -> GoalSource:
    """The source that a config asks for: one, or several, each for its share of the rows.

    Args:
      table: the demonstrations' goals, with their observations.
      config: strategy and weights.
    """
    sources, weights = zip(*config.sources, strict=True)
    draw = [_single_source(source, table, config) for source in sources]

    def mixed(key: Array, replay: ReplayState, rows: Array, steps: Array) -> tuple[Array, Array]:
        key_choice, *keys = jax.random.split(key, len(sources) + 1)
        choice = choose_sources(key_choice, rows.shape[0], weights)
        drawn = draw[0](keys[0], replay, rows, steps)
        for index in range(1, len(sources)):
            drawn = tree_where(choice == index, draw[index](keys[index], replay, rows, steps), drawn)
        return drawn

    return mixed


def _single_source(source: Source, table: GoalTable, config: BatchConfig) -> GoalSource:
    def draw(key: Array, replay: ReplayState, rows: Array, steps: Array) -> tuple[Array, Array]:
        key_row, key_step = jax.random.split(key)
        lengths, observations, found = replay.episodes.lengths, replay.episodes.observations, jnp.ones(rows.shape, bool)
        if source == "task_conditioned":
            return table.observations[uniform_index(key_row, rows.shape, table.count)], found
        if source == "random":
            others = sample_episodes(key_row, replay, rows.size).reshape(rows.shape)
            chosen = hindsight_steps(key_step, jnp.zeros_like(others), lengths[others], source="episode")
            return observations[others, chosen], found
        if source == "joint_intersection":
            nearby = replay.notes[NEARBY_GOAL][rows]
            chosen, found = intersection_steps(key_step, steps, lengths[rows], nearby >= 0)
            if config.intersection_goals == "rollout":
                return observations[rows, chosen], found
            return table.observations[jnp.take_along_axis(nearby, chosen[:, None] - 1, axis=1)[:, 0]], found
        chosen = hindsight_steps(key_step, steps, lengths[rows], source=source)
        return observations[rows, jnp.sort(chosen, axis=-1) if chosen.ndim > 1 else chosen], found

    return draw


def hindsight_steps(key: Array, steps: Array, lengths: Array, *, source: Literal["final", "future", "episode"]) -> Array:
    """Chooses, for each transition, the step of its own episode whose achieved goal becomes the new goal.

    Transition t leads from state t to state t + 1, so "future" is uniform over the states t + 1 .. length, all of them included.

    Args:
      key: random key.
      steps: (...) int32, index t of the transition in its episode, 0 <= t < length.
      lengths: (...) int32, number of transitions of the episode.
      source: see the module's docstring.

    Returns:
      (...) int32 index of a state, 0 <= index <= length.
    """
    if source not in ("final", "future", "episode"):
        raise ValueError(f"source = {source!r} is not the transition's own episode: choose final, future or episode")
    if source == "final":
        return lengths
    first = steps + 1 if source == "future" else jnp.zeros_like(steps)
    return first + uniform_index(key, steps.shape, lengths + 1 - first)


def intersection_steps(key: Array, steps: Array, lengths: Array, is_near: Array) -> tuple[Array, Array]:
    """As `hindsight_steps` with "future", but uniform over those of the states t + 1 .. length that lie near a demonstrated goal.

    Args:
      key: random key.
      steps, lengths: (B,) int32.
      is_near: (B, T) bool per transition of the episode, whether the state that it leads to lies near a goal; what is not later is not looked at.

    Returns:
      (B,) int32 index of a state, and (B,) bool whether there is one; where there is none, the index is 1.
    """
    transition = jnp.arange(is_near.shape[1])[None]
    eligible = is_near & (transition >= steps[:, None]) & (transition < lengths[:, None])
    count = jnp.sum(eligible, axis=1)
    rank = uniform_index(key, steps.shape, jnp.maximum(count, 1)) + 1
    return jnp.argmax(jnp.cumsum(eligible, axis=1) == rank[:, None], axis=1).astype(jnp.int32) + 1, count > 0


def choose_sources(key: Array, num_rows: int, weights: Sequence[Array | float]) -> Array:
    """Draws a source for each row, with probabilities in proportion to the weights: (num_rows,) int32 index of a weight."""
    if len(weights) == 1:
        return jnp.zeros(num_rows, jnp.int32)
    thresholds = jnp.cumsum(jnp.asarray(weights, jnp.float32))
    drawn = jax.random.uniform(key, (num_rows, 1)) * thresholds[-1]
    return jnp.sum(drawn >= thresholds[None, :-1], axis=1, dtype=jnp.int32)
