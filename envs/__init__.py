"""The project's own environments, each in a folder of its own: types, rules and viewer apart, and the physics of the Panda shared.

Public are the six tasks below, the folders' names (`envs.grid`, `envs.reach`, `envs.cable`, `envs.panda`), `envs.rotations`, and `envs.drawing`
with each task's `viewer`, which the dynamics never import.
"""

from hindrl_jax.envs.cable import BringNear, CableInsertion
from hindrl_jax.envs.grid import FixedGridPickAndPlace, GridPickAndPlace
from hindrl_jax.envs.reach import FixedParameterizedReach, ParameterizedReach

__all__ = ["BringNear", "CableInsertion", "FixedGridPickAndPlace", "FixedParameterizedReach", "GridPickAndPlace", "ParameterizedReach"]
