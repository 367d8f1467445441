"""What the grid worlds are made of."""

from __future__ import annotations

from flax import struct

from hindrl_jax.base.types import Array

Box = tuple[tuple[int, int], tuple[int, int]]
"""Lowest and highest cell (x, y), both inside the box."""


class GridState(struct.PyTreeNode, kw_only=True):
    """Everything that the next step depends on."""

    key: Array  # () typed random key, constant within an episode
    agent: Array  # (2,) int32 cell
    objects: Array  # (K, 2) int32 cells; a held object is on the agent's cell
    goal: Array  # (2,) int32 cell
    num_delivered: Array  # () int32, objects 0 .. num_delivered - 1 are delivered
    held: Array  # () int32, index of the held object, -1 for none
    step: Array  # () int32, steps taken in this episode
