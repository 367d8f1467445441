"""Forward kinematics of the Panda: where its links and its hand are at given joint angles, and how they move with the joints.

Everything is unbatched and pure, in metres and radians. The origin is the robot's base.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from hindrl_jax.base.types import Array
from hindrl_jax.envs.panda.linear_algebra import product
from hindrl_jax.envs.panda.robot import INITIAL_JOINTS, NUM_JOINTS, chain


class Posture(NamedTuple):
    """Where the links are, in the base's axes."""

    origins: Array  # (7, 3) m, of the joints
    axes: Array  # (7, 3) of the joints
    rotations: Array  # (7, 3, 3) of the links
    hand_position: Array  # (3,) m, of the grip site
    hand_rotation: Array  # (3, 3) of the hand


def posture(joints: Array) -> Posture:
    """Forward kinematics at joints (7,), in rad.

    The loops over joints, here and in the dynamics, are scans, because one round is then all that a compiler can fuse. Given the whole chain at
    once, XLA's compiler for CPUs recomputes shared terms for every number of the result.
    """
    c = chain()

    def link(carry: tuple[Array, Array], joint: tuple[Array, ...]) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        origin, rotation = carry
        offset, fixed, cos, sin = joint
        origin = origin + product(rotation, offset[:, None])[:, 0]
        x, y, z = jnp.moveaxis(product(rotation, fixed), 1, 0)
        rotation = jnp.stack([cos * x + sin * y, cos * y - sin * x, z], axis=1)
        return (origin, rotation), (origin, rotation)

    turns = (jnp.asarray(c.offsets), jnp.asarray(c.rotations), jnp.cos(joints), jnp.sin(joints))
    (origin, rotation), (origins, rotations) = jax.lax.scan(link, (jnp.zeros(3), jnp.eye(3)), turns)
    return Posture(
        origins=origins,
        axes=rotations[:, :, 2],
        rotations=rotations,
        hand_position=origin + product(rotation, c.hand_offset[:, None])[:, 0],
        hand_rotation=product(rotation, c.hand_rotation),
    )


def joints_at_reset(key: Array, deviation: float, *leading: int) -> Array:
    """(*leading, 7) rad, robosuite's initial joints with Gaussian noise of that deviation, within the joints' limits."""
    c, shape = chain(), (*leading, NUM_JOINTS)
    initial, lower, upper = (jnp.broadcast_to(jnp.asarray(joints, jnp.float32), shape) for joints in (INITIAL_JOINTS, c.lower, c.upper))
    return jnp.clip(initial + deviation * jax.random.normal(key, shape), lower, upper)


def jacobian(posture: Posture) -> Array:
    """(6, 7) velocity of the grip site, m/s, and angular velocity, rad/s, per rad/s of each joint, in the base's axes."""
    return jnp.concatenate([jnp.cross(posture.axes, posture.hand_position[None] - posture.origins), posture.axes], axis=1).T


def motions(posture: Posture) -> Array:
    """(7, 6) what each joint's turning at 1 rad/s does to a body where it passes the base's origin: velocity and angular velocity."""
    return jnp.concatenate([jnp.cross(posture.origins, posture.axes), posture.axes], axis=1)
