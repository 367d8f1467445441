"""`hindrl demos info` and `hindrl demos plot`: what demonstrations hold, and what the epsilon filter keeps of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from rich import box
from rich.table import Table

from hindrl_jax.base.environments import Environment
from hindrl_jax.base.errors import UserError
from hindrl_jax.base.files import disk_trouble
from hindrl_jax.cli.common import console, counted
from hindrl_jax.cli.demonstrations import beside, check_demo, parse_with_meaning
from hindrl_jax.cli.dimension_names import dimension_names
from hindrl_jax.core.goals import epsilon_filter, epsilon_from_demonstrations, is_visited
from hindrl_jax.demonstrations.convert import open_source, read, understand
from hindrl_jax.demonstrations.episodes import padded
from hindrl_jax.demonstrations.foreign import ForeignRecording, Interpretation
from hindrl_jax.demonstrations.recording import Recording, summarise_recording
from hindrl_jax.plotting.curves import save_filter
from hindrl_jax.tasks.registry import TASKS, make


@dataclasses.dataclass(frozen=True)
class Info:
    """Options of `hindrl demos info`."""

    source: tyro.conf.Positional[str]
    """The file, of hindrl_jax or another tool (.hdf5, .npz), or minari:NAME-v0."""
    epsilon_steps: int = 1
    """Distance in steps for epsilon (m of thesis eq. 4.7)."""
    epsilon_deviations: float = 0.0
    """Weight of the standard deviation in epsilon (k of thesis eq. 4.7)."""


def info(arguments: list[str]) -> None:
    """Say what a file of demonstrations holds."""
    options, meaning, environment = parse_with_meaning(Info, arguments, "hindrl demos info", info.__doc__)
    _check_epsilon(options)
    found = open_source(options.source)
    if isinstance(found, ForeignRecording):
        _print_foreign(found)
    try:
        recording = understand(found, options.source, meaning, **environment)
    except UserError as error:
        if not isinstance(found, ForeignRecording) or meaning != Interpretation() or environment["env"] is not None:
            raise
        console.print(f"not to be learned from as it is: {error}")
        return
    _print_recording(options, recording)


def _print_foreign(found: ForeignRecording) -> None:
    """What can be said before it is known which modality is what."""
    demos = found.demonstrations
    lengths = [len(demo.actions) for demo in demos]
    console.print(
        f"{found.source}: {found.format}, {found.env_name}, {counted(len(demos), 'demonstration')}, {sum(lengths)} transitions, "
        f"lengths {min(lengths)} to {max(lengths)}, median {np.median(lengths):g}"
    )
    for key, names in found.filters.items():
        console.print(f"filter key {key}: {counted(len(names), 'demonstration')}")
    table = Table("modality", "numbers", "min", "max", box=box.SIMPLE_HEAD)
    for key, width in found.shapes.items():
        rows = [demo.modalities[key] for demo in demos if key in demo.modalities]
        table.add_row(key, str(width), f"{min(row.min() for row in rows):.4g}", f"{max(row.max() for row in rows):.4g}")
    actions = np.concatenate([demo.actions for demo in demos])
    table.add_row("actions", str(actions.shape[1]), f"{actions.min():.4g}", f"{actions.max():.4g}")
    console.print(table)


def _print_recording(options: Info, recording: Recording) -> None:
    summary = summarise_recording(options.source, recording)
    achieved, lengths, epsilon = _goals(recording, options)
    kept = is_visited(lengths, achieved.shape[1]) & jax.vmap(lambda path: epsilon_filter(path, epsilon))(achieved)
    own = ":" in summary.env_name and not summary.env_name.startswith("gymnasium:")  # "module:Name", a task of the user's own
    ours = own or summary.env_name in TASKS
    arguments = ", ".join(f"{name}={value}" for name, value in summary.env_kwargs.items()) if ours else "..."
    console.print(f"{options.source}: {summary.env_name}({arguments})")
    console.print(
        f"{counted(summary.num_demonstrations, 'demonstration')}, {summary.num_solved} solved, {summary.num_transitions} transitions, "
        f"lengths {summary.length_min} to {summary.length_max}, median {summary.length_median:g}, "
        f"actions from {summary.action_low.min():g} to {summary.action_high.max():g}"
    )
    if summary.expert:
        console.print(f"expert: {', '.join(f'{name}={value}' for name, value in summary.expert.items())}")
    if recording.converted_from:
        console.print(f"converted from {recording.converted_from['format']}")
    console.print(f"the filter keeps {int(jnp.sum(kept))} of {int(jnp.sum(lengths + 1))} goals ({_how(options)})")
    reached = np.concatenate([demo.achieved_goals for demo in recording.demonstrations])
    names = dimension_names(_environment_of(recording))
    goal = {"range": _ranges(reached.min(axis=0), reached.max(axis=0)), "epsilon": [f"{value:.3g}" for value in epsilon]}
    if names.observation and names.observation == names.goal:
        _print_table("observation, achieved goal", names.goal, goal)
    else:
        _print_table("observation", names.observation, {"range": _ranges(summary.observation_low, summary.observation_high)})
        _print_table("achieved goal", names.goal, goal)
    _print_table("action", names.action, {"range": _ranges(summary.action_low, summary.action_high)})


def _print_table(what: str, names: Sequence[str], columns: dict[str, list[str]]) -> None:
    """A row for each dimension, by its number and, if it is known, its name."""
    named = len(names) == len(next(iter(columns.values())))
    columns = {what: list(names), **columns} if named else columns
    table = Table("dim" if named else what, *columns, box=box.SIMPLE_HEAD)
    for column in table.columns:
        column.no_wrap = True
    for index, row in enumerate(zip(*columns.values(), strict=True)):
        table.add_row(str(index), *row)
    console.print(table)


def _environment_of(recording: Recording) -> Environment | None:
    """The environment of a recording; None if it cannot be made here."""
    try:
        return make(recording.env_name, **recording.env_kwargs) if recording.env_name in TASKS else None
    except UserError:
        return None


def _ranges(low: np.ndarray, high: np.ndarray) -> list[str]:
    return [f"{least:.3g} to {most:.3g}" for least, most in zip(low, high, strict=True)]


@dataclasses.dataclass(frozen=True)
class PlotDemo:
    """Options of `hindrl demos plot`."""

    source: tyro.conf.Positional[str]
    """The file, of hindrl_jax or another tool (.hdf5, .npz), or minari:NAME-v0."""
    to: Path | None = None
    """The .png file (default: the file's name with .png)."""
    demo: int = 0
    """Which demonstration, counted from 0."""
    epsilon_steps: int = 5
    """Distance in steps for epsilon (m of thesis eq. 4.7), over all demonstrations of the file."""
    epsilon_deviations: float = 0.0
    """Weight of the standard deviation in epsilon (k of thesis eq. 4.7)."""
    dims: tuple[int, int] | None = None
    """The two goal dimensions to draw (default: those with the largest extent)."""


def plot(arguments: list[str]) -> None:
    """Draw what the epsilon filter keeps of a demonstration."""
    options, meaning, environment = parse_with_meaning(PlotDemo, arguments, "hindrl demos plot", plot.__doc__)
    path = options.to or beside(options.source, ".png")
    if path.suffix != ".png":
        raise UserError(f"cannot draw {path.name}: the name must end in .png")
    _check_epsilon(options)
    recording = read(options.source, meaning, **environment)
    check_demo(options.demo, len(recording.demonstrations), options.source)
    goals = recording.demonstrations[options.demo].achieved_goals
    if goals.shape[1] < 2:
        raise UserError(f"{options.source}: its goals have one dimension, and the picture takes two; give more --achieved-goal-keys")
    dims = options.dims or tuple(sorted(int(dim) for dim in np.argsort(-np.ptp(_continuous(goals), axis=0), kind="stable")[:2]))
    if len(set(dims)) < 2 or not all(0 <= dim < goals.shape[1] for dim in dims):
        raise UserError(f"--dims {dims[0]} {dims[1]} is not usable: give two different numbers from 0 to {goals.shape[1] - 1}")
    _, _, epsilon = _goals(recording, options)
    kept = np.asarray(epsilon_filter(jnp.asarray(goals, jnp.float32), epsilon))
    title = f"{recording.env_name}, demonstration {options.demo}, {_how(options)}"
    names = dimension_names(_environment_of(recording)).goal
    labels = [names[dim] if len(names) == goals.shape[1] else f"goal dimension {dim}" for dim in dims]
    with disk_trouble(path):
        save_filter(goals, kept, np.asarray(epsilon), path, dims=dims, labels=labels, title=title)
    console.print(f"wrote {path}: the filter keeps {kept.sum()} of {len(kept)} goals")


def _continuous(goals: np.ndarray) -> np.ndarray:
    """The goals (T, G) without what only jumps between whole numbers, such as masks, unless there is nothing else."""
    whole = (goals == np.round(goals)).all(axis=0)
    return goals if whole.all() else np.where(whole[None], 0.0, goals)


def _goals(recording: Recording, options: Info | PlotDemo) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The goals (N, T + 1, G) that the demonstrations achieved, their lengths (N,), and epsilon (G,) over all of them."""
    demos = recording.demonstrations
    lengths = jnp.asarray([len(demo) for demo in demos])
    achieved = jnp.asarray(padded([demo.achieved_goals for demo in demos], max(len(demo) for demo in demos) + 1))
    epsilon = epsilon_from_demonstrations(achieved, lengths, steps=options.epsilon_steps, deviations=options.epsilon_deviations)
    return achieved, lengths, epsilon


def _check_epsilon(options: Info | PlotDemo) -> None:
    if options.epsilon_steps < 0 or options.epsilon_deviations < 0:
        raise UserError(
            f"--epsilon-steps {options.epsilon_steps} --epsilon-deviations {options.epsilon_deviations} is not usable: both must be 0 or more"
        )


def _how(options: Info | PlotDemo) -> str:
    """How epsilon was made."""
    return f"epsilon over {options.epsilon_steps} steps with {options.epsilon_deviations:g} deviations"
