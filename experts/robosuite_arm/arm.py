"""Scenes in robosuite, moved by commands, with or without a window; and the one of the reach tasks, a Panda."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from hindrl_jax.base.errors import UserError, one_line
from hindrl_jax.envs import panda
from hindrl_jax.envs.reach import ReachState
from hindrl_jax.experts.robosuite_arm.installation import ROBOSUITE_VERSION, quiet
from hindrl_jax.experts.robosuite_arm.scene import GRIPPER_CLOSED, environment_class

_VIEW = dict(lookat=(-0.1, 0.0, 1.15), distance=1.3, azimuth=180.0, elevation=-25.0)  # from the front, where "right" is right; the mouse turns it


class RobosuiteScene:
    """An environment of robosuite, with or without a window."""

    def __init__(self, build: Callable[..., Any], *, on_screen: bool, view: dict[str, Any]):
        """Builds the scene.

        Args:
          build: makes the environment, given more options of robosuite's.
          on_screen: whether to show it in a window, which `refresh` opens.
          view: from where, as MuJoCo's free camera.

        Raises:
          UserError: if robosuite cannot be imported or lacks files, or there is no screen to show it on.
        """
        if on_screen:
            check_screen()
        window = dict(has_renderer=True, renderer="mjviewer", render_camera=None, renderer_config=dict(cam_config=view)) if on_screen else {}
        try:
            with quiet():
                self.environment = build(**window)
        except (OSError, ValueError) as error:
            raise UserError(
                f"robosuite cannot build its scene ({one_line(error)}): files of it are missing or damaged, "
                f"{sys.executable} -m pip install --force-reinstall --no-deps robosuite=={ROBOSUITE_VERSION}"
            ) from error

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
        """Hides what keys have made the window show: those that steer are also its shortcuts for cameras, hulls and the like."""
        import mujoco

        window = self.environment.viewer and self.environment.viewer.viewer
        if window and window.is_running():
            with window.lock():
                window.opt.flags[:] = mujoco.MjvOption().flags


class RobosuiteArm(RobosuiteScene):
    """One Panda in robosuite, its fingers closed."""

    def __init__(self, num_waypoints: int = 2, *, on_screen: bool = False, **tolerances: float):
        """Builds the scene.

        Args:
          num_waypoints: how many poses to draw.
          on_screen: whether to show it in a window, which `refresh` opens.
          **tolerances: position_tolerance and rotation_tolerance of the environment's own reward, which nothing here needs.

        Raises:
          UserError: as `RobosuiteScene`.
        """
        super().__init__(lambda **window: environment_class()(num_waypoints, **tolerances, **window), on_screen=on_screen, view=_VIEW)

    def begin(self, state: ReachState) -> None:
        """Puts arm and waypoints where they are in a state at reset."""
        self.reset(*jax.device_get((state.joints, state.positions, state.rotations)))

    def reset(self, joints: np.ndarray, positions: np.ndarray | None = None, rotations: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Puts the arm at rest, and the waypoints where they are drawn.

        Args:
          joints: (7,) rad, where the arm is, and towards which its null space then pulls.
          positions, rotations: (K, 3) in m and (K, 3, 3) of the waypoints, in the base's axes. Without them the waypoints stay where they were.

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
        self.environment.step(np.append(np.asarray(command, float), GRIPPER_CLOSED))
        self._undo_shortcuts()
        return self._joints()

    def _joints(self) -> tuple[np.ndarray, np.ndarray]:
        data = self.environment.sim.data
        return np.array(data.qpos[: panda.NUM_JOINTS]), np.array(data.qvel[: panda.NUM_JOINTS])


def check_screen() -> None:
    """Makes sure that there is a screen to open a window on.

    Raises:
      UserError: if there is none.
    """
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise UserError("recording by hand needs a screen, and neither DISPLAY nor WAYLAND_DISPLAY is set: start it from a desktop session")
