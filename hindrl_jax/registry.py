"""The environments by name, each with its expert and its viewer: the one place where tasks are listed."""

from __future__ import annotations

import dataclasses
import difflib
import importlib
from collections.abc import Callable
from types import ModuleType
from typing import Any, Literal

from envs.grid import FixedGridPickAndPlace, GridPickAndPlace
from envs.reach import FixedParameterizedReach, ParameterizedReach
from experts import fetch
from experts.grid import GridExpert
from experts.reach import ReachExpert
from hindrl_jax import from_gymnasium
from hindrl_jax.errors import UserError
from hindrl_jax.types import RestorableEnvironment

Family = Literal["grid", "reach", "gymnasium"]


@dataclasses.dataclass(frozen=True)
class Task:
    """What belongs to one environment name."""

    environment: type[Any]
    """Frozen dataclass; its fields are the environment's arguments."""
    expert: type[Any] | None
    """Frozen dataclass with a method act(key, env, state), or for Gymnasium's environments act(observation, rng); None where nobody can show."""
    viewer_module: str | None
    """Module with save_png(env, state, path), save_gif(env, states, path) and animation(env, states); imported only to draw. None where the
    environment draws itself."""
    family: Family
    """Which of the presets' recipes is for it."""
    summary: str
    """One line for the table of `hindrl envs`."""


TASKS: dict[str, Task] = {
    task.environment.name: task
    for task in (
        Task(GridPickAndPlace, GridExpert, "envs.grid.viewer", "grid", "objects, agent and goal anywhere on the grid (thesis 3.1.1)"),
        Task(FixedGridPickAndPlace, GridExpert, "envs.grid.viewer", "grid", "each of them within a small box of its own (thesis 3.1.2)"),
        Task(ParameterizedReach, ReachExpert, "envs.reach.viewer", "reach", "a Panda arm reaches random poses in order (thesis 3.2.1)"),
        Task(FixedParameterizedReach, ReachExpert, "envs.reach.viewer", "reach", "the same, with poses that never change (thesis 3.2.2)"),
    )
}


def task(name: str) -> Task:
    """The task of that name: one of `TASKS`, or "gymnasium:ID".

    Raises:
      UserError: if there is none; the message lists the names.
    """
    if name.startswith(from_gymnasium.PREFIX):
        environment = from_gymnasium.environment_class(name)
        expert = next((expert for expert in fetch.EXPERTS if environment.id.rpartition(":")[2].startswith(f"{expert.tasks}-")), None)
        return Task(environment, expert, None, "gymnasium", "an environment of Gymnasium")
    if name not in TASKS:
        raise UserError(f"unknown environment {name!r}{did_you_mean(name, TASKS)}; choose one of {', '.join(TASKS)}, or gymnasium:ID")
    return TASKS[name]


def make(name: str, **arguments: Any) -> RestorableEnvironment:
    """Builds an environment by name.

    Args:
      name: for example "FixedGridPickAndPlace", `hindrl envs` lists them; or "gymnasium:FetchReach-v4", which is a `from_gymnasium.GymnasiumEnv`.
      **arguments: fields of the environment, for example num_objects=3; for Gymnasium's also what its own `make` takes.

    Raises:
      UserError: for an unknown name or argument, or a value that the environment refuses.
    """
    environment = task(name).environment
    if name.startswith(from_gymnasium.PREFIX):
        return checked(lambda: from_gymnasium.make(name, arguments))
    known = [field.name for field in dataclasses.fields(environment)]
    for argument in arguments:
        if argument not in known:
            raise UserError(f"{name} has no argument {argument!r}{did_you_mean(argument, known)}; it has {', '.join(known)}")
    return checked(lambda: environment(**arguments))


def viewer(env: RestorableEnvironment) -> ModuleType:
    """The module that draws this environment, which is one of ours."""
    return importlib.import_module(task(env.name).viewer_module)


def checked(build: Callable[[], Any]) -> Any:
    """Runs a constructor whose ValueErrors are written for the user."""
    try:
        return build()
    except ValueError as error:
        raise UserError(str(error)) from error


def did_you_mean(word: str, known: Any) -> str:
    """` (did you mean 'x'?)` if something known is close, else nothing."""
    close = difflib.get_close_matches(word, list(known), n=1)
    return f" (did you mean {close[0]!r}?)" if close else ""
