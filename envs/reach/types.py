"""The state of the reach tasks, and the names of what can simulate their arm."""

from __future__ import annotations

from typing import Literal

from flax import struct

from hindrl_jax.base.types import Array

Backend = Literal["closed_form", "mjx", "robosuite"]
"""What simulates the arm."""


class ReachState(struct.PyTreeNode, kw_only=True):
    """Everything that the next step depends on. K waypoints."""

    key: Array  # () typed random key, constant within an episode
    joints: Array  # (7,) rad
    velocities: Array  # (7,) rad/s
    rest: Array  # (7,) rad, the joints at reset
    positions: Array  # (K, 3) m, of the waypoints
    rotations: Array  # (K, 3, 3) of the waypoints
    num_reached: Array  # () int32, waypoints 0 .. num_reached - 1 are reached
    step: Array  # () int32, steps taken in this episode
