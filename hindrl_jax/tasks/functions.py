"""Functions of one's own by name, MODULE:NAME, on the command line and in files: networks and losses (`config.AgentConfig`)."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any, get_args, get_origin

from hindrl_jax.base.errors import UserError, one_line
from hindrl_jax.tasks.ids import working_directory_on_path


def is_function(hint: Any) -> bool:
    """Whether a field of this type holds a function, or None."""
    return any(get_origin(one) is Callable for one in (hint, *get_args(hint)))


def function_name(function: Any) -> str:
    """MODULE:NAME, by which `find_function` finds it again, in another process too if the module is a file rather than a notebook or script."""
    if hasattr(function, "__qualname__"):
        return f"{function.__module__}:{function.__qualname__}"
    return f"{type(function).__module__}:{type(function).__qualname__} object"  # which is not found again


def is_found_again(function: Any) -> bool:
    """Whether `find_function` finds this very function by its name: not a lambda, one made within another, or what functools.partial makes."""
    try:
        return find_function(function_name(function)) is function
    except UserError:
        return False


def find_function(name: str) -> Any:
    """The function or class of that name; its module is imported from PYTHONPATH or, last of all, the working directory.

    Raises:
      UserError: if it is not there.
    """
    module, _, path = name.partition(":")
    if not (module and path):
        raise UserError(f"{name!r} is not usable: name a function as MODULE:NAME")
    try:
        with working_directory_on_path():
            found = importlib.import_module(module)
        for part in path.split("."):
            found = getattr(found, part)
    except Exception as error:  # of any kind: it is somebody else's code
        where = "a notebook or script" if module == "__main__" else f"module {module!r}"
        advice = "put it into a module of its own" if module == "__main__" else "start in the folder where the module is, or put that on PYTHONPATH"
        raise UserError(f"{name} is not to be found in {where} ({one_line(error)}): {advice}") from error
    if not callable(found):
        raise UserError(f"{name} is no function but {type(found).__name__}: name a function or a class")
    return found
