"""The rules of the grid worlds, each one played by hand from a placed state."""

import jax.numpy as jnp
import numpy as np
import pytest
from grid_states import BOTH_TASKS, DOWN, EITHER_ORDER, LEFT, RIGHT, UP, act, cells, place, play

from hindrl_jax.envs.grid import GridPickAndPlace

# --- moving


@BOTH_TASKS
@pytest.mark.parametrize(("move", "expected"), [(RIGHT, (5, 3)), (DOWN, (4, 4)), (LEFT, (3, 3)), (UP, (4, 2))])
def test_moves(task, move, expected):
    state, _ = play(task(), place((4, 3), [(9, 0), (9, 9)], (0, 9)), act(move, grab=False))
    assert cells(state) == (expected, [(9, 0), (9, 9)], (0, 9))
    assert int(state.step) == 1


@pytest.mark.parametrize(("corner", "moves"), [((0, 0), (LEFT, UP)), ((9, 9), (RIGHT, DOWN))])
def test_walls_stop_the_agent(corner, moves):
    for move in moves:
        state, _ = play(GridPickAndPlace(), place(corner, [(5, 5), (6, 6)], (7, 7)), act(move, grab=False))
        assert cells(state)[0] == corner


def test_largest_score_moves_and_scores_are_clipped_to_the_bounds():
    state = place((4, 4), [(9, 0), (9, 9)], (0, 9))
    moved, _ = play(GridPickAndPlace(), state, jnp.array([0.2, 0.3, 0.1, 0.9, 0.0]))
    assert cells(moved)[0] == (4, 3)
    # -5, 7 and 3 are clipped to 0, 1 and 1: the first of the equal scores wins, which is +y.
    moved, _ = play(GridPickAndPlace(), state, jnp.array([-5.0, 3.0, 0.5, 7.0, 0.0]))
    assert cells(moved)[0] == (4, 5)


# --- grabbing


@BOTH_TASKS
def test_grabbed_object_moves_along_in_the_same_step(task):
    state, _ = play(task(), place((4, 4), [(4, 4), (9, 9)], (0, 9)), act(RIGHT, grab=True))
    assert (int(state.held), cells(state)[:2]) == (0, ((5, 4), [(5, 4), (9, 9)]))
    state, _ = play(task(), state, act(DOWN, grab=True))
    assert (int(state.held), cells(state)[:2]) == (0, ((5, 5), [(5, 5), (9, 9)]))


@pytest.mark.parametrize(("grab", "held"), [(0.5, -1), (0.5001, 0)])
def test_grab_needs_strictly_more_than_one_half(grab, held):
    state, _ = play(GridPickAndPlace(), place((4, 4), [(4, 4), (9, 9)], (0, 9)), act(RIGHT, grab=grab))
    assert int(state.held) == held


def test_grab_looks_at_the_cell_before_the_move():
    state, _ = play(GridPickAndPlace(), place((4, 4), [(5, 4), (9, 9)], (0, 9)), act(RIGHT, grab=True))
    assert int(state.held) == -1
    assert cells(state)[:2] == ((5, 4), [(5, 4), (9, 9)])


def test_an_object_out_of_order_can_be_grabbed_too():
    state, _ = play(GridPickAndPlace(), place((4, 4), [(9, 0), (4, 4)], (0, 9)), act(RIGHT, grab=True))
    assert int(state.held) == 1


def test_lowest_numbered_object_is_grabbed_first_and_only_one():
    state, _ = play(GridPickAndPlace(num_objects=3), place((4, 4), [(9, 0), (4, 4), (4, 4)], (0, 9)), act(RIGHT, grab=True))
    assert int(state.held) == 1
    assert cells(state)[1] == [(9, 0), (5, 4), (4, 4)]


def test_the_held_object_stays_held_on_top_of_another():
    state, _ = play(GridPickAndPlace(), place((4, 4), [(4, 4), (4, 4)], (0, 9), held=1), act(RIGHT, grab=True))
    assert int(state.held) == 1
    assert cells(state)[1] == [(4, 4), (5, 4)]


def test_delivered_objects_cannot_be_grabbed():
    state, _ = play(GridPickAndPlace(), place((0, 9), [(0, 9), (9, 9)], (0, 9), num_delivered=1), act(RIGHT, grab=True))
    assert int(state.held) == -1
    assert cells(state)[1] == [(0, 9), (9, 9)]


# --- releasing


@BOTH_TASKS
@EITHER_ORDER
def test_releasing_the_next_object_on_the_goal_delivers_it(task, strict_order):
    state = place((0, 9), [(0, 9), (9, 9)], (0, 9), held=0)
    state, time_step = play(task(strict_order=strict_order), state, act(RIGHT, grab=False))
    assert (int(state.num_delivered), int(state.held)) == (1, -1)
    assert cells(state)[:2] == ((1, 9), [(0, 9), (9, 9)])  # it stays where it was before the move, the agent moves on
    assert float(time_step.reward) == 0.0
    assert not time_step.terminated


def test_release_looks_at_the_cell_before_the_move():
    # The agent walks onto the goal while releasing: the object was released next to the goal and is lost.
    state, _ = play(GridPickAndPlace(), place((1, 9), [(1, 9), (9, 9)], (0, 9), held=0), act(LEFT, grab=False))
    assert int(state.num_delivered) == 0
    assert cells(state)[1][0] not in [(1, 9), (0, 9), (9, 9)]


@EITHER_ORDER
@pytest.mark.parametrize("held", [0, 1])
def test_releasing_elsewhere_teleports(strict_order, held):
    env = GridPickAndPlace(strict_order=strict_order)
    objects = [(9, 0), (9, 9)]
    objects[held] = (4, 4)
    state, _ = play(env, place((4, 4), objects, (0, 9), held=held), act(RIGHT, grab=False))
    assert (int(state.num_delivered), int(state.held)) == (0, -1)
    agent, after, _ = cells(state)
    assert agent == (5, 4)
    assert after[1 - held] == objects[1 - held]
    assert after[held] not in [(4, 4), (5, 4), (0, 9), objects[1 - held]]


# --- order of the objects


@BOTH_TASKS
def test_strict_an_object_out_of_order_is_teleported_when_carried_onto_the_goal(task):
    env = task(num_objects=3)
    for held in (1, 2):
        objects = [(9, 0), (9, 9), (4, 4)]
        objects[held] = (1, 9)
        state, time_step = play(env, place((1, 9), objects, (0, 9), held=held), act(LEFT, grab=True))
        assert (int(state.held), int(state.num_delivered)) == (-1, 0)
        assert cells(state)[0] == (0, 9)
        assert cells(state)[1][held] not in [(0, 9), (1, 9)]
        assert not time_step.terminated
        assert float(time_step.reward) == 0.0


def test_lenient_an_object_out_of_order_is_teleported_only_on_release():
    env = GridPickAndPlace(num_objects=3, strict_order=False)
    state = place((1, 9), [(9, 0), (1, 9), (4, 4)], (0, 9), held=1)
    state, _ = play(env, state, act(LEFT, grab=True))
    assert int(state.held) == 1
    assert cells(state)[1][1] == (0, 9)
    state, _ = play(env, state, act(RIGHT, grab=False))
    assert (int(state.held), int(state.num_delivered)) == (-1, 0)
    assert cells(state)[1][1] not in [(0, 9), (1, 9)]


# --- success and the end of an episode


@BOTH_TASKS
@EITHER_ORDER
@pytest.mark.parametrize("num_objects", [1, 2, 3])
def test_holding_the_last_object_on_the_goal_after_the_others_solves_the_task(task, strict_order, num_objects):
    env = task(num_objects=num_objects, strict_order=strict_order)
    last = num_objects - 1
    state = place((1, 9), [(0, 9)] * last + [(1, 9)], (0, 9), num_delivered=last, held=last)
    state, time_step = play(env, state, act(LEFT, grab=True))
    assert time_step.terminated
    assert not time_step.truncated
    assert float(time_step.reward) == 1.0
    assert bool(env.is_solved(state))
    np.testing.assert_array_equal(env.achieved_goal(time_step.observation), env.task_goal())


def test_task_goal_by_hand():
    # 3 distances to objects, 1 to the goal, transported 1 1 0, grabbed 0 0 1.
    assert GridPickAndPlace(num_objects=3).task_goal().tolist() == [0.0] * 8 + [1.0, 1.0, 0.0] + [0.0, 0.0, 1.0]


@BOTH_TASKS
@pytest.mark.parametrize("num_objects", [2, 3])
def test_strict_order_decides_about_the_shortcut(task, num_objects):
    last = num_objects - 1
    state = place((1, 9), [*[(9, 0), (9, 9)][:last], (1, 9)], (0, 9), held=last)
    for strict_order in (True, False):
        _, time_step = play(task(num_objects=num_objects, strict_order=strict_order), state, act(LEFT, grab=True))
        assert bool(time_step.terminated) is not strict_order
        assert float(time_step.reward) == float(not strict_order)


def test_success_needs_the_object_held_after_the_move():
    state = place((1, 9), [(0, 9), (1, 9)], (0, 9), num_delivered=1, held=1)
    _, time_step = play(GridPickAndPlace(), state, act(LEFT, grab=False))  # released on the way
    assert not time_step.terminated
    _, time_step = play(GridPickAndPlace(), state, act(RIGHT, grab=True))  # carried away from the goal
    assert not time_step.terminated


def test_time_out_truncates_and_success_at_the_horizon_terminates():
    env = GridPickAndPlace(horizon=7)
    state = place((1, 9), [(0, 9), (1, 9)], (0, 9), num_delivered=1, held=1, step=5)
    _, before = play(env, state, act(RIGHT, grab=True))
    assert not before.truncated
    state = state.replace(step=jnp.int32(6))
    _, timed_out = play(env, state, act(RIGHT, grab=True))
    assert (bool(timed_out.truncated), bool(timed_out.terminated), float(timed_out.reward)) == (True, False, 0.0)
    _, solved = play(env, state, act(LEFT, grab=True))
    assert (bool(solved.truncated), bool(solved.terminated), float(solved.reward)) == (False, True, 1.0)


# --- observation


def test_observation_by_hand():
    env = GridPickAndPlace(num_objects=3)
    state = place((4, 3), [(0, 9), (4, 3), (9, 0)], (0, 9), num_delivered=1, held=1)
    # object 0: (0-4, 9-3); object 1: on the agent; object 2: (9-4, 0-3); goal: (0-4, 9-3); transported; grabbed
    expected = [-4, 6, 0, 0, 5, -3, -4, 6, 1, 0, 0, 0, 1, 0]
    assert env.observe(state).tolist() == expected


def test_the_last_observation_of_an_episode_is_the_true_next_one():
    env = GridPickAndPlace(horizon=1)
    state, time_step = play(env, place((4, 4), [(9, 0), (9, 9)], (0, 9)), act(RIGHT, grab=False))
    assert time_step.truncated
    # After the move to (5, 4), not that of a fresh episode.
    assert time_step.observation.tolist() == [4, -4, 4, 5, -5, 5, 0, 0, 0, 0]
    np.testing.assert_array_equal(time_step.observation, env.observe(state))
