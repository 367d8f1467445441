"""Grid worlds: pick up numbered objects and carry them to a goal cell (thesis section 3.1).

Public are the two tasks, their common class, their state, and the module `viewer`.
"""

from hindrl_jax.envs.grid.pick_and_place import FixedGridPickAndPlace, GridPickAndPlace
from hindrl_jax.envs.grid.rules import GridTask
from hindrl_jax.envs.grid.types import GridState

__all__ = ["FixedGridPickAndPlace", "GridPickAndPlace", "GridState", "GridTask"]
