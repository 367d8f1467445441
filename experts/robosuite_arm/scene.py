"""What our environments of robosuite share, and the one of the reach tasks: the arm, its controller, and waypoints to look at.

The controller is robosuite's IK_POSE at 20 Hz, with its broken default input type put right; `hindrl_jax.envs.panda.controller` restates it.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from hindrl_jax.envs import panda
from hindrl_jax.experts.robosuite_arm.installation import import_robosuite, quiet

_WAYPOINT_GREEN = (0.1, 0.8, 0.1)
_LEAST_OPAQUE = 0.25
GRIPPER_CLOSED = 1.0
"""The action of the gripper that keeps the fingers closed."""
_BASE, _HAND, _GRIP_SITE = "robot0_link0", "robot0_right_hand", "gripper0_right_grip_site"


@functools.cache
def scene_class() -> type[Any]:
    """`RobosuiteScene`, what our environments of robosuite share; a class that can exist only once robosuite does.

    Raises:
      UserError: see `import_robosuite`.
    """
    import_robosuite()
    with quiet():
        from robosuite.environments.manipulation.manipulation_env import ManipulationEnv
        from robosuite.models.arenas import EmptyArena
        from robosuite.models.tasks import ManipulationTask

    class RobosuiteScene(ManipulationEnv):
        """Pandas on their pedestals, moved at 20 Hz by robosuite's IK_POSE, shown in a window that stays open."""

        def __init__(self, num_arms: int, **options: Any):
            """`options` are those of robosuite's ManipulationEnv, for example has_renderer."""
            defaults = dict(
                robots=num_arms * ["Panda"],
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

        def build(self, fill: Callable[[Any], None]) -> None:
            """Makes the model: the robots, where they are now, and an empty room that `fill` is called with."""
            arena = EmptyArena()
            arena.set_origin([0, 0, 0])
            fill(arena)
            self.model = ManipulationTask(mujoco_arena=arena, mujoco_robots=[robot.robot_model for robot in self.robots])

        def reward(self, action: Any = None) -> float:
            del action
            return float(self._check_success())

        def _destroy_viewer(self) -> None:
            # robosuite closes the window at every reset; when the model stays the same, it can stay open as well.
            if self.hard_reset or self.sim is None:
                super()._destroy_viewer()

        def close(self) -> None:
            super()._destroy_viewer()
            super().close()

    return RobosuiteScene


@functools.cache
def environment_class() -> type[Any]:
    """`RobosuiteReach`, likewise.

    Raises:
      UserError: see `import_robosuite`.
    """
    base: Any = scene_class()
    with quiet():
        import mujoco
        from robosuite.utils.mjcf_utils import new_site

    class RobosuiteReach(base):
        """A robosuite environment: a Panda on its pedestal reaches waypoints in order; the reward is 1 when the last one is reached, and 0 before.

        Waypoints are green capsules along the hand's approach, the less opaque the later, each with a bar along which the fingers open.
        Call `place` before `reset`. Observations are robosuite's and `waypoints_reached`, a mask (K,).
        """

        def __init__(self, num_waypoints: int = 2, position_tolerance: float = 0.02, rotation_tolerance: float = 0.05, **options: Any):
            """`options` are those of robosuite's ManipulationEnv, for example has_renderer."""
            self.positions = np.zeros((num_waypoints, 3))
            self.rotations = np.tile(np.eye(3), (num_waypoints, 1, 1))
            self.position_tolerance, self.rotation_tolerance = position_tolerance, rotation_tolerance
            self.num_reached = 0
            super().__init__(1, **options)

        def place(self, positions: np.ndarray, rotations: np.ndarray) -> None:
            """Sets the waypoints of the episodes to come: positions (K, 3) in m and rotation matrices (K, 3, 3), in the axes of the robot's base."""
            self.positions, self.rotations = np.asarray(positions, float), np.asarray(rotations, float)

        def _load_model(self) -> None:
            super()._load_model()
            robot = self.robots[0].robot_model
            robot.set_base_xpos(robot.base_xpos_offset["empty"])
            self.build(self._add_waypoints)

        def _add_waypoints(self, arena: Any) -> None:
            for index, opacity in enumerate(np.linspace(1.0, _LEAST_OPAQUE, len(self.positions))):
                rgba = (*_WAYPOINT_GREEN, opacity)
                arena.worldbody.append(new_site(f"waypoint{index}", rgba, size=(0.012, 0.04), type="capsule"))
                arena.worldbody.append(new_site(f"waypoint{index}_fingers", rgba, size=(0.003, 0.04, 0.003), type="box"))

        def _reset_internal(self) -> None:
            super()._reset_internal()
            self.num_reached = 0
            robot = self.robots[0]
            (arm,) = robot.arms
            # The fingers stay closed (thesis 3.2.1), and so they start closed, although robosuite has them half open.
            self.sim.data.qpos[robot._ref_gripper_joint_pos_indexes[arm]] = 0.0
            robot.gripper[arm].current_action = GRIPPER_CLOSED * np.array([-1.0, 1.0])
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

    return RobosuiteReach


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
