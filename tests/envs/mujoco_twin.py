"""The arm in C MuJoCo: what the closed form is compared with."""

import mujoco
import numpy as np

from hindrl_jax.envs import panda

LIMITS = np.array(3 * [panda.MAX_TRANSLATION] + 3 * [panda.MAX_ROTATION])
START = np.float32(panda.INITIAL_JOINTS) + np.float32(np.random.default_rng(1).normal(0, 0.02, 7))  # rad


def mujoco_at(joints, velocities=0.0, model=None):
    """MuJoCo's data, computed in C."""
    model = model or panda.model()
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = joints, velocities
    mujoco.mj_forward(model, data)
    return data


def mass_matrix(model, data):
    columns = np.zeros((7, 7))
    for column, unit in zip(columns, np.eye(7), strict=True):  # rather than mj_fullM, whose arguments differ between versions
        mujoco.mj_mulM(model, data, column, unit)
    return columns.T


def jacobian(model, data):
    matrix = np.zeros((6, 7))
    mujoco.mj_jacSite(model, data, matrix[:3], matrix[3:], model.site("grip_site").id)
    return matrix


def shortened(vector, limit):
    return vector * min(1.0, limit / max(np.linalg.norm(vector), 1e-12))


def joint_targets(model, data, rest, command):
    """A twin of `controller.joint_targets` as robosuite has it, with a pseudo-inverse."""
    q, j = data.qpos, jacobian(model, data)
    twist = 0.95 * np.concatenate([shortened(command[:3], 0.02), shortened(command[3:], 0.05)]) / 0.1
    pull = np.array([10, 10, 10, 10, 5, 5, 5]) * (rest - q)
    speeds = j.T @ np.linalg.inv(j @ j.T + 0.05**2 * np.eye(6)) @ twist + (np.eye(7) - np.linalg.pinv(j) @ j) @ pull
    fastest = np.abs(speeds).max()
    return q + 0.1 * (speeds / fastest if fastest > 1.0 else speeds)


def mujoco_motion(start, commands):
    """Joints (T, 7) after each command, by C MuJoCo with the exact torque in every substep."""
    model, data, joints = panda.model(), mujoco.MjData(panda.model()), []
    data.qpos[:] = start
    for command in commands:
        for substep in range(25):
            mujoco.mj_step1(model, data)
            if substep == 0:
                goal = joint_targets(model, data, start, command)
            data.ctrl[:] = mass_matrix(model, data) @ (100.0 * (goal - data.qpos) - 20.0 * data.qvel) + data.qfrc_bias
            mujoco.mj_step2(model, data)
        joints.append(data.qpos.copy())
    return np.array(joints)
