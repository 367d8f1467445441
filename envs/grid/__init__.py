"""Grid worlds (thesis section 3.1)."""

from hindrl_jax.envs.grid.pick_and_place import FixedGridPickAndPlace, GridPickAndPlace, GridState

__all__ = ["FixedGridPickAndPlace", "GridPickAndPlace", "GridState"]
