"""The arm against MuJoCo in C: the same chain, the same matrices, nearly the same motion; and the model file against robosuite's arm."""

import contextlib
import importlib.util
import io
import time

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from hindrl_jax.base.environments import compiler_options
from hindrl_jax.envs.reach import ParameterizedReach, panda

LIMITS = np.array(3 * [panda.MAX_TRANSLATION] + 3 * [panda.MAX_ROTATION])
START = np.float32(panda.INITIAL_JOINTS) + np.float32(np.random.default_rng(1).normal(0, 0.02, 7))  # rad


def random_joints(num):
    """(num, 7) anywhere within the joints' ranges."""
    c = panda.chain()
    return np.random.default_rng(0).uniform(c.lower, c.upper, (num, 7)).astype(np.float32)


def mujoco_at(joints, velocities=0.0, model=None):
    """MuJoCo's data, computed in C."""
    model = model or panda.model()
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = joints, velocities
    mujoco.mj_forward(model, data)
    return data


def mass_matrix(model, data):
    matrix = np.zeros((7, 7))
    mujoco.mj_fullM(model, matrix, data.qM)
    return matrix


def jacobian(model, data):
    matrix = np.zeros((6, 7))
    mujoco.mj_jacSite(model, data, matrix[:3], matrix[3:], model.site("grip_site").id)
    return matrix


# --- the chain


@jax.jit
@jax.vmap
def chain_at(joints):
    posture = panda.posture(joints)
    return posture, panda.jacobian(posture), panda.mass_matrix(posture)


def test_posture_jacobian_and_mass_matrix_are_those_of_mujoco():
    model, joints = panda.model(), random_joints(30)
    links = [model.joint(f"joint{i + 1}").bodyid[0] for i in range(7)]
    postures, jacobians, matrices = jax.device_get(chain_at(joints))
    for i, q in enumerate(joints):
        data = mujoco_at(q)
        for found, expected in (
            (postures.origins[i], data.xpos[links]),
            (postures.axes[i], data.xaxis),
            (postures.rotations[i], data.xmat[links].reshape(7, 3, 3)),
            (postures.hand_position[i], data.site("grip_site").xpos),
            (postures.hand_rotation[i], data.body("hand").xmat.reshape(3, 3)),
            (jacobians[i], jacobian(model, data)),
            (matrices[i], mass_matrix(model, data)),
        ):
            np.testing.assert_allclose(found, expected, atol=1e-5)


def test_drag_is_that_of_mujoco():
    model = mujoco.MjModel.from_xml_path(str(panda.MODEL_PATH))
    model.opt.viscosity = 0.0  # which the closed form leaves out
    joints, velocities = random_joints(20), np.random.default_rng(1).normal(size=(20, 7)).astype(np.float32)
    drag = jax.jit(jax.vmap(lambda q, v: panda.drag_torques(v, panda.posture(q))))
    expected = np.stack([mujoco_at(q, v, model).qfrc_fluid for q, v in zip(joints, velocities, strict=True)])
    found = np.asarray(drag(joints, velocities))
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4)
    # It brakes, it grows with the square of the speed, and there is none at rest.
    assert (np.sum(found * velocities, axis=1) < 0).all()
    np.testing.assert_allclose(drag(joints, -3 * velocities), -9 * found, rtol=1e-4, atol=1e-4)
    assert not np.any(drag(joints, 0 * velocities))


def test_the_viscosity_that_is_left_out_is_below_a_hundredth_of_the_drag():
    joints, velocities = random_joints(1)[0], np.full(7, 0.1)
    model = mujoco.MjModel.from_xml_path(str(panda.MODEL_PATH))
    with_both = mujoco_at(joints, velocities, model).qfrc_fluid.copy()
    model.opt.density = 0.0
    assert np.linalg.norm(mujoco_at(joints, velocities, model).qfrc_fluid) < 1e-2 * np.linalg.norm(with_both)


@pytest.mark.parametrize("size", [1, 6, 7])
def test_inverse(size):
    factors = np.random.default_rng(size).normal(size=(20, size, size))
    matrices = np.float32(factors @ factors.transpose(0, 2, 1) + 0.1 * np.eye(size))
    found = jax.jit(jax.vmap(panda.inverse))(matrices)
    expected = np.linalg.inv(matrices.astype(float))
    assert np.abs(found - expected).max() < 1e-4 * np.abs(expected).max()


# --- inverse kinematics


def shortened(vector, limit):
    return vector * min(1.0, limit / max(np.linalg.norm(vector), 1e-12))


def joint_targets(model, data, rest, command):
    """A twin of `panda.joint_targets` as robosuite has it, with a pseudo-inverse."""
    q, j = data.qpos, jacobian(model, data)
    twist = 0.95 * np.concatenate([shortened(command[:3], 0.02), shortened(command[3:], 0.05)]) / 0.1
    pull = np.array([10, 10, 10, 10, 5, 5, 5]) * (rest - q)
    speeds = j.T @ np.linalg.inv(j @ j.T + 0.05**2 * np.eye(6)) @ twist + (np.eye(7) - np.linalg.pinv(j) @ j) @ pull
    fastest = np.abs(speeds).max()
    return q + 0.1 * (speeds / fastest if fastest > 1.0 else speeds)


def test_joint_targets_are_those_of_a_plain_loop():
    rng, num = np.random.default_rng(2), 60
    joints = START + rng.normal(0, 0.3, (num, 7)).astype(np.float32)
    rest = joints + np.where(np.arange(num) < 30, 0.05, 1.0)[:, None] * rng.normal(size=(num, 7))
    commands = rng.uniform(-2, 2, (num, 6)) * LIMITS * np.where(np.arange(num) % 2 == 0, 1.0, 0.2)[:, None]  # too long, and short ones
    found = jax.jit(jax.vmap(lambda q, r, x: panda.joint_targets(q, r, x, panda.posture(q))))(joints, jnp.float32(rest), jnp.float32(commands))
    expected = np.stack([joint_targets(panda.model(), mujoco_at(q), r, x) for q, r, x in zip(joints, rest, commands, strict=True)])
    nearly_singular = np.array([np.linalg.svd(jacobian(panda.model(), mujoco_at(q)))[1][-1] < 0.05 for q in joints])
    np.testing.assert_allclose(found[~nearly_singular], expected[~nearly_singular], atol=1e-5)
    np.testing.assert_allclose(found, expected, atol=1e-3)
    assert (~nearly_singular).sum() > 40
    capped = np.isclose(np.abs(expected - joints).max(axis=1), 0.1)
    assert 10 < capped.sum() < 50  # some joint is at its 1 rad/s, or not


@pytest.mark.parametrize(
    ("vector", "expected"), [([3.0, 4.0], [0.6, 0.8]), ([0.3, 0.4], [0.3, 0.4]), ([-0.6, 0.8], [-0.6, 0.8]), ([0.0, 0.0], [0.0, 0.0])]
)
def test_shortened_by_hand(vector, expected):
    np.testing.assert_allclose(panda.shortened(jnp.array(vector), 1.0), expected, rtol=1e-6)


# --- the motion


def mujoco_motion(start, commands):
    """Joints (T, 7) after each command, by C MuJoCo with the exact torque in every substep."""
    model, data, joints = panda.model(), mujoco.MjData(panda.model()), []
    data.qpos[:] = start
    for command in commands:
        for substep in range(25):
            mujoco.mj_step1(model, data)
            if substep == 0:
                goal = joint_targets(model, data, start, command)
            data.ctrl[:] = mass_matrix(model, data) @ (100.0 * (goal - data.qpos) - 20.0 * data.qvel) + data.qfrc_bias
            mujoco.mj_step2(model, data)
        joints.append(data.qpos.copy())
    return np.array(joints)


NUM_STEPS = 60


def commands_of(name):
    """(60, 6) commands in m and rad."""
    rng, axes = np.random.default_rng(0), {"x": 0, "y": 1, "z": 2, "roll": 3, "pitch": 4, "yaw": 5}
    if name == "random":
        return rng.uniform(-LIMITS, LIMITS, (NUM_STEPS, 6))
    if name == "creeping":
        return 0.02 * commands_of("+x")
    if name == "wandering":
        walk = np.cumsum(rng.normal(size=(NUM_STEPS, 6)), axis=0)
        return walk / np.abs(walk).max(axis=0) * LIMITS
    direction = np.zeros(6) if name == "zero" else {"+": 1.0, "-": -1.0}[name[0]] * np.eye(6)[axes[name[1:]]]
    return np.tile(direction * LIMITS, (NUM_STEPS, 1))


# About twice what was measured: joints in mrad, hand in mm.
MOTIONS = {
    "zero": (0.001, 0.001),
    "creeping": (0.3, 0.1),  # a torque that dry friction can nearly hold
    "+x": (0.15, 0.03),
    "+y": (0.06, 0.03),
    "-y": (0.05, 0.03),
    "+z": (0.15, 0.07),
    "-z": (0.1, 0.03),
    "+roll": (0.2, 0.03),
    "-roll": (0.2, 0.05),
    "+pitch": (1.0, 0.5),
    "+yaw": (1.5, 0.2),
    "-yaw": (1.6, 0.2),
    "random": (0.9, 0.15),
    "wandering": (0.5, 0.08),
    # What the closed form leaves out, and the expert never meets: the limit of joint 4 is soft in MuJoCo, and torques are cut to 80 N m.
    "-x": (150.0, 90.0),
    "-pitch": (50.0, 40.0),
}
NUM_ENVS = 64


@pytest.fixture(scope="module")
def in_closed_form():
    """(64, 7) joints at the start, and (64, 60, 6) commands -> (64, 60, 7) joints and velocities."""

    @jax.jit
    @jax.vmap
    def run(start, commands):
        def step(carry, command):
            carry = panda.control_step(*carry, start, command)
            return carry, carry

        return jax.lax.scan(step, (start, jnp.zeros(7)), commands)[1]

    return run


@pytest.fixture(scope="module")
def motions(in_closed_form):
    """Joints (60, 7) of each of MOTIONS, by the closed form."""
    commands = np.stack([commands_of(name) for name in MOTIONS])
    commands = np.concatenate([commands, np.zeros((NUM_ENVS - len(commands), *commands.shape[1:]))])
    joints, _ = in_closed_form(jnp.asarray(np.tile(START, (NUM_ENVS, 1))), jnp.asarray(commands, jnp.float32))
    return dict(zip(MOTIONS, np.asarray(joints), strict=False))


hands = jax.jit(jax.vmap(lambda joints: panda.posture(joints).hand_position))


@pytest.mark.parametrize("name", MOTIONS)
def test_closed_form_moves_as_mujoco_does(motions, name):
    milliradians, millimetres = MOTIONS[name]
    expected = mujoco_motion(START.astype(float), commands_of(name))
    assert np.abs(motions[name] - expected).max() * 1e3 < milliradians
    distances = np.linalg.norm(hands(motions[name]) - hands(jnp.asarray(expected, jnp.float32)), axis=1)
    assert distances.max() * 1e3 < millimetres
    assert (np.ptp(expected, axis=0).max() > 0.005) == (name != "zero")


def test_joint_limits_are_never_exceeded(in_closed_form):
    """200 control steps of the longest commands, towards every corner of what can be commanded."""
    signs = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 6, indexing="ij"), axis=-1).reshape(NUM_ENVS, 1, 6)
    commands = jnp.asarray(np.tile(signs * LIMITS, (1, NUM_STEPS, 1)), jnp.float32)
    c, joints = panda.chain(), jnp.asarray(np.tile(START, (NUM_ENVS, 1)))
    reached = np.zeros((2, 7), bool)
    for _ in range(4):  # each time from rest, with the null space pulling towards where it begins
        path, velocities = jax.device_get(in_closed_form(joints, commands))
        assert np.isfinite(velocities).all()
        assert (path >= c.lower - 1e-6).all()
        assert (path <= c.upper + 1e-6).all()
        reached |= np.stack([(path <= c.lower + 1e-6).any(axis=(0, 1)), (path >= c.upper - 1e-6).any(axis=(0, 1))])
        joints = path[:, -1]
    assert reached.any(axis=0).sum() >= 4  # most joints have been at one of their limits


# --- friction


@jax.jit
def tracked(offsets):
    """Joints and velocities after one control step of `track` from rest, with the goals at these offsets from the joints."""
    c, joints = panda.chain(), jnp.asarray(START)
    mobility = jnp.diag(1.0 / jnp.asarray(c.armature))  # as if no joint moved another
    moved, velocities = panda.track(joints, jnp.zeros(7), joints + offsets, mobility, jnp.zeros(7), jnp.zeros(7))
    return moved - joints, velocities


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_dry_friction_holds_a_joint_until_the_torque_exceeds_it(sign):
    c = panda.chain()
    # The torque at the beginning is armature * 100 offset; at the offset below it equals the friction loss of 0.1 N m.
    balanced = sign * c.friction / (panda.STIFFNESS * c.armature)
    free = np.array([1.0 - (1 + 10 * 0.05) * np.exp(-10 * 0.05)])  # of the way, after 50 ms of a critically damped joint without friction
    held, _ = tracked(jnp.asarray(0.5 * balanced, jnp.float32))
    assert (np.abs(held) < 0.06 * np.abs(0.5 * balanced) * free).all()  # it gives a little, as MuJoCo's does
    pushed, velocities = tracked(jnp.asarray(20 * balanced, jnp.float32))
    ratio = pushed / (20 * balanced * free)
    assert (ratio > 0.8).all()
    assert (ratio < 1.0).all()  # friction and damping take some of it
    assert (np.sign(velocities) == sign).all()


# --- MJX


class Mjx:
    """16 arms on MJX for 10 control steps, compiled as the project does it."""

    num_envs, num_steps = 16, 10

    def __init__(self):
        env, rng = ParameterizedReach(backend="mjx", joint_noise=0.1), np.random.default_rng(3)
        directions = np.concatenate([np.zeros((1, 6)), np.eye(6), -np.eye(6)])
        commands = rng.uniform(-1, 1, (self.num_steps, self.num_envs, 6))
        commands[:, : len(directions)] = directions
        self.commands = np.float32(commands * LIMITS)
        reset = jax.jit(jax.vmap(env.reset))
        self.start, _ = reset(jax.random.split(jax.random.key(0), self.num_envs))

        def run(state, commands):
            def step(state, command):
                state, _ = jax.vmap(env.step)(state, command)
                return state, state.joints

            return jax.lax.scan(step, state, commands)[1]

        self.printed = io.StringIO()
        # MJX itself broadcasts between ranks.
        with jax.numpy_rank_promotion("allow"), contextlib.redirect_stdout(self.printed), contextlib.redirect_stderr(self.printed):
            self.program = jax.jit(run).lower(self.start, self.commands).compile(compiler_options(env))

    def play(self):
        """(10, 16, 7) joints after each step."""
        return jax.block_until_ready(self.program(self.start, self.commands))


@pytest.fixture(scope="module")
def mjx():
    return Mjx()


def test_mjx_moves_as_mujoco_does(mjx):
    joints = np.asarray(mjx.play())
    for env in range(mjx.num_envs):
        expected = mujoco_motion(np.asarray(mjx.start.joints[env], float), mjx.commands[:, env])
        np.testing.assert_allclose(joints[:, env], expected, atol=1e-4)


def test_mjx_says_nothing(mjx):
    assert mjx.printed.getvalue() == ""


# --- speed: far below what an idle laptop does, and far above what a change in how XLA fuses the loops leaves


def fastest(call):
    """Seconds of the fastest of six calls, or of fewer if they take longer than ten seconds together."""
    seconds = []
    while len(seconds) < 6 and sum(seconds) < 10.0:
        begin = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - begin)
    return min(seconds)


def test_the_closed_form_is_fast_enough_for_bulk_training(in_closed_form):
    start, commands = jnp.asarray(np.tile(START, (NUM_ENVS, 1))), jnp.zeros((NUM_ENVS, NUM_STEPS, 6)) + 0.01
    seconds = fastest(lambda: jax.block_until_ready(in_closed_form(start, commands)))
    assert NUM_ENVS * NUM_STEPS / seconds > 5_000


def test_mjx_is_not_compiled_into_the_trap(mjx):
    """With XLA's default fusion on a CPU it takes a second for every control step."""
    assert mjx.num_envs * mjx.num_steps / fastest(mjx.play) > 100


# --- the model file


@pytest.fixture(scope="module")
def theirs():
    """robosuite's compiled model of its whole scene, and data at the initial configuration with closed fingers."""
    if importlib.util.find_spec("robosuite") is None:  # importorskip would import it, with all its side effects
        pytest.skip("robosuite is not installed")
    from hindrl_jax.experts.robosuite_arm import shared_arm

    arm = shared_arm(2)
    arm.reset(np.array(panda.INITIAL_JOINTS))
    return arm.environment.sim.model._model, arm.environment.sim.data._data


BODIES = {f"link{i}": f"robot0_link{i}" for i in range(8)} | {
    "hand": "robot0_right_hand",
    "gripper": "gripper0_right_right_gripper",
    "left_finger": "gripper0_right_leftfinger",
    "right_finger": "gripper0_right_rightfinger",
    "left_tip": "gripper0_right_finger_joint1_tip",
    "right_tip": "gripper0_right_finger_joint2_tip",
}


def test_bodies_are_those_of_robosuite(theirs):
    model, data = theirs
    ours, mine = panda.model(), mujoco_at(panda.INITIAL_JOINTS)
    base = data.body("robot0_link0")
    axes = base.xmat.reshape(3, 3)
    assert {ours.body(i).name for i in range(1, ours.nbody)} == set(BODIES)
    for name, their_name in BODIES.items():
        a, b = ours.body(name), model.body(their_name)
        # Where the body is and how it lies, in the axes of the base.
        np.testing.assert_allclose(mine.body(name).xpos, axes.T @ (data.body(their_name).xpos - base.xpos), atol=1e-5, err_msg=name)
        np.testing.assert_allclose(mine.body(name).xmat.reshape(3, 3), axes.T @ data.body(their_name).xmat.reshape(3, 3), atol=1e-5, err_msg=name)
        np.testing.assert_allclose(a.mass, b.mass, rtol=1e-6, err_msg=name)
        np.testing.assert_allclose(mine.body(name).xipos, axes.T @ (data.body(their_name).xipos - base.xpos), atol=1e-5, err_msg=name)
        # The moments of inertia about the base's axes: equal moments may stand in another order.
        mine_axes, their_axes = mine.body(name).ximat.reshape(3, 3), axes.T @ data.body(their_name).ximat.reshape(3, 3)
        np.testing.assert_allclose(
            mine_axes @ np.diag(a.inertia) @ mine_axes.T, their_axes @ np.diag(b.inertia) @ their_axes.T, atol=1e-6, err_msg=name
        )
    assert model.body("robot0_link0").subtreemass[0] == pytest.approx(ours.body_mass.sum())  # nothing is missing
    site = data.site("gripper0_right_grip_site")
    np.testing.assert_allclose(mine.site("grip_site").xpos, axes.T @ (site.xpos - base.xpos), atol=1e-5)


def test_joints_are_those_of_robosuite(theirs):
    model, _ = theirs
    ours = panda.model()
    assert ours.nv == 7
    for i in range(7):
        a, b = ours.joint(f"joint{i + 1}"), model.joint(f"robot0_joint{i + 1}")
        np.testing.assert_allclose(a.range, b.range, atol=1e-6)
        np.testing.assert_allclose(a.axis, b.axis, atol=1e-6)
        for name in ("armature", "damping", "frictionloss", "stiffness"):
            np.testing.assert_allclose(getattr(ours, f"dof_{name}" if name != "stiffness" else "jnt_stiffness")[i], getattr(b, name), rtol=1e-6)
        for name in ("dof_solref", "dof_solimp", "jnt_solref", "jnt_solimp"):
            address = b.id if name.startswith("jnt") else b.dofadr[0]
            np.testing.assert_allclose(getattr(ours, name)[i], getattr(model, name)[address], rtol=1e-6)
        motor = [k for k in range(model.nu) if model.actuator_trnid[k, 0] == b.id]
        assert len(motor) == 1
        np.testing.assert_allclose(ours.actuator_ctrlrange[i], model.actuator_ctrlrange[motor[0]], rtol=1e-6)
    for name in ("timestep", "density", "viscosity", "integrator"):
        assert getattr(ours.opt, name) == getattr(model.opt, name)
