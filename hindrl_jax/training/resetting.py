"""When an agent is stuck, and a fresh one learns in its place, see `core.train.reset_networks`: decided by nothing but evaluations.

What an agent happens to solve first decides what it can learn later, and some never learn the rest, whatever they see (the primacy bias; Nikishin et
al., 2022). A fresh agent that begins with the same replay mostly does.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

SHARE = 0.2
"""An agent is given this share of the run's environment steps, at least, to get better than it was."""
DEVIATIONS = 2.0
"""It is better if an evaluation is more than so many standard errors above the last one that counted as better."""
SOME = 0.2
"""An agent that solves less than this share of its episodes is not stuck but at its beginning, and its replay has little to learn from."""


def resets(env_steps: Sequence[int], success: Sequence[float], *, of: int, num_episodes: int, enough: float) -> list[int]:
    """The environment steps at which a run was stuck, and went on with a fresh agent.

    Each agent has a mark, the last of its evaluations that was better than the mark before. It is stuck when it has been without a better one for
    `SHARE` of the run, and for as long as it took it to reach its mark, if the mark is at least `SOME` and below `enough`. Then there is a fresh
    agent, if as much time is left for it.

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
    mark = 0.0
    for steps, solved in zip(env_steps, success, strict=True):
        if solved >= enough or solved > mark + DEVIATIONS * math.sqrt(mark * (1.0 - mark) / num_episodes):
            mark, reached = solved, steps
        patience = max(reached - began, SHARE * of)
        if SOME <= mark < enough and steps - reached >= patience and of - steps >= patience:
            found.append(steps)
            began, reached, mark = steps, steps, 0.0
    return found
