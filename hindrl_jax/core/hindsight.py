"""Hindsight relabelling: which goal a transition is told, after the fact, to have been meant for.

Sources of goals (Andrychowicz et al., HER, 2017; Davchev et al., HinDRL, 2021; thesis sections 2.3.3 and 4.1.2):

    final               the last goal reached in the transition's own episode
    future              a goal reached later in that episode; the thesis's "rollout-conditioned" (eq. 4.3)
    episode             any goal reached in that episode
    random              any goal reached in any episode of the replay
    task_conditioned    any goal reached in the demonstrations (eq. 4.2)
    joint_intersection  a goal reached later in that episode that lies within epsilon of a demonstrated one, or the demonstrated one itself

The strategy joint_union takes task_conditioned with probability `union_sampling_ratio`, else future (eq. 4.4); mixture takes any sources with any
weights. A row whose intersection is empty is not relabelled. What lies within epsilon of what is noted while an episode is lived
(`goals.nearby_goal`), which makes the intersection, "exceptionally slow" in the thesis, nearly as cheap as the others. Differences from HinDRL in the
form that takes demonstrated goals: one goal near each state is noted for good, so a goal is drawn by the states that it lies near.

Where observations hold what an episode is about (`types.RetellableEnvironment`), states from the same sources take the place of that, and no goal is
changed; intersections, which compare goals, have no meaning there.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import jax
import jax.numpy as jnp

from hindrl_jax.base.types import Array
from hindrl_jax.core.randomness import uniform_index


def hindsight_steps(key: Array, steps: Array, lengths: Array, *, source: Literal["final", "future", "episode"]) -> Array:
    """Chooses, for each transition, the step of its own episode whose achieved goal becomes the new goal.

    Transition t leads from state t to state t + 1, so "future" is uniform over the states t + 1 .. length, all of them included.

    Args:
      key: random key.
      steps: (B,) int32, index t of the transition in its episode, 0 <= t < length.
      lengths: (B,) int32, number of transitions of the episode.
      source: see the module's docstring.

    Returns:
      (B,) int32 index of a state, 0 <= index <= length.
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
      is_near: (B, T + 1) bool per state of the episode; what lies outside t + 1 .. length is not looked at.

    Returns:
      (B,) int32 index of a state, and (B,) bool whether there is one; where there is none, the index is 0.
    """
    state = jnp.arange(is_near.shape[1])[None]
    eligible = is_near & (state > steps[:, None]) & (state <= lengths[:, None])
    count = jnp.sum(eligible, axis=1)
    rank = uniform_index(key, steps.shape, jnp.maximum(count, 1)) + 1
    return jnp.argmax(jnp.cumsum(eligible, axis=1) == rank[:, None], axis=1).astype(jnp.int32), count > 0


def choose_sources(key: Array, num_rows: int, weights: Sequence[Array | float]) -> Array:
    """Draws a source for each row, with probabilities in proportion to the weights: (num_rows,) int32 index of a weight."""
    if len(weights) == 1:
        return jnp.zeros(num_rows, jnp.int32)
    thresholds = jnp.cumsum(jnp.asarray(weights, jnp.float32))
    drawn = jax.random.uniform(key, (num_rows, 1)) * thresholds[-1]
    return jnp.sum(drawn >= thresholds[None, :-1], axis=1, dtype=jnp.int32)
