"""Goals: the box test by hand, epsilon and the filter against plain loops, and which states end up in the goal table."""

import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import strategies as st

from hindrl_jax.core.goals import (
    GoalTable,
    GoalTest,
    constant_goal,
    epsilon_filter,
    epsilon_from_demonstrations,
    final_goals,
    goal_reached,
    goal_table,
    is_visited,
    nearby_goal,
    sample_goals,
)

# Goals and epsilons are multiples of 1/4, so that every comparison at the edge of a box is exact.
QUARTERS = st.integers(-8, 8).map(lambda i: i / 4)


@pytest.mark.parametrize(
    ("achieved", "desired", "epsilon", "inclusive", "strict"),
    [
        ([1.0, 2.0], [1.0, 2.0], [0.0, 0.0], True, False),  # epsilon 0: only <= can hold
        ([1.0, 2.0], [1.0, 2.5], [0.0, 0.0], False, False),
        ([1.0, 2.0], [1.5, 2.0], [0.5, 0.5], True, False),  # on the edge of one dimension, 0 < 0.5 in the other
        ([1.0, 2.0], [1.25, 1.75], [0.5, 0.5], True, True),
        ([1.0, 2.0], [1.25, 1.0], [0.5, 0.5], False, False),  # one dimension inside is not enough
        ([1.0, 2.0], [1.25, 1.0], [0.5, 2.0], True, True),  # epsilon is per dimension
        ([-1.0, 0.0], [1.0, 0.0], [1.5, 1.0], False, False),  # distance, not signed difference
        ([1.0, 0.0], [-1.0, 0.0], [1.5, 1.0], False, False),
    ],
)
def test_goal_reached_by_hand(achieved, desired, epsilon, inclusive, strict):
    achieved, desired, epsilon = jnp.array(achieved), jnp.array(desired), jnp.array(epsilon)
    assert bool(goal_reached(achieved, desired, epsilon)) == inclusive
    assert bool(goal_reached(achieved, desired, epsilon, inclusive=False)) == strict


def test_goal_reached_keeps_leading_axes():
    achieved = jnp.arange(12.0).reshape(2, 3, 2)
    reached = goal_reached(achieved, jnp.broadcast_to(jnp.array([4.0, 5.0]), achieved.shape), jnp.zeros(2))
    np.testing.assert_array_equal(reached, [[False, False, True], [False, False, False]])


def test_a_goal_test_projects_observations_and_compares():
    # Observations (x, y) whose goal is y. From y = 1 and 3 to the goal 2 it is 1 each: inside the box of 1 but not strictly; from 4 it is 2.
    observations = jnp.array([[9.0, 1.0], [9.0, 3.0], [9.0, 4.0]])
    for inclusive, expected in ((True, [True, True, False]), (False, [False, False, False])):
        test = GoalTest(achieved_goal=lambda observation: observation[..., 1:], epsilon=jnp.array([1.0]), inclusive=inclusive)
        assert test.reached(observations, jnp.full((3, 1), 2.0)).tolist() == expected
        assert test.reached(observations[None], jnp.full((1, 1, 1), 2.0)).tolist() == [expected]


def epsilon_twin(demonstrations, *, m, k):
    """Thesis eq. 4.7 as plain loops over a list of unpadded (length + 1, G) arrays."""
    goal_dim = demonstrations[0].shape[1]
    epsilon = np.zeros(goal_dim)
    for i in range(goal_dim):
        distances = [abs(goals[t + m, i] - goals[t, i]) for goals in demonstrations for t in range(len(goals) - m)]
        if distances:
            mean = sum(distances) / len(distances)
            epsilon[i] = mean + k * (sum((distance - mean) ** 2 for distance in distances) / len(distances)) ** 0.5
    return epsilon


def padded(demonstrations, *, horizon, padding):
    table = np.full((len(demonstrations), horizon + 1, demonstrations[0].shape[1]), padding, np.float32)
    for row, goals in zip(table, demonstrations, strict=True):
        row[: len(goals)] = goals
    return jnp.asarray(table), jnp.array([len(goals) - 1 for goals in demonstrations], jnp.int32)


@pytest.mark.parametrize("padding", [1e6, np.nan])
@pytest.mark.parametrize(("m", "k"), [(0, 0.0), (0, 2.0), (1, 1.5), (3, 1.0), (6, 1.0), (7, 1.0), (50, 1.0)])
def test_epsilon_is_that_of_plain_loops_whatever_the_padding(m, k, padding):
    rng = np.random.default_rng(0)
    demonstrations = [rng.normal(size=(num, 2)) for num in (7, 2, 4, 6)]  # with m = 3, the second has no pair
    table, lengths = padded(demonstrations, horizon=8, padding=padding)
    epsilon = epsilon_from_demonstrations(table, lengths, steps=m, deviations=k)
    np.testing.assert_allclose(epsilon, epsilon_twin(demonstrations, m=m, k=k), atol=1e-6)


def test_epsilon_by_hand():
    # Pairs two steps apart: |3 - 0| = 3, |4 - 1| = 3 and, in the other demonstration, |0 - 9| = 9. Mean 5, deviation sqrt((4 + 4 + 16) / 3).
    demonstrations = [np.array([[0.0], [1.0], [3.0], [4.0]]), np.array([[9.0], [2.0], [0.0]])]
    table, lengths = padded(demonstrations, horizon=3, padding=-7.0)
    np.testing.assert_allclose(epsilon_from_demonstrations(table, lengths, steps=2, deviations=0.0), [5.0])
    np.testing.assert_allclose(epsilon_from_demonstrations(table, lengths, steps=2, deviations=2.0), [5.0 + 2.0 * 8.0**0.5], rtol=1e-6)


def filter_twin(goals, epsilon):
    """Thesis algorithm 6 as a plain loop."""
    last, mask = None, []
    for goal in goals:
        within = last is not None and all(abs(g - z) <= e for g, z, e in zip(goal, last, epsilon, strict=True))
        mask.append(not within)
        if not within:
            last = goal
    return mask


jitted_filter = jax.jit(epsilon_filter)


@hypothesis.settings(deadline=None, max_examples=40)
@hypothesis.given(
    goals=st.lists(st.tuples(QUARTERS, QUARTERS), min_size=6, max_size=6),
    epsilon=st.tuples(QUARTERS, QUARTERS).map(np.abs),
)
def test_filter_is_that_of_a_plain_loop(goals, epsilon):
    goals = np.array(goals, np.float32)
    mask = jitted_filter(jnp.asarray(goals), jnp.asarray(epsilon, jnp.float32))
    np.testing.assert_array_equal(mask, filter_twin(goals, epsilon))


def test_filter_by_hand():
    # Epsilon is 1 in x and 1 in y. The first goal is kept; (1, 0) is 1 away from it in x, on the edge of its box, which belongs to it. (1, 2) is 2
    # away in y from (0, 0), and from (1, 0). (2, 2) is 1 away in x from (1, 2), on the edge again. (5, 2) is outside.
    goals = jnp.array([[0.0, 0.0], [1.0, 0.0], [1.0, 2.0], [2.0, 2.0], [5.0, 2.0]])
    assert epsilon_filter(goals, jnp.array([1.0, 1.0])).tolist() == [True, False, True, False, True]


def test_filter_by_hand_measures_from_the_last_kept_goal_not_from_the_one_before():
    # Steps of 0.4 with epsilon 0.5 creep out of the box: 0 -> 0.8 (0.4 is near 0) -> 1.6 (1.2 is near 0.8).
    goals = jnp.array([[0.0], [0.4], [0.8], [1.2], [1.6]])
    assert epsilon_filter(goals, jnp.array([0.5])).tolist() == [True, False, True, False, True]


GOALS = jnp.array([[[0.0], [1.0], [1.0], [3.0]], [[4.0], [5.0], [99.0], [99.0]]])  # 99 is padding
LENGTHS = jnp.array([3, 1])


def test_visited_states_are_those_up_to_the_last_one():
    # An episode of l transitions visits l + 1 states.
    assert is_visited(LENGTHS, 4).tolist() == [[True, True, True, True], [True, True, False, False]]


@pytest.mark.parametrize(
    ("keep", "expected"),
    [
        ([[1, 1, 1, 1], [1, 1, 0, 0]], [0.0, 1.0, 1.0, 3.0, 4.0, 5.0]),
        ([[1, 1, 1, 0], [1, 0, 0, 0]], [0.0, 1.0, 1.0, 4.0]),
        ([[0, 0, 0, 1], [0, 1, 0, 0]], [3.0, 5.0]),
        ([[0, 1, 0, 0], [0, 0, 0, 0]], [1.0]),
    ],
)
def test_goal_table_by_hand(keep, expected):
    # The kept goals move to the front, in their order; the table keeps its 2 * 4 rows.
    table = goal_table(jnp.zeros((2, 4, 3)), GOALS, jnp.array(keep, bool))
    assert table.goals.shape == (8, 1)
    assert int(table.count) == len(expected)
    assert table.goals[: len(expected), 0].tolist() == expected


def test_behavioural_goals():
    table = final_goals(GOALS, LENGTHS)
    assert table.goals.tolist() == [[3.0], [5.0]]
    assert int(table.count) == 2
    table = constant_goal(jnp.array([1.0, 2.0]))
    assert table.goals.tolist() == [[1.0, 2.0]]
    assert int(table.count) == 1


def test_sampled_goals_are_uniform_over_all_goals_and_never_padding():
    # 6 goals, 3000 draws: each expected 500 times, standard deviation 20; the bounds are five of them away.
    table = goal_table(GOALS, GOALS.at[0, 2].set(2.0), is_visited(LENGTHS, 4))
    drawn = np.asarray(sample_goals(jax.random.key(0), table, 3000))
    assert drawn.shape == (3000, 1)
    values, counts = np.unique(drawn, return_counts=True)
    assert values.tolist() == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]
    assert counts.min() > 400
    assert counts.max() < 600


def nearby_twin(goals, count, achieved, epsilon, *, inclusive):
    """The rows of the table in whose box a goal lies, as a plain loop."""
    rows = []
    for row in range(count):
        distances = [abs(a - g) for a, g in zip(achieved, goals[row], strict=True)]
        if all(d <= e if inclusive else d < e for d, e in zip(distances, epsilon, strict=True)):
            rows.append(row)
    return rows


@pytest.mark.parametrize("inclusive", [True, False])
@pytest.mark.parametrize("epsilon", [(0.0, 0.0), (1.0, 2.0)])
def test_nearby_goals_are_those_of_a_plain_loop(epsilon, inclusive):
    # The cells of a 4 x 4 grid in a table of 16 rows, of which the last three are padding; 40 calls see each candidate with near certainty.
    goals = np.array([(x, y) for x in range(4) for y in range(4)], np.float32)
    table = GoalTable(goals=jnp.asarray(goals), count=jnp.asarray(13))
    achieved = np.array([(0, 0), (2, 2), (3, 3), (9, 9), (1, 3)], np.float32)
    test = GoalTest(achieved_goal=lambda observation: observation[..., :2], epsilon=jnp.asarray(epsilon), inclusive=inclusive)
    observations = jnp.asarray(np.pad(achieved, ((0, 0), (0, 1)), constant_values=7.0))  # the goal is a part of what is observed
    pick = jax.jit(lambda key: nearby_goal(key, table, observations, test))
    drawn = np.stack([pick(key) for key in jax.random.split(jax.random.key(0), 300)])
    for column, goal in zip(drawn.T, achieved, strict=True):
        assert set(column.tolist()) == set(nearby_twin(goals, 13, goal, epsilon, inclusive=inclusive) or [-1])


def test_a_nearby_goal_is_any_of_them_with_equal_chances():
    # 3 of 5 goals are near; 1500 draws, 500 each, standard deviation 18.
    table = GoalTable(goals=jnp.array([[0.0], [5.0], [0.5], [6.0], [1.0]]), count=jnp.asarray(5))
    test = GoalTest(achieved_goal=lambda observation: observation, epsilon=jnp.array([0.5]))
    pick = jax.vmap(lambda key: nearby_goal(key, table, jnp.full((1, 1), 0.5), test)[0])
    counts = np.bincount(np.asarray(pick(jax.random.split(jax.random.key(1), 1500))), minlength=5)
    assert counts[[1, 3]].tolist() == [0, 0]
    assert np.abs(counts[[0, 2, 4]] - 500).max() < 90


def test_observations_stay_beside_the_goals_that_were_reached_there():
    observations = jnp.concatenate([GOALS * 10.0, -GOALS], axis=-1)
    table = goal_table(observations, GOALS, jnp.array([[1, 0, 1, 0], [0, 1, 0, 0]], bool))
    assert table.observations[:3].tolist() == [[0.0, -0.0], [10.0, -1.0], [50.0, -5.0]]
    np.testing.assert_array_equal(table.observations, np.concatenate([table.goals * 10.0, -table.goals], axis=-1))
