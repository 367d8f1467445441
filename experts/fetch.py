"""Scripted experts of the four Fetch tasks of gymnasium-robotics. They act from observations, not from states, and have no memory: each action
follows from the observation alone.

An observation holds the gripper's position (3), and where there is an object its position (3), the displacement to it from the gripper (3), the
positions of the two fingers (2), the object's orientation (3), its velocity less the gripper's (3), its angular velocity (3) and the gripper's
velocity (3); velocities are displacements per step. Actions are displacements of the gripper (3), 1 being 5 cm, and the opening or closing of the
fingers (1).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from hindrl_jax.base.checks import check, check_types

_STEP = 0.05  # m, the displacement of an action of 1
_BEHIND = 0.5  # share of a commanded displacement that the arm makes within the step, more or less
_PACE = 0.033  # m, the displacement of a step where an action of 1 is repeated


@dataclass(frozen=True)
class _FetchExpert:
    """What all of them share."""

    tasks: ClassVar[str]  # how the ids of its environments begin

    noise: float = 0.1
    """Standard deviation of the noise on each entry of an action, which lies in [-1, 1]."""

    def __post_init__(self) -> None:
        check_types(self)
        check(self, noise=(self.noise >= 0.0, "0 or more"))

    @classmethod
    def plays(cls, env_id: str) -> bool:
        """Whether it is an expert of the environment that Gymnasium knows by that id: of its task, with a sparse reward."""
        return env_id.startswith(f"{cls.tasks}-")

    def _command(self, towards: np.ndarray, fingers: float, rng: np.random.Generator) -> np.ndarray:
        """The action (4,) that moves the gripper by `towards` (3,), in m; fingers 1 opens, -1 closes."""
        displacement = towards / (_STEP * _BEHIND) + self.noise * rng.standard_normal(3)
        return np.clip(np.append(displacement, fingers), -1.0, 1.0).astype(np.float32)

    def _move(self, displacement: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """The action (4,) by which the gripper, on its way already, makes a displacement (3,) in the next step, in m."""
        return self._command(displacement * (_STEP * _BEHIND / _PACE), 0.0, rng)

    def _go_behind(self, gripper: np.ndarray, thing: np.ndarray, place: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """The action (4,) that brings the gripper (3,), over a thing (3,) on the table, to a place (2,) beside it."""
        towards = np.append(place - gripper[:2], 0.0)
        height = gripper[2] - thing[2]
        if np.linalg.norm(towards) < 0.015:
            towards[2] = -0.005 - height
        else:
            towards[2] = 0.055 - height
            if height < 0.035 and np.linalg.norm(gripper[:2] - thing[:2]) < 0.09:
                towards[:2] = 0.0  # up first, so as not to touch it
        return self._move(towards, rng)


@dataclass(frozen=True)
class FetchReachExpert(_FetchExpert):
    """Straight to the goal."""

    tasks: ClassVar[str] = "FetchReach"

    def act(self, observation: dict[str, np.ndarray], rng: np.random.Generator) -> np.ndarray:
        """Observation -> action (4,)."""
        return self._command(observation["desired_goal"] - observation["achieved_goal"], 0.0, rng)


@dataclass(frozen=True)
class FetchPickAndPlaceExpert(_FetchExpert):
    """Above the object, down to it, grasp, and to the goal."""

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


@dataclass(frozen=True)
class FetchPushExpert(_FetchExpert):
    """Over the object to where the goal lies straight behind it, down, and forwards; up again and round where the object has slipped aside."""

    tasks: ClassVar[str] = "FetchPush"

    def act(self, observation: dict[str, np.ndarray], rng: np.random.Generator) -> np.ndarray:
        """Observation -> action (4,)."""
        gripper, thing = observation["observation"][:3], observation["observation"][3:6]
        way = (observation["desired_goal"] - thing)[:2]
        distance = float(np.linalg.norm(way))
        ahead = way / max(distance, 1e-6)
        behind, beside = _along(gripper[:2] - thing[:2], ahead)
        if gripper[2] - thing[2] < 0.01 and behind < 0.0 and np.linalg.norm(beside) < 0.015:
            gap = max(-behind - 0.045, 0.0)  # 4.5 cm lie between the centres where they touch
            return self._move(np.append(min(distance + gap, _PACE) * ahead - beside, thing[2] - 0.01 - gripper[2]), rng)
        return self._go_behind(gripper, thing, thing[:2] - 0.08 * ahead, rng)


@dataclass(frozen=True)
class FetchSlideExpert(_FetchExpert):
    """Over the puck to where it can be hit, down, and at it so fast that it comes to rest at the goal. After the hit nothing can be done.

    How a puck slides, and how it flies off a gripper, was measured in the simulation. It is heavy: it does not reach goals that are farther away than
    half a metre, more or less, nor those that lie far aside.
    """

    tasks: ClassVar[str] = "FetchSlide"

    def act(self, observation: dict[str, np.ndarray], rng: np.random.Generator) -> np.ndarray:
        """Observation -> action (4,)."""
        seen = observation["observation"]
        gripper, puck, puck_velocity = seen[:3], seen[3:6], (seen[14:17] + seen[20:23])[:2]
        wanted = _sliding_velocity((observation["desired_goal"] - puck)[:2])
        hit, contact = _hit(wanted)
        moves, low = np.linalg.norm(puck_velocity) > 0.002, gripper[2] - puck[2] < 0.02
        if moves:
            touches = low and np.linalg.norm(gripper[:2] - puck[:2]) < 0.06
            is_fast = np.linalg.norm(puck_velocity) > 0.9 * np.linalg.norm(wanted)
            return self._move(np.append(hit, puck[2] - 0.005 - gripper[2]) if touches and not is_fast else np.zeros(3), rng)
        speed = max(float(np.linalg.norm(hit)), 1e-6)
        ahead, here = hit / speed, gripper[:2] - puck[:2] - contact
        behind, beside = _along(here, ahead)
        if low and behind < 0.01 and np.linalg.norm(beside) < 0.012:
            # The gripper is fast at the beginning of a step and slow at its end, so it is to touch the puck at the same moment of a step always.
            steps = -behind / speed
            whole = round(steps - _MOMENT)
            pace = float(np.clip(steps / (whole + _MOMENT), 0.6, 1.5)) if whole >= 1 else 1.0
            return self._move(np.append(pace * hit - 0.5 * beside, puck[2] - 0.005 - gripper[2]), rng)
        return self._go_behind(gripper, puck, puck[:2] + contact - 3.0 * hit, rng)


_SLOWING = 0.1 * 9.8 * 0.04**2  # m per step and step: the table's friction, steps of 0.04 s
_MOMENT = 0.4  # of a step, when the gripper touches the puck
_NORMAL, _TANGENTIAL = 1.19, 0.26  # the puck's velocity over the gripper's, across the face that hits and along it; measured


def _along(displacement: np.ndarray, ahead: np.ndarray) -> tuple[float, np.ndarray]:
    """A displacement (2,) as its part along a unit vector, and what remains (2,)."""
    part = float(displacement @ ahead)
    return part, displacement - part * ahead


def _sliding_velocity(way: np.ndarray) -> np.ndarray:
    """The velocity (2,), per step, at which a puck comes to rest after a displacement (2,).

    MuJoCo's friction cone is a pyramid here: it slows the faster of x and y alone until both are equally fast, then each by half. So with
    |x| > |y| the displacement is ((x^2 + y^2) / 2, x y) over the deceleration, whose sum and difference are squares.
    """
    total, difference = way[0] + way[1], way[0] - way[1]
    total, difference = (np.sign(part) * np.sqrt(2.0 * _SLOWING * abs(part)) for part in (total, difference))
    return np.array([total + difference, total - difference]) / 2.0


def _hit(wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How a puck is given a velocity (2,): the gripper's velocity (2,), and where it is from the puck, (2,), when they touch.

    It hits with the face that looks along the larger part; the part along the face moves the puck by friction alone. As fast as the arm can.
    """
    across = int(abs(wanted[1]) > abs(wanted[0]))
    hit = wanted / np.where(np.arange(2) == across, _NORMAL, _TANGENTIAL)
    contact = np.zeros(2)
    contact[across] = -np.sign(wanted[across]) * (0.0385, 0.0414)[across]  # half a gripper and the puck's radius
    return np.clip(hit, -_PACE, _PACE), contact


EXPERTS = (FetchReachExpert, FetchPickAndPlaceExpert, FetchPushExpert, FetchSlideExpert)
