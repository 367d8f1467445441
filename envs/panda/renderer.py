"""The arm as pictures: MuJoCo renders it off screen, and viewers add markers. Imported only by viewers, never by dynamics."""

from __future__ import annotations

import atexit
import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from hindrl_jax.envs.panda import opengl
from hindrl_jax.envs.panda.robot import import_mujoco

mujoco = import_mujoco()

_SHADOW = (0.84, 0.855, 0.88)
_MAX_GEOMS = 4000


class View(NamedTuple):
    """Size of the pictures, and where the camera is."""

    width: int  # pixels
    height: int  # pixels
    look_at: tuple[float, float, float]  # m, the point in the middle of the picture
    distance: float  # m, from there
    azimuth: float  # degrees
    elevation: float  # degrees


class Renderer:
    """The arm, the camera and the OpenGL context that shows them. One picture is: `pose` the arm, add rods, lines and shadows, `render`."""

    def __init__(self, model: Any, view: View):
        """Opens the context.

        Args:
          model: MuJoCo model with the names of panda.xml, or with these after a prefix for each of several arms.
          view: the camera.

        Raises:
          UserError: if no OpenGL library can draw without a screen.
        """
        self._model, self._view = model, view
        self._data = mujoco.MjData(self._model)
        self._gl, self._context = opengl.open_context(self._model, view.width, view.height)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._scene = mujoco.MjvScene(self._model, _MAX_GEOMS)
        self._camera = mujoco.MjvCamera()
        self._camera.lookat[:], self._camera.distance = view.look_at, view.distance
        self._camera.azimuth, self._camera.elevation = view.azimuth, view.elevation
        self._options = mujoco.MjvOption()
        self._rectangle = mujoco.MjrRect(0, 0, view.width, view.height)
        self._floor = float(self._model.geom("floor").pos[2])
        atexit.register(self.close)

    def close(self) -> None:
        """Frees the context, while Python and the OpenGL library are still there."""
        self._gl.make_current()
        self._context.free()
        self._gl.free()
        self._gl = None  # deleted at exit, OSMesa's would complain

    def hand_position(self, joints: Any) -> np.ndarray:
        """(3,) m, of the one arm's grip site at joints (7,), in rad."""
        self._data.qpos[:] = np.asarray(joints)
        mujoco.mj_kinematics(self._model, self._data)
        return self._data.site("grip_site").xpos.copy()

    def pose(self, joints: Any) -> None:
        """Starts a picture, of the arm at these joints (7,), in rad, or of all that moves in another model."""
        self._data.qpos[:] = np.asarray(joints)
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        everything = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(self._model, self._data, self._options, None, self._camera, everything, self._scene)

    def rod(self, start: np.ndarray, end: np.ndarray, radius: float, colour: tuple[float, ...]) -> None:
        """Adds a capsule between two points, in m, with the colour (r, g, b, opacity)."""
        self._connect(mujoco.mjtGeom.mjGEOM_CAPSULE, start, end, radius, colour)

    def line(self, start: np.ndarray, end: np.ndarray, colour: tuple[float, ...]) -> None:
        """Adds a line 2 pixels wide."""
        self._connect(mujoco.mjtGeom.mjGEOM_LINE, start, end, 2.0, colour)

    def shade(self, start: np.ndarray, end: np.ndarray, radius: float, colour: tuple[float, ...], height: float) -> None:
        """Lays the shadow of a capsule on the floor, so that one sees where it is: OpenGL's own shadows triple the time of a picture.

        It is flat and opaque, so that shadows can overlap; of two, the one at the greater height (in m) is seen.
        """
        along = np.array([end[0] - start[0], end[1] - start[1], 0.0])
        length = float(np.linalg.norm(along))
        x = along / length if length > 1e-6 else np.array([1.0, 0.0, 0.0])
        axes = np.stack([x, np.cross([0.0, 0.0, 1.0], x), [0.0, 0.0, 1.0]], axis=1)
        floor = self._floor + height
        middle = (*((start[:2] + end[:2]) / 2), floor)
        self._add(mujoco.mjtGeom.mjGEOM_BOX, (length / 2, radius, 1e-4), middle, axes, (*colour, 1.0))
        for point in (start, end):
            self._add(mujoco.mjtGeom.mjGEOM_CYLINDER, (radius, 1e-4, 0.0), (*point[:2], floor), axes, (*colour, 1.0))

    def shade_arm(self, prefix: str = "") -> None:
        """Lays the shadow of an arm, whose bodies' names begin with `prefix`, on the floor."""
        bodies = [self._data.body(f"{prefix}link{i}").xpos for i in range(8)] + [self._data.body(f"{prefix}hand").xpos]
        for start, end in itertools.pairwise(bodies):
            self.shade(start, end, 0.05, _SHADOW, 0.001)
        hand, y = bodies[-1], self._data.body(f"{prefix}hand").xmat.reshape(3, 3)[:, 1]
        self.shade(hand - 0.08 * y, hand + 0.08 * y, 0.03, _SHADOW, 0.001)

    def render(self) -> np.ndarray:
        """The picture, (height, width, 3) uint8."""
        self._gl.make_current()
        picture = np.empty((self._view.height, self._view.width, 3), np.uint8)
        mujoco.mjr_render(self._rectangle, self._scene, self._context)
        mujoco.mjr_readPixels(picture, None, self._rectangle, self._context)
        return picture[::-1]

    def pixel(self, position: np.ndarray) -> tuple[float, float]:
        """Where a point, in m, is seen: pixels from the left and from the top."""
        left, right = self._scene.camera  # two eyes; the picture is seen from their middle
        forward, up = np.asarray(left.forward), np.asarray(left.up)
        offset = position - (np.asarray(left.pos) + np.asarray(right.pos)) / 2
        scale = left.frustum_near / (offset @ forward) * self._view.height / (left.frustum_top - left.frustum_bottom)
        return self._view.width / 2 + scale * (offset @ np.cross(forward, up)), self._view.height / 2 - scale * (offset @ up)

    def _connect(self, kind: Any, start: np.ndarray, end: np.ndarray, width: float, colour: tuple[float, ...]) -> None:
        geom = self._add(kind, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), np.eye(3), colour)
        if geom is not None:
            mujoco.mjv_connector(geom, kind, width, start, end)

    def _add(self, kind: Any, size: Sequence[float], position: Sequence[float], axes: np.ndarray, colour: Sequence[float]) -> Any:
        if self._scene.ngeom == self._scene.maxgeom:  # hundreds of waypoints: what is left out would not be seen among them
            return None
        geom = self._scene.geoms[self._scene.ngeom]
        mujoco.mjv_initGeom(geom, kind, np.asarray(size), np.asarray(position), axes.reshape(-1), np.asarray(colour, np.float32))
        geom.specular = 0.1
        self._scene.ngeom += 1
        return geom
