"""The closed form of the cable tasks: arms under position actuators, fingers, free heads, weights and leashes."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from cable_states import IN_C, IN_CLOSED_FORM, SHUT, in_closed_form, on_the_way, repeated, reset, roll, state_in_c

from hindrl_jax.envs import panda
from hindrl_jax.envs.cable import closed_form, geometry
from hindrl_jax.envs.cable.rules import GRASP
from hindrl_jax.envs.panda import position_actuators


def lifted():
    """A state of the closed form with both heads held, away from the ends of the cables."""
    return in_closed_form(state_in_c("lifted"))


# --- arms


def test_arms_follow_their_actuators_as_in_mujoco():
    """One arm alone, 20 control steps of 5 ms substeps in C, with the same targets."""
    spec = mujoco.MjSpec.from_file(str(panda.MODEL_PATH))
    model = spec.compile()
    model.opt.timestep, model.opt.integrator = 0.005, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    model.opt.density = model.opt.viscosity = 0.0
    model.opt.gravity[:] = 0.0
    model.dof_frictionloss[:] = 0.0
    model.actuator_ctrllimited[:] = 0
    model.actuator_forcelimited[:] = 0
    model.actuator_biastype[:] = mujoco.mjtBias.mjBIAS_AFFINE
    model.actuator_gainprm[:, 0] = position_actuators.POSITION_GAINS
    model.actuator_biasprm[:, 1] = -position_actuators.POSITION_GAINS
    model.actuator_biasprm[:, 2] = -position_actuators.VELOCITY_GAINS
    data = mujoco.MjData(model)
    joints, velocities = jnp.asarray(panda.INITIAL_JOINTS, jnp.float32), jnp.zeros(7)
    data.qpos[:] = joints
    track = jax.jit(lambda q, v, goal: position_actuators.track(q, v, goal, panda.posture(q), jnp.zeros(())))
    rng = np.random.default_rng(0)
    for _ in range(20):
        goal = np.float32(panda.INITIAL_JOINTS) + rng.uniform(-0.1, 0.1, 7).astype(np.float32)
        joints, velocities = track(joints, velocities, goal)
        data.ctrl[:] = goal
        mujoco.mj_step(model, data, position_actuators.SUBSTEPS)
        np.testing.assert_allclose(joints, data.qpos, atol=2e-3)
    assert np.abs(np.asarray(joints) - panda.INITIAL_JOINTS).max() > 0.02


def test_a_load_turns_the_joints_by_as_much_as_their_actuators_give_way():
    """At rest k (q_goal - q) = J^T load, here with J of the end."""
    start = jnp.asarray(panda.INITIAL_JOINTS, jnp.float32)
    track = jax.jit(lambda q, v: position_actuators.track(q, v, start, panda.posture(q), jnp.asarray(5.0)))
    joints, velocities = start, jnp.zeros(7)
    for _ in range(100):
        joints, velocities = track(joints, velocities)
    np.testing.assert_allclose(velocities, 0.0, atol=1e-4)
    pull = -5.0 * np.asarray(panda.jacobian(panda.posture(joints)))[2]
    np.testing.assert_allclose(np.asarray(joints - start) * position_actuators.POSITION_GAINS, pull, atol=5e-3)
    assert panda.posture(joints).hand_position[2] < panda.posture(start).hand_position[2] - 0.001


def test_joints_stop_at_their_limits():
    limit = jnp.asarray(panda.chain().upper, jnp.float32)
    joints, velocities = position_actuators.track(limit, jnp.ones(7), limit + 1.0, panda.posture(limit), jnp.zeros(()))
    np.testing.assert_array_equal(joints, limit)
    np.testing.assert_array_equal(velocities, 0.0)


# --- weights and leashes: without them, what is learnt is not so in MuJoCo


def sinking(state, env, steps=100):
    """m, by which idle arms (2,) sink."""
    _, scenes = roll(env, state, repeated(SHUT, steps))
    return np.asarray(state.scene.hand_positions[:, 2] - scenes.hand_positions[-1, :, 2])


@pytest.mark.parametrize("situation", ["lifted", "inserting"])
def test_idle_arms_sink_under_the_weight_of_their_cables_as_in_mujoco(situation):
    """Each control step aims at where the joints are now, so nothing brings an arm back: some 10 mm in 5 s."""
    state = state_in_c(situation)
    in_c, in_closed = sinking(state, IN_C), sinking(in_closed_form(state), IN_CLOSED_FORM)
    assert (in_c > 0.004).all()
    np.testing.assert_allclose(in_closed, in_c, atol=0.003)
    light = in_closed_form(state)
    light = light.replace(physics=light.physics.replace(weights=jnp.zeros(2)))
    assert sinking(light, IN_CLOSED_FORM).max() < 0.004


def pulled(state, env, steps=60):
    """What remains after pulling both heads straight down: how far the cables are too short, m (2,), and which heads are held."""
    down = np.tile(np.array([0, 0, -0.02, 0, 0, 0, 1], np.float32), 2)
    last, _ = roll(env, state, repeated(down, steps))
    excess, _ = jax.jit(closed_form._beyond_leash)(last.scene.head_positions, last.scene.head_rotations)
    return np.asarray(excess), np.asarray(last.scene.held), np.asarray(last.scene.hand_positions[:, 2])


def test_a_taut_cable_holds_the_arm_back():
    state = lifted()
    excess, held, height = pulled(state, IN_CLOSED_FORM)
    assert (excess < 0.01).all()
    assert held.all()
    bottom = geometry.ANCHORS[0, 2] - geometry.CABLE_LENGTH - 0.12
    assert (height > bottom).all()


def test_without_its_leash_the_arm_would_tear_the_head_out(monkeypatch):
    """What the test before notices. A cable that is dropped when taut made one in ten of the expert's episodes fail that do not fail in MuJoCo."""
    monkeypatch.setattr(closed_form, "_LEASH_STEP", 1e-6)
    down = np.tile(np.array([0, 0, -0.02, 0, 0, 0, 1], np.float32), 2)

    def episode(state):
        return jax.lax.scan(lambda state, command: (IN_CLOSED_FORM.step(state, command)[0], None), state, repeated(down, 60))[0]

    assert not np.asarray(jax.jit(episode)(lifted()).scene.held).any()


# --- heads


def test_a_hanging_head_hangs():
    state, _ = reset(IN_CLOSED_FORM, jax.random.key(0))
    _, scenes = roll(IN_CLOSED_FORM, state, repeated(np.zeros(14), 20))
    np.testing.assert_allclose(scenes.head_positions[-1], geometry.HANGING_GRIPS, atol=1e-5)
    np.testing.assert_allclose(scenes.head_rotations[-1], np.stack([geometry.HANGING] * 2), atol=1e-5)


def test_a_released_head_swings_on_a_cable_that_does_not_stretch_and_comes_to_rest():
    release = np.tile(np.array([0, 0, 0, 0, 0, 0, -1], np.float32), 2)
    _, scenes = roll(IN_CLOSED_FORM, lifted(), repeated(release, 160))
    assert not scenes.held[5:].any()
    run = np.asarray(scenes.head_positions) - geometry.ANCHORS
    assert np.linalg.norm(run, axis=-1)[5:].max() <= geometry.CABLE_LENGTH + geometry.GRIP + 1e-4
    np.testing.assert_allclose(scenes.head_positions[-1], geometry.HANGING_GRIPS, atol=0.02)
    np.testing.assert_allclose(scenes.head_rotations[-1, :, :, 2], [[0, 0, -1]] * 2, atol=0.1)


@pytest.mark.parametrize(
    ("offset", "taken"),
    [
        ((0.0, 0.0, 0.0), True),
        ((0.007, 0.0, 0.0), True),
        ((0.02, 0.0, 0.0), False),  # before the pads
        ((0.0, 0.02, 0.0), True),  # between open fingers, which centre it
        ((0.0, 0.035, 0.0), False),  # beside a finger
        ((0.0, 0.0, 0.015), False),  # beyond the fingertips
    ],
)
def test_what_closing_fingers_take(offset, taken):
    """Offsets of the hand from the grip in the hand's axes, in m; y is that of the fingers, z that of the approach."""
    state, _ = reset(IN_CLOSED_FORM, jax.random.key(0))
    hands = geometry.HANGING_GRIPS - GRASP @ np.array(offset)
    between, position, rotation = jax.jit(closed_form._grasp)(
        jnp.asarray(GRASP.T @ (geometry.HANGING_GRIPS[0] - hands[0]), jnp.float32), jnp.asarray(GRASP.T @ geometry.HANGING, jnp.float32)
    )
    assert bool(between) == taken
    assert position[1] == 0.0
    assert abs(float(rotation[1, 2])) < 1e-6
    assert not state.scene.held.any()


@functools.cache
def closed_fingers():
    command = np.tile(np.array([0, 0, 0, 0, 0, 0, 1], np.float32), 2)
    state, _ = reset(IN_CLOSED_FORM, jax.random.key(0))
    return roll(IN_CLOSED_FORM, state, repeated(command, 20))[1]


def test_fingers_that_close_on_nothing_close():
    assert closed_fingers().fingers[-1].max() < 0.001
    assert not closed_fingers().held.any()


def test_fingers_close_as_fast_as_in_mujoco():
    state, _ = reset(IN_C, jax.random.key(0))
    _, scenes = roll(IN_C, state, repeated(SHUT, 20))
    np.testing.assert_allclose(closed_fingers().fingers, scenes.fingers, atol=3e-4)


# --- against MuJoCo, from the same states with the same commands

MOST = {"free": (0.02, 1.0), "grasped": (0.05, 20.0), "lifted": (0.2, 4.0), "inserting": (0.2, 4.0)}
"""mm, of the hands after 1 and 20 control steps. A cable that hangs straight holds its head up for some steps before it buckles, in MuJoCo: 13 mm."""


@pytest.mark.parametrize("situation", MOST)
def test_hands_stay_near_those_of_mujoco(situation):
    starts, commands = on_the_way()
    many = jax.jit(jax.vmap(lambda env_state, commands: jax.lax.scan(_scene_step(IN_C), env_state, commands)[1]))
    closed = jax.jit(jax.vmap(lambda env_state, commands: jax.lax.scan(_scene_step(IN_CLOSED_FORM), env_state, commands)[1]))
    in_c = many(starts[situation], commands[situation])
    in_closed = closed(jax.vmap(in_closed_form)(starts[situation]), commands[situation])
    away = 1000 * np.linalg.norm(np.asarray(in_c.hand_positions) - np.asarray(in_closed.hand_positions), axis=-1).max(axis=(0, 2))
    assert away[0] < MOST[situation][0]
    assert away.max() < MOST[situation][1]
    np.testing.assert_array_equal(in_c.held, in_closed.held)


def _scene_step(env):
    def step(state, command):
        state, _ = env.step(state, command)
        return state, state.scene

    return step
