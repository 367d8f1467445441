"""The environments by name, each with its expert and its viewer: the one place where tasks are listed. `register` adds a task of your own.

A task outside this project is named "module:Name" on the command line and in files, so that whoever reads the name can import it.
"""

from __future__ import annotations

import dataclasses
import difflib
import importlib
import inspect
from collections.abc import Callable
from typing import Any

from hindrl_jax.base.environments import Environment
from hindrl_jax.base.errors import UserError
from hindrl_jax.base.steppers import Watchable
from hindrl_jax.base.types import Array, Episodes
from hindrl_jax.envs.cable import BringNear, CableInsertion
from hindrl_jax.envs.grid import FixedGridPickAndPlace, GridPickAndPlace
from hindrl_jax.envs.reach import FixedParameterizedReach, ParameterizedReach
from hindrl_jax.experts import fetch
from hindrl_jax.experts.cable import CableExpert
from hindrl_jax.experts.grid import GridExpert
from hindrl_jax.experts.metaworld import MetaWorldExpert
from hindrl_jax.experts.reach import ReachExpert
from hindrl_jax.experts.robosuite_arm import play_in_robosuite
from hindrl_jax.tasks import from_gymnasium
from hindrl_jax.tasks.ids import working_directory_on_path

Act = Callable[[Array, Any, Array], Array]
"""(key, state, observation (D,)) -> action (A,) in the environment's own units."""
Player = Callable[[Array, Any, Act, int, int], Episodes]
"""(key, environment, act, N, steps for which each action is held) -> N episodes, played one after the other; `act` is compiled."""


@dataclasses.dataclass(frozen=True)
class Task:
    """What belongs to one environment name."""

    environment: type[Any]
    """Frozen dataclass; its fields are the environment's arguments."""
    expert: type[Any] | None
    """Frozen dataclass with a method act(key, env, state), or for Gymnasium's environments act(observation, rng), or acting_in(env), which
    returns such a function; None where nobody can show."""
    viewer: Any
    """What has save_png(env, state, path) and animation(env, states, captions=None) -> (pictures (H, W, 3), seconds that each is shown): an object,
    or the name of a module, which is imported only to draw. None where nothing does, or the environment draws itself."""
    summary: str
    """One line for the table of `hindrl envs`."""
    player: Player | None = None
    """What plays episodes with a back end that steps neither in JAX nor many at once; None where no back end needs it."""


_GRID_VIEWER, _REACH_VIEWER = "hindrl_jax.envs.grid.viewer", "hindrl_jax.envs.reach.viewer"
_CABLE_VIEWER = "hindrl_jax.envs.cable.viewer"

TASKS: dict[str, Task] = {
    task.environment.name: task
    for task in (
        Task(GridPickAndPlace, GridExpert, _GRID_VIEWER, "objects, agent and goal anywhere on the grid (thesis 3.1.1)"),
        Task(FixedGridPickAndPlace, GridExpert, _GRID_VIEWER, "each of them within a small box of its own (thesis 3.1.2)"),
        Task(ParameterizedReach, ReachExpert, _REACH_VIEWER, "a Panda arm reaches random poses in order (thesis 3.2.1)", play_in_robosuite),
        Task(FixedParameterizedReach, ReachExpert, _REACH_VIEWER, "the same, with poses that never change (thesis 3.2.2)", play_in_robosuite),
        Task(BringNear, CableExpert, _CABLE_VIEWER, "two Panda arms bring the ends of two cables together (thesis 3.2.3)", play_in_robosuite),
        Task(
            CableInsertion, CableExpert, _CABLE_VIEWER, "the same arms put one cable's plug into the other's socket (thesis 3.2.4)", play_in_robosuite
        ),
    )
}


_BUILT_IN = frozenset(TASKS)


def register(environment: type[Any], *, expert: type[Any] | None = None, viewer: Any = None, summary: str = "") -> None:
    """Adds a task of your own, which `make`, `preset`, `load_run` and the commands then know by name. A second call replaces the task.

    The commands take the name of the module, too, `hindrl train --env my_tasks:Maze`, import it from PYTHONPATH or the working directory, and it
    calls `register`.

    Args:
      environment: a frozen dataclass that fulfils `base.environments.RestorableEnvironment` and whose name is a class variable:
        `name: ClassVar[str] = "Maze"`. Its fields become options of the commands, and need defaults.
      expert: a frozen dataclass with a method act(key, env, state) -> (A,) action in the environment's own units; None if demonstrations come from
        elsewhere. Its fields become options of `hindrl demos record`.
      viewer: an object or module, or the name of a module, with save_png(env, state, path) and animation(env, states, captions=None), which returns
        pictures (H, W, 3) uint8 and the seconds that each is shown; None for no films.
      summary: one line for `hindrl envs`.

    Raises:
      UserError: if the environment has no usable name, is no frozen dataclass with defaults, or lacks something that an environment must have.
    """
    for kind, noun in ((environment, "an environment"), *([(expert, "an expert")] if expert else [])):
        if not (inspect.isclass(kind) and dataclasses.is_dataclass(kind) and vars(kind)["__dataclass_params__"].frozen):
            raise UserError(f"{getattr(kind, '__name__', kind)} is not usable as {noun}: it must be a class with @dataclasses.dataclass(frozen=True)")
        for field in dataclasses.fields(kind):
            if field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
                raise UserError(f"{kind.__name__} has no default for {field.name}: give it one")
    name = getattr(environment, "name", None)
    if not (isinstance(name, str) and name) or any(field.name == "name" for field in dataclasses.fields(environment)):
        raise UserError(f'{environment.__name__} needs a name that is no field: write name: ClassVar[str] = "{environment.__name__}"')
    if name in _BUILT_IN:
        raise UserError(f"{name} is the name of one of this project's own tasks: choose another")
    needed: tuple[str, ...] = ("horizon", "observation_dim", "goal_dim", "action_dim", "state_dim", "action_low", "action_high")
    needed += ("reset", "step", "achieved_goal", "task_goal", "observe", "state_to_vector", "vector_to_state")
    missing = [attribute for attribute in needed if not hasattr(environment, attribute)]
    if missing:
        raise UserError(
            f"{name} lacks {', '.join(missing)}: see hindrl_jax.base.environments.RestorableEnvironment for what an environment must have"
        )
    if hasattr(environment, "relabel_observations") != hasattr(environment, "num_subgoals"):
        raise UserError(
            f"{name} has one of relabel_observations and num_subgoals: give it both or neither, see hindrl_jax.base.environments.RelabelsObservations"
        )
    if expert is not None and not hasattr(expert, "act"):
        raise UserError(f"{expert.__name__} lacks act(key, env, state), the action that the expert takes")
    TASKS[name] = Task(environment, expert, viewer, summary)


def task(name: str) -> Task:
    """The task of that name: one of `TASKS`, of "module:Name" once the module is imported, or "gymnasium:ID".

    Raises:
      UserError: if there is none; the message lists the names.
    """
    if name.startswith(from_gymnasium.PREFIX):
        environment = from_gymnasium.environment_class(name)
        expert = next((expert for expert in (*fetch.EXPERTS, MetaWorldExpert) if expert.plays(environment.id.rpartition(":")[2])), None)
        return Task(environment, expert, None, "an environment of Gymnasium")
    module, _, name = name.rpartition(":")
    if module:
        _import_from_here(module)
    if name not in TASKS:
        registered = [known for known, entry in TASKS.items() if f"{entry.environment.__module__}.".startswith(f"{module}.")]
        if registered:
            raise UserError(f"unknown environment {name!r}: {module} registers {', '.join(registered)}, by the `name` of the class; choose that")
        where = f", not even by {module!r}, which is to call hindrl_jax.register" if module else ""
        own = "" if module else ", gymnasium:ID, or MODULE:NAME for a task of your own"
        raise UserError(f"unknown environment {name!r}{where}{did_you_mean(name, TASKS)}; choose one of {', '.join(TASKS)}{own}")
    return TASKS[name]


def is_registered_by_user(env: Environment) -> bool:
    """Whether somebody else than this project has registered it."""
    return env.name in TASKS and env.name not in _BUILT_IN


def full_name(env: Environment) -> str:
    """The name by which `make` finds the environment again, in another process too: with its module unless it is this project's own."""
    module = type(env).__module__
    return f"{module}:{env.name}" if is_registered_by_user(env) and module != "__main__" else env.name


def _import_from_here(module: str) -> None:
    """Imports a module from PYTHONPATH or, last of all, the working directory, which an installed command does not look into by itself."""
    try:
        with working_directory_on_path():
            importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module}.".startswith(f"{error.name}."):
            raise  # the module is there, and something that it imports is not
        raise UserError(f"there is no module {module!r}: start the command in the folder where it is, or put that on PYTHONPATH") from error


def make(name: str, **arguments: Any) -> Environment:
    """Builds an environment by name.

    Args:
      name: for example "FixedGridPickAndPlace", `hindrl envs` lists them; or "gymnasium:FetchReach-v4", which is a `from_gymnasium.GymnasiumEnv`;
        for a task of your own its name, or "module:Name".
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


def viewer(env: Environment) -> Any:
    """What draws this environment; None if nothing does."""
    found = task(env.name).viewer
    return importlib.import_module(found) if isinstance(found, str) else found


def is_drawn(env: Environment) -> bool:
    """Whether there are films of this environment: it shows itself, or something draws it."""
    return isinstance(env, Watchable) or task(env.name).viewer is not None


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
