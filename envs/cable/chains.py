"""The state of the MuJoCo model, for both of its back ends: where everything is, and the commands of its actuators. Pure and unbatched.

Joints stand in the model's order: for each arm seven joints and two fingers, then for each cable two hinges per link and three of its head.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from hindrl_jax.base.types import Array
from hindrl_jax.envs import panda
from hindrl_jax.envs.cable import geometry
from hindrl_jax.envs.cable.types import Scene
from hindrl_jax.envs.panda.linear_algebra import product, times

_PER_ARM = panda.NUM_JOINTS + 2
_PAD_SURFACE = 0.0005  # m, by which a pad's face is nearer to the hand's middle than the finger's coordinate
_TOUCHING = 0.001  # m, between a pad's face and a grip that it touches, up to how far contacts give way
_BESIDE_PAD = 0.004  # m, how far the nearest point of a grip's axis may be beside a pad


class Joints(struct.PyTreeNode, kw_only=True):
    """What MuJoCo simulates. Q = 24 + 4 links."""

    positions: Array  # (Q,) rad or m
    velocities: Array  # (Q,) rad/s or m/s
    accelerations: Array  # (Q,) rad/s^2 or m/s^2, the last ones, from where the solver begins


def start(joints: Array, num_links: int) -> Joints:
    """At rest, with arms at joints (2, 7) in rad, and hanging cables of that many links."""
    fingers = jnp.broadcast_to(geometry.INITIAL_FINGER * jnp.array([1.0, -1.0]), (2, 2))
    arms = jnp.concatenate([joints, fingers], axis=1).reshape(-1)
    positions = jnp.concatenate([arms, jnp.zeros(2 * (2 * num_links + 3))])
    nothing = jnp.zeros_like(positions)
    return Joints(positions=positions, velocities=nothing, accelerations=nothing)


def num_links(physics: Joints) -> int:
    """Of each cable."""
    return (physics.positions.shape[-1] - 24) // 4


def arms(physics: Joints) -> tuple[Array, Array]:
    """The arms' joints (2, 7) in rad, and their fingers' coordinates (2, 2) in m, of which the second is not positive."""
    both = physics.positions[: 2 * _PER_ARM].reshape(2, _PER_ARM)
    return both[:, : panda.NUM_JOINTS], both[:, panda.NUM_JOINTS :]


def controls(physics: Joints, rest: Array, finger_targets: Array, command: Array) -> Array:
    """(18,) commands of the actuators for a control step; arguments as those of `closed_form.control_step`."""
    joints, _ = arms(physics)
    goals = jax.vmap(panda.joint_targets)(joints, rest, command, jax.vmap(panda.posture)(joints))
    return jnp.concatenate([goals, jnp.stack([finger_targets, -finger_targets], axis=1)], axis=1).reshape(-1)


def scene(physics: Joints) -> Scene:
    """Where everything is. A head is held if both pads touch its grip, as far as one can tell from where they are."""
    joints, fingers = arms(physics)
    postures = jax.vmap(panda.posture)(joints)
    hand_positions = postures.hand_position + jnp.asarray(geometry.BASES)
    angles = physics.positions[2 * _PER_ARM :].reshape(2, -1)
    head_positions, head_rotations = jax.vmap(_head)(angles, jnp.asarray(geometry.ANCHORS))
    inverses = jnp.swapaxes(postures.hand_rotation, 1, 2)
    positions_in_hand = jax.vmap(times)(inverses, head_positions - hand_positions)
    axes_in_hand = jax.vmap(times)(inverses, head_rotations[:, :, 2])
    return Scene(
        hand_positions=hand_positions,
        hand_rotations=postures.hand_rotation,
        head_positions=head_positions,
        head_rotations=head_rotations,
        fingers=0.5 * (fingers[:, 0] - fingers[:, 1]),
        held=jax.vmap(_is_held)(positions_in_hand, axes_in_hand, fingers),
    )


def cables(physics: Joints) -> Array:
    """(2, L + 1, 3) m, the ends of the links of each cable, from the bar on."""
    angles = physics.positions[2 * _PER_ARM :].reshape(2, -1)
    anchors = jnp.asarray(geometry.ANCHORS)
    ends = jax.vmap(lambda angles, anchor: _links(angles, anchor)[1])(angles, anchors)
    return jnp.concatenate([anchors[:, None], ends], axis=1)


def compact(physics: Joints) -> Joints:
    """All of it that the rest does not follow from: all of it."""
    return physics


def completed(physics: Joints) -> Joints:
    """The inverse of `compact`."""
    return physics


def _links(angles: Array, anchor: Array) -> tuple[tuple[Array, Array], Array]:
    """Where the last link of a cable at (2 L + 3,) rad ends, (3,) m and (3, 3), and where all of them do, (L, 3) m."""
    num_links = angles.shape[0] // 2 - 1
    length = geometry.CABLE_LENGTH / num_links

    def link(carry: tuple[Array, Array], bend: Array) -> tuple[tuple[Array, Array], Array]:
        position, rotation = carry
        rotation = _bent(rotation, bend)
        position = position + length * rotation[:, 2]
        return (position, rotation), position

    bends = angles[: 2 * num_links].reshape(num_links, 2)
    return jax.lax.scan(link, (anchor, jnp.asarray(geometry.HANGING)), bends)


def _head(angles: Array, anchor: Array) -> tuple[Array, Array]:
    """The grip site (3,) in m and the orientation (3, 3) of the head of a cable at (2 L + 3,) rad."""
    (position, rotation), _ = _links(angles, anchor)
    rotation = _bent(rotation, angles[-3:-1])
    x, y, z = rotation.T
    cos, sin = jnp.cos(angles[-1]), jnp.sin(angles[-1])
    return position + geometry.GRIP * z, jnp.stack([cos * x + sin * y, cos * y - sin * x, z], axis=1)


def _bent(rotation: Array, bend: Array) -> Array:
    """(3, 3) turned about its x axis, and then about its new y axis, by (2,) rad."""
    (cos_x, cos_y), (sin_x, sin_y) = jnp.cos(bend), jnp.sin(bend)
    one, nil = jnp.ones(()), jnp.zeros(())
    about_x = jnp.stack([jnp.stack([one, nil, nil]), jnp.stack([nil, cos_x, -sin_x]), jnp.stack([nil, sin_x, cos_x])])
    about_y = jnp.stack([jnp.stack([cos_y, nil, sin_y]), jnp.stack([nil, one, nil]), jnp.stack([-sin_y, nil, cos_y])])
    return product(product(rotation, about_x), about_y)


def _is_held(position: Array, axis: Array, fingers: Array) -> Array:
    """() bool, for a head with grip site (3,) and z axis (3,) in the hand's axes, and the fingers' coordinates (2,)."""
    x, y, z = geometry.from_pads_to_grip(position, axis)
    beside = jnp.maximum(jnp.abs(x), jnp.abs(z)) < geometry.PAD_HALF_SIZE + _BESIDE_PAD
    gaps = jnp.array([1.0, -1.0]) * (fingers - y) - _PAD_SURFACE - geometry.GRIP_RADIUS  # of the left pad and of the right one
    return beside & jnp.all(gaps < _TOUCHING)
