"""The rules of the two reach tasks of thesis sections 3.2.1 and 3.2.2: a Panda arm brings its hand to a number of poses, in order, at 20 Hz.

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

from hindrl_jax.base.checks import check, check_types
from hindrl_jax.base.types import Array, TimeStep
from hindrl_jax.envs import panda, rotations
from hindrl_jax.envs.panda import closed_form, mjx_dynamics
from hindrl_jax.envs.reach.types import Backend, ReachState

_ACTION_BOUND = np.array(3 * [panda.MAX_TRANSLATION] + 3 * [panda.MAX_ROTATION], np.float32)


@dataclass(frozen=True)
class ReachTask(abc.ABC):
    """What both tasks share. They differ in where the waypoints are, and in whether these are observed."""

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
            num_waypoints=(1 <= self.num_waypoints <= 1000, "at least 1 and at most 1000"),
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
    def steps_in_jax(self) -> bool:
        """False with robosuite, which simulates one arm outside JAX; see `hindrl_jax.base.environments.can_step`."""
        return self.backend != "robosuite"

    @property
    def compiler_options(self) -> dict[str, Any]:
        """Options for XLA programs that step this environment."""
        return mjx_dynamics.compiler_options() if self.backend == "mjx" else {}

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
    def observation_dim(self) -> int:
        """D."""

    @property
    @abc.abstractmethod
    def goal_dim(self) -> int:
        """G."""

    @property
    def goal_tolerance(self) -> np.ndarray | None:
        """(G,) half-width of a box around `task_goal()`: a state solves the task if and only if its achieved goal lies in the box. None if there is
        no such box. The mask alone decides. The other entries are as wide as they must be, for where states of an episode are taken as goals."""
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
        joints = panda.joints_at_reset(key_joints, self.joint_noise)
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
        if not self.steps_in_jax:
            raise ValueError("robosuite simulates one arm outside JAX: record or evaluate with it, and train with closed_form or mjx")
        control_step = mjx_dynamics.control_step if self.backend == "mjx" else closed_form.control_step
        joints, velocities = control_step(state.joints, state.velocities, state.rest, jnp.clip(action, self.action_low, self.action_high))
        return self.arrive(state, joints, velocities)

    def arrive(self, state: ReachState, joints: Array, velocities: Array) -> tuple[ReachState, TimeStep]:
        """The rest of a step, once the arm has moved: counts waypoints, rewards and observes.

        Args:
          state: before the step.
          joints, velocities: (7,) after it, in rad and rad/s, from whatever simulates the arm.

        Returns:
          As `step`.
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

    @abc.abstractmethod
    def achieved_goal(self, observation: Array) -> Array:
        """Observations (..., D) -> achieved goals (..., G)."""

    @abc.abstractmethod
    def task_goal(self) -> Array:
        """(G,) the achieved goal of a state that solves the task, up to the tolerances."""

    def is_solved(self, state: ReachState) -> Array:
        """() bool, whether the last waypoint has been reached."""
        return state.num_reached >= self.num_waypoints

    def observe(self, state: ReachState) -> Array:
        """The observation (D,) float32 of a state. The docstring of each task says what is in it."""
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
