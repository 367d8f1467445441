"""The devices of robosuite with which a person steers an arm."""

from __future__ import annotations

import importlib
from typing import Any, Literal

from hindrl_jax.base.errors import UserError, one_line
from hindrl_jax.experts.robosuite_arm.arm import RobosuiteScene
from hindrl_jax.experts.robosuite_arm.installation import quiet

DeviceName = Literal["keyboard", "spacemouse"]


def open_device(name: DeviceName, scene: RobosuiteScene) -> Any:
    """One of robosuite's devices, listening.

    Args:
      name: which.
      scene: what it steers.

    Raises:
      UserError: if a package that it needs is missing or does not work here, or it is not plugged in.
    """
    try:
        with quiet():
            importlib.import_module("pynput.keyboard")
    except ImportError as error:
        raise UserError(f"keys cannot be read here ({one_line(error)}): pip install pynput, and on Linux use an X11 session") from error
    try:
        with quiet():  # the Python package hid is imported by the module itself, and missed by printing
            devices = importlib.import_module("robosuite.devices")
            device = devices.Keyboard if name == "keyboard" else importlib.import_module("robosuite.devices.spacemouse").SpaceMouse
    except ImportError as error:
        raise UserError(f"the {name} cannot be used ({one_line(error)}): pip install hidapi, and libhidapi-hidraw0 on Debian") from error
    try:
        with quiet():
            return device(env=scene.environment)
    except OSError as error:
        raise UserError(f"the {name} cannot be opened ({one_line(error)}): is it plugged in, and may you read it?") from error
