"""The scripted expert of the cable tasks: single decisions, and whole episodes with and without its noise."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hindrl_jax.base.environments import action_to_env
from hindrl_jax.envs.cable import BringNear, CableInsertion, geometry
from hindrl_jax.envs.cable.rules import GRASP
from hindrl_jax.experts.cable import CableExpert
from hindrl_jax.training.playing import play

STEADY = CableExpert(translation_noise=0.0, rotation_noise=0.0, insertion_noise=0.0)
SHAKY = CableExpert()
OPEN, SHUT = geometry.MAX_FINGER, 0.0
GRIPS = geometry.HANGING_GRIPS


def place(offsets=((0.3, 0.0, 0.2), (0.3, 0.0, 0.2)), *, held=(False, False), finger_targets=OPEN):
    """A state with hands at these offsets from hanging grips, turned to grasp them."""
    state = start()
    scene = state.scene.replace(
        hand_positions=jnp.asarray(GRIPS + np.array(offsets, np.float32)),
        hand_rotations=jnp.broadcast_to(jnp.asarray(GRASP, jnp.float32), (2, 3, 3)),
        held=jnp.asarray(held),
    )
    return state.replace(scene=scene, finger_targets=jnp.full(2, finger_targets))


@functools.cache
def start():
    return jax.jit(BringNear().reset)(jax.random.key(0))[0]


@functools.partial(jax.jit, static_argnums=(0, 2))
def decisions(expert, state, num=1):
    """(num, 2, 7) actions under many keys."""
    return jax.vmap(lambda key: expert.act(key, BringNear(), state))(jax.random.split(jax.random.key(1), num)).reshape(num, 2, 7)


# --- single decisions


def test_from_the_first_place_it_goes_straight_to_the_grip_and_its_hand_is_steady():
    back = -0.05 * GRASP[:, 2]
    action = decisions(SHAKY, place((back, back)), 3)
    expected = [*(-0.02 * back / 0.05), 0.0, 0.0, 0.0, -1.0]  # 50 mm away, shortened to 20
    np.testing.assert_allclose(action, np.broadcast_to(expected, (3, 2, 7)), atol=1e-5)


def test_from_elsewhere_it_travels_with_a_shaky_hand():
    actions = decisions(SHAKY, place(), 200)
    assert actions[..., :3].std(axis=0).min() > 0.003
    assert actions[..., 3:6].std(axis=0).min() > 0.01
    assert decisions(STEADY, place(), 200).std(axis=0).max() < 1e-6


@pytest.mark.parametrize(
    ("offset", "finger_targets", "closes"),
    [
        (0.001, OPEN, True),  # there, within 1.5 mm
        (0.002, OPEN, False),  # nearly
        (0.002, 0.03, True),  # fingers that have begun go on,
        (0.009, SHUT, True),
        (0.011, SHUT, False),  # unless the head is lost
    ],
)
def test_when_it_closes_its_fingers(offset, finger_targets, closes):
    action = decisions(STEADY, place(((offset, 0.0, 0.0), (0.3, 0.0, 0.2)), finger_targets=finger_targets))[0]
    assert action[0, 6] == (1.0 if closes else -1.0)
    assert action[1, 6] == -1.0
    assert (jnp.abs(action[0, :6]) < 1e-7).all() == closes  # and stands still meanwhile


def test_an_arm_that_holds_its_head_waits_for_the_other():
    action = decisions(SHAKY, place(((0.0, 0.0, 0.0), (0.3, 0.0, 0.2)), held=(True, False), finger_targets=SHUT))[0]
    np.testing.assert_array_equal(action[0], [0, 0, 0, 0, 0, 0, 1])
    assert jnp.abs(action[1, :6]).max() > 0.001


def test_with_both_heads_it_lifts_them():
    still = place(((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), held=(True, True), finger_targets=SHUT)
    action = decisions(STEADY, still)[0]
    assert (action[:, 6] == 1).all()
    assert (action[:, 2] > 0.001).all()
    assert (decisions(STEADY, still.replace(finger_targets=jnp.array([0.0, 0.008])))[0, :, :6] == 0).all()  # not before fingers have closed


@pytest.mark.parametrize("field", ["translation_noise", "rotation_noise", "insertion_noise"])
@pytest.mark.parametrize("scale", [-0.1, float("nan"), "0.1"])
def test_invalid_scale(field, scale):
    with pytest.raises(ValueError, match=f"{field} = "):
        CableExpert(**{field: scale})


# --- whole episodes

NUM_EPISODES = 20


@pytest.fixture(scope="module", params=[BringNear, CableInsertion])
def played(request):
    """The task, its episodes without noise, and those with it."""
    env = request.param(horizon=500)

    @jax.jit
    def run(key, is_noisy):  # one program for both experts
        def act(key, state, observation):
            steady = STEADY.act(jax.random.key(0), env, state)  # whatever the key
            return jnp.where(is_noisy, SHAKY.act(key, env, state), steady)

        return play(key, env, act, NUM_EPISODES)

    return env, run(jax.random.key(0), False), run(jax.random.key(1), True)


def test_it_solves_every_episode_with_and_without_noise(played):
    _, steady, shaky = played
    for episodes in (steady, shaky):
        assert np.asarray(episodes.terminated).all()
    assert 180 < np.median(steady.lengths) < np.median(shaky.lengths) < 450
    assert np.isfinite(np.asarray(shaky.observations)).all()


def test_both_heads_are_held_at_the_end(played):
    env, _, episodes = played
    last = np.asarray(episodes.observations)[np.arange(NUM_EPISODES), np.asarray(episodes.lengths)]
    np.testing.assert_array_equal(last[:, 27:29], 1.0)
    assert (np.linalg.norm(last[:, 24:27], axis=1) < env.position_tolerance).all()
    np.testing.assert_array_equal(last[:, -1], 1.0)


def test_actions_are_never_longer_than_the_controller_takes(played):
    env, *recordings = played
    for episodes in recordings:
        taken = np.arange(env.horizon)[None] < np.asarray(episodes.lengths)[:, None]
        actions = np.asarray(action_to_env(episodes.actions, env))[taken].reshape(-1, 2, 7)
        assert np.linalg.norm(actions[..., :3], axis=-1).max() <= 0.02 * (1 + 1e-5)
        assert np.linalg.norm(actions[..., 3:6], axis=-1).max() <= 0.05 * (1 + 1e-5)
        assert set(np.unique(actions[..., 6]).tolist()) == {-1.0, 1.0}
