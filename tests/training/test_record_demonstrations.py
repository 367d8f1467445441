"""Recording: only solved episodes, aligned rows, equal seeds give equal demonstrations."""

import dataclasses

import jax
import numpy as np
import pytest

from hindrl_jax.base.environments import action_to_env
from hindrl_jax.base.errors import UserError
from hindrl_jax.envs.grid import FixedGridPickAndPlace
from hindrl_jax.experts.grid import GridExpert
from hindrl_jax.training.recording import record

ENV = FixedGridPickAndPlace(size=6, num_objects=2, horizon=40)


@pytest.fixture(scope="module")
def recording():
    return record(jax.random.key(0), ENV, GridExpert(), 20)


def test_every_demonstration_is_solved_and_rewarded_once_at_its_end(recording):
    episodes = recording
    lengths = np.asarray(episodes.lengths)
    assert len(lengths) == 20
    assert np.asarray(episodes.terminated).all()
    assert (lengths <= ENV.horizon).all()
    for rewards, length in zip(np.asarray(episodes.rewards), lengths, strict=True):
        assert np.flatnonzero(rewards).tolist() == [length - 1]
        assert rewards[length - 1] == 1.0


def test_playing_the_actions_from_the_states_gives_the_next_observations(recording):
    step = jax.jit(ENV.step)
    episodes = recording
    for n in range(5):
        for t in range(int(episodes.lengths[n])):
            state = ENV.vector_to_state(jax.random.key(0), recording.states[n, t])
            np.testing.assert_array_equal(ENV.observe(state), episodes.observations[n, t])
            action = action_to_env(episodes.actions[n, t], ENV)
            if int(state.held) >= 0 and action[4] < 0.5 and not (state.agent == state.goal).all():
                continue  # a teleport: where to is the episode's own chance
            np.testing.assert_array_equal(step(state, action)[1].observation, episodes.observations[n, t + 1])


def test_desired_goal_is_where_the_demonstration_ended(recording):
    episodes = recording
    last = np.asarray(episodes.observations)[np.arange(20), np.asarray(episodes.lengths)]
    np.testing.assert_array_equal(np.asarray(episodes.desired_goals), last)
    np.testing.assert_array_equal(last, np.tile(np.asarray(ENV.task_goal()), (20, 1)))


def test_actions_are_in_the_policys_range(recording):
    assert set(np.unique(recording.actions)) == {-1.0, 1.0}


def test_equal_keys_give_equal_demonstrations_and_others_differ(recording):
    again = record(jax.random.key(0), ENV, GridExpert(), 20)
    np.testing.assert_array_equal(again.actions, recording.actions)
    other = record(jax.random.key(1), ENV, GridExpert(), 20)
    assert not np.array_equal(other.actions, recording.actions)


def test_too_few_solved_episodes_is_an_error_that_says_so():
    impossible = dataclasses.replace(ENV, horizon=5)
    with pytest.raises(UserError, match="solved only 0 of"):
        record(jax.random.key(0), impossible, GridExpert(), 2, max_attempts=16)


def test_unsolved_episodes_are_left_out():
    """With a horizon that the expert often misses, all that is kept is still solved."""
    short = dataclasses.replace(ENV, horizon=25)
    episodes = record(jax.random.key(0), short, GridExpert(), 10)
    assert np.asarray(episodes.terminated).all()
    assert (np.asarray(episodes.lengths) <= 25).all()
