"""Where everything is in the cable tasks, and how large: two Pandas before a bar from which two cables hang (the original code's numbers).

Index 0 is the plug, the arm that takes it and its cable; index 1 the socket and its own. Lengths are in m. A head's z axis points from the cable's
end to the head's tip, and a head is where its grip site is. The world's origin is that of robosuite's arena.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from hindrl_jax.base.types import Array

BASES = np.array([[-0.91, 0.25, 0.912], [-0.91, -0.25, 0.912]], np.float32)
"""(2, 3) of the arms."""
CABLE_LENGTH = 0.40
CABLE_RADIUS = 0.005
CABLE_MASS = 0.0392
"""kg, of each."""
GRIP = 0.02
"""Of the grip site, along a head from the cable's end."""
GRIP_RADIUS, GRIP_HALF_LENGTH = 0.01, 0.02
"""Of the part of a head that fingers hold, a cylinder about the grip site."""
HANGING_GRIPS = np.array([[-0.4235, 0.1878, 1.3368], [-0.4235, -0.1722, 1.3368]], np.float32)
"""(2, 3) the grip sites while the cables hang at rest."""
ANCHORS = HANGING_GRIPS + np.array([0.0, 0.0, CABLE_LENGTH + GRIP], np.float32)
"""(2, 3) the ends of the cables at the bar."""
HANGING = np.diag([1.0, -1.0, -1.0]).astype(np.float32)
"""(3, 3) the orientation of a hanging head."""
HEAD_MASSES = np.array([0.01187, 0.01689])
"""(2,) kg"""
HEAD_CENTRES = np.array([0.045, 0.048])
"""(2,) of mass, from the cable's end."""
TIPS = np.array([0.094, 0.096])
"""(2,) from the cable's end."""
SOCKET_BOTTOM = 0.065
"""From the cable's end: where the plug's tip is when it is inserted."""
DEPTH = 0.031
"""Of the bore, from the socket's tip."""
PIN_START, PIN_RADIUS = 0.055, 0.0032
CLEARANCE = 0.0003
"""Of the pin within the bore, sideways."""
CHAMFER = 0.002
"""Width and height of the slant around the bore's mouth."""
SLEEVE_RADIUS = 0.0105
"""Outer, of the bore's walls."""
PAD_HEIGHT = -0.0036
"""Of the middle of the fingers' pads, along the hand's z axis from its grip site."""
PAD_HALF_SIZE = 0.008
"""Of the square pads."""
FINGER_TOUCHING = 0.0105
"""Coordinate of both fingers at which the pads touch a grip between them."""
MAX_FINGER = 0.04
"""Coordinate of an open finger; the opening is twice that."""
INITIAL_FINGER = 0.0208
"""robosuite's at reset."""


def from_pads_to_grip(position: Array, axis: Array) -> Array:
    """(3,) from the middle of the pads to the nearest point of a grip's axis, for a head with grip site and z axis (3,) in the hand's axes."""
    offset = position - jnp.array([0.0, 0.0, PAD_HEIGHT])
    along = jnp.clip(jnp.sum(offset * axis), -GRIP_HALF_LENGTH, GRIP_HALF_LENGTH)
    return offset - along * axis


def to_tip(head: int) -> float:
    """From the grip site of the plug (0) or the socket (1) to its tip."""
    return float(TIPS[head]) - GRIP
