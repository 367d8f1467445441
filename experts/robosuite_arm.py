"""The reach tasks simulated by robosuite itself: one arm on the CPU, to record demonstrations and to evaluate policies.

Everything about robosuite is in this module. It only moves the arm: waypoints and start come from `env.reset`; observation, reward and progress
from `env.arrive`, as with the other back ends. The controller is robosuite's IK_POSE at 20 Hz, with its broken default input type put right;
`hindrl_jax.envs.reach.panda` restates it.

robosuite takes seconds to import and half a gigabyte of disk, so it is optional and imported only when an arm is asked for.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
import io
import logging
import os
import sys
import warnings
from collections.abc import Callable, Iterator
from importlib import metadata
from types import ModuleType
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from hindrl_jax.base.environments import action_from_env
from hindrl_jax.base.errors import UserError, one_line
from hindrl_jax.base.types import Array, Episodes, TimeStep
from hindrl_jax.envs.reach import panda
from hindrl_jax.envs.reach.parameterized_reach import FixedParameterizedReach, ParameterizedReach, ReachState

ReachEnvironment = FixedParameterizedReach | ParameterizedReach
Act = Callable[[Array, ReachState, Array], Array]
"""(key, state, observation (D,)) -> action (6,) in the environment's own units."""
DeviceName = Literal["keyboard", "spacemouse"]

ROBOSUITE_VERSION, MUJOCO_SERIES = "1.5.1", "3.9"  # from MuJoCo 3.10 on, this robosuite fails to build any environment
INSTALL = f"{sys.executable} -m pip install robosuite=={ROBOSUITE_VERSION} 'mujoco=={MUJOCO_SERIES}.*'"
_WAYPOINT_GREEN = (0.1, 0.8, 0.1)
_LEAST_OPAQUE = 0.25
_GRIPPER_CLOSED = 1.0
_VIEW = dict(lookat=(-0.1, 0.0, 1.15), distance=1.3, azimuth=180.0, elevation=-25.0)  # from the front, where "right" is right; the mouse turns it


# ---------------------------------------------------------------------------------------------------------------------- importing robosuite


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keeps from the screen what robosuite prints and warns about, none of which concerns our users."""
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        warnings.simplefilter("ignore")
        yield


def check_versions() -> None:
    """Makes sure that robosuite is there and that it and MuJoCo go together, which pip does not.

    Raises:
      UserError: if not.
    """
    try:
        found = {name: metadata.version(name) for name in ("robosuite", "mujoco")}
    except metadata.PackageNotFoundError as error:
        raise UserError(f"the robosuite back end needs {error.name}, which is not installed: {INSTALL}") from None
    if found["robosuite"] != ROBOSUITE_VERSION or not f"{found['mujoco']}.".startswith(f"{MUJOCO_SERIES}."):
        raise UserError(
            f"the robosuite back end needs robosuite {ROBOSUITE_VERSION} with mujoco {MUJOCO_SERIES}, but robosuite {found['robosuite']} and "
            f"mujoco {found['mujoco']} are installed: {INSTALL}"
        )


@functools.cache
def import_robosuite() -> ModuleType:
    """robosuite, silenced for good.

    Raises:
      UserError: if it is missing, of another version, or cannot be imported.
    """
    check_versions()
    panda.import_mujoco()
    # Its logger sets its own level while it is imported, and complains at once; to be disabled is all that lasts.
    logging.getLogger("robosuite_logs").disabled = True
    drawing_with = os.environ.get("MUJOCO_GL")
    try:
        with _quiet():
            return importlib.import_module("robosuite")
    except ImportError as error:
        if ".so" in str(error):
            raise UserError(f"robosuite lacks a system library ({one_line(error)}): on Debian, apt-get install libgl1 libglib2.0-0") from error
        raise UserError(f"robosuite cannot be imported ({one_line(error)}): {INSTALL}") from error
    finally:
        # robosuite decides for the whole process how MuJoCo draws, but it is not the only one here that draws.
        if drawing_with is None:
            os.environ.pop("MUJOCO_GL", None)
        else:
            os.environ["MUJOCO_GL"] = drawing_with


# ----------------------------------------------------------------------------------------------------------------------- the environment


@functools.cache
def environment_class() -> type[Any]:
    """`RobosuiteReach`, a class that can exist only once robosuite does.

    Raises:
      UserError: see `import_robosuite`.
    """
    import_robosuite()
    with _quiet():
        import mujoco
        from robosuite.environments.manipulation.manipulation_env import ManipulationEnv
        from robosuite.models.arenas import EmptyArena
        from robosuite.models.tasks import ManipulationTask
        from robosuite.utils.mjcf_utils import new_site

    class RobosuiteReach(ManipulationEnv):
        """A robosuite environment: a Panda on its pedestal reaches waypoints in order; the reward is 1 when the last one is reached, and 0 before.

        Waypoints are green capsules along the hand's approach, the less opaque the later, each with a bar along which the fingers open.
        Call `place` before `reset`. To robosuite's observations comes `waypoints_reached`, a mask.
        """

        def __init__(self, num_waypoints: int = 2, position_tolerance: float = 0.02, rotation_tolerance: float = 0.05, **options: Any):
            """`options` are those of robosuite's ManipulationEnv, for example has_renderer."""
            self.positions = np.zeros((num_waypoints, 3))
            self.rotations = np.tile(np.eye(3), (num_waypoints, 1, 1))
            self.position_tolerance, self.rotation_tolerance = position_tolerance, rotation_tolerance
            self.num_reached = 0
            defaults = dict(
                robots="Panda",
                controller_configs=_controller_config(),
                initialization_noise=None,
                control_freq=round(1 / panda.CONTROL_PERIOD),
                use_camera_obs=False,
                has_offscreen_renderer=False,
                renderer="mujoco",  # which, without a window, does nothing; the other one looks for a screen all the same
                hard_reset=False,
                ignore_done=True,
            )
            super().__init__(**defaults | options)

        def place(self, positions: np.ndarray, rotations: np.ndarray) -> None:
            """Sets the waypoints of the episodes to come: positions (K, 3) in m and rotation matrices (K, 3, 3), in the axes of the robot's base."""
            self.positions, self.rotations = np.asarray(positions, float), np.asarray(rotations, float)

        def reward(self, action: Any = None) -> float:
            del action
            return float(self._check_success())

        def _load_model(self) -> None:
            super()._load_model()
            robot = self.robots[0].robot_model
            robot.set_base_xpos(robot.base_xpos_offset["empty"])
            arena = EmptyArena()
            arena.set_origin([0, 0, 0])
            for index, opacity in enumerate(np.linspace(1.0, _LEAST_OPAQUE, len(self.positions))):
                rgba = (*_WAYPOINT_GREEN, opacity)
                arena.worldbody.append(new_site(f"waypoint{index}", rgba, size=(0.012, 0.04), type="capsule"))
                arena.worldbody.append(new_site(f"waypoint{index}_fingers", rgba, size=(0.003, 0.04, 0.003), type="box"))
            self.model = ManipulationTask(mujoco_arena=arena, mujoco_robots=[robot])

        def _reset_internal(self) -> None:
            super()._reset_internal()
            self.num_reached = 0
            robot = self.robots[0]
            (arm,) = robot.arms
            # The fingers stay closed (thesis 3.2.1), and so they start closed, although robosuite has them half open.
            self.sim.data.qpos[robot._ref_gripper_joint_pos_indexes[arm]] = 0.0
            robot.gripper[arm].current_action = _GRIPPER_CLOSED * np.array([-1.0, 1.0])
            self.sim.forward()
            base = self.sim.data.body(_BASE)
            axes = base.xmat.reshape(3, 3)
            for index, (position, rotation) in enumerate(zip(self.positions, self.rotations, strict=True)):
                for suffix in ("", "_fingers"):
                    site = self.sim.model.site(f"waypoint{index}{suffix}")
                    site.sameframe[:] = 0  # else MuJoCo goes on leaving it at the origin, where the model was compiled with it
                    site.pos[:] = base.xpos + axes @ position
                    mujoco.mju_mat2Quat(site.quat, (axes @ rotation).reshape(-1))

        def _post_action(self, action: np.ndarray) -> tuple[float, bool, dict[str, Any]]:
            if not self._check_success():
                self.num_reached += self._reaches(self.num_reached)
            return super()._post_action(action)

        def _reaches(self, index: int) -> bool:
            """Whether the hand is at a waypoint, by position and by angle."""
            base, axes = self.sim.data.body(_BASE).xpos, self.sim.data.body(_BASE).xmat.reshape(3, 3)
            position = axes.T @ (self.sim.data.site(_GRIP_SITE).xpos - base)
            rotation = axes.T @ self.sim.data.body(_HAND).xmat.reshape(3, 3)
            cosine = (np.trace(rotation.T @ self.rotations[index]) - 1.0) / 2.0
            distance, angle = np.linalg.norm(position - self.positions[index]), np.arccos(np.clip(cosine, -1.0, 1.0))
            return bool(distance < self.position_tolerance and angle < self.rotation_tolerance)

        def _check_success(self) -> bool:
            return self.num_reached >= len(self.positions)

        def _get_observations(self, force_update: bool = False) -> dict[str, np.ndarray]:
            observations = super()._get_observations(force_update)
            observations["waypoints_reached"] = (np.arange(len(self.positions)) < self.num_reached).astype(float)
            return observations

        def _destroy_viewer(self) -> None:
            # robosuite closes the window at every reset; when the model stays the same, it can stay open as well.
            if self.hard_reset or self.sim is None:
                super()._destroy_viewer()

        def close(self) -> None:
            super()._destroy_viewer()
            super().close()

    return RobosuiteReach


_BASE, _HAND, _GRIP_SITE = "robot0_link0", "robot0_right_hand", "gripper0_right_grip_site"


def _controller_config() -> dict[str, Any]:
    """IK_POSE for the arm. Its default input type, "delta", makes it add joint targets to joints: a command of zeros then flings the arm about."""
    arm = dict(
        type="IK_POSE",
        input_type="absolute",
        ik_pos_limit=panda.MAX_TRANSLATION,
        ik_ori_limit=panda.MAX_ROTATION,
        interpolation=None,
        ramp_ratio=0.2,
        gripper=dict(type="GRIP"),
    )
    return dict(type="BASIC", body_parts=dict(right=arm))


class RobosuiteArm:
    """One Panda in robosuite, its fingers closed."""

    def __init__(self, num_waypoints: int = 2, *, on_screen: bool = False, **tolerances: float):
        """Builds the scene.

        Args:
          num_waypoints: how many poses to draw.
          on_screen: whether to show it in a window, which `refresh` opens.
          **tolerances: position_tolerance and rotation_tolerance of the environment's own reward, which nothing here needs.

        Raises:
          UserError: if robosuite cannot be imported or lacks files, or there is no screen to show it on.
        """
        if on_screen:
            check_screen()
        environment = environment_class()
        window = dict(has_renderer=True, renderer="mjviewer", render_camera=None, renderer_config=dict(cam_config=_VIEW)) if on_screen else {}
        try:
            with _quiet():
                self.environment = environment(num_waypoints, **tolerances, **window)
        except (OSError, ValueError) as error:
            raise UserError(
                f"robosuite cannot build its scene ({one_line(error)}): files of it are missing or damaged, "
                f"{sys.executable} -m pip install --force-reinstall --no-deps robosuite=={ROBOSUITE_VERSION}"
            ) from error

    def reset(self, joints: np.ndarray, positions: np.ndarray | None = None, rotations: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Puts the arm at rest at joints (7,), towards which its null space then pulls, and the waypoints at positions (K, 3), rotations (K, 3, 3).

        Returns:
          Joints and velocities (7,), in rad and rad/s.
        """
        if positions is not None:
            self.environment.place(positions, rotations)
        self.environment.robots[0].init_qpos = np.asarray(joints, float)
        self.environment.reset()
        return self._joints()

    def step(self, command: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Moves for one control step of 50 ms.

        Args:
          command: (6,) displacement of the grip site in m and rotation vector in rad, both in the base's axes.

        Returns:
          Joints and velocities (7,), in rad and rad/s.
        """
        self.environment.step(np.append(np.asarray(command, float), _GRIPPER_CLOSED))
        self._undo_shortcuts()
        return self._joints()

    def refresh(self) -> None:
        """Redraws the window, or opens it.

        Raises:
          UserError: if it cannot be opened.
        """
        try:
            self.environment.viewer.update()
        except RuntimeError as error:  # on macOS
            raise UserError(f"the window cannot be opened ({one_line(error)})") from error
        self._undo_shortcuts()

    def is_open(self) -> bool:
        """Whether the window is there, or has yet to be opened."""
        window = self.environment.viewer.viewer
        return window is None or window.is_running()

    def close(self) -> None:
        """Closes the window, if there is one, and frees the simulation."""
        self.environment.close()

    def _undo_shortcuts(self) -> None:
        """Hides what the window has been told to show: the keys that steer are also its shortcuts for cameras, hulls and the like."""
        import mujoco

        window = self.environment.viewer and self.environment.viewer.viewer
        if window and window.is_running():
            with window.lock():
                window.opt.flags[:] = mujoco.MjvOption().flags

    def _joints(self) -> tuple[np.ndarray, np.ndarray]:
        data = self.environment.sim.data
        return np.array(data.qpos[: panda.NUM_JOINTS]), np.array(data.qvel[: panda.NUM_JOINTS])


@functools.cache
def shared_arm(num_waypoints: int) -> RobosuiteArm:
    """Building one takes seconds, a reset milliseconds and leaves nothing behind: so all episodes share it."""
    return RobosuiteArm(num_waypoints)


# --------------------------------------------------------------------------------------------------------------------------- playing in it


def play_in_robosuite(key: Array, env: ReachEnvironment, act: Act, num_episodes: int) -> Episodes:
    """`hindrl_jax.experts.recording.play`, with the arm in robosuite: equal keys give the same starts, waypoints and keys for `act`.

    One episode after the other, on the host. `act` is compiled once, however often this is called with it.

    Args:
      key: random key.
      env: the task, of any back end.
      act: (key, state, observation (D,)) -> action (6,) in m and rad, which is clipped to the environment's bounds before it goes to robosuite.
      num_episodes: N.

    Returns:
      N episodes. Past the end of an episode observations and states are repeated, as `play` does, and actions are 0.

    Raises:
      UserError: if robosuite is missing or unusable.
    """
    arm = shared_arm(env.num_waypoints)
    episodes = [play_episode(key, env, arm, functools.partial(_act, act)) for key in jax.random.split(key, num_episodes)]
    return stacked(episodes)


def play_episode(key: Array, env: ReachEnvironment, arm: RobosuiteArm, act: Act) -> Episodes:
    """Plays one episode on the host.

    Args:
      key: random key.
      env: the task.
      arm: anything with the methods `reset` and `step` of `RobosuiteArm`.
      act: as for `play_in_robosuite`, but any Python function.

    Returns:
      NumPy leaves without the episode axis.
    """
    key_reset, key = jax.random.split(key)
    state, observation, vector = _start(env, key_reset)
    arm.reset(*jax.device_get((state.joints, state.positions, state.rotations)))
    observations, states, actions, rewards = [observation], [vector], [], []
    for _ in range(env.horizon):
        key, key_act = jax.random.split(key)
        action = act(key_act, state, observation)
        command, normalised = _command(env, action)
        joints, velocities = arm.step(np.asarray(command))
        state, time_step, vector = _arrive(env, state, np.float32(joints), np.float32(velocities))
        observation = time_step.observation
        actions.append(normalised)
        rewards.append(time_step.reward)
        observations.append(observation)
        states.append(vector)
        if time_step.terminated or time_step.truncated:
            break

    def repeated(rows: list[Array]) -> Any:
        return np.stack(jax.device_get(rows + rows[-1:] * (env.horizon + 1 - len(rows))))

    def padded(rows: list[Array]) -> Any:
        array = np.stack(jax.device_get(rows))
        return np.concatenate([array, np.zeros((env.horizon - len(rows), *array.shape[1:]), array.dtype)])

    ends: dict[str, Any] = dict(lengths=np.int32(len(actions)), terminated=np.bool_(time_step.terminated))
    return Episodes(
        observations=repeated(observations),
        actions=padded(actions),
        rewards=padded(rewards),
        desired_goals=jax.device_get(env.achieved_goal(observation)),
        states=repeated(states),
        **ends,
    )


def stacked(episodes: list[Episodes]) -> Episodes:
    """Single episodes as one table."""
    return jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *episodes)


@functools.partial(jax.jit, static_argnums=0)
def _act(act: Act, key: Array, state: ReachState, observation: Array) -> Array:
    return act(key, state, observation)


@functools.partial(jax.jit, static_argnums=0)
def _start(env: ReachEnvironment, key: Array) -> tuple[ReachState, Array, Array]:
    state, observation = env.reset(key)
    return state, observation, env.state_to_vector(state)


@functools.partial(jax.jit, static_argnums=0)
def _command(env: ReachEnvironment, action: Array) -> tuple[Array, Array]:
    """The action as robosuite gets it, and as it is recorded."""
    return jnp.clip(action, env.action_low, env.action_high), action_from_env(action, env)


@functools.partial(jax.jit, static_argnums=0)
def _arrive(env: ReachEnvironment, state: ReachState, joints: Array, velocities: Array) -> tuple[ReachState, TimeStep, Array]:
    state, time_step = env.arrive(state, joints, velocities)
    return state, time_step, env.state_to_vector(state)


# -------------------------------------------------------------------------------------------------------------------- devices for a person


def check_screen() -> None:
    """Makes sure that there is a screen to open a window on.

    Raises:
      UserError: if there is none.
    """
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise UserError("recording by hand needs a screen, and neither DISPLAY nor WAYLAND_DISPLAY is set: start it from a desktop session")


def open_device(name: DeviceName, arm: RobosuiteArm) -> Any:
    """One of robosuite's devices, listening.

    Args:
      name: which.
      arm: what it steers.

    Raises:
      UserError: if a package that it needs is missing or does not work here, or it is not plugged in.
    """
    try:
        with _quiet():
            importlib.import_module("pynput.keyboard")
    except ImportError as error:
        raise UserError(f"keys cannot be read here ({one_line(error)}): pip install pynput, and on Linux use an X11 session") from error
    try:
        with _quiet():  # the Python package hid is imported by the module itself, and missed by printing
            devices = importlib.import_module("robosuite.devices")
            device = devices.Keyboard if name == "keyboard" else importlib.import_module("robosuite.devices.spacemouse").SpaceMouse
    except ImportError as error:
        raise UserError(f"the {name} cannot be used ({one_line(error)}): pip install hidapi, and libhidapi-hidraw0 on Debian") from error
    try:
        with _quiet():
            return device(env=arm.environment)
    except OSError as error:
        raise UserError(f"the {name} cannot be opened ({one_line(error)}): is it plugged in, and may you read it?") from error
