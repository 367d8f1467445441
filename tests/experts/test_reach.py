"""The scripted expert of the reach tasks: single decisions by hand, and whole episodes with and without its noise."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hindrl_jax.base.environments import action_to_env
from hindrl_jax.envs import panda, rotations
from hindrl_jax.envs.reach import FixedParameterizedReach, ParameterizedReach
from hindrl_jax.experts.reach import ReachExpert
from hindrl_jax.training.playing import play

ENV = FixedParameterizedReach()
HAND = panda.posture(jnp.asarray(panda.INITIAL_JOINTS, jnp.float32))


def place(offsets, turns, *, num_reached=0):
    """A state with waypoints at these offsets (K, 3) in m and rotation vectors (K, 3) in rad from the hand."""
    joints = jnp.asarray(panda.INITIAL_JOINTS, jnp.float32)
    vector = jnp.concatenate(
        [
            joints,
            jnp.zeros(7),
            joints,
            (HAND.hand_position[None] + jnp.array(offsets)).ravel(),
            jnp.stack([rotations.from_rotation_vector(jnp.array(turn)) @ HAND.hand_rotation for turn in turns]).ravel(),
            jnp.array([num_reached, 0.0]),
        ]
    )
    return ENV.vector_to_state(jax.random.key(0), vector)


@functools.partial(jax.jit, static_argnums=(0, 2))
def decisions(expert, state, num=1):
    """(num, 6) actions under many keys."""
    return jax.vmap(lambda key: expert.act(key, ENV, state))(jax.random.split(jax.random.key(1), num))


# --- single decisions

OFFSETS, TURNS = [(0.3, 0.0, 0.4), (0.003, -0.004, 0.0)], [(0.0, 0.6, -0.8), (0.01, 0.0, 0.02)]


@pytest.mark.parametrize(
    ("num_reached", "expected"),
    [
        (0, [0.012, 0.0, 0.016, 0.0, 0.03, -0.04]),  # straight there, as fast as may be: 0.02 m of 0.5, 0.05 rad of 1
        (1, [0.003, -0.004, 0.0, 0.01, 0.0, 0.02]),  # the second one is near
        (2, [0.003, -0.004, 0.0, 0.01, 0.0, 0.02]),  # and remains the target when all is done
    ],
)
def test_without_noise_it_heads_for_the_next_waypoint(num_reached, expected):
    action = decisions(ReachExpert(0.0), place(OFFSETS, TURNS, num_reached=num_reached))
    np.testing.assert_allclose(action[0], expected, atol=2e-6)


def test_noise_is_gaussian_with_the_given_deviation():
    # So small that nothing is shortened: what is left is eq. 4.10 as it stands.
    scale, num = 1e-3, 4000
    state = place(OFFSETS, TURNS, num_reached=1)
    noise = np.asarray(decisions(ReachExpert(scale), state, num) - decisions(ReachExpert(0.0), state)) / scale
    assert np.abs(noise.mean(axis=0)).max() < 5 / num**0.5
    np.testing.assert_allclose(noise.std(axis=0), 1.0, atol=5 / (2 * num) ** 0.5)
    assert np.abs(np.corrcoef(noise.T) - np.eye(6)).max() < 5 / num**0.5
    np.testing.assert_allclose([(np.abs(noise) < width).mean() for width in (1, 2)], [0.683, 0.954], atol=0.015)


def test_noise_comes_before_the_shortening():
    """The same keys draw the same noise, a hundred times larger."""
    state = place(OFFSETS, TURNS, num_reached=1)
    wanted = np.asarray(decisions(ReachExpert(0.0), state), float)
    small, large = (np.asarray(decisions(ReachExpert(scale), state, 200), float) for scale in (1e-3, 0.1))
    unshortened = wanted + 100 * (small - wanted)
    for half, limit in ((slice(0, 3), 0.02), (slice(3, 6), 0.05)):
        lengths = np.linalg.norm(unshortened[:, half], axis=1, keepdims=True)
        assert (lengths > limit).mean() > 0.9  # it nearly always is too long
        np.testing.assert_allclose(large[:, half], unshortened[:, half] * np.minimum(1.0, limit / lengths), atol=2e-5)


@pytest.mark.parametrize("scale", [-0.1, float("nan"), "0.1"])
def test_invalid_scale(scale):
    with pytest.raises(ValueError, match="randomness_scale = "):
        ReachExpert(randomness_scale=scale)


# --- whole episodes

NUM_EPISODES = 20


@pytest.fixture(scope="module", params=[FixedParameterizedReach, ParameterizedReach])
def played(request):
    """The task, its episodes without noise, and those with it."""
    env = request.param(horizon=400)

    @jax.jit
    def run(key, is_noisy):  # one program for both experts
        def act(key, state, observation):
            steady = ReachExpert(0.0).act(jax.random.key(0), env, state)  # whatever the key
            return jnp.where(is_noisy, ReachExpert().act(key, env, state), steady)

        return play(key, env, act, NUM_EPISODES)

    return env, run(jax.random.key(0), False), run(jax.random.key(1), True)


def test_without_noise_it_solves_every_episode(played):
    """Of these. In one in a hundred random tasks the straight way ends at the limits of the last two joints."""
    env, episodes, _ = played
    lengths = np.asarray(episodes.lengths)
    assert np.asarray(episodes.terminated).all()
    assert lengths.max() < 300  # the horizon of the thesis
    if env.name == "FixedParameterizedReach":
        assert lengths.min() >= 140
        assert lengths.max() <= 190
    else:
        assert np.ptp(lengths) > 50  # near and far ones


def test_noise_makes_episodes_half_as_long_again_and_more(played):
    env, _, episodes = played
    solved = np.asarray(episodes.terminated)
    assert solved.sum() > NUM_EPISODES / 2
    if env.name == "FixedParameterizedReach":
        assert 280 <= np.median(np.asarray(episodes.lengths)[solved]) <= 380


def test_actions_are_never_longer_than_the_controller_takes(played):
    env, *recordings = played
    for episodes in recordings:
        taken = np.arange(env.horizon)[None] < np.asarray(episodes.lengths)[:, None]
        actions = np.asarray(action_to_env(episodes.actions, env))[taken]
        assert np.abs(np.asarray(episodes.actions)[taken]).max() <= 1.0 + 1e-6
        for half, limit in ((slice(0, 3), 0.02), (slice(3, 6), 0.05)):
            lengths = np.linalg.norm(actions[:, half], axis=1)
            assert lengths.max() <= limit * (1 + 1e-5)
            assert (lengths > limit * (1 - 1e-5)).mean() > 0.5  # and mostly as long
