"""The cable tasks in robosuite: the same start as ours, the same fingers, and an episode of the expert. Skipped where robosuite is not installed."""

import importlib.util

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hindrl_jax.envs.cable import BringNear, chains, geometry
from hindrl_jax.experts.cable import CableExpert
from hindrl_jax.experts.robosuite_arm import play_episode, shared_scene

ENV = BringNear(backend="robosuite")


@pytest.fixture(scope="module")
def scene():
    if importlib.util.find_spec("robosuite") is None:  # importorskip would import it, with all its side effects
        pytest.skip("robosuite is not installed")
    return shared_scene(ENV)


def test_it_begins_where_our_own_tasks_do(scene):
    state, _ = jax.jit(ENV.reset)(jax.random.key(0))
    scene.begin(state)
    joints, data = scene.joints(), scene.environment.sim.data
    np.testing.assert_allclose(joints.positions, state.physics.positions, atol=1e-4)
    np.testing.assert_array_equal(joints.velocities, 0.0)
    ours = jax.jit(chains.scene)(joints)
    for i, head in enumerate(("plug", "socket")):
        np.testing.assert_allclose(data.site(f"gripper{i}_right_grip_site").xpos, ours.hand_positions[i], atol=1e-5)
        np.testing.assert_allclose(data.site(f"{head}_grip").xpos, geometry.HANGING_GRIPS[i], atol=1e-5)


class Spy:
    """The scene, and what has come out of it."""

    def __init__(self, scene):
        self.scene, self.outcomes, self.grips = scene, [], []

    def begin(self, state):
        self.scene.begin(state)

    def step(self, command):
        self.grips.append(command.reshape(2, 7)[:, 6])
        self.outcomes.append(self.scene.step(command))
        return self.outcomes[-1]


def test_an_episode_of_the_expert(scene):
    steady, spy = CableExpert(translation_noise=0.0, rotation_noise=0.0), Spy(scene)
    episode = play_episode(jax.random.key(0), ENV, spy, jax.jit(lambda key, state, observation: steady.act(key, ENV, state)))
    assert episode.terminated
    np.testing.assert_array_equal(episode.observations[episode.lengths, 27:29], 1.0)
    # robosuite's gripper goes by as much for a command as that of our other back ends: 4 mm, from half open on.
    targets = np.full(2, 0.02)
    for grips, (found, _) in zip(spy.grips, spy.outcomes, strict=True):
        targets = np.clip(targets - 0.004 * np.sign(grips), 0.0, geometry.MAX_FINGER)
        np.testing.assert_allclose(found, targets, atol=1e-6)
    # Its states are those of C MuJoCo, to be drawn, or to be gone on from.
    in_c = BringNear(backend="mujoco")
    last = in_c.vector_to_state(jax.random.key(0), jnp.asarray(episode.states[-1]))
    np.testing.assert_allclose(in_c.observe(last), episode.observations[-1], atol=1e-5)
