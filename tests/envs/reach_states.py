"""Placed states of the reach tasks: waypoints lie where the hand is, or a little beside it."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hindrl_jax.envs import panda
from hindrl_jax.envs.reach import FixedParameterizedReach, ParameterizedReach, ReachState

BOTH_TASKS = pytest.mark.parametrize("task", [FixedParameterizedReach, ParameterizedReach])
FAR = (0.0, 0.1, 0.0)  # m
TURNED = (0.0, 0.0, 0.3)  # rad


DIRECTIONS = [np.array(v) / np.linalg.norm(v) for v in ([1, 0, 0], [0, 0, -1], [1, -2, 3])]


def mujoco_hand(joints):
    """Position (3,) and matrix (3, 3) of the hand, by MuJoCo in C."""
    data = mujoco.MjData(panda.model())
    data.qpos[:] = joints
    mujoco.mj_kinematics(panda.model(), data)
    return data.site("grip_site").xpos.copy(), data.body("hand").xmat.reshape(3, 3).copy()


def place(offsets, turns=None, *, joints=panda.INITIAL_JOINTS, num_reached=0, step=0, seed=0):
    """A resting arm, and waypoints at these offsets (K, 3) in m and rotation vectors (K, 3) in rad from its hand."""
    position, matrix = mujoco_hand(joints)
    turns = np.zeros_like(offsets) if turns is None else turns
    joints = jnp.asarray(joints, jnp.float32)
    return ReachState(
        key=jax.random.key(seed),
        joints=joints,
        velocities=jnp.zeros(7),
        rest=joints,
        positions=jnp.asarray(position + np.asarray(offsets), jnp.float32),
        rotations=jnp.asarray(Rotation.from_rotvec(turns).as_matrix() @ matrix, jnp.float32),
        num_reached=jnp.asarray(num_reached, jnp.int32),
        step=jnp.asarray(step, jnp.int32),
    )


@functools.partial(jax.jit, static_argnums=0)
def stay(env, state):
    """What becomes of a step in which the arm does not move."""
    return env.arrive(state, state.joints, state.velocities)


@functools.partial(jax.jit, static_argnums=0)
def step(env, state, action):
    return env.step(state, action)


@functools.partial(jax.jit, static_argnums=0)
def observe(env, state):
    return env.observe(state)
