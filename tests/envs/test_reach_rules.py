"""The rules of the reach tasks, each one tried in a placed state."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reach_states import BOTH_TASKS, DIRECTIONS, FAR, TURNED, mujoco_hand, place, stay, step
from scipy.spatial.transform import Rotation

from hindrl_jax.envs import panda
from hindrl_jax.envs.panda import closed_form
from hindrl_jax.envs.reach import FixedParameterizedReach

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


# --- steps


@BOTH_TASKS
def test_a_step_moves_the_arm_as_the_controller_does(task):
    state = place([FAR, FAR])
    action = jnp.array([0.02, -0.01, 0.5, 0.05, -9.0, 0.0])  # clipped to its bounds, dimension by dimension
    clipped = jnp.array([0.02, -0.01, 0.02, 0.05, -0.05, 0.0])
    np.testing.assert_allclose(task().action_high, [0.02] * 3 + [0.05] * 3, rtol=1e-6)
    np.testing.assert_allclose(task().action_low, -task().action_high)
    after, time_step = step(task(), state, action)
    joints, velocities = jax.jit(closed_form.control_step)(state.joints, state.velocities, state.rest, clipped)
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
        ({"num_waypoints": 0}, "num_waypoints = 0 is not usable: it must be at least 1 and at most 1000"),
        ({"num_waypoints": 2.0}, "num_waypoints = 2.0 is not usable: it must be a whole number of at most 2147483647"),
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
