"""Arms and cables in closed form, for training in bulk: one control step of 50 ms of the MuJoCo model in `model`. Pure and unbatched.

  * The arms follow their position actuators (`panda.position_actuators`). A held head with a share of its cable hangs on the hand as a weight:
    without it no arm sinks, and what is precise here is not in MuJoCo.
  * A free head swings on its cable as a pendulum does; a held one is rigid with the hand. Fingers take a head when they close round its grip.
  * A taut cable holds the hand back like a leash. It tears the head out of the fingers only if the arm is far beyond.
  * Hands do not pass through each other, nor the plug through the socket (`contact`).

Differences from MuJoCo: no slip of a held head, no pushing of one that is not held, and a released head is upright within tenths of a second.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from hindrl_jax.base.types import Array
from hindrl_jax.envs import panda, rotations
from hindrl_jax.envs.cable import contact, geometry
from hindrl_jax.envs.cable.contact import Socket
from hindrl_jax.envs.cable.types import Scene
from hindrl_jax.envs.panda import position_actuators
from hindrl_jax.envs.panda.linear_algebra import inverse, length, product, times

_GRAVITY = 9.81  # m/s^2
_CARRIED = 0.2  # share of a cable that the hand carries where heads meet: idle arms then sink as in MuJoCo
_WEIGHTS = _GRAVITY * (geometry.HEAD_MASSES + _CARRIED * geometry.CABLE_MASS)  # (2,) N
_SOCKET = {  # measured in MuJoCo: what enters, and what jams
    "clearance": geometry.CLEARANCE,
    "capture_radius": 0.003,
    "capture_angle": np.radians(3.4),
    "friction": 0.3,
    "compliance": 0.02,
}
_SPREAD = 0.3  # of the numbers above, and of the weights, where episodes are randomised
_HELD_FINGER = geometry.FINGER_TOUCHING - 0.0002  # m, where the fingers come to rest on a grip
_FINGER_MASS, _FINGER_STIFFNESS, _FINGER_DAMPING = 1.11, 1000.0, 100.0  # kg (with armature), N/m, N s/m
_SWING_SUBSTEPS, _SWING_DAMPING = 5, 2.0  # of 10 ms; 1/s
_LEASH_STEP = 0.02  # m, by which a taut cable pulls a hand back within one control step, and beyond which it tears out the head
_UPRIGHT_SHARE = 0.3  # of its tilt against the cable that a free head loses in a control step


def _finger_steps() -> np.ndarray:
    """(2, 2) what a control step makes of a finger's [distance to its target, speed], with damping taken implicitly."""
    h = position_actuators.SUBSTEP
    slowed = 1.0 / (1.0 + h * _FINGER_DAMPING / _FINGER_MASS)
    pull = h * _FINGER_STIFFNESS / _FINGER_MASS * slowed
    return np.linalg.matrix_power(np.array([[1 - h * pull, h * slowed], [-pull, slowed]]), position_actuators.SUBSTEPS).astype(np.float32)


_FINGERS = _finger_steps()


class ClosedForm(struct.PyTreeNode, kw_only=True):
    """What is simulated. The first of two is the plug, or the arm that takes it."""

    joints: Array  # (2, 7) rad
    velocities: Array  # (2, 7) rad/s
    postures: panda.Posture  # leaves (2, ...), follow from the joints
    fingers: Array  # (2,) m
    finger_speeds: Array  # (2,) m/s
    held: Array  # (2,) bool
    grasp_positions: Array  # (2, 3) m, of a held head in the hand's axes
    grasp_rotations: Array  # (2, 3, 3) likewise
    head_positions: Array  # (2, 3) m
    head_rotations: Array  # (2, 3, 3)
    head_speeds: Array  # (2, 3) m/s, 0 while held
    weights: Array  # (2,) N, constant within an episode
    socket: Socket  # likewise


def start(key: Array, joints: Array, *, randomised: bool) -> ClosedForm:
    """At rest, with hanging cables.

    Args:
      key: random key, of what is drawn for the episode.
      joints: (2, 7) rad.
      randomised: whether weights and socket are.
    """
    names = (*_SOCKET, "weights")
    factors = jax.random.uniform(key, (len(names),), minval=1.0 - _SPREAD, maxval=1.0 + _SPREAD) if randomised else jnp.ones(len(names))
    *socket, weight = [factors[i] for i in range(len(names))]
    upright = jnp.broadcast_to(jnp.asarray(geometry.HANGING), (2, 3, 3))
    return ClosedForm(
        joints=joints,
        velocities=jnp.zeros((2, 7)),
        postures=jax.vmap(panda.posture)(joints),
        fingers=jnp.full(2, geometry.INITIAL_FINGER, jnp.float32),
        finger_speeds=jnp.zeros(2),
        held=jnp.zeros(2, bool),
        grasp_positions=jnp.zeros((2, 3)),
        grasp_rotations=jnp.broadcast_to(jnp.eye(3), (2, 3, 3)),
        head_positions=jnp.asarray(geometry.HANGING_GRIPS),
        head_rotations=upright,
        head_speeds=jnp.zeros((2, 3)),
        weights=weight * jnp.asarray(_WEIGHTS, jnp.float32),
        socket=Socket(**{name: factor * value for (name, value), factor in zip(_SOCKET.items(), socket, strict=True)}),
    )


def scene(physics: ClosedForm) -> Scene:
    """Where everything is."""
    positions, hand_rotations = _hands(physics.postures)
    return Scene(
        hand_positions=positions,
        hand_rotations=hand_rotations,
        head_positions=physics.head_positions,
        head_rotations=physics.head_rotations,
        fingers=physics.fingers,
        held=physics.held,
    )


def compact(physics: ClosedForm) -> Any:
    """All of it that the rest does not follow from."""
    return physics.replace(postures=None)


def completed(physics: ClosedForm) -> ClosedForm:
    """The inverse of `compact`."""
    return physics.replace(postures=jax.vmap(panda.posture)(physics.joints))


def control_step(physics: ClosedForm, rest: Array, finger_targets: Array, command: Array) -> ClosedForm:
    """One control step of 50 ms.

    Args:
      physics: before it.
      rest: (2, 7) rad, the joints at reset.
      finger_targets: (2,) m.
      command: (2, 6) displacements in m and rotation vectors in rad, as `panda.joint_targets` takes them.
    """
    load = jnp.where(physics.held, physics.weights, 0.0)
    goals = jax.vmap(panda.joint_targets)(physics.joints, rest, command, physics.postures)
    joints, velocities = jax.vmap(position_actuators.track)(physics.joints, physics.velocities, goals, physics.postures, load)
    moved = physics.replace(joints=joints, velocities=velocities, postures=jax.vmap(panda.posture)(joints))
    return _with_heads(physics, _pushed(physics, moved), finger_targets)


def _hands(postures: panda.Posture) -> tuple[Array, Array]:
    """Positions (2, 3) and rotations (2, 3, 3) of the hands."""
    return postures.hand_position + jnp.asarray(geometry.BASES), postures.hand_rotation


def _carried(physics: ClosedForm) -> tuple[Array, Array]:
    """Positions (2, 3) and rotations (2, 3, 3) of heads that are held."""
    positions, hand_rotations = _hands(physics.postures)
    return positions + jax.vmap(times)(hand_rotations, physics.grasp_positions), jax.vmap(product)(hand_rotations, physics.grasp_rotations)


def _beyond_leash(positions: Array, head_rotations: Array) -> tuple[Array, Array]:
    """By how much the cables are too short for the heads, m (2,), and the directions (2, 3) in which they run from the bar."""
    run = positions - geometry.GRIP * head_rotations[:, :, 2] - jnp.asarray(geometry.ANCHORS)
    distance = length(run)
    return distance - geometry.CABLE_LENGTH, run / distance[:, None]


def _pushed(before: ClosedForm, moved: ClosedForm) -> ClosedForm:
    """The arms after a control step, moved out of each other, to where the socket lets the plug, and back to where the cables let them."""
    positions, hand_rotations = _hands(moved.postures)
    heads = _carried(moved)
    both = jnp.all(before.held)
    shift, turn = contact.plug_in_socket((before.head_positions, before.head_rotations), heads, before.socket)
    shift = jnp.where(both, shift, 0.0) + contact.hands_apart(positions, hand_rotations)
    turn = jnp.where(both, turn, 0.0)
    excess, direction = _beyond_leash(*heads)
    leash = jnp.where(before.held[:, None], -jnp.clip(excess, 0.0, _LEASH_STEP)[:, None] * direction, 0.0)

    share = jnp.array([[0.5], [-0.5]])  # each arm gives way by half
    turns = share * turn[None]
    plug_tip = contact.tip(heads[0][0], heads[1][0], 0)
    shifts = share * shift[None] - jnp.cross(turns, plug_tip[None] - positions) + leash  # turned about the plug's tip
    changes = jax.vmap(_joint_change)(moved.postures, jnp.concatenate([shifts, turns], axis=1))
    touched = jnp.any(jnp.concatenate([shifts, turns], axis=1) != 0.0, axis=1)
    joints = moved.joints + jnp.where(touched[:, None], changes, 0.0)
    velocities = moved.velocities + jnp.where(touched[:, None], changes / panda.CONTROL_PERIOD, 0.0)
    return moved.replace(joints=joints, velocities=velocities, postures=jax.vmap(panda.posture)(joints))


def _joint_change(posture: panda.Posture, twist: Array) -> Array:
    """(7,) rad, the least change of the joints that moves the hand by (6,) m and rad."""
    j = panda.jacobian(posture)
    return times(j.T, times(inverse(product(j, j.T) + 1e-5 * jnp.eye(6)), twist))


def _with_heads(before: ClosedForm, moved: ClosedForm, finger_targets: Array) -> ClosedForm:
    """Fingers and heads after the arms have moved: what is taken, kept and let go."""
    away = before.fingers - finger_targets
    fingers = finger_targets + _FINGERS[0, 0] * away + _FINGERS[0, 1] * before.finger_speeds
    finger_speeds = _FINGERS[1, 0] * away + _FINGERS[1, 1] * before.finger_speeds
    closed = fingers <= _HELD_FINGER

    positions, hand_rotations = _hands(moved.postures)
    free_positions, free_speeds = jax.vmap(_swing)(before.head_positions, before.head_speeds, jnp.asarray(geometry.ANCHORS))
    free_rotations = jax.vmap(_hanging)(before.head_rotations, free_positions - jnp.asarray(geometry.ANCHORS))
    seen = jax.vmap(times)(jnp.swapaxes(hand_rotations, 1, 2), free_positions - positions)
    turned = jax.vmap(product)(jnp.swapaxes(hand_rotations, 1, 2), free_rotations)
    between, grasp_positions, grasp_rotations = jax.vmap(_grasp)(seen, turned)

    taken = ~before.held & closed & (before.fingers > _HELD_FINGER) & between
    held = (before.held & closed) | taken
    grasp_positions = jnp.where(taken[:, None], grasp_positions, before.grasp_positions)
    grasp_rotations = jnp.where(taken[:, None, None], grasp_rotations, before.grasp_rotations)
    carried = _carried(moved.replace(grasp_positions=grasp_positions, grasp_rotations=grasp_rotations))
    held &= _beyond_leash(*carried)[0] < _LEASH_STEP
    in_hand = held | before.held  # one that has just been let go begins where it was carried to
    return moved.replace(
        fingers=jnp.where(held, _HELD_FINGER, fingers),
        finger_speeds=jnp.where(held, 0.0, finger_speeds),
        held=held,
        grasp_positions=grasp_positions,
        grasp_rotations=grasp_rotations,
        head_positions=jnp.where(in_hand[:, None], carried[0], free_positions),
        head_rotations=jnp.where(in_hand[:, None, None], carried[1], free_rotations),
        head_speeds=jnp.where(in_hand[:, None], 0.0, free_speeds),
    )


def _swing(position: Array, speed: Array, anchor: Array) -> tuple[Array, Array]:
    """A free head's grip site (3,) and its speed (3,) after a control step: a point on a string."""
    step, longest = panda.CONTROL_PERIOD / _SWING_SUBSTEPS, geometry.CABLE_LENGTH + geometry.GRIP

    def substep(carry: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], None]:
        position, speed = carry
        speed = speed + step * (jnp.array([0.0, 0.0, -_GRAVITY]) - _SWING_DAMPING * speed)
        run = position + step * speed - anchor
        distance = length(run)
        direction, is_taut = run / distance, distance > longest
        outwards = jnp.maximum(jnp.sum(speed * direction), 0.0)
        return (anchor + jnp.where(is_taut, longest * direction, run), jnp.where(is_taut, speed - outwards * direction, speed)), None

    return jax.lax.scan(substep, (position, speed), length=_SWING_SUBSTEPS)[0]


def _hanging(rotation: Array, run: Array) -> Array:
    """(3, 3) a free head, turned towards the direction in which its cable (3,) runs."""
    turn = rotations.turning(rotation[:, 2], run / length(run))
    return product(rotations.from_rotation_vector(_UPRIGHT_SHARE * turn), rotation)


def _grasp(position: Array, rotation: Array) -> tuple[Array, Array, Array]:
    """What closed fingers make of a head at (3,) m and (3, 3) in the hand's axes, y being that along which fingers move.

    Returns:
      () bool, whether its grip is between them, and the head's position (3,) and rotation (3, 3) once they have centred it.
    """
    axis = rotation[:, 2]
    x, y, z = geometry.from_pads_to_grip(position, axis)
    within_pads = jnp.sqrt(jnp.square(x) + jnp.square(z)) < geometry.PAD_HALF_SIZE
    between = within_pads & (jnp.abs(y) < geometry.MAX_FINGER - geometry.GRIP_RADIUS - 0.002) & (jnp.abs(axis[1]) < 0.35)
    flat = axis * jnp.array([1.0, 0.0, 1.0])
    turn = rotations.turning(axis, flat / length(flat))
    return between, position * jnp.array([1.0, 0.0, 1.0]), product(rotations.from_rotation_vector(turn), rotation)
