"""Whatever is commanded, nothing in the cable tasks explodes, tunnels or stretches, in closed form and in C. A small sample: a thousand episodes are
those of `benchmarks.cable_safety`."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from cable_states import state_in_c

from benchmarks import cable_safety
from benchmarks.cable_parity import as_closed_form
from hindrl_jax.envs.cable import CableInsertion, contact, geometry, model
from hindrl_jax.envs.cable.rules import _solved_scene
from hindrl_jax.experts.cable import CableExpert

BACKENDS = pytest.mark.parametrize("backend", ["closed_form", "mujoco"])
NUM, STEPS = 8, 200


def commands(name):
    """(STEPS, NUM, 14) normalised to [-1, 1]."""
    rng = np.random.default_rng(0)
    if name == "random":
        return rng.uniform(-1, 1, (STEPS, NUM, 14))
    if name == "to and fro":  # as far as may be, turned round at random
        return np.sign(rng.normal(size=(STEPS // 5, NUM, 14))).repeat(5, axis=0)
    if name == "into each other":  # the plug's arm to -y, the socket's to +y, all fingers shut
        towards = np.tile(np.array([0, -1, 0, 0, 0, 0, 1, 0, 1, 0, 0, 0, 0, 1.0]), (STEPS, NUM, 1))
        return towards + 0.3 * rng.normal(size=towards.shape) * (np.arange(14) % 7 < 6)
    raise KeyError(name)


@functools.cache
def played(backend, name, start):
    """States, leaves (STEPS, NUM, ...), and the commands as they were."""
    env = CableInsertion(backend=backend)
    if start == "fresh":
        states = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), NUM))[0]
    else:
        state = state_in_c(start)
        states = jax.tree.map(lambda leaf: jnp.stack([leaf] * NUM), state if backend == "mujoco" else as_closed_form(state))
    given = jnp.asarray(commands(name) * env.action_high, jnp.float32)

    def step(states, actions):
        states, _ = jax.vmap(env.step)(states, actions)
        return states, states.replace(key=None)

    return jax.jit(lambda states: jax.lax.scan(step, states, given)[1])(states)


CASES = pytest.mark.parametrize(
    ("name", "start"), [("random", "fresh"), ("to and fro", "fresh"), ("random", "lifted"), ("to and fro", "lifted"), ("into each other", "lifted")]
)


@BACKENDS
@CASES
def test_everything_stays_finite_slow_and_in_reach(backend, name, start):
    states = played(backend, name, start)
    scene = jax.tree.map(np.asarray, states.scene)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(scene))
    for positions, most in ((scene.hand_positions, 2.0), (scene.head_positions, 8.0)):  # m/s; a head that is let go falls and swings
        speeds = np.linalg.norm(np.diff(positions, axis=0), axis=-1) / 0.05
        assert speeds.max() < most
    run = scene.head_positions - geometry.GRIP * scene.head_rotations[..., 2] - geometry.ANCHORS
    assert np.linalg.norm(run, axis=-1).max() < geometry.CABLE_LENGTH + 0.025  # cables do not stretch
    np.testing.assert_allclose(np.linalg.det(scene.head_rotations), 1.0, atol=1e-3)
    assert scene.fingers.min() > -0.005
    assert scene.fingers.max() < geometry.MAX_FINGER + 0.005


@CASES
def test_kinetic_energy_is_bounded_in_c(name, start):
    states = played("mujoco", name, start)
    m, data = model.model(5), mujoco.MjData(model.model(5))
    energies = []
    for t in range(0, STEPS, 10):
        for i in range(NUM):
            data.qpos[:], data.qvel[:] = states.physics.positions[t, i], states.physics.velocities[t, i]
            mujoco.mj_forward(m, data)
            mujoco.mj_energyVel(m, data)
            energies.append(data.energy[1])
    assert max(energies) < 60.0  # J; two arms whose seven joints turn at 1 rad/s have 18


@BACKENDS
def test_hands_do_not_pass_through_each_other(backend):
    scene = played(backend, "into each other", "lifted").scene
    depth = jax.jit(jax.vmap(jax.vmap(lambda positions, rotations: jnp.linalg.norm(contact.hands_apart(positions, rotations)))))
    assert depth(scene.hand_positions, scene.hand_rotations).max() < 0.03  # of 60 mm; the closed form's hands have other capsules


@BACKENDS
def test_the_plug_never_is_deeper_in_the_socket_than_its_bottom(backend):
    """The expert, who goes on pressing after the plug is in."""
    env = CableInsertion(backend=backend)
    state = state_in_c("inserting")
    state = state if backend == "mujoco" else as_closed_form(state)

    def step(carry, _):
        state, key = carry
        key, key_act = jax.random.split(key)
        state, _ = env.step(state, CableExpert().act(key_act, env, state))
        return (state, key), state.scene

    _, scenes = jax.jit(lambda state: jax.lax.scan(step, (state, jax.random.key(0)), length=120))(state)
    plug, socket = np.moveaxis(np.asarray(scenes.head_rotations)[..., 2], 1, 0)
    tips = np.asarray(scenes.head_positions) + np.array([[geometry.to_tip(0)], [geometry.to_tip(1)]]) * np.stack([plug, socket], axis=1)
    height = ((tips[:, 0] - tips[:, 1]) * socket).sum(axis=-1)
    aside = np.linalg.norm(tips[:, 0] - tips[:, 1] - height[:, None] * socket, axis=-1)
    assert height.min() > -geometry.DEPTH - 0.0015
    assert height.min() < -geometry.DEPTH + 0.003
    assert aside[height < -0.003].max() < geometry.CLEARANCE + 0.0007


@BACKENDS
def test_random_commands_never_insert_the_plug(backend):
    for name, start in (("random", "lifted"), ("to and fro", "lifted"), ("into each other", "lifted")):
        scene = played(backend, name, start).scene
        assert not jax.vmap(jax.vmap(CableInsertion().is_solved))(scene).any()


@pytest.mark.parametrize(
    ("depth", "aside", "expected"),
    [
        (geometry.DEPTH, 0.0, 0.0),  # on the bore's bottom
        (geometry.DEPTH + 0.001, 0.0, 0.001),  # 1 mm in it
        (0.01, geometry.CLEARANCE, 0.0),  # along a wall, half way in
        (0.01, geometry.CLEARANCE + 0.002, 0.002),  # 2 mm in the wall: the bore is nearest
        (0.001, geometry.CLEARANCE + 0.002, 0.001),  # the mouth is nearer
        (0.01, geometry.SLEEVE_RADIUS + geometry.PIN_RADIUS - 0.003, 0.003),  # in the wall from outside
        (-0.01, 0.002, 0.0),  # before the mouth
    ],
)
def test_how_deep_a_tip_is_in_what_is_solid(depth, aside, expected):
    """The benchmark's measure."""
    scene = _solved_scene(depth)
    scene = scene.replace(head_positions=scene.head_positions + jnp.array([[aside, 0.0, 0.0], [0.0, 0.0, 0.0]]))
    np.testing.assert_allclose(cable_safety._overlaps(scene)[1], expected, atol=1e-6)
