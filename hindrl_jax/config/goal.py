"""Epsilon, the goals taken from demonstrations, and the goals of rollouts."""

from __future__ import annotations

import dataclasses
from typing import Literal

from hindrl_jax.base.checks import check, check_types


@dataclasses.dataclass(frozen=True)
class GoalConfig:
    """Epsilon, the goals taken from demonstrations, and the behavioural goals."""

    epsilon_steps: int = 1
    """Distance in steps between the demonstration states whose mean distance gives epsilon (m of thesis eq. 4.7); 0 gives epsilon 0."""
    epsilon_deviations: float = 0.0
    """Weight of the standard deviation of these distances in epsilon (k of thesis eq. 4.7)."""
    epsilon: float | None = None
    """Epsilon itself, the same in all dimensions of the goal, in place of the one that the demonstrations give."""
    epsilon_filtering: bool = False
    """Drop demonstration goals that lie within epsilon of the last kept one (thesis algorithm 6, Smooth HinDRL)."""
    behavioural_goals: Literal["final_demonstration_states", "task", "environment"] = "final_demonstration_states"
    """Goal of a rollout: the end of a random demonstration (thesis algorithm 5), the task's one constant goal (original code; where the environment
    knows of none, the mean of these ends), or, where episodes come with goals of their own (Gymnasium's environments), that goal."""

    def __post_init__(self) -> None:
        check_types(self)
        check(
            self,
            epsilon_steps=(self.epsilon_steps >= 0, "0 or more"),
            epsilon_deviations=(self.epsilon_deviations >= 0.0, "0 or more"),
            epsilon=(self.epsilon is None or self.epsilon >= 0.0, "0 or more, or None"),
        )
        if self.epsilon is not None and self.epsilon_steps > 1:
            raise ValueError(
                f"epsilon_steps = {self.epsilon_steps} is of no use while epsilon = {self.epsilon} is given: set one to 1 or the other to None"
            )
