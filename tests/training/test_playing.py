"""Playing by ability: in JAX, on the host, or one episode after the other."""

import dataclasses

import flat_env
import jax
import numpy as np
import point_env
import pytest
from flat_env import to_corner
from host_env import HostCorridor
from point_env import to_goal
from tiny import CONFIG, ENV
from toy_env import Corridor, corridor_demonstrations

import hindrl_jax as hindrl
from hindrl_jax.config import GoalConfig
from hindrl_jax.core import train
from hindrl_jax.core.guidance import guidance
from hindrl_jax.core.holding import hold, hold_demonstrations
from hindrl_jax.tasks.registry import TASKS
from hindrl_jax.training import host_playing
from hindrl_jax.training.playing import TrainedPolicies, player


def trained(env, demonstrations, config=CONFIG, **changes):
    """Two untrained policies, and what they aim at."""
    config = dataclasses.replace(config, algo="bc", **changes)
    table = demonstrations.replace(states=None)
    decisions = hold(env, config.num_held, chunks=True) if config.action_chunks else env

    def begin(key):
        data = guidance(table, decisions, config)
        begun = train.RolloutState(env_state=(), observation=None, desired_goal=None)
        return train.agents.policy(train.init(key, data, decisions, config, begun=begun).agent, config, average=True), data.behavioural_goals

    return TrainedPolicies(env, config, *jax.vmap(begin)(jax.random.split(jax.random.key(0), 2)))


@pytest.mark.parametrize(("num_held", "lengths"), [(1, {2, 3, 4, 5}), (2, {2, 4, 5})])
def test_evaluations_are_alike_wherever_an_environment_is_stepped(num_held, lengths):
    """Lengths are in steps, whole decisions of them but for the horizon."""
    keys = jax.random.split(jax.random.key(1), 2)
    outcomes = [trained(env, corridor_demonstrations(), action_hold=num_held).evaluate(keys, 5) for env in (Corridor(), HostCorridor())]
    for outcome in outcomes:
        assert set(outcome.length.flat) <= lengths
        assert outcome.success.shape == outcome.length.shape == (2, 5)
        assert (outcome.success | (outcome.length == 5)).all()
        assert (outcome.length >= 2).all()  # 3 are walked in no less than 2 steps of 2
    again = trained(HostCorridor(), corridor_demonstrations(), action_hold=num_held).evaluate(keys, 5)
    np.testing.assert_array_equal(again.length, outcomes[1].length)
    assert all(stepper.closed for stepper in HostCorridor.made)


def test_chunks_are_played_action_by_action():
    """What is done in an episode is what the policy decided at every second step, in that order; evaluations play the same."""
    env = Corridor()
    policies = trained(env, hold_demonstrations(corridor_demonstrations(), 2, chunks=True), action_hold=2, action_chunks=True)
    one_goal = policies.behavioural_goals.replace(count=np.ones_like(policies.behavioural_goals.count))
    policies = dataclasses.replace(policies, behavioural_goals=one_goal)
    episodes = policies.play(jax.random.key(0), 1, 3)
    choose = train.make_policy(jax.tree.map(lambda leaf: leaf[1], policies.policies), hold(env, 2, chunks=True), policies.config)
    goal = policies.behavioural_goals.goals[1, :1]
    for episode, length in enumerate(episodes.lengths):
        for step in range(int(length)):
            seen = episodes.observations[episode, step - step % 2]
            chunk = np.asarray(choose(jax.random.key(0), seen[None], goal)[0]).reshape(2, 2)
            np.testing.assert_allclose(episodes.actions[episode, step], chunk[step % 2], atol=1e-5)
        assert np.abs(episodes.actions[episode, 0] - episodes.actions[episode, 1]).max() > 1e-3
    outcome = policies.evaluate(jax.random.split(jax.random.key(1), 2), 5)
    assert set(outcome.length.flat) <= {2, 4, 5}


def test_what_steps_neither_in_jax_nor_many_at_once_is_played_by_the_tasks_own_player(monkeypatch):
    """With closed_form in the place of robosuite."""

    def play(key, env, act, num_episodes, num_held):
        played.append((env.backend, num_episodes, num_held))
        if act not in players:  # each policy is compiled once
            players[act] = player(dataclasses.replace(env, backend="closed_form"), act, num_episodes, num_held)
        return players[act](key)

    played, reported, players = [], [], {}
    env = hindrl.make("FixedParameterizedReach", num_waypoints=1, horizon=4)
    demonstration = hindrl.record_demonstrations(dataclasses.replace(env, position_tolerance=9.0, rotation_tolerance=9.0), 1)
    elsewhere = dataclasses.replace(env, backend="robosuite")
    monkeypatch.setitem(TASKS, env.name, dataclasses.replace(TASKS[env.name], player=play))
    policies = trained(elsewhere, demonstration, action_hold=3)
    outcome = policies.evaluate(jax.random.split(jax.random.key(1), 2), 3, reported.append)
    assert outcome.length.tolist() == [[4] * 3] * 2
    assert reported == [1, 2, 3, 4, 5, 6]
    assert played == [("robosuite", 1, 3)] * 6
    episodes = policies.play(jax.random.key(0), 1, 2)
    expected = dataclasses.replace(policies, env=env).play(jax.random.key(0), 1, 2)
    jax.tree.map(np.testing.assert_array_equal, episodes, expected)
    np.testing.assert_array_equal(episodes.actions[:, 1], episodes.actions[:, 0])
    np.testing.assert_array_equal(episodes.actions[:, 2], episodes.actions[:, 0])
    assert (episodes.actions[:, 3] != episodes.actions[:, 0]).any()


def test_what_has_no_states_is_not_played_with_them():
    with pytest.raises(hindrl.UserError, match="PointGoal-v0 cannot be played with its states: it has no step in JAX"):
        player(hindrl.make("gymnasium:point_env:PointGoal-v0"), lambda key, state, observation: observation, 1)


@pytest.mark.parametrize("num_held", [1, 2])
def test_episodes_outside_jax_are_what_the_policy_did_there(num_held):
    """Each action moves the point by half of it, and is what the policy chose; a film of the same episodes ends as they do."""
    env = hindrl.make("gymnasium:point_env:PointGoal-v0", horizon=7)
    recorded = hindrl.record_gymnasium(env, to_goal, 2)
    config = dataclasses.replace(point_env.CONFIG, action_hold=num_held)
    policies = trained(env, jax.tree.map(jax.numpy.asarray, hold_demonstrations(recorded, num_held)), config)
    episodes = policies.play(jax.random.key(3), 1, 4)
    assert episodes.states.shape == (4, 8, 0)
    choose = train.make_policy(jax.tree.map(lambda leaf: leaf[1], policies.policies), env, config)
    for episode, length in enumerate(episodes.lengths):
        seen, actions = episodes.observations[episode, : length + 1], episodes.actions[episode, :length]
        np.testing.assert_allclose(seen[1:, 3:], np.clip(seen[:-1, 3:] + point_env.SPEED * actions, -1.0, 1.0), atol=1e-5)
        decided = seen[np.arange(length) // num_held * num_held]
        goals = np.tile(episodes.desired_goals[episode], (length, 1))
        np.testing.assert_allclose(actions, choose(jax.random.key(0), decided, goals), atol=1e-5)
        reached = np.linalg.norm(seen[1:, 3:] - episodes.desired_goals[episode], axis=1) <= 0.2
        np.testing.assert_array_equal(episodes.rewards[episode, :length], reached)
        assert episodes.terminated[episode] == reached[-1]
        assert length == 7 or reached[-1]
    assert len(np.unique(episodes.desired_goals, axis=0)) == 4
    of_one = policies.play(jax.random.key(9), 1, 1)
    pictures, num_solved = policies.film(jax.random.key(9)[None], 1)
    assert (len(pictures), num_solved) == (of_one.lengths[0] + 1, of_one.terminated[0])


def test_episodes_without_goals_of_their_own_are_played_towards_behavioural_ones():
    env = hindrl.make("gymnasium:flat_env:PointFlat-v0", horizon=4, make_kwargs=("near=1.5",))
    recorded = hindrl.record_gymnasium(env, to_corner, 2)
    policies = trained(env, jax.tree.map(jax.numpy.asarray, recorded), flat_env.CONFIG, goal=GoalConfig(behavioural_goals="task"))
    episodes = policies.play(jax.random.key(3), 0, 3)
    np.testing.assert_allclose(episodes.desired_goals, np.tile(policies.behavioural_goals.goals[0, 0], (3, 1)), rtol=1e-6)
    np.testing.assert_allclose(episodes.observations[:, 1, 2:], flat_env.SPEED * episodes.actions[:, 0], atol=1e-5)


def test_actions_are_noted_as_they_were_played():
    """Bounded whole numbers are rounded on their way to the environment."""
    env = hindrl.make("gymnasium:odd_env:Odd-v0", make_kwargs=("action=int8",))
    whole = host_playing.played_action(env, np.array([[0.3, -0.2], [90.0, -90.0]], np.float32))
    np.testing.assert_array_equal(whole, np.rint(whole))
    assert np.all((whole >= np.ceil(env.action_low)) & (whole <= np.floor(env.action_high)))
    bounded = host_playing.played_action(HostCorridor(), np.full((1, HostCorridor().action_dim), 7.0))
    np.testing.assert_array_equal(bounded[0], HostCorridor().action_high)


def test_only_what_draws_itself_is_filmed():
    with pytest.raises(hindrl.UserError, match="FixedGridPickAndPlace does not draw itself"):
        trained(ENV, hindrl.record_demonstrations(ENV, 1)).film(jax.random.split(jax.random.key(0), 1), 0)
