"""Held actions for environments of Gymnasium. Processes that step one import this, so it must import nothing but Gymnasium."""

from __future__ import annotations

from typing import Any

import gymnasium


class HeldActions(gymnasium.Wrapper):
    """Takes each action `num_held` times, or until the episode is over or the goal is reached; what it returns is of the last time."""

    def __init__(self, env: gymnasium.Env, num_held: int, success_key: str | None, success_reward: float):
        """The goal is reached where the info says so under `success_key`, or, where that is None, the reward is as high as `success_reward`."""
        super().__init__(env)
        self._num_held, self._success_key, self._success_reward = num_held, success_key, success_reward

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        for _ in range(self._num_held):
            observation, reward, terminated, truncated, info = self.env.step(action)
            reached = float(reward) >= self._success_reward if self._success_key is None else bool(info[self._success_key])
            if terminated or truncated or reached:
                break
        return observation, reward, terminated, truncated, info


def make_held(make: Any, num_held: int, success_key: str | None, success_reward: float) -> gymnasium.Env:
    """Calls `make`, and has the environment's actions held."""
    return HeldActions(make(), num_held, success_key, success_reward)
