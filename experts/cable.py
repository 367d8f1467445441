"""The scripted expert of the cable tasks (thesis section 4.2.3), which tells from the state alone what comes next.

For each arm:
  1. to a place some centimetres before the grip, with a shaky hand;
  2. from there straight to the grip, exactly;
  3. close the fingers;
  4. wait for the other arm;
  5. to where the tips meet, both arms, with a shaky hand. To insert: then align the plug before the mouth, and push it in.

Where the first place and the meeting are is drawn for each episode, from the episode's key. The stages follow from where things are: an arm that
loses its head starts again.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hindrl_jax.base.checks import check, check_types
from hindrl_jax.base.types import Array
from hindrl_jax.envs import panda, rotations
from hindrl_jax.envs.cable import CableState, CableTask, Scene, geometry
from hindrl_jax.envs.cable.rules import GRASP, MEETING, MEETING_HEADS, tip_error
from hindrl_jax.envs.panda.linear_algebra import length, product, times

_BEFORE, _BEFORE_BOX = 0.09, np.array([0.03, 0.03, 0.05])  # m, from the grip, and half of the box of places there
_MEETING_BOX = np.array([0.02, 0.03, 0.04])  # m, half
_CONE = np.radians(10.0)  # within which the heads' axes at the meeting lie, where they need not be in line
_CORRIDOR, _CORRIDOR_ANGLE = 0.025, 0.2  # m, rad, around the straight way to the grip
_AT_GRIP, _AT_GRIP_ANGLE = 0.0015, 0.06  # m, rad, from where fingers begin to close
_STILL_AT_GRIP = 0.01  # m, where fingers that have begun go on
_GAP = 0.012  # m, between tips that meet
_STANDOFF = 0.01  # m, before the mouth, from where the plug is pushed in
_PUSH = 0.008  # m, by which each command leads
_TURNING_POINT = 0.003  # m around the standoff, where the plug must be in line as in `_IN_LINE`; nearer, as in `_STILL_IN_LINE`
_IN_LINE, _STILL_IN_LINE = (0.0015, 0.02), (0.003, 0.06)  # m, rad


class _Plan(NamedTuple):
    """What is drawn for an episode."""

    before: Array  # (2, 3) m, the first place, from the grip
    meeting: Array  # (3,) m, in the world
    heads: Array  # (2, 3, 3) at the meeting


@dataclass(frozen=True)
class CableExpert:
    """Proportional control in stages, with Gaussian noise. Unbatched and pure: apply `jax.vmap` over keys and states."""

    translation_noise: float = 0.01
    """Standard deviation of the noise on displacements while the hands travel, in m."""
    rotation_noise: float = 0.03
    """Likewise on rotation vectors, in rad."""
    insertion_noise: float = 0.002
    """Standard deviation of the noise on displacements while the plug is aligned and pushed in, in m; on rotation vectors twice that, in rad."""

    def __post_init__(self):
        check_types(self)
        check(
            self,
            translation_noise=(self.translation_noise >= 0.0, "0 or more"),
            rotation_noise=(self.rotation_noise >= 0.0, "0 or more"),
            insertion_noise=(self.insertion_noise >= 0.0, "0 or more"),
        )

    def act(self, key: Array, env: CableTask, state: CableState) -> Array:
        """Chooses an action from the state.

        Args:
          key: random key.
          env: the environment that `state` belongs to.
          state: unbatched state.

        Returns:
          (14,) for each arm a displacement in m and a rotation vector in rad, shortened as the controller would, and the gripper's command.
        """
        scene, inserts = state.scene, env.depth > 0.0
        plan = _plan(state.key, inserts=inserts)
        is_closing = state.finger_targets < geometry.MAX_FINGER - 1e-4
        to_head, closes = jax.vmap(_towards_grip)(_hands(scene), scene.head_positions, plan.before, is_closing)
        closes = closes | scene.held
        has_closed = scene.held & (state.finger_targets < 1e-4)
        carries = jnp.all(has_closed)

        targets, is_fine = _meeting(scene, plan, inserts=inserts)
        to_meeting = jax.vmap(_displacement)(_hands(scene), targets)
        waits = closes & ~carries
        wanted = jnp.where(carries, to_meeting, jnp.where(waits[:, None], 0.0, to_head[0]))
        is_shaky = jnp.where(carries, ~is_fine, to_head[1] & ~closes)
        travel, fine = (
            jnp.array(3 * [a] + 3 * [b]) for a, b in ((self.translation_noise, self.rotation_noise), (self.insertion_noise, 2 * self.insertion_noise))
        )
        scale = jnp.where(is_shaky[:, None], travel[None], jnp.where(carries & is_fine, fine, 0.0)[None])
        commands = jax.vmap(panda.shortened_command)(jax.vmap(panda.shortened_command)(wanted) + scale * jax.random.normal(key, (2, 6)))
        return jnp.concatenate([commands, jnp.where(closes, 1.0, -1.0)[:, None]], axis=1).reshape(-1)


_Pose = tuple[Array, Array]
"""Positions (..., 3) in m and rotation matrices (..., 3, 3)."""


def _hands(scene: Scene) -> _Pose:
    return scene.hand_positions, scene.hand_rotations


def _plan(key: Array, *, inserts: bool) -> _Plan:
    """Draws what an episode's key decides."""
    key_before, key_meeting, key_axis, key_angle = jax.random.split(jax.random.clone(key), 4)
    before = jnp.asarray(-_BEFORE * GRASP[:, 2], jnp.float32)[None] + jax.random.uniform(key_before, (2, 3), minval=-1.0) * _BEFORE_BOX[None]
    meeting = jnp.asarray(MEETING) + jax.random.uniform(key_meeting, (3,), minval=-1.0) * _MEETING_BOX
    axes = jax.random.normal(key_axis, (2, 3))
    axes = axes / jnp.sqrt(jnp.sum(jnp.square(axes), axis=1, keepdims=True))
    angles = _CONE * jnp.sqrt(jax.random.uniform(key_angle, (2, 1)))
    in_line = jnp.asarray(MEETING_HEADS, jnp.float32)
    heads = in_line if inserts else jax.vmap(product)(jax.vmap(rotations.from_rotation_vector)(axes * angles), in_line)
    return _Plan(before, meeting, heads)


def _displacement(hand: _Pose, target: _Pose) -> Array:
    """(6,) m and rad from one pose of the hand to another."""
    return jnp.concatenate([target[0] - hand[0], rotations.between(hand[1], target[1])])


def _towards_grip(hand: _Pose, grip: Array, before: Array, is_closing: Array) -> tuple[tuple[Array, Array], Array]:
    """Stages 1 to 3 of one arm.

    Args:
      hand: its pose.
      grip: (3,) m, of the head's grip site.
      before: (3,) m, the first place, from the grip.
      is_closing: () bool, whether the fingers' targets are less than open.

    Returns:
      The displacement (6,) that is wanted, and () bool, whether with a shaky hand; and () bool, whether the fingers are to close.
    """
    grasp = jnp.asarray(GRASP, jnp.float32)
    exact, first = _displacement(hand, (grip, grasp)), _displacement(hand, (grip + before, grasp))
    distance, angle = length(exact[:3]), length(exact[3:])
    along = jnp.clip(jnp.sum(-exact[:3] * before) / jnp.sum(jnp.square(before)), 0.0, 1.0)  # 0 at the grip, 1 at the first place
    is_near_way = (length(exact[:3] + along * before) < _CORRIDOR) & (angle < _CORRIDOR_ANGLE)
    arrives = (distance < _AT_GRIP) & (angle < _AT_GRIP_ANGLE)
    closes = arrives | (is_closing & (distance < _STILL_AT_GRIP) & (angle < _CORRIDOR_ANGLE))
    return (jnp.where(is_near_way, exact, first), ~is_near_way), closes


def _meeting(scene: Scene, plan: _Plan, *, inserts: bool) -> tuple[_Pose, Array]:
    """Stage 5: where the hands are to be, as they hold their heads now, and () bool, whether the plug is being aligned or pushed in."""
    gap = _STANDOFF if inserts else _GAP
    axis = plan.heads[1, :, 2]
    heads = plan.heads
    tips = jnp.stack([plan.meeting + (gap if inserts else gap / 2) * axis, plan.meeting - (0.0 if inserts else gap / 2) * axis])
    is_fine = jnp.asarray(False)
    if inserts:
        plug, socket = scene.head_rotations[:, :, 2]
        offset = tip_error(scene, 0.0)
        height = jnp.sum(offset * socket)
        aside, angle = length(offset - height * socket), rotations.angle(plug, -socket)
        aligned = product(rotations.from_rotation_vector(rotations.turning(plug, -socket)), scene.head_rotations[0])
        socket_at = _hand_of(scene, 1, tips[1], heads[1])
        is_ready = _is_within(_displacement((scene.hand_positions[1], scene.hand_rotations[1]), socket_at), 0.012, 0.1)
        is_fine = is_ready & (aside < 0.015) & (height < 0.03) & (angle < 0.15)

        is_near_mouth = height < _STANDOFF - _TURNING_POINT
        most_aside, most_angle = (jnp.where(is_near_mouth, far, near) for near, far in zip(_IN_LINE, _STILL_IN_LINE, strict=True))
        pushes = (height < _STANDOFF + _TURNING_POINT) & (aside < most_aside) & (angle < most_angle)
        mouth = scene.head_positions[1] + geometry.to_tip(1) * socket
        fine_tip = mouth + socket * jnp.where(pushes, height - _PUSH, _STANDOFF)
        tips = tips.at[0].set(jnp.where(is_fine, fine_tip, tips[0]))
        heads = heads.at[0].set(jnp.where(is_fine, aligned, heads[0]))
    targets = [_hand_of(scene, i, tips[i], heads[i]) for i in range(2)]
    return (jnp.stack([position for position, _ in targets]), jnp.stack([rotation for _, rotation in targets])), is_fine


def _hand_of(scene: Scene, head: int, tip: Array, rotation: Array) -> _Pose:
    """The pose of the hand with which the tip of its head would be at (3,) and the head at (3, 3), held as it is now."""
    in_hand = product(scene.hand_rotations[head].T, scene.head_rotations[head])
    hand_rotation = product(rotation, in_hand.T)
    offset = times(scene.hand_rotations[head].T, scene.head_positions[head] - scene.hand_positions[head])
    return tip - geometry.to_tip(head) * rotation[:, 2] - times(hand_rotation, offset), hand_rotation


def _is_within(displacement: Array, distance: float, angle: float) -> Array:
    return (length(displacement[:3]) < distance) & (length(displacement[3:]) < angle)
