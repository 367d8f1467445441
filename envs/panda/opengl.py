"""Which OpenGL library MuJoCo draws with, and a context in it that needs no screen.

MuJoCo's own `Renderer` is not used, because it takes the OpenGL library that was chosen when MuJoCo was first imported: on a machine without a
screen, one that cannot work unless MUJOCO_GL was set before.
"""

from __future__ import annotations

import ctypes
import importlib
import os
import sys
from typing import Any

from hindrl_jax.base.errors import UserError
from hindrl_jax.envs.panda.robot import import_mujoco

mujoco = import_mujoco()


def open_context(model: Any, width: int, height: int) -> tuple[Any, Any]:
    """Opens an OpenGL context, and MuJoCo's context in it.

    Args:
      model: the MuJoCo model to draw.
      width, height: of the pictures, in pixels.

    Raises:
      UserError: if OpenGL does not work here.
    """
    wish = os.environ.get("MUJOCO_GL", "").lower().strip()
    library = wish if wish in ("egl", "osmesa", "glfw", "cgl") else opengl_library()
    try:
        gl_context = importlib.import_module(f"mujoco.{library}").GLContext
        gl_context._context = None  # or else a context that cannot be opened complains once more when it is deleted
        gl = gl_context(width, height)
        gl.make_current()
        return gl, mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
    except Exception as error:  # the libraries fail in many ways
        trouble = f"MUJOCO_GL={wish} does not work" if library == wish else "OpenGL does not work"
        raise UserError(f"cannot draw the arm, since {trouble} here: install libegl1 or libosmesa6, or set MUJOCO_GL=egl, osmesa or glfw") from error


def opengl_library() -> str:
    """The module of MuJoCo that is to open an OpenGL context: "egl", "osmesa", "glfw" or "cgl".

    It must be known in advance which one works: MuJoCo uses whatever OpenGL library the process has loaded, so that after one failure another one
    fails as well.
    """
    if sys.platform != "linux":
        return "cgl" if sys.platform == "darwin" else "glfw"
    if _egl_has_device():
        return "egl"
    return "glfw" if os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY") else "osmesa"


def _egl_has_device() -> bool:
    """Whether EGL is there and can draw without a screen, on a GPU or in software. Asks in the way that `mujoco.egl` will."""
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
