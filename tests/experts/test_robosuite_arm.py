"""The arm in robosuite: how far the closed form is from it, and episodes that mean the same as those of `play`.

Tests that need robosuite are skipped where it is not installed.
"""

import dataclasses
import importlib.util

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from kinematic_arm import KinematicArm, KinematicReach

from hindrl_jax.base.environments import action_to_env
from hindrl_jax.envs import panda, rotations
from hindrl_jax.envs.panda import closed_form
from hindrl_jax.envs.reach import FixedParameterizedReach
from hindrl_jax.experts.reach import ReachExpert
from hindrl_jax.experts.robosuite_arm import play_episode, play_in_robosuite, shared_scene, stacked
from hindrl_jax.training.playing import play
from hindrl_jax.training.recording import record

ENV = FixedParameterizedReach(num_waypoints=2, backend="robosuite")
IN_CLOSED_FORM = dataclasses.replace(ENV, backend="closed_form")
STEADY = ReachExpert(randomness_scale=0.02)
COARSE = FixedParameterizedReach(num_waypoints=1, position_tolerance=0.1, rotation_tolerance=0.3, horizon=100, backend="robosuite")


def expert_act(expert, env):
    return lambda key, state, observation: expert.act(key, env, state)


@pytest.fixture(scope="module")
def arm():
    """The arm that `play_in_robosuite` uses as well, since building one takes seconds."""
    if importlib.util.find_spec("robosuite") is None:  # importorskip would import it, with all its side effects
        pytest.skip("robosuite is not installed")
    return shared_scene(ENV)


# --- the motion


def commands(name):
    """(100, 6) commands in m and rad."""
    rng = np.random.default_rng(0)
    limits = np.array(3 * [panda.MAX_TRANSLATION] + 3 * [panda.MAX_ROTATION])
    direction = {"zero": np.zeros(6), "forward": np.eye(6)[0], "down": -np.eye(6)[2], "roll": np.eye(6)[3], "yaw": np.eye(6)[5]}.get(name)
    if name == "random":
        return rng.uniform(-limits, limits, (100, 6))
    if name == "expert":  # two straight lines with the noise of the expert, several times the limits
        lines = np.repeat(rng.uniform(-1, 1, (2, 6)), 50, axis=0)
        return np.clip(lines + rng.normal(size=(100, 6)), -1, 1) * limits
    return np.tile(direction * limits, (100, 1))


@jax.jit
def in_closed_form(joints, sequence):
    """(100, 7) joints after each command, by the closed form."""

    def step(carry, command):
        carry = closed_form.control_step(*carry, joints, command)
        return carry, carry[0]

    return jax.lax.scan(step, (joints, jnp.zeros(7)), sequence)[1]


hands = jax.jit(jax.vmap(lambda joints: panda.posture(joints)[3:]))  # positions and rotations
angles = jax.jit(jax.vmap(lambda a, b: jnp.linalg.norm(rotations.between(a, b))))


@pytest.mark.parametrize(
    ("name", "millimetres", "milliradians"),
    # About twice what was measured.
    [
        ("zero", 0.001, 0.001),
        ("forward", 0.02, 0.04),
        ("down", 0.03, 0.1),
        ("roll", 0.1, 0.3),
        ("yaw", 0.3, 4.0),
        ("random", 0.2, 1.0),
        ("expert", 0.7, 3.0),
    ],
)
def test_closed_form_stays_close_to_robosuite(arm, name, millimetres, milliradians):
    sequence = commands(name)
    start = np.float32(panda.INITIAL_JOINTS) + np.float32(np.random.default_rng(1).normal(0, 0.02, 7))
    joints, velocities = arm.reset(start)
    np.testing.assert_array_equal(joints, start)
    np.testing.assert_array_equal(velocities, 0.0)
    theirs = np.stack([arm.step(command)[0] for command in sequence])
    ours = in_closed_form(start, jnp.asarray(sequence, jnp.float32))
    (our_position, our_rotation), (position, rotation) = hands(ours), hands(jnp.asarray(theirs, jnp.float32))
    distance, angle = jnp.linalg.norm(our_position - position, axis=1).max() * 1e3, angles(our_rotation, rotation).max() * 1e3
    assert distance < millimetres
    assert angle < milliradians


def test_a_reset_leaves_nothing_behind(arm):
    start, command = np.array(panda.INITIAL_JOINTS), np.array([0.02, -0.01, 0.01, 0.03, 0.0, -0.05])
    runs = []
    for _ in range(2):
        arm.reset(start)
        runs.append(np.stack([np.concatenate(arm.step(command)) for _ in range(5)]))
        arm.step(-command)
    np.testing.assert_array_equal(*runs)


# --- episodes


@pytest.mark.parametrize("num_held", [1, 4])
def test_host_loop_plays_as_the_compiled_one_does(num_held):
    """With the same arm on both sides: every row, the padding included, but for actions, whose padding is 0 on the host."""
    env = KinematicReach(num_waypoints=1, position_tolerance=0.1, rotation_tolerance=0.3, horizon=19)
    act = expert_act(ReachExpert(randomness_scale=0.05), env)
    expected = jax.jit(lambda key: play(key, env, act, 6, num_held))(jax.random.key(4))
    arm, jitted = KinematicArm(), jax.jit(act)
    found = stacked([play_episode(key_episode, env, arm, jitted, num_held) for key_episode in jax.random.split(jax.random.key(4), 6)])
    lengths = np.asarray(expected.lengths)
    assert set(np.asarray(expected.terminated).tolist()) == {False, True}
    padding = np.arange(env.horizon)[None] >= lengths[:, None]
    actions = jnp.where(padding[..., None], 0.0, expected.actions)
    expected = expected.replace(actions=actions)
    assert jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), found) == jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), expected)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=2e-4), found, expected)


class Spy:
    """The arm, and what robosuite's own environment makes of the episode."""

    def __init__(self, arm):
        self.arm, self.rewards, self.reached, self.commands = arm, [], [], []

    def begin(self, state):
        self.arm.begin(state)

    def step(self, command):
        outcome = self.arm.step(command)
        self.commands.append(command)
        self.rewards.append(self.arm.environment.reward())
        self.reached.append(self.arm.environment._get_observations()["waypoints_reached"])
        return outcome


@pytest.fixture(scope="module")
def played(arm):
    """A solved episode of the expert in robosuite, and its spy."""
    spy = Spy(arm)
    episode = play_episode(jax.random.key(0), ENV, spy, jax.jit(expert_act(STEADY, ENV)))
    assert episode.terminated
    return episode, spy


def test_robosuites_own_environment_agrees_about_rewards_and_progress(played):
    episode, spy = played
    length = int(episode.lengths)
    np.testing.assert_array_equal(spy.rewards, episode.rewards[:length])
    assert np.flatnonzero(spy.rewards).tolist() == [length - 1]
    np.testing.assert_array_equal(spy.reached, episode.observations[1 : length + 1, -2:])


def test_an_episode_in_robosuite_reaches_the_same_waypoints_in_closed_form(played):
    episode, spy = played
    length = int(episode.lengths)
    actions = action_to_env(jnp.asarray(episode.actions), IN_CLOSED_FORM)
    np.testing.assert_allclose(actions[:length], spy.commands, atol=1e-6)
    # An episode ends as soon as the hand is within the tolerance, so a hair's breadth more is granted to the replay.
    env = dataclasses.replace(IN_CLOSED_FORM, position_tolerance=0.0205, rotation_tolerance=0.054)
    start = env.vector_to_state(jax.random.key(0), episode.states[0])
    replay = jax.jit(lambda state, actions: jax.lax.scan(env.step, state, actions))
    state, _ = replay(start, actions[:length])
    assert int(state.num_reached) == 2
    np.testing.assert_allclose(state.joints, episode.states[-1][:7], atol=1e-3)  # 2e-4 was measured


def test_actions_are_clipped_for_robosuite_and_recorded_as_they_are(arm):
    spy, env = Spy(arm), dataclasses.replace(ENV, horizon=2)
    episode = play_episode(jax.random.key(0), env, spy, lambda key, state, observation: 3.0 * jnp.asarray(env.action_high))
    np.testing.assert_allclose(spy.commands, np.tile(env.action_high, (2, 1)))
    np.testing.assert_allclose(episode.actions, 3.0, rtol=1e-6)


@pytest.fixture(scope="module")
def recording(arm):
    return record(jax.random.key(0), COARSE, STEADY, 2)


def test_recording_keeps_solved_episodes_and_repeats_itself(recording):
    episodes = recording
    assert np.asarray(episodes.terminated).all()
    assert episodes.observations.shape == (2, COARSE.horizon + 1, COARSE.observation_dim)
    np.testing.assert_array_equal(episodes.rewards.sum(axis=1), 1.0)
    again = record(jax.random.key(0), COARSE, STEADY, 1)
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a, b[:1]), again, recording)


def test_playing_compiles_once(arm):
    traces = []

    def act(key, state, observation):
        traces.append(1)
        return STEADY.act(key, COARSE, state)

    env = dataclasses.replace(COARSE, horizon=2)
    for seed in range(2):
        assert play_in_robosuite(jax.random.key(seed), env, act, 2).lengths.tolist() == [2, 2]
    assert len(traces) == 1
