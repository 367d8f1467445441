"""The two reach tasks of thesis sections 3.2.1 and 3.2.2: a Panda arm brings its hand to a number of poses, in order, at 20 Hz.

A waypoint is reached when the grip site is within `position_tolerance` of its position and the hand within `rotation_tolerance` of its orientation,
and all waypoints before it have been reached. The reward is 1 when the last one is, and 0 before. Poses are in the frame of the robot's base.

Differences from the thesis:
  * Orientations are observed in the continuous 6-D form. The axis-angle of a hand that points down lies where it jumps from pi to -pi;
    `orientation="axis_angle"` gives it all the same.
  * A rotation counts as reached by its angle, not by the distance between two axis-angle vectors, for the same reason (`rotation_test`).
  * The joints vary at reset by 0.02 rad, as in the original code; in the text every episode starts from the same position (`joint_noise=0`).
  * Commanded rotations are about the base's axes, as in robosuite's controller; the text has them relative to the hand's orientation.
  * The random task observes the waypoints, as the thesis says it must: for each, the displacement and the rotation that remain, the one whose turn
    it is first. Its achieved goal is the displacement and rotation that remain to the last waypoint, and the mask, so that equal goals mean the same
    in every episode. Hindsight rewrites the waypoints in the observations instead of the goal (`ParameterizedReach.relabel_observations`).
"""

from __future__ import annotations

import abc
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from hindrl_jax.base.checks import check, check_types
from hindrl_jax.base.types import Array, TimeStep
from hindrl_jax.envs.reach import mjx_dynamics, panda, rotations

Backend = Literal["closed_form", "mjx", "robosuite"]

FIXED_WAYPOINTS = ((0.58766, 0.26816, 0.37820, 2.89549, 0.03567, -0.39348), (0.42493, 0.07166, 0.36318, 2.88426, 0.12777, 0.35920))
"""The thesis's two fixed waypoints: position in m and axis-angle of the hand in rad, in the frame of the robot's base."""
LOWEST, HIGHEST = (0.4, -0.3, 0.0), (0.6, 0.3, 0.4)
"""Corners of the box of random waypoints, in m."""
MAX_TILT = np.pi / 4
"""Largest rotation of a random waypoint from a hand that points straight down, in rad."""
_DOWN = np.diag([1.0, -1.0, -1.0]).astype(np.float32)
_ACTION_BOUND = np.array(3 * [panda.MAX_TRANSLATION] + 3 * [panda.MAX_ROTATION], np.float32)


class ReachState(struct.PyTreeNode, kw_only=True):
    """Everything that the next step depends on. K waypoints."""

    key: Array  # () typed random key, constant within an episode
    joints: Array  # (7,) rad
    velocities: Array  # (7,) rad/s
    rest: Array  # (7,) rad, the joints at reset
    positions: Array  # (K, 3) m, of the waypoints
    rotations: Array  # (K, 3, 3) of the waypoints
    num_reached: Array  # () int32, waypoints 0 .. num_reached - 1 are reached
    step: Array  # () int32, steps taken in this episode


@dataclass(frozen=True)
class _Reach(abc.ABC):
    """What both tasks share; they differ in where the waypoints are, and in whether they are observed."""

    name: ClassVar[str]
    interchangeable: ClassVar[tuple[str, ...]] = ("backend",)
    """Arguments in which demonstrations may differ from the environment that learns from them."""
    render_fps: ClassVar[int] = round(1 / panda.CONTROL_PERIOD)
    """Steps shown per second of a film: real time."""

    num_waypoints: int = 2
    """Number of poses to reach, in order."""
    horizon: int = 300
    """Number of steps, of 50 ms each, after which an episode is truncated."""
    position_tolerance: float = 0.02
    """Distance in m within which a waypoint counts as reached."""
    rotation_tolerance: float = 0.05
    """Angle in rad within which a waypoint counts as reached."""
    joint_noise: float = 0.02
    """Standard deviation in rad of the joints at reset; 0 starts every episode in the same place, as the thesis's text has it."""
    orientation: Literal["six_d", "axis_angle"] = "six_d"
    """How the hand's orientation is observed: two columns of its matrix, or the thesis's axis-angle, which jumps."""
    rotation_test: Literal["angle", "axis_angle"] = "angle"
    """What rotation_tolerance bounds: the angle between hand and waypoint, or the distance of their axis-angle vectors, as in the original code."""
    backend: Backend = "closed_form"
    """Who simulates the arm: closed_form (for bulk training), mjx (MuJoCo's own equations in JAX, some forty times slower), or robosuite (one
    arm on the CPU, to record or to evaluate)."""

    def __post_init__(self):
        check_types(self)
        check(
            self,
            num_waypoints=(self.num_waypoints >= 1, "at least 1"),
            horizon=(self.horizon >= 1, "at least 1"),
            position_tolerance=(self.position_tolerance > 0, "greater than 0"),
            rotation_tolerance=(self.rotation_tolerance > 0, "greater than 0"),
            joint_noise=(self.joint_noise >= 0, "0 or more"),
        )

    @property
    def pose_dim(self) -> int:
        """Numbers that describe the pose of the hand: 9, or 6 with axis-angle."""
        return 9 if self.orientation == "six_d" else 6

    @property
    def action_dim(self) -> int:
        return 6

    @property
    def action_low(self) -> np.ndarray:
        """(6,) m and rad."""
        return -_ACTION_BOUND

    @property
    def action_high(self) -> np.ndarray:
        """(6,) m and rad."""
        return _ACTION_BOUND

    @property
    def compiler_options(self) -> dict[str, Any]:
        """Options for XLA programs that step this environment: on CPUs, its newer fusion code makes MJX several hundred times slower, and its
        concurrent scheduler can leave large batches of MJX waiting for ever (both seen with jaxlib 0.10.2)."""
        if self.backend != "mjx" or jax.default_backend() != "cpu":
            return {}
        return {"xla_cpu_use_fusion_emitters": False, "xla_cpu_enable_concurrency_optimized_scheduler": False}

    @property
    def observation_low(self) -> np.ndarray:
        """(D,) float32, the least value of each entry of an observation, up to rounding."""
        return self._observation_bounds()[0]

    @property
    def observation_high(self) -> np.ndarray:
        """(D,) float32, the greatest."""
        return self._observation_bounds()[1]

    @property
    @abc.abstractmethod
    def goal_dim(self) -> int: ...

    @property
    def goal_tolerance(self) -> np.ndarray | None:
        """(G,) half-width of the box around `task_goal()` in which the achieved goal of a state lies if and only if that solves the task; None if
        there is no such box. The mask alone decides; the rest is as wide as it must be, and serves where states of an episode are taken as goals."""
        return np.array(
            3 * [self.position_tolerance] + (self.goal_dim - self.num_waypoints - 3) * [self.rotation_tolerance] + self.num_waypoints * [0.0],
            np.float32,
        )

    @property
    def state_dim(self) -> int:
        """Length of `state_to_vector`."""
        return 3 * panda.NUM_JOINTS + 12 * self.num_waypoints + 2

    def reset(self, key: Array) -> tuple[ReachState, Array]:
        """Starts an episode: key -> (state, observation (D,))."""
        key_episode, key_joints, key_waypoints = jax.random.split(key, 3)
        noise = self.joint_noise * jax.random.normal(key_joints, (panda.NUM_JOINTS,))
        lower, upper = (jnp.asarray(limit, jnp.float32) for limit in (panda.chain().lower, panda.chain().upper))
        joints = jnp.clip(jnp.asarray(panda.INITIAL_JOINTS, jnp.float32) + noise, lower, upper)
        positions, rotation_matrices = self._waypoints(key_waypoints)
        state = ReachState(
            key=key_episode,
            joints=joints,
            velocities=jnp.zeros_like(joints),
            rest=joints,
            positions=positions,
            rotations=rotation_matrices,
            num_reached=jnp.zeros((), jnp.int32),
            step=jnp.zeros((), jnp.int32),
        )
        return state, self.observe(state)

    def step(self, state: ReachState, action: Array) -> tuple[ReachState, TimeStep]:
        """Takes one control step of 50 ms.

        Args:
          state: the state to step from.
          action: (6,) displacement of the hand in m and rotation vector in rad, both in the base's axes; clipped to +-0.02 and +-0.05. The
            controller then shortens both vectors to these lengths, and the arm follows with inertia: a few millimetres per step.

        Returns:
          The next state, and the time step with the true next observation.

        Raises:
          ValueError: with the robosuite back end, which is not a JAX program.
        """
        if self.backend == "robosuite":
            raise ValueError("robosuite simulates one arm outside JAX: record or evaluate with it, and train with closed_form or mjx")
        control_step = mjx_dynamics.control_step if self.backend == "mjx" else panda.control_step
        joints, velocities = control_step(state.joints, state.velocities, state.rest, jnp.clip(action, self.action_low, self.action_high))
        return self.arrive(state, joints, velocities)

    def arrive(self, state: ReachState, joints: Array, velocities: Array) -> tuple[ReachState, TimeStep]:
        """The rest of a step, once the arm has moved: has it reached a waypoint, and was it the last?

        Args:
          state: before the step.
          joints, velocities: (7,) after it, in rad and rad/s, from whatever simulates the arm.
        """
        state = state.replace(joints=joints, velocities=velocities, step=state.step + 1)
        arm = panda.posture(joints)
        position, rotation = self.next_waypoint(state)
        reached = self._is_within(arm.hand_position, arm.hand_rotation, position, rotation) & ~self.is_solved(state)
        state = state.replace(num_reached=state.num_reached + reached)
        terminated = self.is_solved(state)
        return state, TimeStep(
            observation=self._observe(state, arm),
            reward=terminated.astype(jnp.float32),
            terminated=terminated,
            truncated=(state.step >= self.horizon) & ~terminated,
        )

    def _is_within(self, hand_position: Array, hand_rotation: Array, position: Array, rotation: Array) -> Array:
        """() bool, whether a hand at (3,) and (3, 3) has reached a waypoint at (3,) and (3, 3)."""
        if self.rotation_test == "angle":
            turn = rotations.between(hand_rotation, rotation)
        else:
            turn = rotations.to_rotation_vector(rotation) - rotations.to_rotation_vector(hand_rotation)
        distance, angle = (jnp.sqrt(jnp.sum(jnp.square(vector))) for vector in (position - hand_position, turn))
        return (distance < self.position_tolerance) & (angle < self.rotation_tolerance)

    def next_waypoint(self, state: ReachState) -> tuple[Array, Array]:
        """Position (3,) and rotation matrix (3, 3) of the waypoint whose turn it is, or of the last one if all are reached."""
        chosen = jnp.arange(self.num_waypoints) == jnp.minimum(state.num_reached, self.num_waypoints - 1)
        position = jnp.sum(jnp.where(chosen[:, None], state.positions, 0.0), axis=0)
        return position, jnp.sum(jnp.where(chosen[:, None, None], state.rotations, 0.0), axis=0)

    def is_solved(self, state: ReachState) -> Array:
        """() bool, whether the last waypoint has been reached."""
        return state.num_reached >= self.num_waypoints

    def observe(self, state: ReachState) -> Array:
        """(D,) float32, see the properties of the task."""
        return self._observe(state, panda.posture(state.joints))

    def state_to_vector(self, state: ReachState) -> Array:
        """(state_dim,) float32: joints, velocities, rest, waypoints, num_reached, step; all of the state but its key."""
        counters = jnp.stack([state.num_reached, state.step])
        arrays = (state.joints, state.velocities, state.rest, state.positions.reshape(-1), state.rotations.reshape(-1), counters)
        return jnp.concatenate(arrays, dtype=jnp.float32)

    def vector_to_state(self, key: Array, vector: Array) -> ReachState:
        """The inverse of `state_to_vector`: (state_dim,) -> the state, with `key` as its key."""
        vector, count = jnp.asarray(vector, jnp.float32), self.num_waypoints
        joints, velocities, rest, positions, matrices, counters = jnp.split(vector, np.cumsum([7, 7, 7, 3 * count, 9 * count]))
        return ReachState(
            key=key,
            joints=joints,
            velocities=velocities,
            rest=rest,
            positions=positions.reshape(count, 3),
            rotations=matrices.reshape(count, 3, 3),
            num_reached=counters[0].astype(jnp.int32),
            step=counters[1].astype(jnp.int32),
        )

    def _pose(self, position: Array, rotation: Array) -> Array:
        """(pose_dim,) a position (3,) and a rotation matrix (3, 3) of the hand, as they are observed."""
        orientation = rotations.to_six_d if self.orientation == "six_d" else rotations.to_rotation_vector
        return jnp.concatenate([position, orientation(rotation)])

    def _mask(self, state: ReachState) -> Array:
        """(K,) 1 for each waypoint that has been reached."""
        return (jnp.arange(self.num_waypoints) < state.num_reached).astype(jnp.float32)

    def _observation_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """What `observation_low` and `observation_high` return: here of the pose and the mask, with which all observations begin."""
        high = 3 * [panda.longest_reach()] + (self.pose_dim - 3) * [1.0 if self.orientation == "six_d" else np.pi]
        mask = self.num_waypoints * [1.0]
        return np.array([*(-value for value in high), *(0.0 for _ in mask)], np.float32), np.array([*high, *mask], np.float32)

    @abc.abstractmethod
    def _observe(self, state: ReachState, arm: panda.Posture) -> Array:
        """(D,) the observation, given the posture that belongs to the state."""

    @abc.abstractmethod
    def _waypoints(self, key: Array) -> tuple[Array, Array]:
        """Positions (K, 3) and rotation matrices (K, 3, 3) of the waypoints."""


@dataclass(frozen=True)
class FixedParameterizedReach(_Reach):
    """The waypoints are the same in every episode and are not observed (thesis 3.2.2).

    Observation and achieved goal: the hand's position (3), its orientation (6), and a mask of the waypoints reached (K). The first two waypoints are
    the thesis's; further ones are drawn once and for all from the distribution of the random task.
    """

    name: ClassVar[str] = "FixedParameterizedReach"

    @property
    def observation_dim(self) -> int:
        return self.pose_dim + self.num_waypoints

    @property
    def goal_dim(self) -> int:
        return self.observation_dim

    def achieved_goal(self, observation: Array) -> Array:
        """The observation itself (thesis section 3.2.1)."""
        return observation

    def task_goal(self) -> Array:
        """(G,) the last waypoint's pose, and a mask of ones."""
        positions, matrices = self._waypoints(jax.random.key(0))
        return jnp.concatenate([self._pose(positions[-1], matrices[-1]), jnp.ones(self.num_waypoints)])

    @property
    def goal_tolerance(self) -> np.ndarray | None:
        """As for both tasks. None where the angle decides and axis-angles are observed, which can be far apart for hands that are close."""
        return None if (self.orientation, self.rotation_test) == ("axis_angle", "angle") else super().goal_tolerance

    def _observe(self, state: ReachState, arm: panda.Posture) -> Array:
        return jnp.concatenate([self._pose(arm.hand_position, arm.hand_rotation), self._mask(state)])

    def _waypoints(self, key: Array) -> tuple[Array, Array]:
        del key
        poses = jnp.asarray(FIXED_WAYPOINTS[: self.num_waypoints], jnp.float32)
        positions, matrices = poses[:, :3], jax.vmap(rotations.from_rotation_vector)(poses[:, 3:])
        if self.num_waypoints > len(FIXED_WAYPOINTS):
            more = random_waypoints(jax.random.key(0), self.num_waypoints - len(FIXED_WAYPOINTS))
            positions, matrices = jnp.concatenate([positions, more[0]]), jnp.concatenate([matrices, more[1]])
        return positions, matrices


@dataclass(frozen=True)
class ParameterizedReach(_Reach):
    """The waypoints are drawn anew in every episode, and observed (thesis 3.2.1).

    Observation: the hand's position (3), its orientation (6), a mask of the waypoints reached (K), and for each waypoint the displacement (3, in m)
    and the rotation vector (3, in rad) from the hand to it: first the waypoint whose turn it is, then those after it, then those reached. Achieved
    goal: the last waypoint's displacement and rotation vector, and the mask.
    """

    name: ClassVar[str] = "ParameterizedReach"

    @property
    def observation_dim(self) -> int:
        return self.pose_dim + 7 * self.num_waypoints

    @property
    def goal_dim(self) -> int:
        return 6 + self.num_waypoints

    def achieved_goal(self, observation: Array) -> Array:
        """(..., D) -> (..., 6 + K): what remains to the last waypoint, and the mask."""
        _, mask, remaining = self._parts(observation)
        place = jnp.mod(self.num_waypoints - 1 - jnp.sum(mask, axis=-1).astype(jnp.int32), self.num_waypoints)
        last = jnp.take_along_axis(remaining, place[..., None, None], axis=-2)[..., 0, :]
        return jnp.concatenate([last, mask], axis=-1)

    def task_goal(self) -> Array:
        """(6 + K,) nothing remains, and all is reached."""
        return jnp.concatenate([jnp.zeros(6), jnp.ones(self.num_waypoints)])

    @property
    def num_subgoals(self) -> int:
        """One for each waypoint."""
        return self.num_waypoints

    def relabel_observations(self, key: Array, observations: Array, subgoals: Array) -> tuple[Array, Array]:
        """What would have been observed if the waypoints that remain had been where the hand was in other states.

        The waypoints do not affect the motion of the arm, so this is exact. How many waypoints have been reached at the beginning is as recorded or
        drawn uniformly, with equal chances. Without the draws, no row could be about a later waypoint before the policy has found the first.

        Args:
          key: random key.
          observations: (n + 1, D) of consecutive states, the task not solved in the first.
          subgoals: (K, D) observations of the states whose poses become the remaining waypoints, in the order in which these are to be reached. If
            only r waypoints remain, the first r are used.

        Returns:
          The relabelled observations (n + 1, D), and (n,) bool for each but the first, whether the task is solved there.
        """
        key_choice, key_count = jax.random.split(key)
        poses, masks, remaining = self._parts(observations)
        positions, matrices = jax.vmap(self._from_pose)(poses)
        recorded = jnp.sum(masks[0]).astype(jnp.int32)
        drawn = jax.random.randint(key_count, (), 0, self.num_waypoints)
        count = jnp.where(jax.random.bernoulli(key_choice), recorded, drawn)

        displacements, turns = jnp.split(jnp.roll(remaining[0], recorded, axis=0), 2, axis=-1)
        old_positions = positions[:1] + displacements
        old_matrices = jnp.sum(jax.vmap(rotations.from_rotation_vector)(turns)[:, :, :, None] * matrices[0][None, None], axis=2)
        new_positions, new_matrices = jax.vmap(self._from_pose)(self._parts(jnp.roll(subgoals, count, axis=0))[0])
        moved = jnp.arange(self.num_waypoints) >= count
        waypoints = jnp.where(moved[:, None], new_positions, old_positions), jnp.where(moved[:, None, None], new_matrices, old_matrices)

        remaining = jax.vmap(_remaining, (0, 0, None, None))(positions, matrices, *waypoints)  # (n + 1, K, 6)
        within = jax.vmap(jax.vmap(self._is_within, (None, None, 0, 0)), (0, 0, None, None))(positions, matrices, *waypoints)  # (n + 1, K)

        def arrive(count: Array, within: Array) -> tuple[Array, Array]:
            count = count + jnp.any(within & (jnp.arange(self.num_waypoints) == count))
            return count, count

        _, counts = jax.lax.scan(arrive, count, within[1:])
        counts = jnp.concatenate([count[None], counts])
        return jax.vmap(self._joined)(poses, counts, remaining), counts[1:] >= self.num_waypoints

    def _parts(self, observation: Array) -> tuple[Array, Array, Array]:
        """(..., D) -> the pose (..., P), the mask (..., K), and what remains to each waypoint (..., K, 6) as it is ordered there."""
        pose, mask, remaining = jnp.split(observation, [self.pose_dim, self.pose_dim + self.num_waypoints], axis=-1)
        return pose, mask, remaining.reshape((*remaining.shape[:-1], self.num_waypoints, 6))

    def _joined(self, pose: Array, num_reached: Array, remaining: Array) -> Array:
        """The observation of a pose (P,), a number of waypoints reached (), and what remains to each waypoint (K, 6), from first to last."""
        mask = (jnp.arange(self.num_waypoints) < num_reached).astype(jnp.float32)
        return jnp.concatenate([pose, mask, jnp.roll(remaining, -num_reached, axis=0).reshape(-1)])

    def _from_pose(self, pose: Array) -> tuple[Array, Array]:
        """The inverse of `_pose`: (P,) -> a position (3,) and a rotation matrix (3, 3)."""
        orientation = rotations.from_six_d if self.orientation == "six_d" else rotations.from_rotation_vector
        return pose[:3], orientation(pose[3:])

    def _observe(self, state: ReachState, arm: panda.Posture) -> Array:
        remaining = _remaining(arm.hand_position, arm.hand_rotation, state.positions, state.rotations)
        return self._joined(self._pose(arm.hand_position, arm.hand_rotation), state.num_reached, remaining)

    def _observation_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        low, high = super()._observation_bounds()
        reach = panda.longest_reach()
        nearest, farthest = ([corner + sign * reach for corner in box] for box, sign in ((LOWEST, -1.0), (HIGHEST, 1.0)))
        remaining = [np.array(self.num_waypoints * [*place, *turn], np.float32) for place, turn in ((nearest, 3 * [-np.pi]), (farthest, 3 * [np.pi]))]
        return np.concatenate([low, remaining[0]]), np.concatenate([high, remaining[1]])

    def _waypoints(self, key: Array) -> tuple[Array, Array]:
        return random_waypoints(key, self.num_waypoints)


def _remaining(hand_position: Array, hand_rotation: Array, positions: Array, matrices: Array) -> Array:
    """(K, 6) displacement in m and rotation vector in rad from the hand to each of K poses."""
    turns = jax.vmap(rotations.between, (None, 0))(hand_rotation, matrices)
    return jnp.concatenate([positions - hand_position[None], turns], axis=1)


def random_waypoints(key: Array, count: int) -> tuple[Array, Array]:
    """Positions (count, 3), uniform in the box, and matrices (count, 3, 3): a hand pointing down, turned by up to pi/4 about a random axis."""
    key_position, key_axis, key_angle = jax.random.split(key, 3)
    low, high = (jnp.broadcast_to(jnp.asarray(corner), (count, 3)) for corner in (LOWEST, HIGHEST))
    positions = jax.random.uniform(key_position, (count, 3), minval=low, maxval=high)
    axes = jax.random.normal(key_axis, (count, 3))
    axes = axes / jnp.sqrt(jnp.sum(jnp.square(axes), axis=1, keepdims=True))
    turns = jax.vmap(rotations.from_rotation_vector)(axes * jax.random.uniform(key_angle, (count, 1), maxval=MAX_TILT))
    return positions, jnp.sum(turns[:, :, :, None] * _DOWN[None, None, :, :], axis=2)
