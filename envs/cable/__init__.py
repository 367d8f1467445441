"""Two Panda arms and two cables: bring the ends of the cables near each other, or insert one into the other (thesis sections 3.2.3 and 3.2.4).

Public are the two tasks, their common class, their state, and the module `viewer`.
"""

from hindrl_jax.envs.cable.rules import CableTask
from hindrl_jax.envs.cable.tasks import BringNear, CableInsertion
from hindrl_jax.envs.cable.types import CableState, Scene

__all__ = ["BringNear", "CableInsertion", "CableState", "CableTask", "Scene"]
