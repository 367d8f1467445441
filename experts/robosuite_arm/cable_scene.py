"""The cable tasks as an environment of robosuite: two of its Pandas, and the cables, plug and socket of our MuJoCo model.

What is not as in our own model:
  * The arms: robosuite's own meshes and masses, with dry friction and drag, under torques of its IK_POSE, in physics steps of 2 ms. Ours have
    position actuators, no dry friction, and steps of 5 ms.
  * Hands touch each other with robosuite's meshes. There is no table.

Cables, heads, their contacts and the solver's options are the same.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import numpy as np

from hindrl_jax.envs import panda
from hindrl_jax.envs.cable import CableState, chains, geometry, model
from hindrl_jax.experts.robosuite_arm.arm import RobosuiteScene
from hindrl_jax.experts.robosuite_arm.scene import scene_class

_VIEW = dict(lookat=(-0.5, 0.0, 1.35), distance=1.5, azimuth=180.0, elevation=-15.0)  # from the front, where "right" is right
_PEDESTAL = np.array([0.0, 0.0, 0.912])  # m, from where robosuite puts a robot to the base of its arm
_PADS = [[f"gripper{i}_right_finger{k}_pad_collision" for k in (1, 2)] for i in range(2)]
_OPTIONS = {"cone": "pyramidal", "impratio": "10", "iterations": "20", "ls_iterations": "50"}  # those of our model


@functools.cache
def environment_class() -> type[Any]:
    """`RobosuiteCables`, a class that can exist only once robosuite does.

    Raises:
      UserError: see `import_robosuite`.
    """
    base: Any = scene_class()

    class RobosuiteCables(base):
        """A robosuite environment: two Pandas before two hanging cables. Its reward is 0; the rules of our tasks say when they are solved."""

        def __init__(self, num_links: int = 5, **options: Any):
            """`options` are those of robosuite's ManipulationEnv, for example has_renderer."""
            self.num_links = num_links
            super().__init__(2, **options)

        def _check_success(self) -> bool:
            return False

        def _load_model(self) -> None:
            super()._load_model()
            for robot, place in zip(self.robots, geometry.BASES, strict=True):
                robot.robot_model.set_base_xpos(place - _PEDESTAL)
            self.build(self._add_cables)
            self.model.root.find("option").attrib.update(_OPTIONS)

        def _add_cables(self, arena: Any) -> None:
            arena.asset.extend(model.materials())
            for element in model.hanging(self.num_links):
                for geom in element.iter("geom"):
                    geom.attrib = {"contype": "0", "conaffinity": "0", "mass": "0"} | geom.attrib
                arena.worldbody.append(element)
            arena.contact.extend(model.pairs(_PADS))

        def _reset_internal(self) -> None:
            super()._reset_internal()
            for robot in self.robots:
                robot.gripper["right"].current_action = np.zeros(2)  # half open, as robosuite has the fingers
            self.sim.forward()

    return RobosuiteCables


class RobosuiteCables(RobosuiteScene):
    """Two Pandas in robosuite, and two cables."""

    def __init__(self, num_links: int = 5, *, on_screen: bool = False):
        """Builds the scene.

        Args:
          num_links: links of each cable.
          on_screen: whether to show it in a window, which `refresh` opens.

        Raises:
          UserError: as `RobosuiteScene`.
        """
        super().__init__(lambda **window: environment_class()(num_links, **window), on_screen=on_screen, view=_VIEW)
        arms = [[f"robot{i}_joint{k + 1}" for k in range(panda.NUM_JOINTS)] + [f"gripper{i}_right_finger_joint{k}" for k in (1, 2)] for i in range(2)]
        joints = [self.environment.sim.model._model.joint(name) for name in (*arms[0], *arms[1], *model.joint_names(num_links))]
        self._positions, self._velocities = (np.array([at[0] for at in of]) for of in zip(*((j.qposadr, j.dofadr) for j in joints), strict=True))

    def begin(self, state: CableState) -> None:
        """Puts the arms where they are in a state at reset, at rest, with hanging cables."""
        for robot, joints in zip(self.environment.robots, np.asarray(state.rest, float), strict=True):
            robot.init_qpos = joints
        self.environment.reset()

    def step(self, command: np.ndarray) -> tuple[np.ndarray, chains.Joints]:
        """Moves for one control step of 50 ms.

        Args:
          command: (14,) for each arm the displacement of its grip site in m, its rotation vector in rad, and the gripper's command.

        Returns:
          Where the grippers' commands want the fingers (2,), m, and the joints, as `hindrl_jax.envs.cable.chains` has them.
        """
        self.environment.step(np.asarray(command, float))
        self._undo_shortcuts()
        closing = np.array([robot.gripper["right"].current_action[0] for robot in self.environment.robots])
        return (0.5 * geometry.MAX_FINGER * (1.0 + closing)).astype(np.float32), self.joints()

    def joints(self) -> chains.Joints:
        """Where everything is now."""
        data = self.environment.sim.data
        of_joints = (data.qpos[self._positions], data.qvel[self._velocities], data.qacc[self._velocities])
        positions, velocities, accelerations = jax.tree.map(np.float32, of_joints)
        return chains.Joints(positions=positions, velocities=velocities, accelerations=accelerations)
