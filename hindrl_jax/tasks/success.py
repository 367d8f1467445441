"""What says that an environment of Gymnasium is solved. Processes that step one import this, so it must import nothing but NumPy."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

REWARD_TOLERANCE = 1e-6
"""Relative, and absolute for rewards below 1: an environment may give a reward as float32 and compute it as float64, or the other way round."""
SUCCESS_KEYS = ("is_success", "success")
"""In the info; the latter in gymnasium-robotics's mazes and hands, and in Meta-World."""


@dataclasses.dataclass(frozen=True)
class SuccessRule:
    """Which steps solve the task; see `solved` for the order in which its fields count."""

    key: str | None = None
    """Where the info of every step says it."""
    reward: float | None = None
    """The least reward that says it."""

    def solved(self, info: dict[str, Any], rewards: Any, terminated: Any) -> np.ndarray:
        """Whether steps solve the task: where the info says it under `key`, that counts; else rewards as high as `reward`; where there is neither,
        a step that ends the episode with a reward above 0, unless the info of this very step says it otherwise under one of `SUCCESS_KEYS`.

        Args:
          info: of one environment, or of several as Gymnasium's vector environments give it, with axes of one number more at most.
          rewards: (...)
          terminated: (...) bool.

        Returns:
          (...) bool.

        Raises:
          ValueError: if the info does not say it, or not as one number, or truth, for each.
        """
        rewards = np.asarray(rewards, np.float64)
        if self.key is not None:
            if not np.all(info.get(f"_{self.key}", self.key in info)):
                raise ValueError(f"info has no {self.key!r}, which it had at the first step")
            return _truths(info, self.key, np.ones(rewards.shape, bool))
        if self.reward is not None:
            return rewards >= self.reward - REWARD_TOLERANCE * max(1.0, abs(self.reward))
        solved = np.asarray(terminated, bool) & (rewards > 0.0)
        for key in reversed(SUCCESS_KEYS):  # the first of them has the last word
            if key in info:
                says = np.broadcast_to(np.asarray(info.get(f"_{key}", True), bool), rewards.shape)
                solved = np.where(says, _truths(info, key, says), solved)
        return solved


def _truths(info: dict[str, Any], key: str, says: np.ndarray) -> np.ndarray:
    """(...) bool, what the info holds under a key, where it says something, `says` (...) bool; else False."""
    try:
        values = np.asarray(info[key], np.float64).reshape(says.shape)
    except (TypeError, ValueError):
        values = np.full(says.shape, np.nan)
    if np.isnan(values[says]).any():
        raise ValueError(f"info[{key!r}] = {info[key]} does not say whether the goal is reached: it must be one truth value at each step")
    return says & (values > 0.5)
