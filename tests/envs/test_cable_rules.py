"""The rules of the cable tasks: what is observed, when they are solved, what commands do, and what is refused."""

import chex
import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cable_states import BOTH_TASKS, SHUT, reset, step

from hindrl_jax.envs import panda
from hindrl_jax.envs.cable import BringNear, CableInsertion, Scene, geometry
from hindrl_jax.envs.cable.rules import MEETING, MEETING_HEADS, tip_error


def key():
    """The same key, as often as it is wanted."""
    return jax.random.key(0)


def scene(gap, *, aside=0.0, tilt=0.0):
    """Both heads in line along y, their tips `gap` apart (negative inside the socket)."""
    cos, sin = np.cos(tilt), np.sin(tilt)
    plug = np.array([[1, 0, 0], [0, cos, -sin], [0, sin, cos]]) @ MEETING_HEADS[0]
    tips = MEETING + np.array([[aside, gap, 0.0], [0.0, 0.0, 0.0]])
    rotations = np.stack([plug, MEETING_HEADS[1]])
    positions = tips - np.array([[geometry.to_tip(0)], [geometry.to_tip(1)]]) * rotations[:, :, 2]
    arms = jnp.zeros((2, 3)), jnp.stack([jnp.eye(3)] * 2)
    return Scene(
        hand_positions=arms[0],
        hand_rotations=arms[1],
        head_positions=jnp.asarray(positions, jnp.float32),
        head_rotations=jnp.asarray(rotations, jnp.float32),
        fingers=jnp.array([0.01, 0.03]),
        held=jnp.array([True, False]),
    )


# --- solved or not


@pytest.mark.parametrize(("gap", "solved"), [(0.0195, True), (0.0205, False), (-0.0195, True)])
def test_tips_are_near_within_2_cm(gap, solved):
    assert bool(BringNear().is_solved(scene(gap))) == solved
    assert bool(BringNear(position_tolerance=0.05).is_solved(scene(gap)))


@pytest.mark.parametrize(
    ("gap", "aside", "tilt", "solved"),
    [
        (-0.031, 0.0, 0.0, True),
        (-0.0282, 0.0, 0.0, True),  # 2.8 mm from the bottom
        (-0.0278, 0.0, 0.0, False),
        (-0.031, 0.0029, 0.0, True),
        (-0.030, 0.0029, 0.0, False),  # 3.07 mm
        (-0.031, 0.0, np.radians(1.70), True),
        (-0.031, 0.0, np.radians(1.72), False),
        (0.0, 0.0, 0.0, False),
    ],
)
def test_a_plug_is_inserted_within_3_mm_and_1_71_degrees(gap, aside, tilt, solved):
    assert bool(CableInsertion().is_solved(scene(gap, aside=aside, tilt=tilt))) == solved


def test_heads_that_point_the_same_way_are_not_inserted():
    """Where both axes agree, turning one into the other's opposite has no direction of its own: the angle must be pi all the same."""
    same = scene(-0.031)
    turned = same.replace(head_rotations=jnp.stack([same.head_rotations[1]] * 2))
    plug = turned.head_rotations[0, :, 2]
    bottom = turned.head_positions[1] + (geometry.to_tip(1) - geometry.DEPTH) * plug
    turned = turned.replace(head_positions=turned.head_positions.at[0].set(bottom - geometry.to_tip(0) * plug))
    np.testing.assert_allclose(tip_error(turned, geometry.DEPTH), 0.0, atol=1e-6)
    assert not bool(CableInsertion().is_solved(turned))


def test_one_arm_cannot_bring_the_tips_together():
    """A cable is too short for its tip to come near the other's, which hangs."""
    farthest = geometry.CABLE_LENGTH + geometry.TIPS[0]
    other_tip = geometry.HANGING_GRIPS[1] - [0, 0, geometry.to_tip(1)]
    assert np.linalg.norm(other_tip - geometry.ANCHORS[0]) > farthest + 0.1


# --- observations and goals


def test_an_observation_by_hand():
    env = CableInsertion()
    state, _ = reset(env, key())
    found = np.asarray(env.observe(state.replace(scene=scene(0.05))))
    np.testing.assert_allclose(found[:9], [0, 0, 0, 1, 0, 0, 0, 1, 0], atol=1e-6)  # position, and two columns of the rotation
    np.testing.assert_allclose(found[18:24], scene(0.05).head_positions.reshape(-1), atol=1e-6)  # from the hands, which are at 0
    np.testing.assert_allclose(found[24:27], [0, 0.05 + geometry.DEPTH, 0], atol=1e-6)
    np.testing.assert_allclose(found[27:31], [1, 0, 0.02, 0.06], atol=1e-6)  # one is held; openings are twice the fingers' coordinates
    np.testing.assert_allclose(found[31:38], [0, -1, 0, 0, 1, 0, 0], atol=1e-6)
    thesis = np.asarray(CableInsertion(observation="thesis").observe(state.replace(scene=scene(0.05))))
    np.testing.assert_allclose(thesis[:24], found[:24])
    np.testing.assert_allclose(thesis[24:27], [0, 0.05, 0], atol=1e-6)  # between the tips
    np.testing.assert_allclose(thesis[27:], found[27:31])
    assert env.observe(state.replace(scene=scene(-0.031)))[-1] == 1.0


@BOTH_TASKS
def test_the_goal_says_what_solves_the_task(task):
    env = task()
    goal, tolerance = np.asarray(env.task_goal()), env.goal_tolerance
    state, start = reset(env, key())
    assert goal[-1] == 1.0
    for gap in (-0.031, 0.0, 0.01, 0.019, 0.021, 0.1):
        found = np.asarray(env.observe(state.replace(scene=scene(gap))))
        assert (np.abs(found - goal) <= tolerance).all() == bool(env.is_solved(scene(gap)))
    assert not (np.abs(np.asarray(start) - goal) <= tolerance).all()
    assert (env.observation_low <= goal).all()
    assert (goal <= env.observation_high).all()
    assert task(observation="thesis").goal_tolerance is None


# --- starts


def test_an_episode_starts_at_rest_at_the_initial_joints_with_noise():
    states, observations = jax.jit(jax.vmap(BringNear().reset))(jax.random.split(key(), 2000))
    deviations = np.asarray(states.physics.joints) - np.array(panda.INITIAL_JOINTS)
    np.testing.assert_allclose(deviations.std(axis=0), 0.02, rtol=0.12)
    assert np.abs(np.corrcoef(deviations.reshape(-1, 14).T) - np.eye(14)).max() < 0.15
    np.testing.assert_array_equal(states.rest, states.physics.joints)
    np.testing.assert_allclose(states.scene.head_positions[7], [[-0.4235, 0.1878, 1.3368], [-0.4235, -0.1722, 1.3368]], atol=1e-6)
    assert not np.any(states.physics.velocities)
    assert np.isfinite(observations).all()
    assert len(np.unique(jax.random.key_data(states.key), axis=0)) == 2000


@BOTH_TASKS
def test_both_back_ends_start_alike(task):
    first, second = (reset(task(backend=backend), key())[0] for backend in ("closed_form", "mujoco"))
    chex.assert_trees_all_close(first.scene, second.scene, atol=1e-6)
    chex.assert_trees_all_equal(first.rest, second.rest)


def test_randomised_episodes_differ_in_socket_and_weight_by_at_most_30_percent():
    plain = reset(BringNear(), key())[0].physics
    drawn = jax.jit(jax.vmap(BringNear(randomised=True).reset))(jax.random.split(key(), 500))[0].physics
    for name in ("clearance", "capture_radius", "capture_angle", "friction", "compliance"):
        ratio = np.asarray(getattr(drawn.socket, name)) / float(getattr(plain.socket, name))
        assert 0.7 <= ratio.min() < 0.72
        assert 1.28 < ratio.max() <= 1.3
    ratio = np.asarray(drawn.weights) / np.asarray(plain.weights)
    assert 0.7 <= ratio.min() < 0.72
    np.testing.assert_allclose(ratio[:, 0], ratio[:, 1], rtol=1e-5)
    np.testing.assert_allclose(plain.weights, 9.81 * (np.array([0.01187, 0.01689]) + 0.2 * 0.0392), rtol=1e-5)


# --- steps


def test_a_gripper_s_command_moves_its_fingers_targets_by_its_sign_alone():
    state, _ = reset(BringNear(), key())
    np.testing.assert_allclose(state.finger_targets, 0.02)
    action = np.zeros(14, np.float32)
    action[[6, 13]] = 0.01, -1.0
    state, _ = step(BringNear(), state, action)
    np.testing.assert_allclose(state.finger_targets, [0.016, 0.024], atol=1e-7)
    state, _ = step(BringNear(), state, np.zeros(14, np.float32))
    np.testing.assert_allclose(state.finger_targets, [0.016, 0.024], atol=1e-7)
    for _ in range(8):
        state, _ = step(BringNear(), state, action)
    np.testing.assert_allclose(state.finger_targets, [0.0, 0.04], atol=1e-7)
    assert state.scene.fingers[0] < 0.012 < 0.03 < state.scene.fingers[1]


def test_each_arm_follows_its_own_command():
    state, before = reset(BringNear(joint_noise=0.0), key())
    action = np.zeros(14, np.float32)
    action[0], action[9] = 0.02, 0.02  # the plug's arm along x, the socket's along z
    for _ in range(5):
        state, after = step(BringNear(), state, action)
    moved = np.asarray(after.observation) - np.asarray(before)
    assert 0.01 < moved[0] < 0.03
    assert 0.01 < moved[11] < 0.03
    assert np.abs(moved[[1, 2, 9, 10]]).max() < 0.004


@pytest.mark.parametrize("backend", ["closed_form", "mujoco"])
def test_what_is_not_finite_stays_so_and_leaves_other_episodes_alone(backend, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # where MuJoCo would write its warnings
    env = BringNear(backend=backend)
    states, _ = jax.vmap(env.reset)(jax.random.split(key(), 3))
    actions = jnp.zeros((3, 14)).at[1, 2].set(jnp.nan)
    many = jax.jit(jax.vmap(env.step))
    for _ in range(2):
        states, steps = many(states, actions)
    finite = np.isfinite(steps.observation).all(axis=1)
    assert finite.tolist() == [True, False, True]
    assert not steps.terminated.any()
    assert list(tmp_path.iterdir()) == []


# --- arguments and compilation


@BOTH_TASKS
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"horizon": 0}, "horizon = 0 is not usable: it must be at least 1"),
        ({"position_tolerance": 0.0}, "position_tolerance = 0.0 is not usable: it must be greater than 0 and less than 0.36, .*"),
        ({"position_tolerance": 0.4}, "position_tolerance = 0.4 is not usable: it must be greater than 0 and less than 0.36, .*"),
        ({"joint_noise": float("inf")}, "joint_noise = inf is not usable: it must be a finite number"),
        ({"joint_noise": -0.01}, "joint_noise = -0.01 is not usable: it must be 0 or more"),
        ({"num_links": 1}, "num_links = 1 is not usable: it must be from 2 to 20"),
        ({"observation": "pixels"}, "observation = 'pixels' is not usable: it must be one of full, thesis"),
        ({"backend": "bullet"}, "backend = 'bullet' is not usable: it must be one of closed_form, mujoco, mjx, robosuite"),
        ({"randomised": True, "backend": "mujoco"}, "randomised = True is not usable: it must be false with backend = mujoco"),
    ],
)
def test_invalid_arguments_say_what_is_wrong(task, arguments, message):
    with pytest.raises(ValueError, match=rf"^{message}$"):
        task(**arguments)


@pytest.mark.parametrize("angle", [0.0, 3.2])
def test_an_angle_must_be_positive_and_less_than_a_half_turn(angle):
    with pytest.raises(ValueError, match=rf"rotation_tolerance = {angle} is not usable: it must be greater than 0 and less than pi"):
        CableInsertion(rotation_tolerance=angle)


@pytest.mark.parametrize("backend", ["closed_form", "mujoco"])
def test_equal_environments_compile_once(backend):
    chex.clear_trace_counter()
    one_step = jax.jit(chex.assert_max_traces(lambda env, state, action: env.step(state, action), n=1), static_argnums=0)
    state, _ = jax.eval_shape(BringNear(backend=backend).reset, key())
    for _ in range(2):
        state, _ = one_step.trace(BringNear(backend=backend), state, jax.ShapeDtypeStruct((14,), jnp.float32)).out_info


def test_many_side_by_side_through_gymnasium_in_c():
    envs = gymnasium.make_vec("hindrl/BringNear-v0", num_envs=3, backend="mujoco", max_episode_steps=5)
    observations, _ = envs.reset(seed=1)
    assert observations["observation"].shape == (3, 38)
    for _ in range(6):
        observations, rewards, *_ = envs.step(np.broadcast_to(SHUT, (3, 14)))
    assert np.isfinite(observations["observation"]).all()
    assert (rewards == 0).all()
