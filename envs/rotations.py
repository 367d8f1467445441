"""Rotations of the hand: matrices (3, 3) within the dynamics, rotation vectors and the 6-D form in observations. All unbatched."""

from __future__ import annotations

import jax.numpy as jnp

from hindrl_jax.base.types import Array


def from_rotation_vector(vector: Array) -> Array:
    """Rodrigues' formula: axis times angle (3,), in rad -> matrix (3, 3)."""
    angle = jnp.sqrt(jnp.sum(jnp.square(vector)))
    x, y, z = vector / jnp.maximum(angle, 1e-12)
    skew = jnp.stack([jnp.stack([0.0 * x, -z, y]), jnp.stack([z, 0.0 * x, -x]), jnp.stack([-y, x, 0.0 * x])])
    squared = jnp.stack([x, y, z])[:, None] * jnp.stack([x, y, z])[None, :] - jnp.sign(angle) * jnp.eye(3)
    return jnp.eye(3) + jnp.sin(angle) * skew + (1.0 - jnp.cos(angle)) * squared


def to_rotation_vector(matrix: Array) -> Array:
    """Axis times angle (3,), the angle in [0, pi]. At pi the axis jumps to its opposite.

    By way of the quaternion, whose largest component is found first, so that nothing is divided by a small number at any angle.
    """
    (a, b, c), (d, e, f), (g, h, i) = matrix
    candidates = jnp.stack(  # 4 q_k (w, x, y, z) for each component q_k of the quaternion
        [
            jnp.stack([1 + a + e + i, h - f, c - g, d - b]),
            jnp.stack([h - f, 1 + a - e - i, b + d, c + g]),
            jnp.stack([c - g, b + d, 1 - a + e - i, f + h]),
            jnp.stack([d - b, c + g, f + h, 1 - a - e + i]),
        ]
    )
    largest = jnp.arange(4) == jnp.argmax(jnp.diagonal(candidates))
    quaternion = jnp.sum(jnp.where(largest[:, None], candidates, 0.0), axis=0)
    quaternion = quaternion * jnp.where(quaternion[0] < 0, -1.0, 1.0)
    w, vector = quaternion[0], quaternion[1:]
    sine = jnp.sqrt(jnp.sum(jnp.square(vector)))
    return vector / jnp.maximum(sine, 1e-12) * (2.0 * jnp.arctan2(sine, w))


def to_six_d(matrix: Array) -> Array:
    """The first two columns (6,): a continuous form of the rotation (Zhou et al., On the continuity of rotation representations, 2019)."""
    return jnp.concatenate([matrix[:, 0], matrix[:, 1]])


def from_six_d(columns: Array) -> Array:
    """The inverse of `to_six_d`: the first two columns (6,) of a rotation matrix -> the matrix (3, 3)."""
    first, second = columns[:3], columns[3:]
    return jnp.stack([first, second, jnp.cross(first, second)], axis=1)


def between(source: Array, target: Array) -> Array:
    """The rotation vector (3,) that turns matrix `source` into `target`, in the axes that both are given in."""
    return to_rotation_vector(jnp.sum(target[:, None, :] * source[None, :, :], axis=2))


def turning(source: Array, target: Array) -> Array:
    """The shortest rotation vector (3,) that turns the direction `source` into `target`, both unit vectors (3,); 0 where they are opposite."""
    normal = jnp.cross(source, target)
    sine = jnp.sqrt(jnp.sum(jnp.square(normal)) + 1e-20)
    return normal / sine * jnp.arctan2(sine, jnp.sum(source * target))


def angle(first: Array, second: Array) -> Array:
    """() rad between two unit vectors (3,)."""
    return jnp.arctan2(jnp.sqrt(jnp.sum(jnp.square(jnp.cross(first, second)))), jnp.sum(first * second))
