"""What is observed in the reach tasks, which part of it is a goal, and how hindsight relabels it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reach_states import DIRECTIONS, FAR, TURNED, mujoco_hand, observe, place, stay
from scipy.spatial.transform import Rotation

from hindrl_jax.base.environments import RelabelsObservations
from hindrl_jax.envs import panda
from hindrl_jax.envs.reach import FixedParameterizedReach, ParameterizedReach

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
