"""Gymnasium's registry: our environments are put into it, as hindrl/NAME-v0, and those of others are found in it.

Gymnasium looks for no plug-ins; a package registers its environments when it is imported. So this module is imported with ours, and again by every
process that steps an environment, and must import nothing but Gymnasium. `hindrl_jax.tasks.as_gymnasium` is what our entries lead to.
"""

from __future__ import annotations

import contextlib
import difflib
import importlib
import io
import os
import sys
from collections.abc import Iterator
from typing import Any

import gymnasium

from hindrl_jax.base.errors import UserError, one_line

NAMESPACE = "hindrl"
ROBOTICS = "gymnasium_robotics"
MAX_EPISODE_STEPS = {
    "GridPickAndPlace": 100,
    "FixedGridPickAndPlace": 100,
    "ParameterizedReach": 300,
    "FixedParameterizedReach": 300,
    "BringNear": 450,
    "CableInsertion": 750,
}
"""The names of `hindrl_jax.tasks.registry.TASKS` and their horizons, written out, since reading them there would import JAX."""


_forked_from_jax = False


def _note_fork() -> None:
    """Runs in every forked process. JAX's threads do not live on in it, and what waits for them waits for ever."""
    global _forked_from_jax
    _forked_from_jax = _forked_from_jax or bool(getattr(sys.modules.get("jax._src.xla_bridge"), "_backends", None))


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_note_fork)


def check_not_forked() -> None:
    """Makes sure that JAX can compute in this process.

    Raises:
      UserError: if the process was forked from one in which JAX had computed.
    """
    if _forked_from_jax:
        raise UserError(
            "this process was forked from one that has used JAX, and JAX hangs in it: leave vectorization_mode out, so that one program steps all "
            "environments, or have processes started afresh, gymnasium.make_vec(..., vector_kwargs={'context': 'spawn'})"
        )


@contextlib.contextmanager
def working_directory_on_path() -> Iterator[None]:
    """Lets modules be imported from the working directory, last of all, which an installed command does not look into by itself."""
    folder = os.getcwd()
    if folder in sys.path:
        yield
        return
    sys.path.append(folder)
    try:
        yield
    finally:
        with contextlib.suppress(ValueError):  # what was imported may have changed the path, too
            sys.path.remove(folder)


def gymnasium_id(name: str) -> str:
    """The id of one of our environments, for `gymnasium.make`."""
    return f"{NAMESPACE}/{name}-v0"


def register() -> None:
    """Registers all environments; what is registered already stays."""
    for name, max_episode_steps in MAX_EPISODE_STEPS.items():
        if gymnasium_id(name) not in gymnasium.registry:
            gymnasium.register(
                id=gymnasium_id(name),
                entry_point="hindrl_jax.tasks.as_gymnasium:GoalEnv",
                vector_entry_point="hindrl_jax.tasks.as_gymnasium:GoalVectorEnv",
                max_episode_steps=max_episode_steps,
                kwargs={"name": name},
            )


def check_registered(gymnasium_id: str) -> None:
    """Makes sure that an id, as in FetchReach-v4 or my_package:MyEnv-v0, is in Gymnasium's registry; imports what would put it there.

    Raises:
      UserError: if it is not.
    """
    module, _, env_id = gymnasium_id.rpartition(":")
    if module or env_id not in gymnasium.registry:
        try:
            # gymnasium-robotics prints news of some of its environments, whichever one wants.
            with working_directory_on_path(), contextlib.redirect_stderr(io.StringIO()):
                importlib.import_module(module or ROBOTICS)
        except Exception as error:  # packages that load a simulator fail in many ways
            if module or not (isinstance(error, ModuleNotFoundError) and error.name == ROBOTICS):
                name = module or ROBOTICS
                advice = "install it, or start in the folder where it is, or mend what it complains of"
                raise UserError(f"{gymnasium_id}: {name} cannot be imported ({one_line(error)}): {advice}") from error
    if env_id not in gymnasium.registry:
        close = difflib.get_close_matches(env_id, list(gymnasium.registry), n=1)
        hint = f" (did you mean {close[0]!r}?)" if close else ""
        raise UserError(
            f"Gymnasium knows no environment {env_id!r}{hint}: install the package that has it (gymnasium-robotics for Fetch tasks, hands and "
            "mazes), or name that package's module, as in gymnasium:MODULE:ID"
        )


def make_single(gymnasium_id: str, arguments: dict[str, Any], max_episode_steps: int | None, render_mode: str | None = None) -> gymnasium.Env:
    """One environment of that id, registered before if need be; for processes of their own, too.

    Raises:
      UserError: if it cannot be made.
    """
    check_registered(gymnasium_id)
    limit = {} if max_episode_steps is None else {"max_episode_steps": max_episode_steps}
    try:
        with working_directory_on_path():
            return gymnasium.make(gymnasium_id.rpartition(":")[2], render_mode=render_mode, disable_env_checker=True, **limit, **arguments)
    except UserError:
        raise
    except Exception as error:  # of any kind: what it takes to be made is the environment's own business
        given = ", ".join(f"{name}={value!r}" for name, value in arguments.items())
        raise UserError(f"gymnasium.make({gymnasium_id!r}{', ' + given if given else ''}) failed: {one_line(error)}") from error
