"""Rollouts on the toy corridor, where every observation says which episode and which step it belongs to."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toy_env import Corridor, corridor_demonstrations

from hindrl_jax.core import rollout
from hindrl_jax.core.goals import GoalTable

ENV = Corridor(horizon=5, width=3.0)
GOALS = GoalTable(goals=jnp.array([[7.0], [8.0], [9.0], [99.0]]), count=jnp.asarray(3))
# Velocities of the environments: 2 solves the corridor in 2 steps (2, 4), 1 in 4 steps, 0.5 never; in policy units 1, 0, -0.5.
ACTIONS = jnp.array([[1.0, 0.0], [0.0, 0.0], [-0.5, 0.0]])
FIRST_ENDS = [2, 4, 5]


@functools.partial(jax.jit, static_argnames="num_steps")
def play(key, num_steps):
    key_reset, key_steps = jax.random.split(key)
    start = rollout.reset(key_reset, ENV, GOALS, 3)

    def step(state, key):
        state, time_step = rollout.step(state, rollout.reset(key, ENV, GOALS, 3), ACTIONS, ENV)
        return state, (state, time_step)

    return start, jax.lax.scan(step, start, jax.random.split(key_steps, num_steps))[1]


@pytest.fixture(scope="module")
def played():
    start, (states, time_steps) = play(jax.random.key(0), num_steps=40)
    return start, states, time_steps


def test_episodes_end_where_they_should(played):
    _, _, time_steps = played
    for env, end in enumerate(FIRST_ENDS):
        ends = np.arange(1, 41) % end == 0
        solves = env < 2
        assert np.asarray(time_steps.terminated[:, env]).tolist() == (ends & solves).tolist()
        assert np.asarray(time_steps.truncated[:, env]).tolist() == (ends & (not solves)).tolist()
        assert np.asarray(time_steps.reward[:, env]).tolist() == (ends & solves).tolist()


def test_auto_reset_keeps_the_true_next_observation_and_starts_a_fresh_episode(played):
    start, states, time_steps = played
    before = np.concatenate([start.observation[None], states.observation[:-1]])
    velocity = np.array([2.0, 1.0, 0.5])
    # The time step goes on with the episode that was acted in, also where it ended.
    np.testing.assert_array_equal(time_steps.observation[..., 0], before[..., 0])
    np.testing.assert_array_equal(time_steps.observation[..., 1], before[..., 1] + 1)
    np.testing.assert_array_equal(time_steps.observation[..., 2], before[..., 2] + velocity)
    over = np.asarray(time_steps.terminated | time_steps.truncated)
    # The state carries on with it, or stands at the start of another one.
    np.testing.assert_array_equal(np.asarray(states.observation)[~over], np.asarray(time_steps.observation)[~over])
    assert np.all(np.asarray(states.observation)[over][:, 1:] == 0.0)
    starts = np.concatenate([start.observation[:, 0], np.asarray(states.observation)[over][:, 0]])
    assert len(np.unique(starts)) == len(starts)  # no two episodes are alike
    np.testing.assert_array_equal(states.env_state.step, states.observation[..., 1])
    np.testing.assert_array_equal(states.env_state.start, states.observation[..., 0])


def test_goal_is_kept_within_an_episode_and_drawn_again_after_it(played):
    start, states, time_steps = played
    before = np.concatenate([start.desired_goal[None], states.desired_goal[:-1]])
    over = np.asarray(time_steps.terminated | time_steps.truncated)
    np.testing.assert_array_equal(np.asarray(states.desired_goal)[~over], before[~over])
    assert set(np.asarray(states.desired_goal)[over][:, 0].tolist()) == {7.0, 8.0, 9.0}


def test_starts_are_all_states_of_demonstrations_but_the_last():
    # (episode, t); the episodes have 2, 5 and 1 transitions, and their last states and what lies behind those are never drawn.
    expected = [(0, 0), (0, 1), (1, 0), (1, 1), (1, 2), (1, 3), (1, 4), (2, 0)]
    table = rollout.StartTable(states=jnp.zeros((3, 7, 2)), lengths=jnp.array([2, 5, 1]))
    drawn = jax.jit(rollout.sample_starts, static_argnums=2)(jax.random.key(0), table, 4000)
    rows, counts = np.unique(np.stack([drawn.demo, drawn.step], axis=1), axis=0, return_counts=True)
    assert rows.tolist() == [list(row) for row in expected]
    # Uniform over the states, not over the demonstrations; five deviations of a binomial.
    assert np.abs(counts - 4000 / len(expected)).max() < 5 * np.sqrt(4000 / len(expected))


DEMONSTRATIONS = corridor_demonstrations((1.0, 0.7), env=ENV)  # 4 and 5 steps, starts 10 and 11; padding is NaN


@functools.partial(jax.jit, static_argnames="ratio")
def starts(key, ratio):
    table = rollout.StartTable(states=DEMONSTRATIONS.states, lengths=DEMONSTRATIONS.lengths)
    return rollout.reset(key, ENV, GOALS, 3000, rollout.DemoResets(starts=table, ratio=ratio))


@pytest.mark.parametrize("ratio", [0.0, 0.3, 1.0])
def test_the_given_share_of_episodes_begins_in_demonstrated_states(ratio):
    state = jax.device_get(starts(jax.random.key(0), ratio).replace(env_state=None))
    demonstrated = state.observation[:, 0] >= 10
    assert abs(demonstrated.sum() - 3000 * ratio) <= 5 * np.sqrt(3000 * ratio * (1 - ratio))
    assert np.all(state.observation[~demonstrated][:, 1:] == 0.0)  # the environment's own start
    assert len(np.unique(state.observation[~demonstrated][:, 0])) >= (~demonstrated).sum() - 10  # of 2^23 possible ones
    assert set(state.desired_goal[:, 0].tolist()) == {7.0, 8.0, 9.0}  # goals are drawn as ever
    np.testing.assert_array_equal(state.origin.demo, np.where(demonstrated, state.observation[:, 0] - 10, -1))
    np.testing.assert_array_equal(state.origin.step[demonstrated], state.observation[demonstrated, 1])
    if ratio == 0.0:
        return
    # Each of the 4 + 5 states but the last ones, as often as any other.
    rows, counts = np.unique(state.observation[demonstrated], axis=0, return_counts=True)
    expected = np.concatenate([DEMONSTRATIONS.observations[i, :length] for i, length in enumerate((4, 5))])
    np.testing.assert_array_equal(rows, expected)
    assert np.abs(counts - demonstrated.sum() / 9).max() < 5 * np.sqrt(demonstrated.sum() / 9)


def test_a_demonstrated_start_is_the_whole_state_with_keys_of_its_own():
    state = starts(jax.random.key(1), 1.0)
    np.testing.assert_array_equal(state.observation, jax.vmap(ENV.observe)(state.env_state))
    keys = jax.random.key_data(state.env_state.key)
    assert len(np.unique(keys, axis=0)) == len(keys)
    # It goes on as the demonstration did, and has the steps left that the demonstration had: at velocity 1, 4 passes the width of 3.
    first = np.flatnonzero((state.observation[:, 0] == 10) & (state.observation[:, 1] == 2))[:1]
    env_state = jax.tree.map(lambda leaf: leaf[first[0]], state.env_state)
    for t in (3, 4):
        env_state, time_step = ENV.step(env_state, jnp.ones(2))
        assert time_step.observation.tolist() == [10.0, t, t]
        assert bool(time_step.terminated) == (t == 4)


@functools.partial(jax.jit, static_argnames=("act", "num_episodes"))
def evaluate(key, act, num_episodes):
    return rollout.evaluate(key, ENV, GOALS, act, num_episodes)


def test_evaluation_plays_every_episode_to_its_end():
    def act(key, observation, desired_goal):
        # At most 5 steps are taken in each: velocity 2 solves in 2, 1 in 4, and 0.5 is cut at the horizon.
        return jnp.where(desired_goal == 7.0, 1.0, jnp.where(desired_goal == 8.0, 0.0, -0.5)) * jnp.ones((1, 2))

    result = evaluate(jax.random.key(1), act, 30)
    assert result.success.shape == result.length.shape == (30,)
    assert {(bool(s), int(n)) for s, n in zip(result.success, result.length, strict=True)} == {(True, 2), (True, 4), (False, 5)}


def test_a_reward_after_the_end_does_not_count():
    # An environment that ends (unsolved) after one step and would pay a reward in the second.
    class Short(Corridor):
        def step(self, state, action):
            state, time_step = super().step(state, action)
            ends = state.step == 1
            return state, time_step.replace(reward=(state.step == 2).astype(jnp.float32), terminated=ends & False, truncated=ends)

    act = lambda key, observation, desired_goal: jnp.zeros((4, 2))  # noqa: E731
    result = jax.jit(lambda key: rollout.evaluate(key, Short(), GOALS, act, 4))(jax.random.key(2))
    assert result.success.tolist() == [False] * 4
    assert result.length.tolist() == [1] * 4


def test_evaluation_gives_the_policy_a_fresh_key_at_every_step():
    def act(key, observation, desired_goal):
        # Solves only if some draws are high and others low: with one key for all steps, the walk could not mix them.
        return jax.random.uniform(key, (200, 2), minval=-1.0, maxval=1.0)

    lengths = np.asarray(evaluate(jax.random.key(3), act, 200).length)
    assert {3, 4, 5} <= set(lengths.tolist())
    # The sum of velocities U(0, 2) exceeds 3 within 3 steps with probability 1/2, were they independent; a velocity drawn once and kept
    # exceeds it (velocity > 1) with probability 1/2, too, but within 4 steps the two have 0.827 and 0.625.
    assert (lengths <= 4).mean() == pytest.approx(0.827, abs=0.1)
