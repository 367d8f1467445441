"""Where episodes of the reach tasks start, and where their waypoints are."""

import functools

import jax
import numpy as np
import pytest
from reach_states import BOTH_TASKS, observe
from scipy.spatial.transform import Rotation

from hindrl_jax.envs import panda
from hindrl_jax.envs.reach import FixedParameterizedReach, ParameterizedReach

NUM_RESETS = 3000


@functools.partial(jax.jit, static_argnums=0)
def resets(env):
    """Start states, with observations."""
    return jax.vmap(env.reset)(jax.random.split(jax.random.key(3), NUM_RESETS))


@BOTH_TASKS
def test_an_episode_starts_at_rest_at_the_initial_joints_with_noise(task):
    states, observations = resets(task())
    for name in ("velocities", "num_reached", "step"):
        assert not np.any(getattr(states, name))
    np.testing.assert_array_equal(states.rest, states.joints)
    deviations = np.asarray(states.joints) - np.array(panda.INITIAL_JOINTS)
    assert np.abs(deviations.mean(axis=0)).max() < 5 * 0.02 / NUM_RESETS**0.5
    np.testing.assert_allclose(deviations.std(axis=0), 0.02, rtol=0.08)
    assert np.abs(np.corrcoef(deviations.T) - np.eye(7)).max() < 0.1
    np.testing.assert_allclose(observations[7], observe(task(), jax.tree.map(lambda leaf: leaf[7], states)), atol=1e-6)
    assert len(np.unique(jax.random.key_data(states.key), axis=0)) == NUM_RESETS


def test_without_noise_every_episode_starts_in_the_same_place():
    states, _ = resets(FixedParameterizedReach(joint_noise=0.0))
    expected = [0, np.pi / 16, 0, -5 * np.pi / 6, 0, np.pi - 0.2, np.pi / 4]
    np.testing.assert_allclose(states.joints, np.tile(expected, (NUM_RESETS, 1)), rtol=1e-6)


def test_starts_are_within_the_joint_limits():
    env, chain = FixedParameterizedReach(joint_noise=1.0), panda.chain()
    state, _ = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 50))
    joints = np.asarray(state.joints)
    assert (joints >= np.float32(chain.lower)).all()
    assert (joints <= np.float32(chain.upper)).all()
    assert ((joints == np.float32(chain.lower)) | (joints == np.float32(chain.upper))).any()


def test_waypoints_of_the_fixed_task_are_the_thesis_s():
    states, _ = resets(FixedParameterizedReach())
    for positions, matrices in zip(np.asarray(states.positions)[:4], np.asarray(states.rotations), strict=False):
        np.testing.assert_allclose(positions, [[0.58766, 0.26816, 0.37820], [0.42493, 0.07166, 0.36318]], atol=1e-7)
        vectors = [[2.89549, 0.03567, -0.39348], [2.88426, 0.12777, 0.35920]]
        np.testing.assert_allclose(matrices, Rotation.from_rotvec(vectors).as_matrix(), atol=1e-6)


def assert_in_the_box(positions, matrices):
    assert (positions >= np.float32([0.4, -0.3, 0.0])).all()
    assert (positions <= np.float32([0.6, 0.3, 0.4])).all()
    tilt = Rotation.from_matrix(matrices.reshape(-1, 3, 3)) * Rotation.from_matrix(np.diag([1, -1, -1])).inv()
    assert tilt.magnitude().max() <= np.pi / 4 + 1e-5
    return tilt


@pytest.mark.parametrize("num_waypoints", [1, 4])
def test_any_number_of_fixed_waypoints(num_waypoints):
    states, _ = resets(FixedParameterizedReach(num_waypoints=num_waypoints))
    positions, matrices = np.asarray(states.positions), np.asarray(states.rotations)
    assert positions.shape == (NUM_RESETS, num_waypoints, 3)
    assert (positions == positions[0]).all()  # whatever the key
    assert (matrices == matrices[0]).all()
    thesis, _ = resets(FixedParameterizedReach())
    np.testing.assert_array_equal(positions[0, :2], thesis.positions[0, :num_waypoints])
    if num_waypoints > 2:
        assert_in_the_box(positions[0, 2:], matrices[0, 2:])
        assert len(np.unique(positions[0], axis=0)) == num_waypoints


def test_random_waypoints_fill_the_box_and_tilt_by_up_to_a_quarter_of_pi():
    states, _ = resets(ParameterizedReach())
    positions = np.asarray(states.positions).reshape(-1, 3)  # 6,000 of them, all different
    num = len(positions)
    assert len(np.unique(positions, axis=0)) == num == 6000
    tilt = assert_in_the_box(positions, np.asarray(states.rotations))
    widths = np.array([0.2, 0.6, 0.4])
    np.testing.assert_allclose(positions.mean(axis=0), [0.5, 0.0, 0.2], atol=5 * 0.29 * 0.6 / num**0.5)
    np.testing.assert_allclose(positions.std(axis=0), widths / 12**0.5, rtol=0.05)
    angles = tilt.magnitude()  # uniform
    assert angles.mean() == pytest.approx(np.pi / 8, abs=5 * 0.23 / num**0.5)
    assert angles.std() == pytest.approx(np.pi / 4 / 12**0.5, rel=0.05)
    axes = tilt.as_rotvec() / angles[:, None]  # uniform over directions: each coordinate uniform in [-1, 1]
    assert np.abs(axes.mean(axis=0)).max() < 5 * 0.58 / num**0.5
    np.testing.assert_allclose(axes.std(axis=0), 3**-0.5, rtol=0.05)
