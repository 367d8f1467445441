"""The arm against MuJoCo in C: the same chain, the same matrices; and the controller against a plain loop."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco_twin import LIMITS, START, jacobian, joint_targets, mass_matrix, mujoco_at

from hindrl_jax.envs import panda
from hindrl_jax.envs.panda.closed_form import drag_torques
from hindrl_jax.envs.panda.controller import shortened
from hindrl_jax.envs.panda.linear_algebra import inverse


def random_joints(num):
    """(num, 7) anywhere within the joints' ranges."""
    c = panda.chain()
    return np.random.default_rng(0).uniform(c.lower, c.upper, (num, 7)).astype(np.float32)


# --- the chain


@jax.jit
@jax.vmap
def chain_at(joints):
    posture = panda.posture(joints)
    return posture, panda.jacobian(posture), panda.mass_matrix(posture)


def test_posture_jacobian_and_mass_matrix_are_those_of_mujoco():
    model, joints = panda.model(), random_joints(30)
    links = [model.joint(f"joint{i + 1}").bodyid[0] for i in range(7)]
    postures, jacobians, matrices = jax.device_get(chain_at(joints))
    for i, q in enumerate(joints):
        data = mujoco_at(q)
        for found, expected in (
            (postures.origins[i], data.xpos[links]),
            (postures.axes[i], data.xaxis),
            (postures.rotations[i], data.xmat[links].reshape(7, 3, 3)),
            (postures.hand_position[i], data.site("grip_site").xpos),
            (postures.hand_rotation[i], data.body("hand").xmat.reshape(3, 3)),
            (jacobians[i], jacobian(model, data)),
            (matrices[i], mass_matrix(model, data)),
        ):
            np.testing.assert_allclose(found, expected, atol=1e-5)


def test_drag_is_that_of_mujoco():
    model = mujoco.MjModel.from_xml_path(str(panda.MODEL_PATH))
    model.opt.viscosity = 0.0  # which the closed form leaves out
    joints, velocities = random_joints(20), np.random.default_rng(1).normal(size=(20, 7)).astype(np.float32)
    drag = jax.jit(jax.vmap(lambda q, v: drag_torques(v, panda.posture(q))))
    expected = np.stack([mujoco_at(q, v, model).qfrc_fluid for q, v in zip(joints, velocities, strict=True)])
    found = np.asarray(drag(joints, velocities))
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4)
    # It brakes, it grows with the square of the speed, and there is none at rest.
    assert (np.sum(found * velocities, axis=1) < 0).all()
    np.testing.assert_allclose(drag(joints, -3 * velocities), -9 * found, rtol=1e-4, atol=1e-4)
    assert not np.any(drag(joints, 0 * velocities))


def test_the_viscosity_that_is_left_out_is_below_a_hundredth_of_the_drag():
    joints, velocities = random_joints(1)[0], np.full(7, 0.1)
    model = mujoco.MjModel.from_xml_path(str(panda.MODEL_PATH))
    with_both = mujoco_at(joints, velocities, model).qfrc_fluid.copy()
    model.opt.density = 0.0
    assert np.linalg.norm(mujoco_at(joints, velocities, model).qfrc_fluid) < 1e-2 * np.linalg.norm(with_both)


@pytest.mark.parametrize("size", [1, 6, 7])
def test_inverse(size):
    factors = np.random.default_rng(size).normal(size=(20, size, size))
    matrices = np.float32(factors @ factors.transpose(0, 2, 1) + 0.1 * np.eye(size))
    found = jax.jit(jax.vmap(inverse))(matrices)
    expected = np.linalg.inv(matrices.astype(float))
    assert np.abs(found - expected).max() < 1e-4 * np.abs(expected).max()


# --- inverse kinematics


def test_joint_targets_are_those_of_a_plain_loop():
    rng, num = np.random.default_rng(2), 60
    joints = START + rng.normal(0, 0.3, (num, 7)).astype(np.float32)
    rest = joints + np.where(np.arange(num) < 30, 0.05, 1.0)[:, None] * rng.normal(size=(num, 7))
    commands = rng.uniform(-2, 2, (num, 6)) * LIMITS * np.where(np.arange(num) % 2 == 0, 1.0, 0.2)[:, None]  # too long, and short ones
    found = jax.jit(jax.vmap(lambda q, r, x: panda.joint_targets(q, r, x, panda.posture(q))))(joints, jnp.float32(rest), jnp.float32(commands))
    expected = np.stack([joint_targets(panda.model(), mujoco_at(q), r, x) for q, r, x in zip(joints, rest, commands, strict=True)])
    nearly_singular = np.array([np.linalg.svd(jacobian(panda.model(), mujoco_at(q)))[1][-1] < 0.05 for q in joints])
    np.testing.assert_allclose(found[~nearly_singular], expected[~nearly_singular], atol=1e-5)
    np.testing.assert_allclose(found, expected, atol=1e-3)
    assert (~nearly_singular).sum() > 40
    capped = np.isclose(np.abs(expected - joints).max(axis=1), 0.1)
    assert 10 < capped.sum() < 50  # some joint is at its 1 rad/s, or not


@pytest.mark.parametrize(
    ("vector", "expected"), [([3.0, 4.0], [0.6, 0.8]), ([0.3, 0.4], [0.3, 0.4]), ([-0.6, 0.8], [-0.6, 0.8]), ([0.0, 0.0], [0.0, 0.0])]
)
def test_shortened_by_hand(vector, expected):
    np.testing.assert_allclose(shortened(jnp.array(vector), 1.0), expected, rtol=1e-6)
