"""Scripted experts of two Fetch tasks of gymnasium-robotics. They act from observations, not from states.

An observation holds the gripper's position (3), and where there is an object its position (3), the displacement to it from the gripper (3) and the
positions of the two fingers (2). Actions are displacements of the gripper (3), 1 being 5 cm, and the opening or closing of the fingers (1).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from hindrl_jax.base.checks import check, check_types

_STEP = 0.05  # m, the displacement of an action of 1
_BEHIND = 0.5  # share of a commanded displacement that the arm makes within the step, more or less


@dataclass(frozen=True)
class _FetchExpert:
    """What both experts share."""

    tasks: ClassVar[str]  # how the ids of its environments begin

    noise: float = 0.1
    """Standard deviation of the noise on each entry of an action, which lies in [-1, 1]."""

    def __post_init__(self) -> None:
        check_types(self)
        check(self, noise=(self.noise >= 0.0, "0 or more"))

    def _command(self, towards: np.ndarray, fingers: float, rng: np.random.Generator) -> np.ndarray:
        """The action (4,) that moves the gripper by `towards` (3,), in m; fingers 1 opens, -1 closes."""
        displacement = towards / (_STEP * _BEHIND) + self.noise * rng.standard_normal(3)
        return np.clip(np.append(displacement, fingers), -1.0, 1.0).astype(np.float32)


@dataclass(frozen=True)
class FetchReachExpert(_FetchExpert):
    """Straight to the goal."""

    tasks: ClassVar[str] = "FetchReach"

    def act(self, observation: dict[str, np.ndarray], rng: np.random.Generator) -> np.ndarray:
        """Observation -> action (4,)."""
        return self._command(observation["desired_goal"] - observation["achieved_goal"], 0.0, rng)


@dataclass(frozen=True)
class FetchPickAndPlaceExpert(_FetchExpert):
    """Above the object, down to it, grasp, and to the goal. It has no memory: each action follows from the observation alone."""

    tasks: ClassVar[str] = "FetchPickAndPlace"

    def act(self, observation: dict[str, np.ndarray], rng: np.random.Generator) -> np.ndarray:
        """Observation -> action (4,)."""
        seen = observation["observation"]
        to_object, fingers = seen[6:9], seen[9:11]
        beside, above = np.linalg.norm(to_object[:2]), -to_object[2]
        if beside < 0.015 and abs(above) < 0.015:  # the object is between the fingers
            grasped = fingers.sum() < 0.052  # it is 5 cm wide
            return self._command((observation["desired_goal"] - observation["achieved_goal"]) if grasped else to_object, -1.0, rng)
        if beside < 0.015:
            return self._command(to_object, 1.0, rng)
        return self._command(to_object + np.array([0.0, 0.0, 0.05]), 1.0, rng)


EXPERTS = (FetchReachExpert, FetchPickAndPlaceExpert)
