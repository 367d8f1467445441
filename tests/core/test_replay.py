"""Replay: exactly the complete episodes that are still held are drawn, and every number of them is the one that was recorded."""

import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import strategies as st
from numbered_replay import (
    HORIZON,
    LENGTHS,
    NUM_ADDS,
    Numbered,
    at,
    demonstrations,
    is_terminated,
    kept,
    near,
    replay_history,
    reward_of,
)

from hindrl_jax.core import replay as replays
from hindrl_jax.core.hindsight import NEARBY_GOAL
from hindrl_jax.core.replay import sample_episodes, sample_steps

draw_episodes = jax.jit(sample_episodes, static_argnums=2)
draw_steps = jax.jit(sample_steps)


@hypothesis.settings(deadline=None, max_examples=30)
@hypothesis.given(lengths=LENGTHS, step=st.integers(HORIZON - 1, NUM_ADDS - 1))
@hypothesis.example(lengths=[[3], [3]], step=2)  # the first episode is just complete
@hypothesis.example(lengths=[[3], [3]], step=8)  # all slots but one are complete
@hypothesis.example(lengths=[[3], [3]], step=10)  # the last slot is being written
@hypothesis.example(lengths=[[3], [3]], step=11)  # every slot has been written to its end
@hypothesis.example(lengths=[[3], [3]], step=12)  # the first slot is being written again
@hypothesis.example(lengths=[[1], [3, 2]], step=NUM_ADDS - 1)  # many times around, at different paces
def test_samples_are_exactly_the_complete_episodes_still_held(lengths, step):
    history, complete = replay_history(lengths)
    replay, expected = at(history, step), kept(complete[step])
    episodes = replay.episodes
    # At most 6 episodes: the chance that 400 draws miss one is below 6 * (5/6)^400 < 1e-30.
    rows = np.asarray(draw_episodes(jax.random.key(step), replay, 400))
    assert {tuple(map(int, episodes.observations[row, 0, :2])) for row in rows} == set(expected)
    for row in set(rows.tolist()):
        env, episode = (int(number) for number in episodes.observations[row, 0, :2])
        length = expected[env, episode]
        assert episodes.lengths[row] == length
        assert episodes.terminated[row] == is_terminated(episode)
        assert episodes.desired_goals[row].tolist() == [-1 - env, episode, 0]
        assert episodes.observations[row, : length + 1].tolist() == [[env, episode, t] for t in range(length + 1)]
        rewards = [reward_of(env, episode, t) for t in range(length)]
        assert episodes.rewards[row, :length].tolist() == rewards
        assert episodes.actions[row, :length, 0].tolist() == rewards
        assert replay.notes[NEARBY_GOAL][row, :length].tolist() == [near(env, episode, t + 1) for t in range(length)]
    steps = np.asarray(draw_steps(jax.random.key(1000 + step), episodes, rows))
    assert set(zip(rows.tolist(), steps.tolist(), strict=True)) == {(row, t) for row in set(rows.tolist()) for t in range(episodes.lengths[row])}


def test_complete_episodes_are_drawn_uniformly_whatever_their_environment():
    # After 5 steps environment 0 has three complete episodes left of five, environment 1 has one. 4000 draws, 1000 each, deviation 27.
    history, _ = replay_history([[1], [3]])
    rows = np.asarray(draw_episodes(jax.random.key(0), at(history, 4), 4000))
    counts = np.unique(rows, return_counts=True)[1]
    assert len(counts) == 4
    assert np.abs(counts - 1000).max() < 140


def test_steps_are_drawn_uniformly():
    steps = np.asarray(sample_steps(jax.random.key(0), demonstrations(), jnp.zeros(3000, jnp.int32)))
    counts = np.bincount(steps)
    assert len(counts) == 3
    assert np.abs(counts - 1000).max() < 130  # deviation 26


def test_capacity_is_at_least_two_episodes_per_environment():
    env = Numbered(horizon=10)
    with pytest.raises(ValueError, match=r"buffer_size = 59 is too small.*at least 60"):
        replays.init(env, num_envs=3, capacity=59)
    assert replays.init(env, num_envs=3, capacity=60).episodes.rewards.shape == (6, 10)
    assert replays.init(env, num_envs=3, capacity=119).episodes.rewards.shape == (9, 10)


def test_the_replay_keeps_the_notes_that_it_was_made_for():
    # Each of the two environments has two slots of 10 steps. What has not been written has the value that was given.
    env = Numbered(horizon=10)
    assert replays.init(env, num_envs=2, capacity=40).notes == {}
    replay = replays.init(env, num_envs=2, capacity=40, notes={"number": -1})
    assert {name: (values.dtype.kind, np.unique(values).tolist()) for name, values in replay.notes.items()} == {"number": ("i", [-1])}
    recorded = replays.RecordedStep(
        observation=jnp.zeros((2, 3)),
        desired_goal=jnp.zeros((2, 3)),
        action=jnp.zeros((2, 1)),
        reward=jnp.zeros(2),
        next_observation=jnp.zeros((2, 3)),
        terminated=jnp.array([False, True]),
        truncated=jnp.zeros(2, bool),
        notes={"number": jnp.array([5, 6])},
    )
    replay = replays.add(replays.add(replay, recorded), recorded)
    # Environment 0 has written steps 0 and 1 of its first episode, environment 1 step 0 of its first and of its second.
    number = np.full((4, 10), -1)
    number[0, :2], number[2, 0], number[3, 0] = 5, 6, 6
    np.testing.assert_array_equal(replay.notes["number"], number)
