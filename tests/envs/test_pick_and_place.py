"""The rules of the grid worlds, each one played by hand from a placed state."""

import dataclasses
import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hindrl_jax.envs.grid.pick_and_place import FixedGridPickAndPlace, GridPickAndPlace, GridState, _free_rank

RIGHT, DOWN, LEFT, UP = range(4)  # +x, +y, -x, -y
BOTH_TASKS = pytest.mark.parametrize("task", [GridPickAndPlace, FixedGridPickAndPlace])
EITHER_ORDER = pytest.mark.parametrize("strict_order", [True, False])


def place(agent, objects, goal, *, num_delivered=0, held=-1, step=0, seed=0):
    """A state with everything where the test wants it; cells are (x, y)."""
    integers = {"agent": agent, "objects": objects, "goal": goal, "num_delivered": num_delivered, "held": held, "step": step}
    return GridState(key=jax.random.key(seed), **{name: jnp.asarray(value, jnp.int32) for name, value in integers.items()})


def act(move, *, grab):
    """(5,) action that moves and sets the grab switch."""
    return jnp.zeros(5).at[move].set(1.0).at[4].set(float(grab))


@functools.partial(jax.jit, static_argnums=0)
def jitted_step(env, state, action):
    return env.step(state, action)


def play(env, state, *actions):
    """Takes all actions; returns the last state and the last time step."""
    for action in actions:
        state, time_step = jitted_step(env, state, action)
    return state, time_step


def cells(state):
    """Agent, objects and goal as tuples."""
    return tuple(state.agent.tolist()), [tuple(o) for o in state.objects.tolist()], tuple(state.goal.tolist())


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


# --- teleports


@functools.partial(jax.jit, static_argnums=(0, 3))
def teleports(env, state, action, num):
    """(num, K, 2) objects after the same step under many keys."""
    keys = jax.random.split(jax.random.key(7), num)
    return jax.vmap(lambda key: env.step(state.replace(key=key), action)[0].objects)(keys)


@pytest.mark.parametrize("rule", ["released", "rejected"])
def test_random_teleport_is_uniform_over_exactly_the_free_cells(rule):
    env = GridPickAndPlace(size=4)
    if rule == "released":  # the agent moves from (1, 1), where it leaves object 1, to (2, 1)
        state, action = place((1, 1), [(3, 0), (1, 1)], (0, 2), held=1), act(RIGHT, grab=False)
        taken = {(2, 1), (1, 1), (3, 0), (0, 2)}
    else:  # the agent carries object 1 onto the goal
        state, action = place((1, 1), [(3, 0), (1, 1)], (2, 1), held=1), act(RIGHT, grab=True)
        taken = {(2, 1), (3, 0)}
    objects = np.asarray(teleports(env, state, action, 14_000))
    assert (objects[:, 0] == [3, 0]).all()
    counts = np.zeros((4, 4), int)
    np.add.at(counts, tuple(objects[:, 1].T), 1)
    free = {(x, y) for x in range(4) for y in range(4)} - taken
    assert {tuple(c) for c in np.argwhere(counts).tolist()} == free
    # 14,000 over 12 or 14 cells: at least 1,000 each, with a standard deviation below 34.
    assert np.abs(counts[counts > 0] - 14_000 / len(free)).max() < 5 * 34


def test_random_teleport_finds_the_only_free_cell():
    env = GridPickAndPlace(size=2, num_objects=1)
    state = place((0, 0), [(0, 0)], (1, 1), held=0)  # agent to (1, 0); object left at (0, 0); goal at (1, 1)
    assert np.asarray(teleports(env, state, act(RIGHT, grab=False), 50)).reshape(-1, 2).tolist() == [[0, 1]] * 50


@pytest.mark.parametrize(
    ("held", "box"), [(0, [(8, 0), (9, 0), (8, 1), (9, 1)]), (1, [(8, 8), (9, 8), (8, 9), (9, 9)]), (2, [(4, 4), (5, 4), (4, 5), (5, 5)])]
)
def test_fixed_teleport_is_uniform_over_the_start_box(held, box):
    env = FixedGridPickAndPlace(num_objects=3)
    objects = [(9, 0), (9, 9), (4, 5)]
    objects[held] = (2, 3)
    after = np.asarray(teleports(env, place((2, 3), objects, (0, 9), held=held), act(RIGHT, grab=False), 4000))[:, held]
    counts = [int((after == cell).all(axis=1).sum()) for cell in box]
    assert sum(counts) == 4000
    assert max(abs(count - 1000) for count in counts) < 5 * 28  # standard deviation 27.4


def test_fixed_teleport_avoids_the_agent():
    state = place((7, 1), [(7, 1), (9, 9)], (0, 9), held=0)  # the agent moves onto (8, 1), inside the start box of object 0
    after = np.asarray(teleports(FixedGridPickAndPlace(), state, act(RIGHT, grab=False), 500))[:, 0]
    assert {tuple(cell) for cell in after.tolist()} == {(8, 0), (9, 0), (9, 1)}


def test_fixed_teleport_with_single_cell_boxes_may_land_on_the_agent():
    state = place((8, 0), [(8, 0), (9, 9)], (0, 9), held=0)
    after = np.asarray(teleports(FixedGridPickAndPlace(random_box_size=1), state, act(RIGHT, grab=False), 20))[:, 0]
    assert {tuple(cell) for cell in after.tolist()} == {(9, 0)}


def test_teleports_differ_from_step_to_step():
    # The key stays the same within an episode; the step must enter the draw.
    env = GridPickAndPlace()
    landed = {cells(play(env, place((4, 4), [(4, 4), (9, 9)], (0, 9), held=0, step=t), act(RIGHT, grab=False))[0])[1][0] for t in range(20)}
    assert len(landed) > 10


def test_free_rank_against_a_list_of_the_free_ranks():
    rng = np.random.default_rng(0)
    bits = np.concatenate([rng.integers(0, 2**32, 1990, np.uint32), np.arange(10, dtype=np.uint32)])
    occupied = rng.integers(0, 9, (2000, 6)).astype(np.int32)  # of 8 ranks; 8 itself is to be ignored; many duplicates
    drawn = np.asarray(jax.jit(jax.vmap(lambda b, o: _free_rank(b, list(o), 8)))(bits, occupied))
    for i in range(2000):
        free = [rank for rank in range(8) if rank not in occupied[i]]
        assert int(drawn[i]) == free[int(bits[i]) % len(free)]


# --- reset


@functools.partial(jax.jit, static_argnums=(0, 1))
def resets(env, num):
    """num start states, with observations."""
    return jax.vmap(env.reset)(jax.random.split(jax.random.key(3), num))


@BOTH_TASKS
def test_reset_starts_a_fresh_episode(task):
    states, observations = resets(task(num_objects=3), 10)
    assert (np.asarray(states.num_delivered) == 0).all()
    assert (np.asarray(states.held) == -1).all()
    assert (np.asarray(states.step) == 0).all()
    np.testing.assert_array_equal(observations, jax.vmap(task(num_objects=3).observe)(states))
    assert len(np.unique(jax.random.key_data(states.key), axis=0)) == 10


@pytest.mark.parametrize("num_objects", [2, 3])
def test_random_reset_is_uniform_over_distinct_cells(num_objects):
    env = GridPickAndPlace(size=3, num_objects=num_objects)
    states, _ = resets(env, 9000)
    everything = np.concatenate([states.agent[:, None], states.goal[:, None], states.objects], axis=1)  # (N, K+2, 2)
    ranks = everything[..., 1] * 3 + everything[..., 0]
    assert (np.diff(np.sort(ranks, axis=1), axis=1) > 0).all()
    for column in ranks.T:  # each of the 9 cells 1,000 times, standard deviation 29.8
        counts = np.bincount(column, minlength=9)
        assert len(counts) == 9
        assert np.abs(counts - 1000).max() < 5 * 30
    pairs = np.bincount(ranks[:, 0] * 9 + ranks[:, 1], minlength=81)  # agent and goal: 72 ordered pairs, 125 each
    assert (pairs > 0).sum() == 72


def test_fixed_reset_fills_exactly_the_start_boxes():
    env = FixedGridPickAndPlace(num_objects=7)
    states, _ = resets(env, 400)
    everything = np.concatenate([states.agent[:, None], states.goal[:, None], states.objects], axis=1)
    expected = [  # lowest and highest x, lowest and highest y
        ((0, 1), (0, 1)),  # agent
        ((0, 1), (8, 9)),  # goal
        ((8, 9), (0, 1)),  # object 0
        ((8, 9), (8, 9)),
        ((4, 5), (4, 5)),
        ((8, 9), (4, 5)),
        ((4, 5), (0, 1)),
        ((4, 5), (8, 9)),
        ((0, 1), (4, 5)),
    ]
    for i, (xs, ys) in enumerate(expected):
        assert {tuple(cell) for cell in everything[:, i].tolist()} == {(x, y) for x in xs for y in ys}
        assert env.start_boxes[i] == ((xs[0], ys[0]), (xs[1], ys[1]))


# --- saved states


@BOTH_TASKS
def test_state_survives_the_way_through_a_vector(task):
    env = task(num_objects=3)
    state = place((4, 3), [(0, 9), (4, 3), (9, 2)], (0, 9), num_delivered=1, held=1, step=42, seed=5)
    vector = env.state_to_vector(state)
    assert vector.dtype == jnp.float32
    assert vector.tolist() == [4, 3, 0, 9, 4, 3, 9, 2, 0, 9, 1, 1, 42]
    assert vector.shape == (env.state_dim,)
    back = env.vector_to_state(jax.random.key(5), vector)
    chex.assert_trees_all_equal(back, state)
    chex.assert_trees_all_equal_shapes_and_dtypes(back.replace(key=None), state.replace(key=None))


# --- arguments and compilation


@pytest.mark.parametrize(
    ("task", "arguments", "message"),
    [
        (GridPickAndPlace, {"size": 0}, "size must be at least 1"),
        (GridPickAndPlace, {"num_objects": 0}, "num_objects must be at least 1"),
        (GridPickAndPlace, {"horizon": 0}, "horizon must be at least 1"),
        (GridPickAndPlace, {"size": 2, "num_objects": 2}, "no free cell"),
        (FixedGridPickAndPlace, {"random_box_size": 0}, "random_box_size must be at least 1"),
        (FixedGridPickAndPlace, {"random_box_size": 6}, "overlap"),
        (FixedGridPickAndPlace, {"size": 5, "num_objects": 3}, "overlap"),
        (FixedGridPickAndPlace, {"num_objects": 8}, "at most 7 objects"),
    ],
)
def test_invalid_arguments_say_what_is_wrong(task, arguments, message):
    with pytest.raises(ValueError, match=message):
        task(**arguments)


def test_the_tightest_valid_arguments():
    GridPickAndPlace(size=2, num_objects=1)
    FixedGridPickAndPlace(random_box_size=5)
    FixedGridPickAndPlace(size=6, num_objects=7)


@BOTH_TASKS
def test_equal_environments_compile_once(task):
    chex.clear_trace_counter()  # it counts by source line, not by function object
    reset = jax.jit(chex.assert_max_traces(lambda env, key: env.reset(key), n=1), static_argnums=0)
    step = jax.jit(chex.assert_max_traces(lambda env, state, action: env.step(state, action), n=1), static_argnums=0)
    for seed in range(3):
        env = dataclasses.replace(task(num_objects=3))
        state, _ = reset(env, jax.random.key(seed))
        for _ in range(2):
            state, _ = step(env, state, act(seed, grab=True))
