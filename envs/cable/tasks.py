"""The two cable tasks of the thesis: when they are solved. `rules` has all else."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import jax.numpy as jnp
import numpy as np

from hindrl_jax.base.checks import check
from hindrl_jax.base.types import Array
from hindrl_jax.envs import rotations
from hindrl_jax.envs.cable import geometry
from hindrl_jax.envs.cable.rules import CableTask, tip_error
from hindrl_jax.envs.cable.types import Scene


@dataclass(frozen=True)
class BringNear(CableTask):
    """The tips of plug and socket are to be close to each other (thesis 3.2.3). The cables are too short for one arm to do it alone."""

    name: ClassVar[str] = "BringNear"

    position_tolerance: float = 0.02
    """Distance in m within which the tips count as near."""

    def __post_init__(self):
        super().__post_init__()
        check(self, position_tolerance=_between_tips(self.position_tolerance))

    @property
    def depth(self) -> float:
        return 0.0

    @property
    def tip_tolerance(self) -> float:
        return self.position_tolerance

    def is_solved(self, scene: Scene) -> Array:
        return _distance(tip_error(scene, self.depth)) < self.position_tolerance


@dataclass(frozen=True)
class CableInsertion(CableTask):
    """The plug is to be in the socket: its tip at the bore's bottom, and both axes opposite (thesis 3.2.4)."""

    name: ClassVar[str] = "CableInsertion"

    horizon: int = 750
    """Number of steps, of 50 ms each, after which an episode is truncated."""
    position_tolerance: float = 0.003
    """Distance in m of the plug's tip from the bore's bottom within which it counts as inserted."""
    rotation_tolerance: float = float(np.round(np.radians(1.71), 5))
    """Angle in rad between plug and socket within which it does."""

    def __post_init__(self):
        super().__post_init__()
        check(
            self,
            position_tolerance=_between_tips(self.position_tolerance),
            rotation_tolerance=(0 < self.rotation_tolerance < np.pi, "greater than 0 and less than pi, since heads hang side by side at first"),
        )

    @property
    def depth(self) -> float:
        return geometry.DEPTH

    @property
    def tip_tolerance(self) -> float:
        return self.position_tolerance

    def is_solved(self, scene: Scene) -> Array:
        plug, socket = scene.head_rotations[:, :, 2]
        is_there = _distance(tip_error(scene, self.depth)) < self.position_tolerance
        return is_there & (rotations.angle(plug, -socket) < self.rotation_tolerance)


def _between_tips(tolerance: float) -> tuple[bool, str]:
    """Whether a distance in m is one that hanging tips do not keep of themselves, and what it must be."""
    apart = float(np.linalg.norm(geometry.HANGING_GRIPS[0] - geometry.HANGING_GRIPS[1]))
    return 0 < tolerance < apart, f"greater than 0 and less than {apart:.2f}, as far as hanging tips are apart"


def _distance(vector: Array) -> Array:
    return jnp.sqrt(jnp.sum(jnp.square(vector)))
