"""Grid worlds (thesis section 3.1)."""

from envs.grid.pick_and_place import FixedGridPickAndPlace, GridPickAndPlace, GridState

__all__ = ["FixedGridPickAndPlace", "GridPickAndPlace", "GridState"]
