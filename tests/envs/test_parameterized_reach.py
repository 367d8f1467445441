"""The rules of the reach tasks, each one tried in a placed state: waypoints lie where the hand is, or a little beside it."""

import functools

import chex
import hypothesis
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hindrl_jax.base.environments import RelabelsObservations
from hindrl_jax.envs.reach import FixedParameterizedReach, ParameterizedReach, ReachState, panda, rotations

BOTH_TASKS = pytest.mark.parametrize("task", [FixedParameterizedReach, ParameterizedReach])
FAR = (0.0, 0.1, 0.0)  # m
TURNED = (0.0, 0.0, 0.3)  # rad


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


NUM_RESETS = 3000


@functools.partial(jax.jit, static_argnums=0)
def resets(env):
    """Start states, with observations."""
    return jax.vmap(env.reset)(jax.random.split(jax.random.key(3), NUM_RESETS))


# --- rotations


to_vectors = jax.jit(jax.vmap(rotations.to_rotation_vector))
from_vectors = jax.jit(jax.vmap(rotations.from_rotation_vector))
six_d = jax.jit(jax.vmap(rotations.to_six_d))
between = jax.jit(jax.vmap(rotations.between))
UNIT_VECTORS = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1).map(lambda v: np.array(v) / np.linalg.norm(v))


@hypothesis.given(axis=UNIT_VECTORS, angle=st.floats(0, np.pi))
@hypothesis.example(axis=np.array([1.0, 0, 0]), angle=np.pi)  # a hand that points straight down
@hypothesis.example(axis=np.array([0, -0.6, 0.8]), angle=np.pi)
@hypothesis.example(axis=np.array([0, 0, 1.0]), angle=np.pi - 1e-3)
@hypothesis.example(axis=np.array([0, 0.6, 0.8]), angle=1e-4)
@hypothesis.example(axis=np.array([0, 0, -1.0]), angle=1e-30)
@hypothesis.example(axis=np.array([0, 0, 1.0]), angle=0.0)
@hypothesis.settings(deadline=None, max_examples=60)
def test_rotation_vectors_there_and_back(axis, angle):
    vector = np.float32(angle * axis)
    matrix = from_vectors(vector[None])
    np.testing.assert_allclose(matrix[0], Rotation.from_rotvec(vector).as_matrix(), atol=1e-6)
    back = np.asarray(to_vectors(matrix)[0])
    assert np.linalg.norm(back) <= np.pi + 1e-6
    if angle < np.pi - 1e-5:
        np.testing.assert_allclose(back, vector, atol=3e-6)
    else:  # where an axis and its opposite mean the same
        assert min(np.abs(back - vector).max(), np.abs(back + vector).max()) < 3e-6


def test_rotation_vectors_of_matrices_are_those_of_scipy():
    matrices = Rotation.random(200, random_state=0).as_matrix()
    found = to_vectors(jnp.asarray(matrices, jnp.float32))
    np.testing.assert_allclose(found, Rotation.from_matrix(matrices).as_rotvec(), atol=1e-5)


def test_six_d_is_continuous_where_rotation_vectors_jump():
    axes = Rotation.random(50, random_state=1).as_matrix()[:, 0]
    vectors = np.concatenate([(np.pi - 1e-3) * axes, -(np.pi - 1e-3) * axes]).astype(np.float32)  # 2e-3 rad apart, from both sides of pi
    matrices = from_vectors(vectors)
    found = np.asarray(six_d(matrices))
    assert np.abs(found[:50] - found[50:]).max() < 2.1e-3
    assert np.linalg.norm(to_vectors(matrices)[:50] - to_vectors(matrices)[50:], axis=1).min() > 6.0
    # It is the whole rotation: the third column follows.
    np.testing.assert_allclose(np.cross(found[:, :3], found[:, 3:]), matrices[:, :, 2], atol=1e-6)
    np.testing.assert_allclose(jax.vmap(rotations.from_six_d)(found), matrices, atol=1e-6)


def test_between_turns_the_source_into_the_target_in_the_axes_of_the_base():
    source, target = (Rotation.random(100, random_state=seed) for seed in (2, 3))
    found = between(jnp.asarray(source.as_matrix(), jnp.float32), jnp.asarray(target.as_matrix(), jnp.float32))
    np.testing.assert_allclose((Rotation.from_rotvec(found) * source).as_matrix(), target.as_matrix(), atol=1e-5)
    quarter = between(jnp.eye(3)[None], jnp.array([[[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]]))  # x becomes y: about +z
    np.testing.assert_allclose(quarter, [[0, 0, np.pi / 2]], atol=1e-6)


# --- reset


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


# --- when a waypoint is reached


@BOTH_TASKS
def test_waypoints_count_in_order_only(task):
    env = task()
    state, time_step = stay(env, place([FAR, (0, 0, 0)]))  # the arm is at the second one
    assert (int(state.num_reached), bool(time_step.terminated)) == (0, False)
    state, time_step = stay(env, place([(0, 0, 0), FAR]))
    assert (int(state.num_reached), bool(time_step.terminated)) == (1, False)
    state, time_step = stay(env, state)  # the first one does not count twice
    assert (int(state.num_reached), bool(time_step.terminated)) == (1, False)
    state, time_step = stay(env, place([FAR, (0, 0, 0)], num_reached=1))  # that it has been reached is enough
    assert (int(state.num_reached), bool(time_step.terminated)) == (2, True)


@BOTH_TASKS
def test_waypoints_in_one_place_take_a_step_each(task):
    state, outcomes = place([(0, 0, 0)] * 2), []
    for _ in range(2):
        state, time_step = stay(task(), state)
        outcomes.append((int(state.num_reached), float(time_step.reward), bool(time_step.terminated)))
    assert outcomes == [(1, 0.0, False), (2, 1.0, True)]


DIRECTIONS = [np.array(v) / np.linalg.norm(v) for v in ([1, 0, 0], [0, 0, -1], [1, -2, 3])]


@pytest.mark.parametrize("direction", DIRECTIONS, ids=str)
@pytest.mark.parametrize(
    ("tolerances", "offset", "turn", "reached"),
    [
        ((0.02, 0.05), 0.0199, 0.0, True),
        ((0.02, 0.05), 0.0201, 0.0, False),
        ((0.02, 0.05), 0.0, 0.0499, True),
        ((0.02, 0.05), 0.0, 0.0501, False),
        ((0.02, 0.05), 0.0199, 0.0499, True),  # each for itself, not their sum
        ((0.02, 0.05), 0.0, np.pi, False),
        ((0.1, 0.5), 0.099, 0.49, True),
        ((0.1, 0.5), 0.101, 0.0, False),
        ((0.1, 0.5), 0.0, 0.51, False),
    ],
)
def test_tolerances(direction, tolerances, offset, turn, reached):
    env = FixedParameterizedReach(position_tolerance=tolerances[0], rotation_tolerance=tolerances[1])
    state, _ = stay(env, place([offset * direction, FAR], [turn * direction[::-1], (0, 0, 0)]))
    assert int(state.num_reached) == int(reached)


@BOTH_TASKS
def test_the_rotation_test_of_the_original_code_jumps(task):
    """A hand that points down turns by pi about a horizontal axis: 0.02 rad about another one flips the sign of its axis-angle vector."""
    _, matrix = mujoco_hand(panda.INITIAL_JOINTS)
    by_vectors = task(num_waypoints=1, rotation_test="axis_angle")
    reached = []
    for angle in np.linspace(-0.045, 0.045, 7):
        turn = angle * np.array([0.0, 1.0, 0.0])
        state = place([(0.0, 0.0, 0.0)], [turn])
        jump = np.linalg.norm(
            Rotation.from_matrix(Rotation.from_rotvec(turn).as_matrix() @ matrix).as_rotvec() - Rotation.from_matrix(matrix).as_rotvec()
        )
        assert bool(stay(task(num_waypoints=1), state)[1].terminated)
        assert bool(stay(by_vectors, state)[1].terminated) == (jump < 0.05)
        reached.append(jump < 0.05)
    assert len(set(reached)) == 2


@BOTH_TASKS
def test_mask_reward_and_end(task):
    env = task(num_waypoints=3, horizon=7)
    start = env.pose_dim
    for num_reached, mask in [(0, [1, 0, 0]), (1, [1, 1, 0]), (2, [1, 1, 1])]:
        state, time_step = stay(env, place([(0, 0, 0)] * 3, num_reached=num_reached, step=4))
        assert time_step.observation[start : start + 3].tolist() == mask
        solved = num_reached == 2
        assert (bool(time_step.terminated), float(time_step.reward), bool(time_step.truncated)) == (solved, float(solved), False)
        assert bool(env.is_solved(state)) == solved
        assert int(state.step) == 5
    for step_before, num_reached, expected in [(5, 0, (False, False)), (6, 0, (False, True)), (6, 2, (True, False))]:
        _, time_step = stay(env, place([(0, 0, 0)] * 3, num_reached=num_reached, step=step_before))
        assert (bool(time_step.terminated), bool(time_step.truncated)) == expected


# --- goals


@pytest.mark.parametrize("orientation", ["six_d", "axis_angle"])
def test_task_goal_of_the_fixed_task_is_its_last_waypoint(orientation):
    goal = FixedParameterizedReach(orientation=orientation).task_goal()
    vector = [2.88426, 0.12777, 0.35920]
    pose = Rotation.from_rotvec(vector).as_matrix()[:, :2].T.reshape(-1) if orientation == "six_d" else vector
    np.testing.assert_allclose(goal, [0.42493, 0.07166, 0.36318, *pose, 1.0, 1.0], atol=1e-6)


def test_a_solved_fixed_task_has_the_task_goal_but_for_the_tolerances():
    # The thesis's last waypoint is moved to just within the tolerances of where the arm is, and the goal with it.
    env = FixedParameterizedReach()
    state, time_step = stay(env, place([FAR, 0.0199 * DIRECTIONS[2]], [TURNED, 0.049 * DIRECTIONS[2]], num_reached=1))
    assert time_step.terminated
    achieved = np.asarray(env.achieved_goal(time_step.observation))
    np.testing.assert_array_equal(achieved, time_step.observation)
    goal = np.concatenate([state.positions[1], np.asarray(state.rotations[1])[:, :2].T.reshape(-1), [1.0, 1.0]])
    assert 0.019 < np.linalg.norm(achieved[:3] - goal[:3]) < 0.02
    assert 0.03 < np.abs(achieved - goal)[3:-2].max() < 0.05
    assert achieved[-2:].tolist() == [1.0, 1.0]


def test_a_solved_random_task_has_the_task_goal_but_for_the_tolerances():
    env = ParameterizedReach()
    assert env.task_goal().tolist() == [0.0] * 6 + [1.0, 1.0]
    _, time_step = stay(env, place([FAR, 0.0199 * DIRECTIONS[2]], [TURNED, 0.049 * DIRECTIONS[2]], num_reached=1))
    assert time_step.terminated
    achieved = np.asarray(env.achieved_goal(time_step.observation))
    assert achieved[6:].tolist() == [1.0, 1.0]
    np.testing.assert_allclose(achieved[:6], np.concatenate([0.0199 * DIRECTIONS[2], 0.049 * DIRECTIONS[2]]), atol=1e-6)
    # Nothing but the last waypoint and the mask enters it.
    _, elsewhere = stay(env, place([(0.05, 0, 0), 0.0199 * DIRECTIONS[2]], [(0, 0, 0), 0.049 * DIRECTIONS[2]], num_reached=1))
    np.testing.assert_array_equal(env.achieved_goal(elsewhere.observation), achieved)
    assert not np.array_equal(elsewhere.observation, time_step.observation)


def test_goals_of_many_observations_at_once():
    for env in (FixedParameterizedReach(num_waypoints=3), ParameterizedReach(num_waypoints=3)):
        observations = jnp.arange(2 * 4 * env.observation_dim, dtype=jnp.float32).reshape(2, 4, -1)
        goals = env.achieved_goal(observations)
        assert goals.shape == (2, 4, env.goal_dim)
        np.testing.assert_array_equal(goals[1, 2], env.achieved_goal(observations[1, 2]))


# --- hindsight


def test_only_the_random_task_relabels_observations():
    assert isinstance(ParameterizedReach(), RelabelsObservations)
    assert not isinstance(FixedParameterizedReach(), RelabelsObservations)


@pytest.mark.parametrize("arguments", [{}, {"num_waypoints": 3}, {"orientation": "axis_angle", "rotation_test": "axis_angle"}])
def test_relabelled_observations_are_what_would_have_been_observed(arguments):
    env = ParameterizedReach(**arguments)
    count, num_steps, starts = env.num_waypoints, 4, (0, 5, 11)
    joints = np.array(panda.INITIAL_JOINTS) + np.cumsum(np.random.default_rng(0).normal(0.004, 0.006, (30, 7)), axis=0)
    state = place(
        np.linspace((0.1, 0.0, 0.1), (-0.1, 0.2, 0.0), count), np.linspace((0.3, 0, 0), (0, 0, 0.2), count), joints=joints[0], num_reached=1
    )
    look = jax.jit(jax.vmap(lambda q, reached: env.observe(state.replace(joints=q, num_reached=reached))))
    # As recorded, a waypoint is reached on the way.
    observations = look(jnp.asarray(joints, jnp.float32), jnp.asarray(np.arange(30) >= 8, jnp.int32))
    relabel, arrive = jax.jit(env.relabel_observations), jax.jit(env.arrive)
    reached_at_first, solved_at_all = set(), []
    for seed in range(12):
        start = starts[seed % 3]
        chosen = [start + 2, start + 3, start + 3 + seed][:count] if count == 3 else [start + 1 + seed % 3, start + 3]
        relabelled, solved = relabel(jax.random.key(seed), observations[start : start + num_steps + 1], observations[np.array(chosen)])
        mask = relabelled[0, env.pose_dim : env.pose_dim + count]
        reached = int(mask.sum())
        # The same motion, played with the waypoints where they now are.
        poses = [mujoco_hand(joints[index]) for index in chosen[: count - reached]]
        played = state.replace(joints=jnp.asarray(joints[start], jnp.float32), num_reached=jnp.asarray(reached))
        played = played.replace(
            positions=played.positions.at[reached:].set(jnp.array([position for position, _ in poses])),
            rotations=played.rotations.at[reached:].set(jnp.array([matrix for _, matrix in poses])),
        )
        np.testing.assert_allclose(relabelled[0], observe(env, played), atol=2e-5)
        for index in range(1, num_steps + 1):
            played, time_step = arrive(played, jnp.asarray(joints[start + index], jnp.float32), played.velocities)
            np.testing.assert_allclose(relabelled[index], time_step.observation, atol=2e-5)
            assert solved[index - 1] == env.is_solved(played)
        reached_at_first.add(reached)
        solved_at_all.append(bool(solved[-1]))
    assert reached_at_first == set(range(count))
    assert sum(solved_at_all) > 0


# --- observations


@pytest.mark.parametrize("orientation", ["six_d", "axis_angle"])
def test_observation_is_what_mujoco_says(orientation):
    joints = np.array(panda.INITIAL_JOINTS) + np.random.default_rng(0).normal(0, 0.3, 7)
    offsets, turns = [(0.1, -0.2, 0.05), (-0.03, 0.0, 0.2)], [(0.3, 0.1, -0.2), (0.0, 2.0, 1.0)]
    state = place(offsets, turns, joints=joints, num_reached=1)
    position, matrix = mujoco_hand(joints)
    pose = matrix[:, :2].T.reshape(-1) if orientation == "six_d" else Rotation.from_matrix(matrix).as_rotvec()
    hand_and_mask = np.concatenate([position, pose, [1.0, 0.0]])
    remaining = np.concatenate([offsets, turns], axis=1)[::-1].reshape(-1)  # the second, whose turn it is, then the first, which has been reached
    found = observe(FixedParameterizedReach(orientation=orientation), state)
    np.testing.assert_allclose(found, hand_and_mask, atol=1e-5)
    found = observe(ParameterizedReach(orientation=orientation), state)
    np.testing.assert_allclose(found, np.concatenate([hand_and_mask, remaining]), atol=1e-5)


@pytest.mark.parametrize("num_waypoints", [1, 2, 3, 4])
@pytest.mark.parametrize(("orientation", "pose_dim"), [("six_d", 9), ("axis_angle", 6)])
def test_dimensions(num_waypoints, orientation, pose_dim):
    arguments = dict(num_waypoints=num_waypoints, orientation=orientation)
    fixed, random = FixedParameterizedReach(**arguments), ParameterizedReach(**arguments)
    assert fixed.observation_dim == fixed.goal_dim == pose_dim + num_waypoints
    assert (random.observation_dim, random.goal_dim) == (pose_dim + 7 * num_waypoints, 6 + num_waypoints)
    for env in (fixed, random):
        assert (env.action_dim, env.state_dim) == (6, 23 + 12 * num_waypoints)
        state, observation = jax.eval_shape(env.reset, jax.random.key(0))
        assert observation.shape == (env.observation_dim,)
        assert jax.eval_shape(env.state_to_vector, state).shape == (env.state_dim,)
        _, time_step = jax.eval_shape(env.step, state, jnp.zeros(6))
        assert time_step.observation.shape == (env.observation_dim,)


# --- steps


@BOTH_TASKS
def test_a_step_moves_the_arm_as_the_controller_does(task):
    state = place([FAR, FAR])
    action = jnp.array([0.02, -0.01, 0.5, 0.05, -9.0, 0.0])  # clipped to its bounds, dimension by dimension
    clipped = jnp.array([0.02, -0.01, 0.02, 0.05, -0.05, 0.0])
    np.testing.assert_allclose(task().action_high, [0.02] * 3 + [0.05] * 3, rtol=1e-6)
    np.testing.assert_allclose(task().action_low, -task().action_high)
    after, time_step = step(task(), state, action)
    joints, velocities = jax.jit(panda.control_step)(state.joints, state.velocities, state.rest, clipped)
    np.testing.assert_allclose(after.joints, joints, atol=1e-6)
    np.testing.assert_allclose(after.velocities, velocities, atol=1e-5)
    np.testing.assert_array_equal(after.rest, state.rest)
    position, _ = mujoco_hand(after.joints)
    np.testing.assert_allclose(time_step.observation[:3], position, atol=1e-5)
    moved = position - mujoco_hand(state.joints)[0]
    assert 1e-4 < moved @ np.array([0.02, -0.01, 0.02]) / 0.03 < 0.02  # forward, if with inertia


def test_a_resting_arm_without_a_command_stays():
    state, time_step = step(FixedParameterizedReach(), place([(0, 0, 0), FAR]), jnp.zeros(6))
    np.testing.assert_allclose(state.joints, panda.INITIAL_JOINTS, atol=1e-6)
    assert time_step.observation[-2:].tolist() == [1.0, 0.0]


@BOTH_TASKS
def test_robosuite_is_not_stepped_here(task):
    env = task(backend="robosuite")
    state, _ = jax.eval_shape(env.reset, jax.random.key(0))
    with pytest.raises(ValueError, match="robosuite simulates one arm outside JAX") as error:
        jax.eval_shape(env.step, state, jnp.zeros(6))
    assert "\n" not in str(error.value)


# --- saved states


@BOTH_TASKS
def test_state_survives_the_way_through_a_vector(task):
    env = task()
    state = place([(0.1, 0.2, 0.3), FAR], [TURNED, (0.1, 0, 0)], num_reached=1, step=42, seed=5)
    state = state.replace(velocities=jnp.arange(7.0), rest=state.rest + 0.1)
    vector = env.state_to_vector(state)
    assert vector.dtype == jnp.float32
    assert vector.shape == (env.state_dim,)
    parts = [state.joints, state.velocities, state.rest, state.positions.ravel(), state.rotations.ravel(), [1, 42]]
    np.testing.assert_array_equal(vector, np.concatenate(parts))
    back = env.vector_to_state(jax.random.key(5), vector)
    chex.assert_trees_all_equal(back, state)
    chex.assert_trees_all_equal_shapes_and_dtypes(back.replace(key=None), state.replace(key=None))


@BOTH_TASKS
def test_an_episode_goes_on_from_a_restored_state_as_it_would_have(task):
    env = task()
    actions = np.random.default_rng(0).uniform(-0.05, 0.05, (8, 6)).astype(np.float32)
    state = place([(0.005, 0.0, 0.0), FAR], joints=np.array(panda.INITIAL_JOINTS) + 0.02)
    for action in actions[:4]:
        state, _ = step(env, state, action)
    restored = env.vector_to_state(jax.random.key(9), env.state_to_vector(state))
    for action in actions[4:]:
        state, time_step = step(env, state, action)
        restored, again = step(env, restored, action)
        chex.assert_trees_all_equal(again, time_step)
    assert int(state.num_reached) == 1
    assert np.abs(state.velocities).max() > 0.01


# --- arguments and compilation


@BOTH_TASKS
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"num_waypoints": 0}, "num_waypoints = 0 is not usable: it must be at least 1"),
        ({"num_waypoints": 2.0}, "num_waypoints = 2.0 is not usable: it must be a whole number"),
        ({"horizon": 0}, "horizon = 0 is not usable: it must be at least 1"),
        ({"position_tolerance": 0.0}, "position_tolerance = 0.0 is not usable: it must be greater than 0"),
        ({"rotation_tolerance": -0.1}, "rotation_tolerance = -0.1 is not usable: it must be greater than 0"),
        ({"joint_noise": -0.01}, "joint_noise = -0.01 is not usable: it must be 0 or more"),
        ({"joint_noise": float("nan")}, "joint_noise = nan is not usable: it must be a finite number"),
        ({"orientation": "quaternion"}, "orientation = 'quaternion' is not usable: it must be one of six_d, axis_angle"),
        ({"backend": "gazebo"}, "backend = 'gazebo' is not usable: it must be one of closed_form, mjx, robosuite"),
    ],
)
def test_invalid_arguments_say_what_is_wrong(task, arguments, message):
    with pytest.raises(ValueError, match=rf"^{message}$"):
        task(**arguments)


@BOTH_TASKS
def test_equal_environments_compile_once(task):
    chex.clear_trace_counter()  # it counts by source line, not by function object
    reset = jax.jit(chex.assert_max_traces(lambda env, key: env.reset(key), n=1), static_argnums=0)
    one_step = jax.jit(chex.assert_max_traces(lambda env, state, action: env.step(state, action), n=1), static_argnums=0)
    for seed in range(2):  # tracing alone, since compiling takes seconds
        state, _ = reset.trace(task(), jax.random.key(seed)).out_info
        for _ in range(2):
            state, _ = one_step.trace(task(), state, jax.ShapeDtypeStruct((6,), jnp.float32)).out_info
    with pytest.raises(AssertionError, match="traced > 1 times"):
        reset.trace(task(horizon=7), jax.random.key(0))
