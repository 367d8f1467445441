"""The Panda arm: its chain of links, inverse kinematics and joint tracking, in closed form for bulk simulation.

Everything is unbatched and pure, in metres, radians, seconds, kilograms, with the robot's base as origin. One control step of 50 ms restates
robosuite 1.5.1's IK_POSE controller at 20 Hz on MuJoCo's dynamics at 2 ms:

1. `joint_targets`. Damped least squares turn the commanded displacement into joint velocities, plus a pull towards the joints at reset in the null
   space; speeds are capped and held for 0.1 s: q_goal = q + 0.1 dq.
2. `track`. 25 times, torques M(q) (100 (q_goal - q) - 20 v) + bias drive the joints against friction and damping.

Differences from MuJoCo in `track`: the mass matrix is that at the beginning of the control step, dry friction comes from one iteration per substep,
air drag keeps the direction that it has halfway through, torque limits and viscosity are left out, joint limits are hard, and the closed fingers
are part of the hand. Over a hundred control steps the hand stays within 0.7 mm and 6 mrad of robosuite's, on average within 0.13 mm and 1.2 mrad,
as long as no joint meets its limit (`python -m benchmarks.run --only reach_parity`). At a limit, MuJoCo's soft stop and ours can part by centimetres.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hindrl_jax.base.errors import UserError, one_line
from hindrl_jax.base.types import Array

MODEL_PATH = Path(__file__).with_name("panda.xml")
NUM_JOINTS = 7
INITIAL_JOINTS = (0.0, np.pi / 16, 0.0, -5 * np.pi / 6, 0.0, np.pi - 0.2, np.pi / 4)
"""(7,) rad, robosuite's initial configuration."""
MAX_TRANSLATION = 0.02  # m, per control step; longer commands are shortened
MAX_ROTATION = 0.05  # rad, likewise
CONTROL_PERIOD = 0.05  # s
SUBSTEPS = 25
_SUBSTEP = CONTROL_PERIOD / SUBSTEPS

_COMMAND_GAIN = 0.95  # share of the command that the inverse kinematics aims at within the integration time
_INTEGRATION_TIME = 0.1  # s
_DAMPING = 0.05  # of the least squares
_NULL_SPACE_GAINS = (10.0, 10.0, 10.0, 10.0, 5.0, 5.0, 5.0)  # 1/s
_MAX_JOINT_SPEED = 1.0  # rad/s
STIFFNESS, TRACKING_DAMPING = 100.0, 20.0  # 1/s^2, 1/s
_HALFWAY = np.linalg.matrix_power(
    [
        [1 - _SUBSTEP**2 * STIFFNESS, _SUBSTEP * (1 - _SUBSTEP * TRACKING_DAMPING)],
        [-_SUBSTEP * STIFFNESS, 1 - _SUBSTEP * TRACKING_DAMPING],
    ],
    SUBSTEPS // 2,
)[1]  # velocity after half of the substeps from [q - q_goal, v], without friction and drag


@dataclass(frozen=True, eq=False)
class Chain:
    """The numbers of panda.xml that the closed form needs. Frames of the links are those at their joints, rotating about z."""

    offsets: np.ndarray  # (7, 3) m, origin of each link in the one before
    rotations: np.ndarray  # (7, 3, 3) orientation of each link in the one before, at joint angle 0
    hand_offset: np.ndarray  # (3,) m, grip site in link 7
    hand_rotation: np.ndarray  # (3, 3) orientation of the hand in link 7
    masses: np.ndarray  # (7,) kg; what is fixed to a link belongs to it
    centres: np.ndarray  # (7, 3) m, centre of mass in the link
    inertias: np.ndarray  # (7, 3, 3) kg m^2, about the centre of mass, in the link's axes
    drag_links: np.ndarray  # (K,) which link each of K bodies is fixed to
    drag_centres: np.ndarray  # (K, 3) m, centres of mass of these bodies in their links
    drag_axes: np.ndarray  # (K, 3, 3) their principal axes of inertia in their links
    drag_boxes: np.ndarray  # (K, 3) m, sides of the boxes with their inertia
    armature: np.ndarray  # (7,) kg m^2
    damping: np.ndarray  # (7,) N m s/rad
    friction: np.ndarray  # (7,) N m, largest dry friction
    friction_regularisation: np.ndarray  # (7,) R of MuJoCo's friction constraint, rad/s^2 per N m
    friction_rate: float  # 1/s, b of its reference acceleration -b v
    air_density: float  # kg/m^3
    lower: np.ndarray  # (7,) rad
    upper: np.ndarray  # (7,) rad


def import_mujoco() -> Any:
    """MuJoCo's module, imported late, since it loads the OpenGL library that MUJOCO_GL names, which may be missing though nothing is drawn.

    Raises:
      UserError: if it does not load.
    """
    try:
        import mujoco
    except Exception as error:  # of many kinds, depending on the library
        raise UserError(f"MuJoCo does not load ({one_line(error)}): install mujoco, and what MUJOCO_GL names or MUJOCO_GL=disable") from error
    return mujoco


@functools.cache
def model() -> Any:
    """The compiled MuJoCo model of panda.xml."""
    mujoco = import_mujoco()
    return mujoco.MjModel.from_xml_path(str(MODEL_PATH))


@functools.cache
def chain() -> Chain:
    """Reads the chain off the MuJoCo model, merging what is fixed to link 7 into it."""
    mujoco = import_mujoco()
    m = model()
    data = mujoco.MjData(m)
    mujoco.mj_kinematics(m, data)
    links = [m.joint(f"joint{i + 1}").bodyid[0] for i in range(NUM_JOINTS)]
    position, rotation = data.xpos, data.xmat.reshape(-1, 3, 3)
    parents = [m.body_parentid[link] for link in links]

    def fixed_to(link: int) -> list[int]:
        members = [link]
        for body in range(link + 1, m.nbody):
            if m.body_parentid[body] in members and m.body_jntnum[body] == 0:
                members.append(body)
        return members

    masses, centres, inertias, boxes = [], [], [], []
    for index, link in enumerate(links):
        members = fixed_to(link)
        weights = m.body_mass[members]
        places = (data.xipos[members] - position[link]) @ rotation[link]
        centre = weights @ places / weights.sum()
        inertia = np.zeros((3, 3))
        for body, weight, place in zip(members, weights, places, strict=True):
            axes, offset = rotation[link].T @ data.ximat[body].reshape(3, 3), place - centre
            inertia += axes @ np.diag(m.body_inertia[body]) @ axes.T + weight * (offset @ offset * np.eye(3) - np.outer(offset, offset))
            boxes.append((index, place, axes, _box_sides(weight, m.body_inertia[body])))
        masses.append(weights.sum())
        centres.append(centre)
        inertias.append(inertia)
    drag_links, drag_centres, drag_axes, drag_boxes = map(np.array, zip(*boxes, strict=True))

    site, hand = m.site("grip_site").id, m.body("hand").id
    impedance, largest_impedance = m.dof_solimp[0, :2]
    return Chain(
        offsets=np.array([(position[link] - position[parent]) @ rotation[parent] for parent, link in zip(parents, links, strict=True)]),
        rotations=np.array([rotation[parent].T @ rotation[link] for parent, link in zip(parents, links, strict=True)]),
        hand_offset=(data.site_xpos[site] - position[links[-1]]) @ rotation[links[-1]],
        hand_rotation=rotation[links[-1]].T @ rotation[hand],
        masses=np.array(masses),
        centres=np.array(centres),
        inertias=np.array(inertias),
        drag_links=drag_links,
        drag_centres=drag_centres,
        drag_axes=drag_axes,
        drag_boxes=drag_boxes,
        armature=np.array(m.dof_armature),
        damping=np.array(m.dof_damping),
        friction=np.array(m.dof_frictionloss),
        friction_regularisation=(1 - impedance) / impedance * m.dof_invweight0,
        friction_rate=float(2 / (largest_impedance * m.dof_solref[0, 0])),
        air_density=float(m.opt.density),
        lower=np.array(m.jnt_range[:, 0]),
        upper=np.array(m.jnt_range[:, 1]),
    )


def longest_reach() -> float:
    """How far the hand could be from the base, in m, if the arm were a rope: the sum of the distances from joint to joint."""
    c = chain()
    return float(np.linalg.norm(c.offsets, axis=1).sum() + np.linalg.norm(c.hand_offset))


def _box_sides(mass: float, inertia: np.ndarray) -> np.ndarray:
    """Sides (3,) of the homogeneous box with this mass and these principal moments."""
    return np.sqrt(6 / mass * (inertia.sum() - 2 * inertia))


class Posture(NamedTuple):
    """Where the links are, in the base's axes."""

    origins: Array  # (7, 3) m, of the joints
    axes: Array  # (7, 3) of the joints
    rotations: Array  # (7, 3, 3) of the links
    hand_position: Array  # (3,) m, of the grip site
    hand_rotation: Array  # (3, 3) of the hand


def posture(joints: Array) -> Posture:
    """Forward kinematics at joints (7,).

    The loops over joints, here and below, are scans, because one round is then all that a compiler can fuse. Given the whole chain at once, XLA's
    compiler for CPUs computes shared terms anew for every number of the result.
    """
    c = chain()

    def link(carry: tuple[Array, Array], joint: tuple[Array, ...]) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        origin, rotation = carry
        offset, fixed, cos, sin = joint
        origin = origin + _product(rotation, offset[:, None])[:, 0]
        x, y, z = jnp.moveaxis(_product(rotation, fixed), 1, 0)
        rotation = jnp.stack([cos * x + sin * y, cos * y - sin * x, z], axis=1)
        return (origin, rotation), (origin, rotation)

    turns = (jnp.asarray(c.offsets), jnp.asarray(c.rotations), jnp.cos(joints), jnp.sin(joints))
    (origin, rotation), (origins, rotations) = jax.lax.scan(link, (jnp.zeros(3), jnp.eye(3)), turns)
    return Posture(
        origins=origins,
        axes=rotations[:, :, 2],
        rotations=rotations,
        hand_position=origin + _product(rotation, c.hand_offset[:, None])[:, 0],
        hand_rotation=_product(rotation, c.hand_rotation),
    )


def jacobian(posture: Posture) -> Array:
    """(6, 7) velocity of the grip site, m/s, and angular velocity, rad/s, per rad/s of each joint, in the base's axes."""
    return jnp.concatenate([jnp.cross(posture.axes, posture.hand_position[None] - posture.origins), posture.axes], axis=1).T


def mass_matrix(posture: Posture) -> Array:
    """(7, 7) kg m^2, armature included, by composite rigid bodies: what hangs on joint i moves as one body when joint i turns."""
    c = chain()

    def composite(carry: tuple[Array, Array, Array], link: tuple[Array, ...]) -> tuple[tuple[Array, Array, Array], Array]:
        """Adds a link to the body (mass, mass times centre, inertia about the base's origin); its momentum when the link's joint turns."""
        mass, moment, inertia = carry
        own_mass, own_centre, own_inertia, origin, rotation = link
        centre = origin + _product(rotation, own_centre[:, None])[:, 0]
        mass, moment = mass + own_mass, moment + own_mass * centre
        steiner = jnp.sum(jnp.square(centre)) * jnp.eye(3) - centre[:, None] * centre[None, :]
        inertia = inertia + _product(_product(rotation, own_inertia), rotation.T) + own_mass * steiner
        axis = rotation[:, 2]
        velocity = jnp.cross(origin, axis)  # where the body passes the base's origin, at 1 rad/s
        linear = mass * velocity + jnp.cross(axis, moment)
        angular = _product(inertia, axis[:, None])[:, 0] + jnp.cross(moment, velocity)
        return (mass, moment, inertia), jnp.concatenate([linear, angular])

    links = (jnp.asarray(c.masses), jnp.asarray(c.centres), jnp.asarray(c.inertias), posture.origins, posture.rotations)
    _, momenta = jax.lax.scan(composite, (jnp.zeros(()), jnp.zeros(3), jnp.zeros((3, 3))), links, reverse=True)
    lower = jnp.tril(_product(momenta, _motions(posture).T))
    return lower + jnp.tril(lower, -1).T + jnp.diag(jnp.asarray(c.armature))


def drag_torques(velocities: Array, posture: Posture) -> Array:
    """(7,) N m of air drag on the joints at velocities (7,) rad/s, by MuJoCo's inertia boxes.

    It counts: robosuite gives each fingertip of 10 g the moments of inertia of a box 2.4 m wide, and with it that box's drag.
    """
    c = chain()
    links, boxes = c.drag_links, jnp.asarray(c.drag_boxes)
    motions = _motions(posture)
    # (K, 6) velocities of the bodies, their linear part where they pass the base's origin
    twists = jnp.cumsum(motions * velocities[:, None], axis=0)[links]
    rotations = posture.rotations[links]
    centres = posture.origins[links] + jnp.sum(rotations * c.drag_centres[:, None, :], axis=2)
    axes = jnp.sum(rotations[:, :, :, None] * c.drag_axes[:, None, :, :], axis=2)
    linear = jnp.sum(axes * (twists[:, :3] + jnp.cross(twists[:, 3:], centres))[:, :, None], axis=1)
    angular = jnp.sum(axes * twists[:, 3:, None], axis=1)
    area = jnp.prod(boxes, axis=1)[:, None] / boxes
    fourth = boxes**4
    force = -0.5 * c.air_density * area * jnp.abs(linear) * linear
    torque = -c.air_density / 64 * boxes * (jnp.sum(fourth, axis=1)[:, None] - fourth) * jnp.abs(angular) * angular
    force, torque = jnp.sum(axes * force[:, None, :], axis=2), jnp.sum(axes * torque[:, None, :], axis=2)
    wrenches = jnp.concatenate([force, torque + jnp.cross(centres, force)], axis=1)  # (K, 6) about the base's origin
    on_joints = (np.arange(NUM_JOINTS)[:, None] <= links[None, :]).astype(np.float32)  # which bodies a joint carries
    carried = _product(jnp.asarray(on_joints), wrenches)
    return jnp.sum(motions * carried, axis=1)


def _motions(posture: Posture) -> Array:
    """(7, 6) what each joint's turning at 1 rad/s does to a body where it passes the base's origin: velocity and angular velocity."""
    return jnp.concatenate([jnp.cross(posture.origins, posture.axes), posture.axes], axis=1)


def joint_targets(joints: Array, rest: Array, command: Array, posture: Posture) -> Array:
    """Where the joints should go, by inverse kinematics.

    dq = J^T (J J^T + 0.05^2 1)^-1 9.5 [d; w] + (1 - J^+ J) K (rest - q), scaled down so that no joint exceeds 1 rad/s; q_goal = q + 0.1 dq.

    Args:
      joints: (7,) rad, q.
      rest: (7,) rad, the joints at reset, towards which the null space pulls.
      command: (6,) displacement d of the grip site in m and rotation vector w in rad, both in the base's axes; shortened to 0.02 m and 0.05 rad.
      posture: at `joints`.

    Returns:
      (7,) rad.
    """
    j = jacobian(posture)
    gram = _product(j, j.T)
    twist = shortened_command(command) * (_COMMAND_GAIN / _INTEGRATION_TIME)
    pull = jnp.asarray(_NULL_SPACE_GAINS) * (rest - joints)
    damped = inverse(gram + _DAMPING**2 * jnp.eye(6))
    undamped = inverse(gram + 1e-7 * jnp.eye(6))  # no more than keeps float32 from dividing by 0
    in_range = _times(damped, twist) - _times(undamped, _times(j, pull))
    speeds = _times(j.T, in_range) + pull
    slowdown = jnp.minimum(1.0, _MAX_JOINT_SPEED / jnp.maximum(jnp.max(jnp.abs(speeds)), 1e-9))
    return joints + _INTEGRATION_TIME * slowdown * speeds


def track(joints: Array, velocities: Array, goal: Array, mobility: Array, halfway: Array, drag: Array) -> tuple[Array, Array]:
    """25 substeps towards the goal: q'' = 100 (goal - q) - 20 v + M^-1 (drag + friction - damping v), by semi-implicit Euler.

    Dry friction is MuJoCo's: as large as it takes to stop the joint (softly: a = -b v - R f), but at most the joint's friction loss. One step of
    projected Jacobi iteration per substep, from the forces of the substep before, finds it. Drag grows with the square of the speed.

    Args:
      joints, velocities, goal: (7,).
      mobility: (7, 7) inverse of the mass matrix.
      halfway: (7,) rad/s, typical velocities of this control step.
      drag: (7,) N m, the drag at those.

    Returns:
      Joints and velocities (7,) at the end.
    """
    c = chain()
    damping, limit, soft = jnp.asarray(c.damping), jnp.asarray(c.friction), jnp.asarray(c.friction_regularisation)
    lower, upper = jnp.asarray(c.lower), jnp.asarray(c.upper)
    along = halfway / jnp.maximum(jnp.sum(jnp.square(halfway)), 1e-9)
    step_size = 1.0 / (jnp.diagonal(mobility) + soft)

    def substep(carry: tuple[Array, Array, Array], _: None) -> tuple[tuple[Array, Array, Array], None]:
        q, v, friction = carry
        free = STIFFNESS * (goal - q) - TRACKING_DAMPING * v
        share = jnp.sum(v * along)  # 1 at the typical velocities
        outer = drag * jnp.clip(share * jnp.abs(share), -2.0, 2.0) - damping * v
        excess = free + _times(mobility, outer + friction) + c.friction_rate * v + soft * friction
        friction = jnp.clip(friction - step_size * excess, -limit, limit)
        v = v + _SUBSTEP * (free + _times(mobility, outer + friction))
        moved = q + _SUBSTEP * v
        q = jnp.clip(moved, lower, upper)
        return (q, jnp.where(q == moved, v, 0.0), friction), None

    (joints, velocities, _), _ = jax.lax.scan(substep, (joints, velocities, jnp.zeros_like(joints)), length=SUBSTEPS)
    return joints, velocities


def control_step(joints: Array, velocities: Array, rest: Array, command: Array) -> tuple[Array, Array]:
    """One control step of 50 ms: `joint_targets`, then `track`.

    Args:
      joints, velocities: (7,) rad and rad/s.
      rest, command: as in `joint_targets`.

    Returns:
      The joints and their velocities (7,) at its end.
    """
    start = posture(joints)
    goal = joint_targets(joints, rest, command, start)
    halfway = _HALFWAY[0] * (joints - goal) + _HALFWAY[1] * velocities
    return track(joints, velocities, goal, inverse(mass_matrix(start)), halfway, drag_torques(halfway, start))


def inverse(matrix: Array) -> Array:
    """Inverse of a symmetric positive definite matrix (n, n), by Gauss-Jordan elimination without pivots.

    `jnp.linalg.inv` would call LAPACK once per environment on a CPU.
    """
    size = matrix.shape[0]

    def eliminate(k: Array, a: Array) -> Array:
        here = jnp.arange(size) == k
        row, column, pivot = a[k], a[:, k], a[k, k]
        row = jnp.where(here, 1.0, row) / pivot
        rest = jnp.where(here[None, :], 0.0, a) - column[:, None] * row[None, :]
        return jnp.where(here[:, None], row[None, :], rest)

    return jax.lax.fori_loop(0, size, eliminate, matrix)


def _product(a: Array, b: Array | np.ndarray) -> Array:
    """a b of small matrices (m, k) and (k, n): a sum of outer products, because a batch of tiny `dot`s is slow on a CPU."""
    return functools.reduce(jnp.add, [a[:, i, None] * b[None, i, :] for i in range(a.shape[1])])


def _times(a: Array, x: Array) -> Array:
    """a x of a small matrix (m, k) and a vector (k,)."""
    return functools.reduce(jnp.add, [a[:, i] * x[i] for i in range(a.shape[1])])


def shortened_command(command: Array) -> Array:
    """A command (6,), its displacement shortened to 0.02 m and its rotation vector to 0.05 rad, as the controller does."""
    return jnp.concatenate([shortened(command[:3], MAX_TRANSLATION), shortened(command[3:], MAX_ROTATION)])


def shortened(vector: Array, limit: float) -> Array:
    """A vector (n,), no longer than the limit."""
    return vector * jnp.minimum(1.0, limit / jnp.maximum(jnp.sqrt(jnp.sum(jnp.square(vector))), 1e-12))
