"""Steps and their n-step returns: by hand, and against plain loops, as recorded and as relabelled."""

import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import strategies as st
from numbered_replay import BATCH, DEMO, demonstrations

from hindrl_jax.base.types import Episodes
from hindrl_jax.config import BatchConfig, QuirksConfig, TrainConfig
from hindrl_jax.core.goals import GoalTest
from hindrl_jax.core.relabel import reward_by_goal
from hindrl_jax.core.steps import as_occupancy, read_steps, transitions


@pytest.mark.parametrize(
    ("terminated", "quirks", "discounts"),
    [
        (True, QuirksConfig(), [0.25, 0.0, 0.0]),
        (False, QuirksConfig(), [0.25, 0.25, 0.5]),  # the last transition takes one step only, so gamma^1
        (False, QuirksConfig(timeouts_are_terminal=True), [0.25, 0.0, 0.0]),
    ],
)
def test_two_step_returns_by_hand(terminated, quirks, discounts):
    # One episode of 3 transitions through the states 10, 11, 12, 13, with rewards 1, 2, 4. Gamma is 1/2, n is 2.
    #   from step 0: 1 + 2/2 = 2, up to state 12; not at the end, so the value of state 12 counts with gamma^2 = 1/4
    #   from step 1: 2 + 4/2 = 4, up to state 13, where the episode ends
    #   from step 2: 4, up to state 13; there is no second step
    episodes = Episodes(
        observations=jnp.array([[[10.0], [11.0], [12.0], [13.0], [jnp.nan]]]),
        actions=jnp.array([[[0.1], [0.2], [0.3], [jnp.nan]]]),
        rewards=jnp.array([[1.0, 2.0, 4.0, jnp.nan]]),
        lengths=jnp.array([3]),
        terminated=jnp.array([terminated]),
        desired_goals=jnp.array([[-7.0]]),
    )
    config = TrainConfig(batch=BatchConfig(gamma=0.5, n_step=2), quirks=quirks)
    steps = read_steps(episodes, jnp.zeros(3, jnp.int32), jnp.arange(3), 2)
    batch = transitions(steps, lambda observation: 100.0 * observation, config, is_demonstration=True)
    assert batch.reward.tolist() == [2.0, 4.0, 4.0]
    assert batch.discount.tolist() == discounts
    assert batch.observation.tolist() == [[10.0], [11.0], [12.0]]
    assert batch.next_observation.tolist() == [[12.0], [13.0], [13.0]]
    assert batch.achieved_goal.tolist() == [[1000.0], [1100.0], [1200.0]]
    assert batch.next_achieved_goal.tolist() == [[1200.0], [1300.0], [1300.0]]
    assert batch.desired_goal.tolist() == [[-7.0]] * 3
    np.testing.assert_allclose(batch.action[:, 0], [0.1, 0.2, 0.3])
    assert batch.is_demonstration.tolist() == [True] * 3
    assert batch.is_relabelled.tolist() == [False] * 3


@pytest.mark.parametrize(
    ("terminated", "rewards", "discounts"),
    [(False, [0.25, 0.75, 0.5], [0.25, 0.25, 0.5]), (True, [0.25, 1.0, 1.0], [0.25, 0.0, 0.0])],
)
def test_returns_where_the_goal_is_to_be_held_by_hand(terminated, rewards, discounts):
    # One episode through the states 10, 11, 12, 13, the goal reached in the last two. Gamma is 1/2, n is 2, so each step at the goal is worth 1/2.
    #   from step 0: 0 + 1/2 * 1/2 = 1/4, up to state 12
    #   from step 1: 1/2 + 1/2 * 1/2 = 3/4, up to state 13; who stays there for ever has 1/2 + 1/4 + ... = 1
    #   from step 2: 1/2
    # An episode that the environment ends at the goal is worth 1 there: 1/2 + 1/2 * 1 from step 1, and 1 from step 2.
    episodes = Episodes(
        observations=jnp.array([[[10.0], [11.0], [12.0], [13.0]]]),
        actions=jnp.zeros((1, 3, 1)),
        rewards=jnp.array([[0.0, 1.0, 1.0]]),
        lengths=jnp.array([3]),
        terminated=jnp.array([terminated]),
        desired_goals=jnp.array([[12.5]]),
    )
    config = TrainConfig(batch=BatchConfig(gamma=0.5, n_step=2))
    steps = as_occupancy(read_steps(episodes, jnp.zeros(3, jnp.int32), jnp.arange(3), 2), 0.5)
    batch = transitions(steps, lambda observation: observation, config, is_demonstration=False)
    assert batch.reward.tolist() == rewards
    assert batch.discount.tolist() == discounts


def transition_twin(episodes, row, step, goal, *, by_goal, epsilon, config):
    """(reward, discount, next observation, goal) as a plain loop; the achieved goal is entry 2 of an observation."""
    length, total, discount = int(episodes.lengths[row]), 0.0, 1.0
    for t in range(step, min(step + config.batch.n_step, length)):
        following = episodes.observations[row, t + 1]
        distance = abs(following[2] - goal)
        reached = by_goal and bool(distance < epsilon if config.quirks.strict_goal_test else distance <= epsilon)
        total += discount * (float(reached) if by_goal else episodes.rewards[row, t])
        discount *= config.batch.gamma
        over = t == length - 1 and (bool(episodes.terminated[row]) or config.quirks.timeouts_are_terminal)
        if over or (reached and not config.quirks.bootstrap_past_relabelled_goals):
            discount = 0.0
            break
    return total, discount, following, goal if by_goal else episodes.desired_goals[row, 0]


ROWS = 6


@hypothesis.settings(deadline=None, max_examples=60)
@hypothesis.given(
    lengths=st.lists(st.integers(1, 4), min_size=3, max_size=3),
    places=st.lists(st.integers(0, 2), min_size=15, max_size=15),
    terminated=st.lists(st.booleans(), min_size=3, max_size=3),
    rows=st.lists(st.tuples(st.integers(0, 2), st.integers(0, 3), st.integers(0, 2), st.booleans()), min_size=ROWS, max_size=ROWS),
    epsilon=st.sampled_from([0.0, 1.0]),
    config=st.builds(
        TrainConfig,
        batch=st.builds(
            BatchConfig,
            n_step=st.sampled_from([1, 3]),
            gamma=st.sampled_from([0.5, 0.9, 1.0]),
        ),
        quirks=st.builds(
            QuirksConfig,
            strict_goal_test=st.booleans(),
            bootstrap_past_relabelled_goals=st.booleans(),
            timeouts_are_terminal=st.booleans(),
        ),
    ),
    is_demonstration=st.booleans(),
)
def test_transitions_are_those_of_a_plain_loop(lengths, places, terminated, rows, epsilon, config, is_demonstration):
    observations = np.zeros((3, 5, 3), np.float32)
    observations[..., 0], observations[..., 1], observations[..., 2] = np.arange(3)[:, None], np.arange(5)[None], np.reshape(places, (3, 5))
    rewards = np.arange(12, dtype=np.float32).reshape(3, 4) + 1.0
    for i, length in enumerate(lengths):
        observations[i, length + 1 :] = np.nan
        rewards[i, length:] = np.nan
    episodes = Episodes(
        observations=observations,
        actions=-rewards[..., None],
        rewards=rewards,
        lengths=np.array(lengths, np.int32),
        terminated=np.array(terminated),
        desired_goals=np.array([[-1.0], [-2.0], [-3.0]], np.float32),
    )
    row = np.array([row for row, _, _, _ in rows], np.int32)
    first = np.array([step % lengths[row] for row, step, _, _ in rows], np.int32)
    goals = np.array([[goal] for _, _, goal, _ in rows], np.float32)
    by_goal = np.array([flag for _, _, _, flag in rows])
    test = GoalTest(
        achieved_goal=lambda observation: observation[..., 2:],
        epsilon=jnp.array([epsilon]),
        inclusive=not config.quirks.strict_goal_test,
        ends_return=not config.quirks.bootstrap_past_relabelled_goals,
    )
    table, chosen = jax.tree.map(jnp.asarray, episodes), jnp.asarray(by_goal)
    recorded = read_steps(table, jnp.asarray(row), jnp.asarray(first), config.batch.n_step)
    given_goals = recorded.replace(desired_goal=jnp.where(chosen[:, None], goals, recorded.desired_goal), is_relabelled=chosen)
    steps = reward_by_goal(given_goals, test)
    batch = jax.device_get(transitions(steps, test.achieved_goal, config, is_demonstration=is_demonstration))
    for i in range(ROWS):
        reward, discount, following, goal = transition_twin(
            episodes, row[i], first[i], goals[i, 0], by_goal=by_goal[i], epsilon=epsilon, config=config
        )
        np.testing.assert_allclose([batch.reward[i], batch.discount[i], batch.desired_goal[i, 0]], [reward, discount, goal], rtol=1e-5)
        np.testing.assert_array_equal(batch.next_observation[i], following)
        np.testing.assert_array_equal(batch.next_achieved_goal[i], following[2:])
        np.testing.assert_array_equal(batch.observation[i], observations[row[i], first[i]])
        np.testing.assert_array_equal(batch.achieved_goal[i], observations[row[i], first[i], 2:])
        assert batch.action[i, 0] == -rewards[row[i], first[i]]
    assert batch.is_demonstration.tolist() == [is_demonstration] * ROWS
    assert batch.is_relabelled.tolist() == by_goal.tolist()


def test_jitted_equals_not_jitted():
    test = GoalTest(achieved_goal=lambda observation: observation, epsilon=jnp.zeros(3))

    def read(episodes, rows, steps, goals):
        chosen = goals[:, 2] < 2
        recorded = read_steps(episodes, rows, steps, BATCH.n_step)
        rewarded = reward_by_goal(recorded.replace(desired_goal=goals, is_relabelled=chosen), test)
        return transitions(rewarded, test.achieved_goal, TrainConfig(batch=BATCH), is_demonstration=False)

    arguments = (demonstrations(), jnp.array([0, 2, 2, 1]), jnp.array([1, 0, 1, 0]), jnp.array([[DEMO, 2.0, t] for t in range(4)]))
    jax.tree.map(np.testing.assert_array_equal, jax.jit(read)(*arguments), read(*arguments))
