"""The MuJoCo model of the cable tasks, and its two back ends: C, and MJX against C."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from cable_states import IN_C, SHUT, on_the_way, repeated, reset, roll

from benchmarks.cable_parity import situations
from hindrl_jax.base.environments import compiler_options
from hindrl_jax.envs.cable import BringNear, CableInsertion, chains, geometry, model, mujoco_dynamics
from hindrl_jax.experts.cable import CableExpert
from hindrl_jax.training.playing import play


def mujoco_data(state, num_links=5):
    data = mujoco.MjData(model.model(num_links))
    data.qpos[:] = state.physics.positions
    mujoco.mj_forward(model.model(num_links), data)
    return data


# --- the model


@pytest.mark.parametrize("num_links", [2, 5, 10])
def test_the_model_has_as_many_links_as_wanted_and_the_same_mass_and_length(num_links):
    m = model.model(num_links)
    assert m.nq == m.nv == 24 + 4 * num_links
    assert (m.nu, m.npair, m.nmesh) == (18, 31, 0)
    data = mujoco.MjData(m)
    mujoco.mj_kinematics(m, data)
    for index, name in enumerate(model.HEADS):
        np.testing.assert_allclose(data.site(f"{name}_grip").xpos, geometry.HANGING_GRIPS[index], atol=1e-6)
        pieces = [m.body(f"{name}_piece{i}").mass[0] for i in range(num_links)]
        assert sum(pieces) == pytest.approx(0.0392)
    np.testing.assert_allclose(data.site("plug_tip").xpos[2], 1.3368 + 0.02 - 0.094, atol=1e-6)


def test_its_bore_is_wider_than_the_pin_by_the_clearance_and_as_deep_as_said():
    m = model.model(5)
    for k in range(8):
        wall = m.geom(f"wall{k}")
        nearest = np.hypot(*wall.pos[:2]) - wall.size[0]
        assert nearest == pytest.approx(m.geom("pin").size[0] + geometry.CLEARANCE, abs=1e-7)
    assert m.geom("bottom").pos[2] + m.geom("bottom").size[2] == pytest.approx(geometry.TIPS[1] - geometry.DEPTH)
    assert m.site("socket_bottom").pos[2] == pytest.approx(geometry.SOCKET_BOTTOM)


def test_it_has_the_options_without_which_grips_burst():
    m = model.model(5)
    assert (m.opt.timestep, m.opt.impratio, m.opt.iterations, m.opt.ls_iterations) == (0.005, 10, 20, 50)
    assert m.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
    assert m.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    stiff = (m.pair_solimp[:, :3] == [0.99, 0.999, 0.001]).all(axis=1)
    assert stiff.sum() == 4 + 16 + 1  # pads on grips, pin in the bore and on its slants, pin on the bottom


@pytest.mark.parametrize("num_links", [2, 5])
def test_where_everything_is_agrees_with_mujoco(num_links):
    m, data, rng = model.model(num_links), mujoco.MjData(model.model(num_links)), np.random.default_rng(0)
    for _ in range(5):
        positions = rng.uniform(-0.5, 0.5, m.nq).astype(np.float32)
        scene = jax.jit(chains.scene)(chains.Joints(positions=jnp.asarray(positions), velocities=jnp.zeros(m.nv), accelerations=jnp.zeros(m.nv)))
        data.qpos[:] = positions
        mujoco.mj_kinematics(m, data)
        for index, name in enumerate(model.HEADS):
            np.testing.assert_allclose(scene.hand_positions[index], data.site(f"{name}_grip_site").xpos, atol=2e-6)
            np.testing.assert_allclose(scene.hand_rotations[index], data.body(f"{name}_hand").xmat.reshape(3, 3), atol=2e-6)
            np.testing.assert_allclose(scene.head_positions[index], data.site(f"{name}_grip").xpos, atol=2e-6)
            np.testing.assert_allclose(scene.head_rotations[index], data.body(f"{name}_head").xmat.reshape(3, 3), atol=2e-6)
            fingers = data.joint(f"{name}_left_slide").qpos[0], data.joint(f"{name}_right_slide").qpos[0]
            np.testing.assert_allclose(scene.fingers[index], (fingers[0] - fingers[1]) / 2, atol=1e-6)


@functools.cache
def episode():
    """States of one of the expert's episodes in C, leaves (T, ...)."""

    def step(carry, _):
        state, key = carry
        key, key_act = jax.random.split(key)
        state, _ = IN_C.step(state, CableExpert().act(key_act, IN_C, state))
        return (state, key), state.replace(key=None)

    start, _ = reset(IN_C, jax.random.key(1))
    return jax.jit(lambda state: jax.lax.scan(step, (state, jax.random.key(2)), length=460)[1])(start)


def touches(data, name):
    """Whether both pads of an arm touch its head's grip."""
    m = data.model
    grip, pads = m.geom(f"{name}_grip").id, {m.geom(f"{name}_{side}_pad").id for side in ("left", "right")}
    return pads <= {geom for contact in data.contact for geom in contact.geom if grip in contact.geom}


def test_a_head_is_held_where_both_pads_touch_its_grip():
    """As geometry alone says, which JAX knows without MuJoCo's contacts."""
    states = episode()
    found, expected = [], []
    for t in range(0, 460, 5):
        data = mujoco_data(jax.tree.map(lambda leaf, t=t: leaf[t], states))
        expected.append([touches(data, name) for name in model.HEADS])
        found.append(np.asarray(states.scene.held[t]).tolist())
    differ = np.array(found) != np.array(expected)
    assert differ.sum() <= 2  # within a step of the first touch
    assert np.array(expected).any(axis=0).all()
    assert not np.array(expected).all(axis=0).any()


# --- C, many side by side


def test_a_step_is_a_pure_function_of_many_episodes_and_of_one():
    states = jax.tree.map(lambda leaf: leaf[100:106:2], episode())
    states = states.replace(key=jax.random.split(jax.random.key(0), 3))
    actions = jnp.asarray(np.random.default_rng(0).uniform(IN_C.action_low, IN_C.action_high, (3, 14)).astype(np.float32))
    many, _ = jax.jit(jax.vmap(IN_C.step))(states, actions)
    again, _ = jax.jit(jax.vmap(IN_C.step))(states, actions)
    np.testing.assert_array_equal(many.physics.positions, again.physics.positions)
    nested, _ = jax.jit(jax.vmap(jax.vmap(IN_C.step)))(*jax.tree.map(lambda leaf: leaf[None], (states, actions)))
    np.testing.assert_array_equal(many.physics.positions, nested.physics.positions[0])
    one, _ = jax.jit(IN_C.step)(jax.tree.map(lambda leaf: leaf[1], states), actions[1])
    np.testing.assert_allclose(one.physics.positions, many.physics.positions[1], atol=1e-6)


def test_a_step_is_ten_of_mujoco_s_own():
    state = jax.tree.map(lambda leaf: leaf[150], episode()).replace(key=jax.random.key(0))
    m, data = model.model(5), mujoco.MjData(model.model(5))
    data.qpos[:], data.qvel[:] = state.physics.positions, state.physics.velocities
    data.qacc_warmstart[:] = state.physics.accelerations
    data.ctrl[:] = jax.jit(chains.controls)(state.physics, state.rest, state.finger_targets, jnp.zeros((2, 6)))
    mujoco.mj_step(m, data, 10)
    after = jax.jit(mujoco_dynamics.control_step)(state.physics, state.rest, state.finger_targets, jnp.zeros((2, 6)))
    np.testing.assert_allclose(after.positions, data.qpos, atol=1e-5)


def test_a_large_batch_comes_back():
    """A callback that waits for the threads which wait for it would hang."""
    states, _ = jax.jit(jax.vmap(IN_C.reset))(jax.random.split(jax.random.key(0), 512))
    states, _ = jax.jit(jax.vmap(IN_C.step))(states, jnp.zeros((512, 14)))
    assert np.isfinite(states.physics.positions).all()


def test_any_number_of_links_can_be_stepped():
    env = BringNear(backend="mujoco", num_links=3)
    state, _ = reset(env, jax.random.key(0))
    state, scenes = roll(env, state, repeated(SHUT, 5))
    assert state.physics.positions.shape == (36,)
    np.testing.assert_allclose(scenes.head_positions[-1], geometry.HANGING_GRIPS, atol=1e-3)


def test_nothing_slips_out_of_a_firm_grip_under_a_shaky_hand():
    """The most that a head moves in its hand from being taken on, in mm: a burst throws it out at once."""
    states = episode()
    held = np.asarray(states.scene.held).all(axis=1)
    solved = np.asarray(jax.vmap(IN_C.is_solved)(states.scene))
    while_held = slice(np.flatnonzero(held)[0] + 10, np.flatnonzero(solved)[0])  # who presses on then, slides along the plug
    assert held[while_held].all()
    offset = np.asarray(states.scene.head_positions - states.scene.hand_positions)[while_held]
    in_hand = np.einsum("taji,taj->tai", np.asarray(states.scene.hand_rotations)[while_held], offset)
    assert 1000 * np.linalg.norm(in_hand - in_hand[0], axis=-1).max() < 2.0


# --- minutes each


def solved_in_c(task, num_episodes, expert=None):
    env, expert = task(backend="mujoco"), expert or CableExpert()
    played = jax.jit(lambda key: play(key, env, lambda key, state, _: expert.act(key, env, state), num_episodes))(jax.random.key(5))
    return np.asarray(played.terminated), np.asarray(played.lengths)


@pytest.mark.slow
@pytest.mark.parametrize("task", [BringNear, CableInsertion])
def test_the_shaky_expert_solves_nearly_every_episode(task):
    solved, lengths = solved_in_c(task, 40)
    assert solved.mean() >= 0.95
    assert np.percentile(lengths, 95) < 480


@pytest.mark.slow
def test_a_shaky_expert_notices_a_model_in_which_grips_burst(monkeypatch):
    """Elliptic cones and a short line search: a steady expert solves all episodes with them, too."""
    bad = mujoco.MjModel.from_xml_string(model.xml(5))
    bad.opt.cone, bad.opt.ls_iterations = mujoco.mjtCone.mjCONE_ELLIPTIC, 10
    _, pool, data = mujoco_dynamics._pool(5)
    monkeypatch.setattr(mujoco_dynamics, "_pool", lambda num_links: (bad, pool, data))
    solved, _ = solved_in_c(BringNear, 20, CableExpert(translation_noise=0.02, rotation_noise=0.03))
    assert solved.mean() < 0.9


@pytest.mark.slow
def test_mjx_stays_with_c_from_every_situation():
    """Tips and hands within 1 mm after 20 control steps with the same commands. Where a shaky hand presses the plug against the bore's walls, MJX,
    which works in float32, throws it out of the grip: a steady one inserts it here."""
    env = CableInsertion(backend="mjx")
    starts, commands = map(dict, on_the_way())
    steady = situations(jax.random.key(0), 2, CableExpert(insertion_noise=0.0))
    starts["inserting"], commands["inserting"] = (found["inserting"] for found in steady)

    def scenes(env):
        def episode(state, commands):
            def step(state, command):
                state, _ = env.step(state, command)
                return state, state.scene

            return jax.lax.scan(step, state, commands)[1]

        return jax.jit(jax.vmap(episode), compiler_options=compiler_options(env))

    in_mjx, in_c = scenes(env), scenes(IN_C)
    for situation in starts:
        first, second = (run(starts[situation], commands[situation]) for run in (in_mjx, in_c))
        for name in ("hand_positions", "head_positions"):
            assert 1000 * np.abs(np.asarray(getattr(first, name)) - np.asarray(getattr(second, name))).max() < 1.0, (situation, name)
        np.testing.assert_array_equal(first.held, second.held)
