"""The motion of the Panda in closed form, for bulk simulation.

Everything is unbatched and pure, in metres, radians, seconds, kilograms. The origin is the robot's base. One control step of 50 ms restates
robosuite 1.5.1's IK_POSE controller at 20 Hz on MuJoCo's dynamics at 2 ms:

1. `controller.joint_targets`. Damped least squares turn the commanded displacement into joint velocities, plus a pull towards the joints at reset in
   the null space; speeds are capped and held for 0.1 s: q_goal = q + 0.1 dq.
2. `track`. 25 times, torques M(q) (100 (q_goal - q) - 20 v) + bias drive the joints against friction and damping.

Differences from MuJoCo in `track`:
  * The mass matrix is that at the beginning of the control step.
  * Dry friction comes from one iteration per substep.
  * Air drag keeps the direction that it has halfway through.
  * Torque limits and viscosity are left out, and joint limits are hard.
  * The closed fingers are part of the hand.

Over a hundred control steps the hand stays within 0.7 mm and 6 mrad of robosuite's, on average within 0.13 mm and 1.2 mrad, as long as no joint
meets its limit (`python -m benchmarks.run --only reach_parity`). At a limit, MuJoCo's soft stop and ours can part by centimetres.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from hindrl_jax.base.types import Array
from hindrl_jax.envs.panda.controller import CONTROL_PERIOD, STIFFNESS, SUBSTEPS, TRACKING_DAMPING, joint_targets
from hindrl_jax.envs.panda.kinematics import Posture, motions, posture
from hindrl_jax.envs.panda.linear_algebra import inverse, product, times
from hindrl_jax.envs.panda.robot import NUM_JOINTS, chain

_SUBSTEP = CONTROL_PERIOD / SUBSTEPS  # s
_HALFWAY = np.linalg.matrix_power(
    [
        [1 - _SUBSTEP**2 * STIFFNESS, _SUBSTEP * (1 - _SUBSTEP * TRACKING_DAMPING)],
        [-_SUBSTEP * STIFFNESS, 1 - _SUBSTEP * TRACKING_DAMPING],
    ],
    SUBSTEPS // 2,
)[1]  # velocity after half of the substeps from [q - q_goal, v], without friction and drag


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


def mass_matrix(posture: Posture) -> Array:
    """(7, 7) kg m^2, armature included, by composite rigid bodies: all that joint i carries moves as one body when joint i turns."""
    c = chain()

    def composite(carry: tuple[Array, Array, Array], link: tuple[Array, ...]) -> tuple[tuple[Array, Array, Array], Array]:
        """Adds a link to the body (mass, mass times centre, inertia about the base's origin); its momentum when the link's joint turns."""
        mass, moment, inertia = carry
        own_mass, own_centre, own_inertia, origin, rotation = link
        centre = origin + product(rotation, own_centre[:, None])[:, 0]
        mass, moment = mass + own_mass, moment + own_mass * centre
        steiner = jnp.sum(jnp.square(centre)) * jnp.eye(3) - centre[:, None] * centre[None, :]
        inertia = inertia + product(product(rotation, own_inertia), rotation.T) + own_mass * steiner
        axis = rotation[:, 2]
        velocity = jnp.cross(origin, axis)  # where the body passes the base's origin, at 1 rad/s
        linear = mass * velocity + jnp.cross(axis, moment)
        angular = product(inertia, axis[:, None])[:, 0] + jnp.cross(moment, velocity)
        return (mass, moment, inertia), jnp.concatenate([linear, angular])

    links = (jnp.asarray(c.masses), jnp.asarray(c.centres), jnp.asarray(c.inertias), posture.origins, posture.rotations)
    _, momenta = jax.lax.scan(composite, (jnp.zeros(()), jnp.zeros(3), jnp.zeros((3, 3))), links, reverse=True)
    lower = jnp.tril(product(momenta, motions(posture).T))
    return lower + jnp.tril(lower, -1).T + jnp.diag(jnp.asarray(c.armature))


def drag_torques(velocities: Array, posture: Posture) -> Array:
    """(7,) N m of air drag on the joints at velocities (7,) rad/s, by MuJoCo's inertia boxes.

    It counts: robosuite gives each fingertip of 10 g the moments of inertia of a box 2.4 m wide, and with it that box's drag.
    """
    c = chain()
    links, boxes = c.drag_links, jnp.asarray(c.drag_boxes)
    per_joint = motions(posture)
    # (K, 6) velocities of the bodies, their linear part where they pass the base's origin
    twists = jnp.cumsum(per_joint * velocities[:, None], axis=0)[links]
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
    carried = product(jnp.asarray(on_joints), wrenches)
    return jnp.sum(per_joint * carried, axis=1)


def track(joints: Array, velocities: Array, goal: Array, mobility: Array, halfway: Array, drag: Array) -> tuple[Array, Array]:
    """25 substeps towards the goal: q'' = 100 (goal - q) - 20 v + M^-1 (drag + friction - damping v), by semi-implicit Euler.

    Dry friction is MuJoCo's: as large as it takes to stop the joint (softly: a = -b v - R f), but at most the joint's friction loss. One step of
    projected Jacobi iteration per substep, from the forces of the substep before, finds it. Drag grows with the square of the speed.

    Args:
      joints, velocities, goal: (7,) rad, rad/s and rad.
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
        excess = free + times(mobility, outer + friction) + c.friction_rate * v + soft * friction
        friction = jnp.clip(friction - step_size * excess, -limit, limit)
        v = v + _SUBSTEP * (free + times(mobility, outer + friction))
        moved = q + _SUBSTEP * v
        q = jnp.clip(moved, lower, upper)
        return (q, jnp.where(q == moved, v, 0.0), friction), None

    (joints, velocities, _), _ = jax.lax.scan(substep, (joints, velocities, jnp.zeros_like(joints)), length=SUBSTEPS)
    return joints, velocities
