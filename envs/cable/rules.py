"""The rules of the two cable tasks of thesis sections 3.2.3 and 3.2.4: two Panda arms take the ends of two hanging cables, at 20 Hz.

What is observed, rewarded, drawn at reset and cut off at the horizon stands here, and is the same for all back ends.

Differences from the thesis:
  * The observation holds the axes of plug and socket, without which it does not determine whether the plug is inserted, and whether the task is
    solved, so that a goal can say so. `observation="thesis"` gives the original code's 31 numbers, which do neither.
  * The horizon is 450 and 750 control steps: 300 is too short at the speed that robosuite's limits on a command allow.
  * The hand tilts by 40 degrees to grasp, since one that lies flat, as in the thesis's pictures, is out of the arms' reach at the cables' places.
  * Joints vary at reset by 0.02 rad, as in the original code.
  * Commanded rotations are about the world's axes, as in robosuite's controller.
"""

from __future__ import annotations

import abc
import functools
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np

from hindrl_jax.base.checks import check, check_types
from hindrl_jax.base.types import Array, TimeStep
from hindrl_jax.envs import panda, rotations
from hindrl_jax.envs.cable import chains, closed_form, geometry, mjx_dynamics, mujoco_dynamics
from hindrl_jax.envs.cable.types import Backend, CableState, Scene

_ACTION_BOUND = np.array(2 * (3 * [panda.MAX_TRANSLATION] + 3 * [panda.MAX_ROTATION] + [1.0]), np.float32)
_FINGER_STEP = 0.004  # m, by which a gripper's command moves the fingers' targets in a control step, as in robosuite

_TILT = np.radians(40.0)
GRASP = np.array([[np.cos(_TILT), 0.0, -np.sin(_TILT)], [0.0, 1.0, 0.0], [np.sin(_TILT), 0.0, np.cos(_TILT)]]) @ geometry.HANGING
"""(3, 3) a hand that takes a hanging head, tilted by 40 degrees from pointing straight down."""
MEETING = np.array([-0.39, 0.008, 1.42])
"""(3,) m, in the middle of where both arms bring their heads: below 1.36 m the cables are taut."""
_QUARTER_TURN = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # about x
MEETING_HEADS = np.stack([_QUARTER_TURN.T, _QUARTER_TURN]) @ geometry.HANGING
"""(2, 3, 3) heads in line along y, the plug's axis towards -y."""


@dataclass(frozen=True)
class CableTask(abc.ABC):
    """What both tasks share. They differ in where the plug's tip is to be, and how exactly.

    Observation: position (3, m, in the world) and orientation (6) of each hand; from each hand to its head's grip site (3, m); from where the plug's
    tip is to be to where it is (3, m); whether each head is held (2); each gripper's opening (2, m); the axes of plug and socket (2 x 3); whether the
    task is solved (1). The plug's arm comes first. Achieved goal: all of it, as in the thesis.
    """

    name: ClassVar[str]
    render_fps: ClassVar[int] = round(1 / panda.CONTROL_PERIOD)
    """Steps shown per second of a film: real time."""

    horizon: int = 450
    """Number of steps, of 50 ms each, after which an episode is truncated."""
    joint_noise: float = 0.02
    """Standard deviation in rad of the joints at reset."""
    observation: Literal["full", "thesis"] = "full"
    """What is observed: all that the task depends on, or the original code's 31 numbers."""
    randomised: bool = False
    """Whether the cables' weight, and how the socket takes the plug, are drawn again for each episode, within 30%; only in closed form."""
    num_links: int = 5
    """Links of each cable in MuJoCo; the closed form's have none."""
    backend: Backend = "closed_form"
    """Who simulates: closed_form (for bulk training), mujoco (C MuJoCo, many episodes side by side, some fifty times slower), mjx (the same
    equations in JAX, for GPUs; not to insert, as it throws out of the hand a plug that is pressed against the bore), or robosuite (its arms, on the
    CPU, to record by hand or to evaluate)."""

    def __post_init__(self):
        check_types(self)
        check(
            self,
            horizon=(self.horizon >= 1, "at least 1"),
            joint_noise=(self.joint_noise >= 0, "0 or more"),
            randomised=(not self.randomised or self.backend == "closed_form", f"false with backend = {self.backend}"),
            num_links=(2 <= self.num_links <= 20, "from 2 to 20"),
        )

    @property
    def steps_in_jax(self) -> bool:
        """False with robosuite, which simulates outside JAX; see `hindrl_jax.base.environments.can_step`."""
        return self.backend != "robosuite"

    @property
    def compiler_options(self) -> dict[str, Any]:
        """Options for XLA programs that step this environment."""
        return mjx_dynamics.compiler_options() if self.backend == "mjx" else {}

    @property
    def action_dim(self) -> int:
        return 14

    @property
    def action_low(self) -> np.ndarray:
        """(14,) for each arm m, rad, and the gripper's command, which opens where it is negative."""
        return -_ACTION_BOUND

    @property
    def action_high(self) -> np.ndarray:
        """(14,) likewise; it closes where it is positive."""
        return _ACTION_BOUND

    @property
    def observation_dim(self) -> int:
        return 38 if self.observation == "full" else 31

    @property
    def goal_dim(self) -> int:
        return self.observation_dim

    @property
    def state_dim(self) -> int:
        """Length of `state_to_vector`; it depends on the back end."""
        shapes = self._shapes()
        return sum(leaf.size for leaf in jax.tree.leaves((shapes.rest, shapes.finger_targets, shapes.physics, shapes.step)))

    def achieved_goal(self, observation: Array) -> Array:
        """The observation itself (thesis section 3.2.3)."""
        return observation

    def task_goal(self) -> Array:
        """(G,) a state in which the task is solved, in the middle of where both arms reach."""
        return self._observe(_solved_scene(self.depth))

    @property
    def goal_tolerance(self) -> np.ndarray | None:
        """(G,) half-width of a box around `task_goal()`: a state solves the task if and only if its achieved goal lies in the box. The last entry
        alone decides; where the plug's tip is follows, and all else may be anything. None with the thesis's observation, which cannot tell."""
        if self.observation == "thesis":
            return None
        low, high = self._observation_bounds()
        tolerance = high - low
        tolerance[24:27], tolerance[-1] = self.tip_tolerance, 0.0
        return tolerance

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
    def depth(self) -> float:
        """How far in the socket the plug's tip is to be, m."""

    @property
    @abc.abstractmethod
    def tip_tolerance(self) -> float:
        """How far from there it may be, m."""

    @abc.abstractmethod
    def is_solved(self, scene: Scene) -> Array:
        """() bool"""

    def reset(self, key: Array) -> tuple[CableState, Array]:
        """Starts an episode: key -> (state, observation (D,))."""
        key_episode, key_joints, key_physics = jax.random.split(key, 3)
        joints = panda.joints_at_reset(key_joints, self.joint_noise, 2)
        if self.backend == "closed_form":
            physics: Any = closed_form.start(key_physics, joints, randomised=self.randomised)
        else:
            physics = chains.start(joints, self.num_links)
        state = CableState(
            key=key_episode,
            rest=joints,
            finger_targets=jnp.full(2, geometry.MAX_FINGER / 2, jnp.float32),
            physics=physics,
            scene=self._dynamics.scene(physics),
            step=jnp.zeros((), jnp.int32),
        )
        return state, self.observe(state)

    def step(self, state: CableState, action: Array) -> tuple[CableState, TimeStep]:
        """Takes one control step of 50 ms.

        Args:
          state: the state to step from.
          action: (14,) for each arm the displacement of the hand in m, its rotation vector in rad, both in the world's axes, and the gripper's
            command, of which only the sign counts; clipped to +-0.02, +-0.05 and +-1. The controller then shortens both vectors to these lengths, and
            the arm follows with inertia: a few millimetres per step.

        Returns:
          The next state, and the time step with the true next observation.

        Raises:
          ValueError: with the robosuite back end.
        """
        if not self.steps_in_jax:
            raise ValueError("robosuite simulates outside JAX and cannot be compiled: use play_in_robosuite of hindrl_jax.experts.robosuite_arm")
        commands = jnp.clip(action, self.action_low, self.action_high).reshape(2, 7)
        finger_targets = jnp.clip(state.finger_targets - _FINGER_STEP * jnp.sign(commands[:, 6]), 0.0, geometry.MAX_FINGER)
        return self.arrive(state, finger_targets, self._dynamics.control_step(state.physics, state.rest, finger_targets, commands[:, :6]))

    def arrive(self, state: CableState, finger_targets: Array, physics: Any) -> tuple[CableState, TimeStep]:
        """The rest of a step, once arms and cables have moved: rewards and observes.

        Args:
          state: before the step.
          finger_targets: (2,) m, where the grippers' commands want the fingers.
          physics: after it, in the form of the back end: that of `chains` for MuJoCo, MJX and robosuite.

        Returns:
          As `step`.
        """
        scene = self._dynamics.scene(physics)
        state = state.replace(finger_targets=finger_targets, physics=physics, scene=scene, step=state.step + 1)
        terminated = self.is_solved(scene)
        return state, TimeStep(
            observation=self.observe(state),
            reward=terminated.astype(jnp.float32),
            terminated=terminated,
            truncated=(state.step >= self.horizon) & ~terminated,
        )

    def observe(self, state: CableState) -> Array:
        """The observation (D,) float32 of a state."""
        return self._observe(state.scene)

    def state_to_vector(self, state: CableState) -> Array:
        """(state_dim,) float32: all of the state but its key and what follows from the rest."""
        parts = (state.rest, state.finger_targets, self._dynamics.compact(state.physics), state.step)
        return jnp.concatenate([jnp.ravel(leaf).astype(jnp.float32) for leaf in jax.tree.leaves(parts)])

    def vector_to_state(self, key: Array, vector: Array) -> CableState:
        """The inverse of `state_to_vector`: (state_dim,) -> the state, with `key` as its key."""
        shapes = self._shapes()
        parts, tree = jax.tree.flatten((shapes.rest, shapes.finger_targets, shapes.physics, shapes.step))
        pieces = jnp.split(jnp.asarray(vector, jnp.float32), np.cumsum([leaf.size for leaf in parts])[:-1])
        leaves = [piece.reshape(leaf.shape).astype(leaf.dtype) for piece, leaf in zip(pieces, parts, strict=True)]
        rest, finger_targets, compact, step = jax.tree.unflatten(tree, leaves)
        physics = self._dynamics.completed(compact)
        return CableState(key=key, rest=rest, finger_targets=finger_targets, physics=physics, scene=self._dynamics.scene(physics), step=step)

    @property
    def _dynamics(self) -> Any:
        """The module that simulates, or for robosuite, which does not, the one that knows its states."""
        return {"closed_form": closed_form, "mujoco": mujoco_dynamics, "mjx": mjx_dynamics, "robosuite": chains}[self.backend]

    def _shapes(self) -> CableState:
        """The shapes of a state, with its physics in their compact form."""
        return _compact_shapes(self)

    def _observe(self, scene: Scene) -> Array:
        hands = [jnp.concatenate([scene.hand_positions[i], rotations.to_six_d(scene.hand_rotations[i])]) for i in range(2)]
        is_full = self.observation == "full"
        parts = [
            *hands,
            (scene.head_positions - scene.hand_positions).reshape(-1),
            tip_error(scene, self.depth if is_full else 0.0),
            scene.held.astype(jnp.float32),
            2.0 * scene.fingers,
        ]
        if is_full:
            parts += [scene.head_rotations[:, :, 2].reshape(-1), self.is_solved(scene).astype(jnp.float32)[None]]
        return jnp.concatenate(parts)

    def _observation_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """What `observation_low` and `observation_high` return."""
        arm, cable = panda.longest_reach(), geometry.CABLE_LENGTH + 0.1
        low, high = [], []
        for base in geometry.BASES:
            low += [*(base - arm), *6 * [-1.0]]
            high += [*(base + arm), *6 * [1.0]]
        for base, anchor in zip(geometry.BASES, geometry.ANCHORS, strict=True):
            low += [*(anchor - cable - base - arm)]
            high += [*(anchor + cable - base + arm)]
        between = geometry.ANCHORS[0] - geometry.ANCHORS[1]
        reach = 2 * (cable + 0.1)
        low += [*(between - reach), 0.0, 0.0, 0.0, 0.0]
        high += [*(between + reach), 1.0, 1.0, *2 * [2.0 * geometry.MAX_FINGER + 0.01]]
        if self.observation == "full":
            low += [*6 * [-1.0], 0.0]
            high += [*6 * [1.0], 1.0]
        return np.array(low, np.float32), np.array(high, np.float32)


@functools.cache
def _compact_shapes(env: CableTask) -> CableState:
    state, _ = jax.eval_shape(env.reset, jax.random.key(0))
    return state.replace(physics=jax.eval_shape(env._dynamics.compact, state.physics))


def tip_error(scene: Scene, depth: float) -> Array:
    """(3,) m, from where the plug's tip is to be, `depth` below the socket's tip, to where it is."""
    plug, socket = scene.head_rotations[:, :, 2]
    tip = scene.head_positions[0] + geometry.to_tip(0) * plug
    return tip - scene.head_positions[1] - (geometry.to_tip(1) - depth) * socket


def _solved_scene(depth: float) -> Scene:
    """Both heads in line along y, the plug's tip `depth` in the socket, each in the middle of a hand that is tilted as at the grasp."""
    hands = MEETING_HEADS @ geometry.HANGING.T @ GRASP
    places = np.stack([MEETING - (geometry.to_tip(i) - i * depth) * MEETING_HEADS[i, :, 2] for i in range(2)])
    return Scene(
        hand_positions=jnp.asarray(places, jnp.float32),
        hand_rotations=jnp.asarray(hands, jnp.float32),
        head_positions=jnp.asarray(places, jnp.float32),
        head_rotations=jnp.asarray(MEETING_HEADS, jnp.float32),
        fingers=jnp.full(2, geometry.FINGER_TOUCHING),
        held=jnp.ones(2, bool),
    )
