"""The two grid worlds of thesis section 3.1: where things start, and where teleported objects go. `rules` has all else."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from hindrl_jax.base.types import Array
from hindrl_jax.envs.grid.cells import free_rank, overlap, rank_to_cell
from hindrl_jax.envs.grid.rules import GridTask
from hindrl_jax.envs.grid.types import Box


@dataclass(frozen=True)
class GridPickAndPlace(GridTask):
    """Everything starts on distinct uniformly random cells, and teleported objects land on a uniformly random free cell (thesis 3.1.1)."""

    name: ClassVar[str] = "GridPickAndPlace"

    def __post_init__(self):
        super().__post_init__()
        if self.num_objects + 2 >= self.size**2:
            raise ValueError(
                f"{self.num_objects} objects, the agent and the goal leave no free cell on a grid of size {self.size}; "
                "raise size or lower num_objects."
            )

    def _start_cells(self, bits: Array) -> Array:
        ranks: list[Array] = []
        for i in range(self.num_objects + 2):
            ranks.append(free_rank(bits[i], ranks, self.size**2))
        return jnp.stack([rank_to_cell(rank, self.size) for rank in ranks])

    def _teleport_cell(self, bits: Array, lost: Array, agent: Array, objects: Array, goal: Array) -> Array:
        # A released object is still listed in `objects` at the cell it was released on, so it cannot land there again.
        del lost
        occupied = [agent, goal, *(objects[i] for i in range(self.num_objects))]
        ranks = [cell[1] * self.size + cell[0] for cell in occupied]
        return rank_to_cell(free_rank(bits, ranks, self.size**2), self.size)


@dataclass(frozen=True)
class FixedGridPickAndPlace(GridTask):
    """Everything starts in a small box of its own, and teleported objects return to their own start box (thesis 3.1.2).

    With d = size and b = random_box_size, the agent starts in the corner box at (0, 0), the goal is in the one at (0, d-1), object 0 starts in the
    one at (d-1, 0) and object 1 in the one at (d-1, d-1). The original supports only these two objects. Our choice for more: object 2 starts in the
    centre of the grid and objects 3 to 6 at the middle of the edges at x = d-1, y = 0, y = d-1 and x = 0.
    """

    name: ClassVar[str] = "FixedGridPickAndPlace"

    random_box_size: int = 2
    """Number of cells along each side of the boxes in which the agent, the goal and the objects start."""

    def __post_init__(self):
        super().__post_init__()
        if self.random_box_size < 1:
            raise ValueError(f"random_box_size must be at least 1, got {self.random_box_size}.")
        if self.num_objects > 7:
            raise ValueError(f"FixedGridPickAndPlace has start boxes for at most 7 objects, got num_objects={self.num_objects}.")
        if any(overlap(a, b) for a, b in combinations(self.start_boxes, 2)):
            raise ValueError(
                f"{self.num_objects + 2} start boxes of random_box_size={self.random_box_size} overlap on a grid of size {self.size}; "
                "raise size, or lower random_box_size or num_objects."
            )

    @property
    def start_boxes(self) -> tuple[Box, ...]:
        """The boxes in which the agent, the goal and the objects start, in that order."""
        end = self.size - self.random_box_size
        middle = end // 2
        corners = [(0, 0), (0, end), (end, 0), (end, end), (middle, middle), (end, middle), (middle, 0), (middle, end), (0, middle)]
        extent = self.random_box_size - 1
        return tuple(((x, y), (x + extent, y + extent)) for x, y in corners[: self.num_objects + 2])

    def _start_cells(self, bits: Array) -> Array:
        lowest = jnp.array([box[0] for box in self.start_boxes], jnp.int32)
        ranks = (bits % np.uint32(self.random_box_size**2)).astype(jnp.int32)
        return lowest + jax.vmap(rank_to_cell, (0, None))(ranks, self.random_box_size)

    def _teleport_cell(self, bits: Array, lost: Array, agent: Array, objects: Array, goal: Array) -> Array:
        del objects, goal  # they are never in this object's box, other than the teleported object itself
        width = self.random_box_size
        boxes = np.array([box[0] for box in self.start_boxes[2:]], np.int32)
        chosen = jnp.arange(self.num_objects) == lost
        lowest = jnp.sum(jnp.where(chosen[:, None], boxes, 0), axis=0, dtype=jnp.int32)
        offset = agent - lowest
        blocked = jnp.all((offset >= 0) & (offset < width)) & (width > 1)
        agent_rank = jnp.where(blocked, offset[1] * width + offset[0], width**2)
        return lowest + rank_to_cell(free_rank(bits, [agent_rank], width**2), width)
