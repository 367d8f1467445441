"""When a run is stuck and learns anew, see `core.train.reset_networks`: decided by nothing but its evaluations.

What an agent happens to solve first decides what it can learn later, and some never learn the rest, whatever they see (the primacy bias; Nikishin et
al., 2022). A fresh agent that begins with the same replay mostly does.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

SHARE = 0.2
"""Of a run's steps, without a better evaluation, after which it is stuck, if its agent needed no more for the best one."""
DEVIATIONS = 2.0
"""An evaluation is better than another one if it is more than so many of that one's standard errors above it."""


def resets(env_steps: Sequence[int], success: Sequence[float], *, of: int, num_episodes: int, enough: float) -> list[int]:
    """The environment steps at which a run began anew.

    An agent is stuck when no evaluation was better than its best for a fifth of the run, and for as long as it had taken to that one. It begins anew
    if as many steps are left, and if it solves something, and not `enough`.

    Args:
      env_steps: (N,) of the run's evaluations.
      success: (N,) in [0, 1], of them.
      of: environment steps of the whole run.
      num_episodes: of each evaluation.
      enough: success with which an agent is left alone.

    Example:
      >>> resets([10, 20, 30, 40, 50], [0.0, 0.7, 0.7, 0.72, 0.7], of=80, num_episodes=100, enough=0.95)
      [40]
    """
    found: list[int] = []
    began = reached = 0
    best = 0.0
    for steps, solved in zip(env_steps, success, strict=True):
        if solved >= enough or solved > best + DEVIATIONS * np.sqrt(best * (1.0 - best) / num_episodes):
            best, reached = solved, steps
        took = reached - began
        if 0.0 < best < enough and steps - reached >= max(took, SHARE * of) and of - steps >= took:
            found.append(steps)
            began, reached, best = steps, steps, 0.0
    return found
