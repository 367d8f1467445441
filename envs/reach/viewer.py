"""Pictures and animations of the reach tasks, rendered off screen by MuJoCo. The dynamics never import this module.

The arm wears robosuite's meshes where robosuite is installed, and the capsules of panda.xml where it is not. Both hang on the bodies of panda.xml, so
that what is shown is what is simulated.

MuJoCo's own `Renderer` is not used, because it takes the OpenGL library that was chosen when MuJoCo was first imported: on a machine without a
screen, one that cannot work unless MUJOCO_GL was set before.
"""

from __future__ import annotations

import atexit
import ctypes
import functools
import importlib
import importlib.util
import itertools
import os
import sys
from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from hindrl_jax.base.errors import UserError
from hindrl_jax.envs import drawing
from hindrl_jax.envs.reach import panda
from hindrl_jax.envs.reach.parameterized_reach import FixedParameterizedReach, ParameterizedReach, ReachState

mujoco = panda.import_mujoco()

_WIDTH, _HEIGHT = 480, 400  # pixels, without the caption
_MAX_PICTURES = 160  # of one animation; of longer episodes every second state is shown, or every third, ...

_LOOK_AT = (0.32, 0.03, 0.25)  # m
_DISTANCE = 1.46  # m
_AZIMUTH, _ELEVATION = 145.0, -22.0  # degrees

_GREEN = tuple(v / 255 for v in drawing.GREEN)
_BLUE = tuple(v / 255 for v in drawing.BLUE)
_GREY = (0.62, 0.65, 0.69)
_SHADOW = (0.84, 0.855, 0.88)
_AXES = ((0.85, 0.22, 0.22), (0.20, 0.62, 0.25), (0.18, 0.40, 0.85))  # colours of x, y, z
_HAND_TO_FINGERTIPS = 0.067  # m
_MAX_GEOMS = 4000
_DRESS = {  # files of robosuite, each with the bodies that have another name in panda.xml
    "robots/panda/robot.xml": {},
    "grippers/panda_gripper.xml": {"right_gripper": "gripper", "leftfinger": "left_finger", "rightfinger": "right_finger"},
}


def frame(env: FixedParameterizedReach | ParameterizedReach, state: ReachState, *, caption: str = "") -> np.ndarray:
    """Draws one state.

    Each waypoint is a green T, where the hand would be with its fingers pointing along the stem, with the x, y and z axes of its orientation in red,
    green and blue. The next waypoint is opaque, those after it are the fainter the later their turn (as in thesis figure 3.4), and those already
    reached are grey and ticked. The numbers give the order. Below the arm and the waypoints lie their shadows, in the same colours.

    Args:
      env: the environment that `state` belongs to.
      state: unbatched state.
      caption: the first line below the picture; the name of the environment if empty.

    Returns:
      (height, width, 3) uint8 RGB picture. Its size is always the same.

    Raises:
      UserError: if no OpenGL library can draw without a screen.
    """
    return _draw(env, state, caption, [])


def save_png(env: FixedParameterizedReach | ParameterizedReach, state: ReachState, path: str | PathLike, *, caption: str = "") -> None:
    """Saves the picture that `frame` draws."""
    drawing.save_png(frame(env, state, caption=caption), path)


def save_gif(
    env: FixedParameterizedReach | ParameterizedReach,
    states: Sequence[ReachState] | ReachState,
    path: str | PathLike,
    *,
    seconds_per_frame: float = panda.CONTROL_PERIOD,
    captions: Sequence[str] | None = None,
) -> None:
    """Saves what `animation` draws as an endlessly repeated one; the last picture stays a second longer.

    Args:
      path: file to write.
      env, states, seconds_per_frame, captions: as for `animation`; programs that show GIFs round the seconds to hundredths.

    Raises:
      ValueError: if there are no states, or not one caption per state.
      UserError: if no OpenGL library can draw without a screen.
    """
    drawing.save_gif(*animation(env, states, seconds_per_frame=seconds_per_frame, captions=captions), path)


def animation(
    env: FixedParameterizedReach | ParameterizedReach,
    states: Sequence[ReachState] | ReachState,
    *,
    seconds_per_frame: float = panda.CONTROL_PERIOD,
    captions: Sequence[str] | None = None,
) -> tuple[list[np.ndarray], list[float]]:
    """Draws an episode, with the way of the hand so far.

    Of long episodes only every second state is shown, or every third, and so on, and the last one. Each is then shown for longer, so that the
    animation takes as long as it would with all of them.

    Args:
      env: the environment that the states belong to.
      states: a list of states, or one state whose arrays have a leading time axis.
      seconds_per_frame: time between states, real time by default.
      captions: one caption per state, as in `frame`.

    Returns:
      The pictures, (height, width, 3) uint8 each, and how many seconds each is shown.

    Raises:
      ValueError: if there are no states, or not one caption per state.
      UserError: if no OpenGL library can draw without a screen.
    """
    pairs = drawing.captioned_states(states, captions, ReachState)
    stride = -(-len(pairs) // _MAX_PICTURES)
    shown = [*range(0, len(pairs) - 1, stride), len(pairs) - 1]
    way = [_stage().hand_position(state.joints) for state, _ in pairs]
    pictures = [_draw(env, pairs[i][0], pairs[i][1], way[: i + 1]) for i in shown]
    return pictures, [*(seconds_per_frame * np.diff(shown)), seconds_per_frame]


def _draw(env: FixedParameterizedReach | ParameterizedReach, state: ReachState, caption: str, way: Sequence[np.ndarray]) -> np.ndarray:
    """`frame`, with a line through the positions `way` of the hand, in m."""
    stage = _stage()
    positions, rotations = np.asarray(state.positions, float), np.asarray(state.rotations, float)
    num_reached, num_waypoints = int(state.num_reached), len(positions)

    stage.pose(state.joints)
    for start, end in itertools.pairwise(way):
        stage.line(start, end, (*_BLUE, 0.7))
    stage.shade_arm()
    for i in range(num_waypoints):
        _add_waypoint(stage, positions[i], rotations[i], i - num_reached)
    image = Image.fromarray(stage.render())

    for i in reversed(range(num_waypoints)):  # so that the next one's number lies on top
        top = positions[i] - _HAND_TO_FINGERTIPS * rotations[i][:, 2]
        x, y = stage.pixel(top + np.array([0.0, 0.0, 0.04]))
        label = _label(i + 1, i - num_reached)
        left, upper = (round(float(np.clip(v - label.width / 2, 0, limit - label.width))) for v, limit in ((x, _WIDTH), (y, _HEIGHT)))
        image.paste(label, (left, upper), label)

    progress = f"step {int(state.step)}    reached {num_reached}/{num_waypoints}"
    strip = drawing.caption_strip(_WIDTH, caption or env.name, progress, solved=bool(env.is_solved(state)))
    return np.concatenate([np.asarray(image), strip])


def _add_waypoint(stage: _Stage, position: np.ndarray, rotation: np.ndarray, turns_left: int) -> None:
    """Adds the marker of a waypoint whose turn comes after `turns_left` others; that of a reached one has passed and is negative."""
    x, y, z = rotation.T
    opacity, reached = _opacity(turns_left), turns_left < 0
    colour = _GREY if reached else _GREEN
    on_floor = tuple(1 - (0.3 + 0.7 * opacity) * (1 - c) for c in colour)
    palm = position - _HAND_TO_FINGERTIPS * z
    for start, end, radius in ((palm - 0.05 * y, palm + 0.05 * y, 0.016), (palm, position, 0.008)):
        stage.rod(start, end, radius, (*colour, opacity))
        stage.shade(start, end, radius, on_floor, 0.001 + 0.001 * opacity)  # the next one's on top
    for axis, axis_colour in zip((x, y, z), _AXES, strict=True):
        stage.rod(position, position + 0.05 * axis, 0.003, (*(_GREY if reached else axis_colour), opacity))


def _opacity(turns_left: int) -> float:
    """Of a waypoint whose turn comes after `turns_left` others, or has passed."""
    return 0.45 if turns_left < 0 else max(0.55**turns_left, 0.15)


@functools.lru_cache(maxsize=256)
def _label(number: int, turns_left: int) -> Image.Image:
    """A disc with the number of a waypoint, or with a tick if it has been reached."""
    radius, rim = (13 if turns_left == 0 else 10), 2  # pixels
    scale = drawing.SUPERSAMPLING
    size, rim = 2 * radius * scale, rim * scale
    colour, strength = (_GREY, 1.0) if turns_left < 0 else (_GREEN, _opacity(turns_left))
    mixed = tuple(round(255 * (1 - strength * (1 - c))) for c in colour)
    image = Image.new("RGBA", (size, size))
    draw = ImageDraw.Draw(image)
    draw.ellipse([0, 0, size - 1, size - 1], fill=drawing.BACKGROUND)
    draw.ellipse([rim, rim, size - 1 - rim, size - 1 - rim], fill=mixed)
    if turns_left < 0:
        drawing.tick(draw, size / 2, size / 2, size / 2 - rim)
    else:
        ink = drawing.BACKGROUND if turns_left == 0 else tuple(round(150 * c) for c in _GREEN)  # white would not be seen on paler discs
        draw.text((size / 2, size / 2), str(number), font=drawing.font(round(0.65 * size)), fill=ink, anchor="mm")
    return image.reduce(scale)


class _Stage:
    """The arm, the camera and the OpenGL context that shows them. Markers are added to the scene of the moment: `pose`, add, `render`."""

    def __init__(self):
        self._model = _model()
        self._data = mujoco.MjData(self._model)
        self._gl, self._context = _open(self._model)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._scene = mujoco.MjvScene(self._model, _MAX_GEOMS)
        self._camera = mujoco.MjvCamera()
        self._camera.lookat[:], self._camera.distance = _LOOK_AT, _DISTANCE
        self._camera.azimuth, self._camera.elevation = _AZIMUTH, _ELEVATION
        self._options = mujoco.MjvOption()
        self._rectangle = mujoco.MjrRect(0, 0, _WIDTH, _HEIGHT)
        self._floor = float(self._model.geom("floor").pos[2])
        atexit.register(self.close)

    def close(self) -> None:
        """Frees the context, while Python and the OpenGL library are still there."""
        self._gl.make_current()
        self._context.free()
        self._gl.free()
        self._gl = None  # deleted at exit, OSMesa's would complain

    def hand_position(self, joints: Any) -> np.ndarray:
        """(3,) m, of the grip site."""
        self._data.qpos[:] = np.asarray(joints)
        mujoco.mj_kinematics(self._model, self._data)
        return self._data.site("grip_site").xpos.copy()

    def pose(self, joints: Any) -> None:
        """Starts a picture, of the arm at these joints (7,)."""
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

    def shade_arm(self) -> None:
        """Lays the arm's shadow on the floor."""
        bodies = [self._data.body(f"link{i}").xpos for i in range(8)] + [self._data.body("hand").xpos]
        for start, end in itertools.pairwise(bodies):
            self.shade(start, end, 0.05, _SHADOW, 0.001)
        hand, y = bodies[-1], self._data.body("hand").xmat.reshape(3, 3)[:, 1]
        self.shade(hand - 0.08 * y, hand + 0.08 * y, 0.03, _SHADOW, 0.001)

    def render(self) -> np.ndarray:
        """(H, W, 3) uint8."""
        self._gl.make_current()
        picture = np.empty((_HEIGHT, _WIDTH, 3), np.uint8)
        mujoco.mjr_render(self._rectangle, self._scene, self._context)
        mujoco.mjr_readPixels(picture, None, self._rectangle, self._context)
        return picture[::-1]

    def pixel(self, position: np.ndarray) -> tuple[float, float]:
        """Where a point, in m, is seen: pixels from the left and from the top."""
        left, right = self._scene.camera  # two eyes; the picture is seen from their middle
        forward, up = np.asarray(left.forward), np.asarray(left.up)
        offset = position - (np.asarray(left.pos) + np.asarray(right.pos)) / 2
        scale = left.frustum_near / (offset @ forward) * _HEIGHT / (left.frustum_top - left.frustum_bottom)
        return _WIDTH / 2 + scale * (offset @ np.cross(forward, up)), _HEIGHT / 2 - scale * (offset @ up)

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


@functools.cache
def _stage() -> _Stage:
    """The stage of this process; to set it up takes as long as dozens of pictures."""
    return _Stage()


def _model() -> Any:
    """panda.xml, dressed in robosuite's meshes if robosuite is there. (It is not imported, which would take seconds.)"""
    robosuite = importlib.util.find_spec("robosuite")
    if robosuite is None or robosuite.origin is None:
        return panda.model()
    try:
        spec = mujoco.MjSpec.from_file(str(panda.MODEL_PATH))
        for body in spec.bodies:
            for geom in body.geoms:
                if geom.type == mujoco.mjtGeom.mjGEOM_CAPSULE or body.name == "gripper":
                    spec.delete(geom)
        for file, bodies in _DRESS.items():
            _dress(spec, Path(robosuite.origin).parent / "models" / "assets" / file, bodies)
        return spec.compile()
    except (ValueError, AttributeError, KeyError):  # a version of robosuite whose files or bodies are others
        return panda.model()


def _dress(spec: Any, file: Path, names: dict[str, str]) -> None:
    """Hangs the visible meshes of robosuite's file on bodies of panda.xml: those of the same name, or else as `names` has it."""
    dress = mujoco.MjSpec.from_file(str(file))
    colours = {material.name: material.rgba for material in dress.materials}
    meshes = {mesh.name: mesh for mesh in dress.meshes}
    used = set()
    for body in dress.bodies:
        for geom in body.geoms:
            if geom.group != 1:  # the others are for collisions
                continue
            if geom.meshname not in used:
                used.add(geom.meshname)
                spec.add_mesh(name=geom.meshname, file=str(file.parent / meshes[geom.meshname].file))
            looks = {"rgba": colours.get(geom.material, geom.rgba), "group": 1, "contype": 0, "conaffinity": 0, "mass": 0}
            place = {"pos": geom.pos, "quat": geom.quat}
            spec.body(names.get(body.name, body.name)).add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=geom.meshname, **place, **looks)


def _open(model: Any) -> tuple[Any, Any]:
    """An OpenGL context, and MuJoCo's context in it.

    Raises:
      UserError: if OpenGL does not work here.
    """
    wish = os.environ.get("MUJOCO_GL", "").lower().strip()
    library = wish if wish in ("egl", "osmesa", "glfw", "cgl") else opengl_library()
    try:
        gl_context = importlib.import_module(f"mujoco.{library}").GLContext
        gl_context._context = None  # or else a context that cannot be opened complains once more when it is deleted
        gl = gl_context(_WIDTH, _HEIGHT)
        gl.make_current()
        return gl, mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
    except Exception as error:  # the libraries fail in many ways
        trouble = f"MUJOCO_GL={wish} does not work" if library == wish else "OpenGL does not work"
        raise UserError(f"cannot draw the arm, since {trouble} here: install libegl1 or libosmesa6, or set MUJOCO_GL=egl, osmesa or glfw") from error


def opengl_library() -> str:
    """The module of MuJoCo that is to open an OpenGL context.

    It must be known in advance which one works: MuJoCo uses whatever OpenGL library the process has loaded, so that after one failure another one
    fails as well.
    """
    if sys.platform != "linux":
        return "cgl" if sys.platform == "darwin" else "glfw"
    if _egl_has_device():
        return "egl"
    return "glfw" if os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY") else "osmesa"


def _egl_has_device() -> bool:
    """Whether EGL is there and can draw without a screen, on a GPU or in software. Asked in the way that `mujoco.egl` will take."""
    try:
        egl = ctypes.CDLL("libEGL.so.1")
    except OSError:
        return False
    egl.eglGetProcAddress.restype, egl.eglGetProcAddress.argtypes = ctypes.c_void_p, [ctypes.c_char_p]
    egl.eglInitialize.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p]
    query_devices, get_display = (egl.eglGetProcAddress(name) for name in (b"eglQueryDevicesEXT", b"eglGetPlatformDisplayEXT"))
    if not query_devices or not get_display:
        return False
    query_devices = ctypes.CFUNCTYPE(ctypes.c_uint, ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p)(query_devices)
    get_display = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_uint, ctypes.c_void_p, ctypes.c_void_p)(get_display)
    devices, count = (ctypes.c_void_p * 16)(), ctypes.c_int()
    query_devices(len(devices), devices, ctypes.byref(count))
    displays = [get_display(0x313F, device, None) for device in devices[: count.value]]  # EGL_PLATFORM_DEVICE_EXT
    return any(display and egl.eglInitialize(display, None, None) for display in displays)
