"""What keeps things apart in the closed form: hands from each other, and the plug within the socket or out of it. All unbatched.

Both arms are moved apart, by half of the overlap each. Of the socket, five numbers say what contact in MuJoCo does there (`Socket`):

  * A tip that comes to the mouth within `capture_radius` and `capture_angle` enters; any other is **blocked** there. Nothing helps it in.
  * Within the bore the plug is held sideways to the clearance, and in angle to what the clearance leaves at its depth.
  * What presses it against the walls also holds it by friction: it advances, or comes out, by so much less than commanded (jamming). A turning hand
    jams it most where it has entered least, as the walls have the shortest lever there.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from hindrl_jax.base.types import Array
from hindrl_jax.envs import rotations
from hindrl_jax.envs.cable import geometry
from hindrl_jax.envs.panda.linear_algebra import length, times

_HAND_PARTS = np.array(  # ends (m, in the hand) and radius of the capsules that a hand is: across its palm, and along its fingers
    [[[0.0, -0.07, -0.067], [0.0, 0.07, -0.067]], [[0.0, 0.0, -0.067], [0.0, 0.0, -0.01]]], np.float32
)
_HAND_RADII = np.array([0.03, 0.02], np.float32)
_AT_MOUTH = 0.001  # m, how deep a tip may be and still be outside: one that is blocked rests at 0, up to rounding
_SHORTEST_LEVER = 0.004  # m, of a plug that has just entered


class Socket(struct.PyTreeNode, kw_only=True):
    """How the socket takes the plug."""

    clearance: Array  # () m, of the pin within the bore
    capture_radius: Array  # () m, how far beside the mouth a tip may come
    capture_angle: Array  # () rad, how oblique
    friction: Array  # () share of the sideways correction by which the plug's way along the bore is shortened
    compliance: Array  # () m^2, how far a hand gives way sideways for a force, over how far it turns for a moment


def hands_apart(positions: Array, hand_rotations: Array) -> Array:
    """(3,) how far the first hand must move away from the second, m; zeros if they do not touch.

    Args:
      positions: (2, 3) m, of the hands' grip sites.
      hand_rotations: (2, 3, 3) of the hands.
    """
    ends = jnp.sum(hand_rotations[:, None, None] * _HAND_PARTS[None, :, :, None, :], axis=-1) + positions[:, None, None]  # (hand, part, end, 3)
    first, second = (jnp.stack([ends[hand][part] for part in order]) for hand, order in ((0, (0, 0, 1, 1)), (1, (0, 1, 0, 1))))
    radii = (_HAND_RADII[:, None] + _HAND_RADII[None, :]).reshape(-1)
    apart = jax.vmap(between_segments)(first, second)  # (4, 3)
    distances = length(apart)
    gaps = distances - radii
    nearest = jnp.arange(4) == jnp.argmin(gaps)
    direction = jnp.sum(jnp.where(nearest[:, None], apart / distances[:, None], 0.0), axis=0)
    return jnp.maximum(-jnp.min(gaps), 0.0) * direction


def between_segments(first: Array, second: Array) -> Array:
    """(3,) the shortest way from segment `second` to segment `first`, each (2, 3) (Ericson, Real-Time Collision Detection, 2004, section 5.1.9)."""
    d1, d2, r = first[1] - first[0], second[1] - second[0], first[0] - second[0]
    a, e, f, c, b = (jnp.sum(x * y) for x, y in ((d1, d1), (d2, d2), (d2, r), (d1, r), (d1, d2)))
    determinant = a * e - b * b
    s = jnp.clip(jnp.where(determinant > 1e-9, (b * f - c * e) / jnp.maximum(determinant, 1e-9), 0.0), 0.0, 1.0)
    t = jnp.clip((b * s + f) / e, 0.0, 1.0)
    s = jnp.clip((b * t - c) / a, 0.0, 1.0)
    return r + d1 * s - d2 * t


def plug_in_socket(before: tuple[Array, Array], after: tuple[Array, Array], socket: Socket) -> tuple[Array, Array]:
    """How the plug must move and turn, relative to the socket, to be where contact lets it.

    Args:
      before, after: positions (2, 3) in m and rotations (2, 3, 3) of the heads before the control step, and after it if nothing touched.
      socket: how it takes the plug.

    Returns:
      (3,) m and (3,) rad; zeros if they do not touch.
    """
    height_before, aside_before = _seen_from_socket(*before)
    height, aside = _seen_from_socket(*after)
    plug, axis = after[1][:, :, 2]
    off, angle = length(aside), rotations.angle(plug, -axis)
    outwards = aside / off

    was_inside = height_before < -_AT_MOUTH
    is_in = was_inside & (length(aside_before) < geometry.CLEARANCE + geometry.CHAMFER)
    mouth = jnp.where(off < socket.capture_radius, 0.0, geometry.CHAMFER)  # one that is too far aside rests on the chamfer's rim
    at_bore = (height < mouth) & (height > -geometry.TIPS[1])
    entering = at_bore & ~was_inside & (off < socket.capture_radius) & (angle < socket.capture_angle)
    guided = at_bore & (is_in | entering)

    # Guided by the walls, and held by friction along them.
    depth = jnp.maximum(-height, _SHORTEST_LEVER)
    widest = jnp.minimum(socket.capture_angle, 2.0 * socket.clearance / depth)
    sideways = jnp.maximum(off - socket.clearance, 0.0)
    turned = jnp.maximum(angle - widest, 0.0)
    held_back = socket.friction * (sideways + socket.compliance * turned / depth)
    way = height - height_before
    rest = height_before + jnp.sign(way) * jnp.maximum(jnp.abs(way) - held_back, 0.0)
    rest = jnp.maximum(rest, -geometry.DEPTH)
    by_walls = -sideways * outwards + (rest - height) * axis
    turning = rotations.turning(plug, -axis) * (turned / jnp.maximum(angle, 1e-9))

    # Blocked by the mouth, or by the sleeve's outside.
    reach = geometry.SLEEVE_RADIUS + geometry.PIN_RADIUS - off
    by_mouth = jnp.where(mouth - height < reach, (mouth - height) * axis, reach * outwards)
    blocked = at_bore & ~guided & (reach > 0.0)
    return jnp.where(guided, by_walls, jnp.where(blocked, by_mouth, 0.0)), jnp.where(guided, turning, 0.0)


def _seen_from_socket(positions: Array, head_rotations: Array) -> tuple[Array, Array]:
    """Height () of the plug's tip over the socket's, and how far it is beside the socket's axis (3,), m."""
    plug, socket = head_rotations[:, :, 2]
    offset = positions[0] + geometry.to_tip(0) * plug - positions[1] - geometry.to_tip(1) * socket
    height = jnp.sum(offset * socket)
    return height, offset - height * socket


def tip(position: Array, rotation: Array, head: int) -> Array:
    """(3,) m, of the plug (0) or socket (1) at (3,) and (3, 3)."""
    return position + geometry.to_tip(head) * times(rotation, jnp.array([0.0, 0.0, 1.0]))
