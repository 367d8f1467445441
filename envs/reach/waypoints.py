"""Where the waypoints of the reach tasks are: the thesis's two fixed ones, and the distribution of random ones. In the frame of the robot's base."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from hindrl_jax.base.types import Array
from hindrl_jax.envs import rotations

FIXED_WAYPOINTS = ((0.58766, 0.26816, 0.37820, 2.89549, 0.03567, -0.39348), (0.42493, 0.07166, 0.36318, 2.88426, 0.12777, 0.35920))
"""The thesis's two fixed waypoints: position in m and axis-angle of the hand in rad."""
LOWEST, HIGHEST = (0.4, -0.3, 0.0), (0.6, 0.3, 0.4)
"""Corners of the box of random waypoints, in m."""
MAX_TILT = np.pi / 4
"""Largest rotation of a random waypoint from a hand that points straight down, in rad."""
_DOWN = np.diag([1.0, -1.0, -1.0]).astype(np.float32)


def fixed_waypoints(count: int) -> tuple[Array, Array]:
    """Positions (count, 3) and matrices (count, 3, 3): the thesis's two, then further ones drawn with a key that is always the same."""
    poses = jnp.asarray(FIXED_WAYPOINTS[:count], jnp.float32)
    positions, matrices = poses[:, :3], jax.vmap(rotations.from_rotation_vector)(poses[:, 3:])
    if count > len(FIXED_WAYPOINTS):
        more = random_waypoints(jax.random.key(0), count - len(FIXED_WAYPOINTS))
        positions, matrices = jnp.concatenate([positions, more[0]]), jnp.concatenate([matrices, more[1]])
    return positions, matrices


def random_waypoints(key: Array, count: int) -> tuple[Array, Array]:
    """Positions (count, 3), uniform in the box, and matrices (count, 3, 3): a hand pointing down, turned by up to pi/4 about a random axis."""
    key_position, key_axis, key_angle = jax.random.split(key, 3)
    low, high = (jnp.broadcast_to(jnp.asarray(corner), (count, 3)) for corner in (LOWEST, HIGHEST))
    positions = jax.random.uniform(key_position, (count, 3), minval=low, maxval=high)
    axes = jax.random.normal(key_axis, (count, 3))
    axes = axes / jnp.sqrt(jnp.sum(jnp.square(axes), axis=1, keepdims=True))
    turns = jax.vmap(rotations.from_rotation_vector)(axes * jax.random.uniform(key_angle, (count, 1), maxval=MAX_TILT))
    return positions, jnp.sum(turns[:, :, :, None] * _DOWN[None, None, :, :], axis=2)
