"""Held actions for environments of Gymnasium. Processes that step one import this, so it must import nothing but Gymnasium and NumPy."""

from __future__ import annotations

from typing import Any

import gymnasium

from hindrl_jax.tasks.success import SuccessRule


class HeldActions(gymnasium.Wrapper):
    """Takes each action `num_held` times, or until the episode is over or, by a rule, the task is solved; what it returns is of the last time."""

    def __init__(self, env: gymnasium.Env, num_held: int, rule: SuccessRule | None):
        super().__init__(env)
        self._num_held, self._rule = num_held, rule

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        for _ in range(self._num_held):
            observation, reward, terminated, truncated, info = self.env.step(action)
            if terminated or truncated or (self._rule is not None and self._rule.solved(info, reward, terminated)):
                break
        return observation, reward, terminated, truncated, info


def make_held(make: Any, num_held: int, rule: SuccessRule | None) -> gymnasium.Env:
    """Calls `make`, and has the environment's actions held."""
    return HeldActions(make(), num_held, rule)
