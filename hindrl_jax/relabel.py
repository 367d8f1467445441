"""Hindsight relabelling: which goal a transition is told, after the fact, to have been meant for.

Strategies (Andrychowicz et al., HER, 2017; Davchev et al., HinDRL, 2021; thesis section 4.1.2):
  final             the last goal reached in the transition's own episode
  future            a goal reached later in that episode; the thesis's "rollout-conditioned" (eq. 4.3)
  episode           any goal reached in that episode
  task_conditioned  any goal reached in the demonstrations (eq. 4.2)
  joint_union       task_conditioned with probability `union_sampling_ratio`, else future (eq. 4.4)
"""

from __future__ import annotations

from typing import Literal

import jax
import jax.numpy as jnp

from hindrl_jax.config import Strategy
from hindrl_jax.goals import GoalTable, sample_goals
from hindrl_jax.randomness import uniform_index
from hindrl_jax.types import Array


def hindsight_steps(key: Array, steps: Array, lengths: Array, *, strategy: Literal["final", "future", "episode"]) -> Array:
    """Chooses, for each transition, the step of its own episode whose achieved goal becomes the new goal.

    Transition t leads from state t to state t + 1, so "future" is uniform over the states t + 1 .. length, all of them included.

    Args:
      key: random key.
      steps: (B,) int32, index t of the transition in its episode, 0 <= t < length.
      lengths: (B,) int32, number of transitions of the episode.
      strategy: see the module's docstring.

    Returns:
      (B,) int32 index of a state, 0 <= index <= length.
    """
    if strategy not in ("final", "future", "episode"):
        raise ValueError(f"strategy = {strategy!r} takes no goals from the episode: choose final, future or episode")
    if strategy == "final":
        return lengths
    first = steps + 1 if strategy == "future" else jnp.zeros_like(steps)
    return first + uniform_index(key, steps.shape, lengths + 1 - first)


def relabelled_goals(
    key: Array,
    table: GoalTable,
    hindsight_goals: Array,
    *,
    strategy: Strategy,
    union_sampling_ratio: float,
) -> Array:
    """Chooses between the goals of the rollout and those of the demonstrations.

    Args:
      key: random key.
      table: goals reached in the demonstrations.
      hindsight_goals: (B, G) goals reached in the transitions' own episodes, see `hindsight_steps`.
      strategy: see the module's docstring.
      union_sampling_ratio: for joint_union, the probability that a goal comes from the demonstrations.

    Returns:
      (B, G) goals.
    """
    if strategy in ("final", "future", "episode"):
        return hindsight_goals
    key_goal, key_union = jax.random.split(key)
    demonstrated = sample_goals(key_goal, table, hindsight_goals.shape[0])
    if strategy == "task_conditioned":
        return demonstrated
    if strategy != "joint_union":
        raise ValueError(f"unknown strategy {strategy!r}: choose final, future, episode, task_conditioned or joint_union")
    from_demonstration = jax.random.bernoulli(key_union, union_sampling_ratio, (hindsight_goals.shape[0], 1))
    return jnp.where(from_demonstration, demonstrated, hindsight_goals)
