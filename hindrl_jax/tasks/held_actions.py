"""Held actions for environments of Gymnasium. Processes that step one import this, so it must import nothing but Gymnasium and NumPy."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

REWARD_TOLERANCE = 1e-6
"""Relative, and absolute for rewards below 1: an environment may give a reward as float32 and compute it as float64, or the other way round."""


def is_success(said: Any, rewards: Any, success_key: str | None, success_reward: float) -> np.ndarray:
    """Whether steps reach their goals.

    Args:
      said: what the info holds under `success_key`, (...) or with axes of one number after that.
      rewards: (...)
      success_key: where the info says so; None where the reward does, by being as high as `success_reward`.
      success_reward: the reward of reaching the goal exactly.

    Returns:
      (...) bool.

    Raises:
      ValueError: if what is said is not one number, or truth, for each.
    """
    rewards = np.asarray(rewards, np.float64)
    if success_key is None:
        return rewards >= success_reward - REWARD_TOLERANCE * max(1.0, abs(success_reward))
    try:
        values = np.asarray(said, np.float64).reshape(rewards.shape)
    except (TypeError, ValueError):
        values = np.full(rewards.shape, np.nan)
    if np.isnan(values).any():
        raise ValueError(f"info[{success_key!r}] = {said} does not say whether the goal is reached: it must be one truth value at each step")
    return values > 0.5


class HeldActions(gymnasium.Wrapper):
    """Takes each action `num_held` times, or until the episode is over or the goal is reached; what it returns is of the last time."""

    def __init__(self, env: gymnasium.Env, num_held: int, success_key: str | None, success_reward: float):
        """The goal is reached where the info says so under `success_key`, or, where that is None, the reward is as high as `success_reward`."""
        super().__init__(env)
        self._num_held, self._success_key, self._success_reward = num_held, success_key, success_reward

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        for _ in range(self._num_held):
            observation, reward, terminated, truncated, info = self.env.step(action)
            said = None if self._success_key is None else info.get(self._success_key)
            if terminated or truncated or is_success(said, reward, self._success_key, self._success_reward):
                break
        return observation, reward, terminated, truncated, info


def make_held(make: Any, num_held: int, success_key: str | None, success_reward: float) -> gymnasium.Env:
    """Calls `make`, and has the environment's actions held."""
    return HeldActions(make(), num_held, success_key, success_reward)
