"""Finding and importing robosuite, and keeping it quiet.

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
from collections.abc import Iterator
from importlib import metadata
from types import ModuleType

from hindrl_jax.base.errors import UserError, one_line
from hindrl_jax.envs import panda

ROBOSUITE_VERSION, MUJOCO_SERIES = "1.5.1", "3.9"  # from MuJoCo 3.10 on, this robosuite fails to build any environment
INSTALL = f"{sys.executable} -m pip install robosuite=={ROBOSUITE_VERSION} 'mujoco=={MUJOCO_SERIES}.*' 'mujoco-mjx=={MUJOCO_SERIES}.*'"


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Keeps what robosuite prints and warns about from the screen; none of it concerns our users."""
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
        with quiet():
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
