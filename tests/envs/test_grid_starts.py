"""Where things start in the grid worlds and where they are teleported to; saved states, arguments and compilation."""

import dataclasses
import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from grid_states import BOTH_TASKS, RIGHT, act, cells, place, play

from hindrl_jax.envs.grid import FixedGridPickAndPlace, GridPickAndPlace
from hindrl_jax.envs.grid.cells import free_rank

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
    drawn = np.asarray(jax.jit(jax.vmap(lambda b, o: free_rank(b, list(o), 8)))(bits, occupied))
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
