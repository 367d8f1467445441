"""Optional packages, imported where they are asked for."""

from __future__ import annotations

import importlib
import sys
from types import ModuleType

from hindrl_jax.base.errors import UserError, one_line


def require(module: str, otherwise: str) -> ModuleType:
    """Imports a module of an optional package; returns the package.

    Args:
      module: a module within the package, since a folder of the package's name in the working directory passes for an empty package.
      otherwise: what the user can do without it.

    Raises:
      UserError: if it is missing or unusable.
    """
    package = module.partition(".")[0]
    try:
        importlib.import_module(module)
    except ImportError as error:
        if isinstance(error, ModuleNotFoundError) and (error.name or "").partition(".")[0] == package:
            raise UserError(f"{package} is not installed: run `{sys.executable} -m pip install {package}`, or {otherwise}") from error
        raise UserError(f"{package} cannot be imported ({one_line(error)}): mend its installation, or {otherwise}") from error
    return sys.modules[package]
