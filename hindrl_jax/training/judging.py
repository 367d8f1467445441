"""Demonstrations as the environment judges them, where episodes come with goals of their own: they end at the goal, or go on there."""

from __future__ import annotations

import numpy as np

from hindrl_jax.base.environments import Environment, holds_goal
from hindrl_jax.base.errors import UserError
from hindrl_jax.base.steppers import gives_goals
from hindrl_jax.base.types import Episodes


def as_judged_by(env: Environment, demonstrations: Episodes) -> Episodes:
    """Demonstrations that end where an episode of the environment would, so that the same ones serve whether the goal is to be reached or held.

    Args:
      env: the task.
      demonstrations: numpy leaves (..., N, T, ...), rewards 1 at each step at the goal and 0 elsewhere.

    Returns:
      Where the goal is to be reached, each up to the first step that reaches it; else as they are.

    Raises:
      UserError: if the goal is to be held, and a reward is neither 0 nor 1.
    """
    if not gives_goals(env):
        return demonstrations
    rewards = np.where(_taken(demonstrations), demonstrations.rewards, 0.0)
    says_success = np.isin(rewards, (0.0, 1.0))
    if holds_goal(env) and not says_success.all():
        raise UserError(
            f"a demonstration has a reward of {rewards[~says_success][0]:g}, and {env.name}, where the goal is to be held, takes 1 at the goal and 0 "
            "elsewhere: convert with --sparse-rewards, or choose success = reached"
        )
    if holds_goal(env) or not says_success.all():
        return demonstrations
    lengths = steps_to_goal(demonstrations)
    last = np.arange(rewards.shape[-1]) == lengths[..., None] - 1
    return demonstrations.replace(lengths=lengths, rewards=(rewards * last).astype(np.float32))


def steps_to_goal(demonstrations: Episodes) -> np.ndarray:
    """Steps up to the first that is rewarded, of a demonstration without one all of them: (..., N) int32."""
    rewarded = (np.asarray(demonstrations.rewards) > 0.0) & _taken(demonstrations)
    lengths = np.asarray(demonstrations.lengths)
    return np.where(rewarded.any(axis=-1), rewarded.argmax(axis=-1) + 1, lengths).astype(np.int32)


def _taken(demonstrations: Episodes) -> np.ndarray:
    """Which steps are no padding: (..., N, T) bool."""
    return np.arange(np.shape(demonstrations.rewards)[-1]) < np.asarray(demonstrations.lengths)[..., None]
