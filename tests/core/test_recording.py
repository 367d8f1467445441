"""What training records: every stored episode is one that was played, from the start, with the goal and the notes that it should have."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from corridor_training import (
    COLLECT_STEPS,
    HORIZON,
    LEARN_STEPS,
    NUM_ENVS,
    SPEEDS,
    make_config,
    make_data,
    make_env,
    recorded_episodes,
    with_output_bias,
)
from toy_env import corridor_demonstrations

from hindrl_jax.config import BatchConfig, GoalConfig
from hindrl_jax.core import agent as agents
from hindrl_jax.core import train
from hindrl_jax.core.hindsight import NEARBY_GOAL


@pytest.fixture(scope="module")
def data():
    return make_data(make_config())


@pytest.fixture(scope="module")
def recorded(data):
    """The replay after `collect` and `learn`, and after `learn` again; the first policy plays (0.5, -0.5) and a little noise."""
    env, config = make_env(), make_config()

    @jax.jit
    def start(key):
        state = train.collect(train.init(key, data, env, config), data, env=env, config=config, num_iterations=COLLECT_STEPS)
        return with_output_bias(state, [np.arctanh(0.5), np.arctanh(-0.5), -5.0, -5.0])

    learn = jax.jit(functools.partial(train.learn, env=env, config=config, num_iterations=LEARN_STEPS))
    first, _ = learn(start(jax.random.key(0)), data)
    second, _ = learn(first, data)
    return jax.device_get((first.replay, second.replay))


def test_replay_holds_what_was_played(recorded, data):
    goals = np.asarray(data.behavioural_goals.goals)
    starts = []
    for _, length, episode in recorded_episodes(recorded[1]):
        observations, actions, rewards = episode.observations[: length + 1], episode.actions[:length], episode.rewards[:length]
        starts.append(observations[0, 0])
        assert np.all(observations[:, 0] == observations[0, 0])  # one episode, not two
        assert observations[:, 1].tolist() == list(range(length + 1))
        np.testing.assert_allclose(np.diff(observations[:, 2]), actions[:, 0] + 1.0, atol=1e-5)  # policy units to velocities
        assert rewards.tolist() == (observations[1:, 2] > 4.0).tolist()
        assert bool(episode.terminated) == bool(rewards[-1])
        assert rewards[:-1].sum() == 0.0
        assert episode.terminated or length == HORIZON
        assert np.any(episode.desired_goals == goals)
        assert np.abs(actions).max() <= 1.0
    assert len(starts) >= NUM_ENVS * 2
    assert len(set(starts)) == len(starts)
    assert recorded[1].notes == {}


def test_actions_are_uniform_at_first_and_the_policys_when_learning(recorded):
    replay = recorded[0]
    slots, first_of_policy = len(replay.episodes.lengths) // NUM_ENVS, set()
    for env in range(NUM_ENVS):
        rows = [(env * slots + slot, length) for slot, length in enumerate(replay.episodes.lengths[env * slots : (env + 1) * slots]) if length]
        rows.append((env * slots + replay.slot[env], replay.step[env]))  # the episode under way
        actions = np.concatenate([replay.episodes.actions[row, :length] for row, length in rows])
        assert len(actions) == COLLECT_STEPS + LEARN_STEPS
        # The policy has moved by a few Adam steps of 1e-3; a uniform action is as near as that to it with probability 1e-3 at most.
        from_policy = np.all(np.abs(actions - np.array([0.5, -0.5])) < 0.05, axis=1)
        assert from_policy.tolist() == [False] * COLLECT_STEPS + [True] * LEARN_STEPS
        assert actions[:COLLECT_STEPS].std() > 0.4  # U(-1, 1) has 0.58
        first_of_policy.add(float(actions[COLLECT_STEPS, 0]))
    assert len(first_of_policy) == NUM_ENVS  # sampled: the mean action is the same in all environments


def collected_and_evaluated(config, data):
    """The replay after 60 steps of random actions, and 20 evaluated episodes of a policy that walks with velocity 1, whatever it sees."""
    env = make_env()

    @jax.jit
    def run(key):
        key_init, key_evaluate = jax.random.split(key)
        state = train.init(key_init, data, env, config)
        state = with_output_bias(train.collect(state, data, env=env, config=config, num_iterations=60), [0.0, 0.0, 0.0, 0.0])
        policy = agents.policy(state.agent, config, average=False).replace(noise=0.0)
        return state.replay, train.evaluate(key_evaluate, policy, data, env=env, config=config, num_episodes=20)

    return jax.device_get(run(jax.random.key(0)))


def test_training_episodes_may_begin_in_demonstrated_states_and_evaluations_never_do():
    config = make_config(demo_reset_ratio=1.0, batch=BatchConfig(n_step=1))
    demonstrations, data = corridor_demonstrations(SPEEDS, env=make_env()), make_data(config)
    assert data.starts.lengths.sum() == 14
    assert data.demonstrations.states is None

    replay, evaluation = collected_and_evaluated(config, data)
    begun = set()
    for _, length, episode in recorded_episodes(replay):
        observations = episode.observations
        demo, start = int(observations[0, 0]) - 10, int(observations[0, 1])
        np.testing.assert_array_equal(observations[0], demonstrations.observations[demo, start])
        assert start < demonstrations.lengths[demo]
        assert observations[: length + 1, 1].tolist() == list(range(start, start + length + 1))  # the steps are counted on
        assert start + length == HORIZON or episode.terminated
        begun.add((demo, start))
    assert len(begun) > 7  # of 14
    assert evaluation.length.tolist() == [5] * 20  # from 0, velocity 1 passes 4 in the fifth step


def test_a_reverse_curriculum_moves_back_where_episodes_succeed():
    """At velocity 1 every episode succeeds, from wherever it begins; at velocity 0 none does."""
    env = make_env()
    config = make_config(demo_reset_ratio=0.75, demo_reset_curriculum=True, batch=BatchConfig(n_step=1))
    demonstrations, data = corridor_demonstrations(SPEEDS, env=env), make_data(config)
    lengths = np.asarray(demonstrations.lengths)

    @jax.jit
    def run(key, bias):
        state = with_output_bias(train.init(key, data, env, config), bias)
        act = train.make_policy(agents.policy(state.agent, config, average=False).replace(noise=0.0), env, config)

        def step(state, key):
            state = train._interact(key, state, data, env, config, act)
            return state, state.curriculum

        return jax.lax.scan(step, state, jax.random.split(jax.random.fold_in(key, 7), 60))

    state, curricula = run(jax.random.key(0), jnp.zeros(4))
    first_steps = np.asarray(curricula.first_step)
    assert (first_steps[0] == lengths - 1).all()
    for demo, length in enumerate(lengths):  # 5, 4 and 5 steps: back by 4 from the last but one, or to the beginning
        assert np.unique(first_steps[:, demo]).tolist() == [0, length - 1]
    for _, _, episode in recorded_episodes(state.replay):
        demo = int(episode.observations[0, 0]) - 10
        if demo >= 0:  # it began in a demonstrated state, of which no other can be than the last but one until three have succeeded
            np.testing.assert_array_equal(episode.observations[0], demonstrations.observations[demo, int(episode.observations[0, 1])])
    _, curricula = run(jax.random.key(0), jnp.array([-9.0, 0.0, 0.0, 0.0]))
    assert (np.asarray(curricula.first_step) == lengths - 1).all()


def test_a_demonstrated_goal_near_the_end_of_each_transition_is_noted_where_intersections_need_it():
    # Goals are 0, 1, ..., 5 and epsilon is 0.2, so that about 4 of 10 positions are near one, and only one.
    env = make_env()
    config = make_config(batch=BatchConfig(hindrl_sampling_strategy="joint_intersection"), goal=GoalConfig(epsilon=0.2))
    data = make_data(config, (1.0,))
    replay = jax.jit(lambda key: train.collect(train.init(key, data, env, config), data, env=env, config=config, num_iterations=40))(
        jax.random.key(0)
    ).replay
    notes, goals, near = np.asarray(replay.notes[NEARBY_GOAL]), np.arange(6.0), []
    for row, length, episode in recorded_episodes(replay):
        for t in range(length):
            distances = np.abs(goals - episode.observations[t + 1, 2])
            expected = int(distances.argmin()) if distances.min() <= 0.2 else -1
            assert notes[row, t] == expected
            near.append(expected >= 0)
    assert len(near) > 60
    assert 0.2 < np.mean(near) < 0.6
    assert (notes[np.asarray(replay.episodes.lengths) == 0, -1] == -1).all()  # not written yet
