"""`hindrl reproduce ...`: experiments on the recipe itself, and those of the thesis."""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np
from rich import box
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeRemainingColumn
from rich.table import Table

from hindrl_jax.base.errors import UserError
from hindrl_jax.cli.common import console, counted, parse, seeds_from
from hindrl_jax.reproduction import ablation, cells, thesis_report
from hindrl_jax.reproduction.cells import Cell
from hindrl_jax.reproduction.claims import settings_to_run
from hindrl_jax.reproduction.options import OPTIONS
from hindrl_jax.reproduction.outcomes import Outcome, outcomes_of
from hindrl_jax.reproduction.scales import FIRST_SEED, SCALES, Recipe, ScaleName, num_cores, seconds_of
from hindrl_jax.reproduction.scales import cells_of as thesis_cells
from hindrl_jax.reproduction.thesis import ARTIFACTS
from hindrl_jax.runs.recorded import read_recorded
from hindrl_jax.tasks.registry import did_you_mean
from hindrl_jax.training.checks import steps_to_learn
from hindrl_jax.training.evaluating import Diverged
from hindrl_jax.training.result import Result


@dataclasses.dataclass(frozen=True)
class Ablation:
    """Options of `hindrl reproduce ablation`."""

    out: Path = Path("runs/ablation")
    """Directory of the tables and of all runs. Started again with the same options, what is finished there is kept and the rest is trained."""
    tasks: tuple[str, ...] = ()
    """What to train on: fixed-1, fixed-5 or random-50, the fixed or the random grid with that many demonstrations (default: all)."""
    options: tuple[str, ...] = ()
    """The changes to train, next to the recipe without any (default: all; --list shows them)."""
    seeds: int = 16
    """Number of seeds, side by side; the same for all changes. With fewer than 8 or so the intervals are much too narrow."""
    seed: int = 2_000
    """The first seed; the others follow it."""
    steps: int | None = None
    """Environment steps of each run (default: the recipe's own)."""
    overwrite: bool = False
    """Replace runs that were made with other options. To train one again with the same options, remove its directory."""
    list: bool = False
    """Show the changes there are, and train nothing."""


def ablate(arguments: list[str]) -> None:
    """Train the default recipe with one change at a time, and compare."""
    given = parse(Ablation, arguments, "hindrl reproduce ablation", ablate.__doc__)
    if given.list:
        console.print(_option_table())
        return
    tasks = _chosen(given.tasks, ablation.TASKS, "--tasks")
    known = {option.name: option for option in OPTIONS}
    names = _chosen(given.options, known, "--options")
    if given.seeds < 2:
        raise UserError(f"--seeds {given.seeds} is too few: an interval needs at least 2")
    cells_of = functools.partial(ablation.cells_of, given.out, seeds=seeds_from(given.seeds, given.seed), steps=given.steps)
    chosen = cells_of(tasks=tasks, options=[known[name] for name in names])
    # The tables hold all that is there, also from an earlier start with other options, so all of it must be of the same seeds and steps.
    everything = cells_of(tasks=ablation.TASKS, options=OPTIONS)
    cells.check_can_train(chosen if given.overwrite else everything, overwrite=given.overwrite)
    for cell in chosen:
        steps_to_learn(cell.spec.env, cell.spec.config)
    to_train = [cell for cell in chosen if not cells.is_finished(cell)]
    kept = len(chosen) - len(to_train)
    console.print(f"{counted(len(to_train), 'setting')} to train, {counted(given.seeds, 'seed')} from {given.seed}, {kept} finished before")

    def table(cell: Cell) -> str:
        outcomes = outcomes_of(everything)
        ablation.write_tables(given.out, outcomes)
        return _outcome_line(next(outcome for outcome in outcomes if outcome.cell == cell))

    _train_all(to_train, table, weight=lambda cell: 1.0)
    if not to_train:
        ablation.write_tables(given.out, outcomes_of(everything))
    console.print(f"wrote {given.out}: {ablation.TABLE}, {ablation.TEXT}, {ablation.PICTURE}, and a run's directory for each setting")


@dataclasses.dataclass(frozen=True)
class Thesis:
    """Options of `hindrl reproduce table-5.1` and the like."""

    recipe: tuple[Recipe, ...] = ("default",)
    """What to train with: default, the project's own recipe; thesis, the hyperparameters and the algorithm of its text; original, with the quirks of
    its code, too. Several may be given."""
    scale: ScaleName = "quick"
    """How much of it: quick, a check that everything runs; laptop, a night or two on two cores; full, unchanged, meant for a GPU."""
    seeds: int | None = None
    """Number of seeds of each cell (default: that of the scale)."""
    seed: int = FIRST_SEED
    """The first seed; the others follow it."""
    out: Path = Path("runs/thesis")
    """Directory of the report and of all runs. Started again with the same options, what is finished there is kept, what was interrupted goes on at
    its last checkpoint, and the rest is trained. Cells of another machine are put in by copying their folders."""
    overwrite: bool = False
    """Replace runs that were made with other options."""
    report_only: bool = False
    """Train nothing: write the report of what is there."""


def reproduce(name: str, arguments: list[str]) -> None:
    """Trains the cells of an artifact of the thesis that are not finished yet, and writes the report of all that are.

    Args:
      name: a key of `ARTIFACTS`, or "all".
      arguments: of the command line.

    Raises:
      UserError: for options that are not usable, for a directory that holds something else, and if a run cannot be trained.
    """
    given = parse(Thesis, arguments, f"hindrl reproduce {name}", _WORDS[name])
    if given.seeds is not None and given.seeds < 1:
        raise UserError(f"--seeds {given.seeds} is too few: train at least 1 seed")
    seeds_from(given.seeds or 1, given.seed)
    names = tuple(ARTIFACTS) if name == "all" else (name,)
    by_recipe = [
        thesis_cells(
            given.out,
            settings_to_run(names, recipe=recipe, scale=given.scale),
            recipe=recipe,
            scale=given.scale,
            num_seeds=given.seeds,
            first_seed=given.seed,
        )
        for recipe in dict.fromkeys(given.recipe)
    ]
    chosen = list({cell.path: cell for of_recipe in by_recipe for cell in of_recipe.values()}.values())
    if not given.report_only:
        _train_thesis(chosen, given)
    files = thesis_report.write(given.out, given.scale)
    console.print(f"wrote {given.out}: {', '.join(files)}")


def _train_thesis(chosen: list[Cell], given: Thesis) -> None:
    cells.check_can_train(chosen, overwrite=given.overwrite)
    for cell in chosen:
        steps_to_learn(cell.spec.env, cell.spec.config)
    to_train = [cell for cell in chosen if not cells.is_finished(cell)]
    expected = functools.partial(seconds_of, cores=num_cores())
    minutes = sum(expected(cell.spec) for cell in to_train) / 60
    console.print(f"{given.scale}: {SCALES[given.scale].summary}")
    console.print(
        f"{counted(len(to_train), 'cell')} to train, {len(chosen) - len(to_train)} finished before; about {minutes:,.0f} min on "
        f"{counted(num_cores(), 'core')} that have nothing else to do"
    )
    _train_all(to_train, _cell_line, weight=lambda cell: expected(cell.spec))


def _cell_line(cell: Cell) -> str:
    run = read_recorded(cell.path)
    return f"{cell.group:<9}{cell.task:<12}{cell.name:<14}{thesis_report.cell_text(run):<40}{run.train_seconds:8.1f} s"


def _command(name: str) -> Callable[[list[str]], None]:
    def command(arguments: list[str]) -> None:
        reproduce(name, arguments)

    command.__doc__ = _WORDS[name]
    return command


_WORDS = {name: f"The thesis's {name.replace('-', ' ')}: {artifact.title}." for name, artifact in ARTIFACTS.items()}
_WORDS["all"] = "All tables and figures of the thesis, with a verdict on each of its claims."
COMMANDS: dict[str, Callable[[list[str]], None]] = {"ablation": ablate, **{name: _command(name) for name in _WORDS}}
"""What `hindrl reproduce` can be given."""


def _train_all(to_train: Sequence[Cell], say: Callable[[Cell], str], *, weight: Callable[[Cell], float]) -> None:
    """Trains cells, with a bar for each, and then a line. One that diverges is left out, and the next one is trained.

    Args:
      to_train: in order.
      say: what to say of a cell that is trained.
      weight: how much longer a cell takes than others, from which follows how long the rest will take.
    """
    started, done = time.perf_counter(), 0.0
    with _bars() as progress:
        for index, cell in enumerate(to_train):
            name = f"{cell.task} {cell.name}: "
            bar, cpu = progress.add_task(f"{name}compiling", total=cell.spec.config.num_steps, rates=""), time.process_time()
            try:
                cells.train(cell, report=functools.partial(_advance, progress, bar, name))
                line = say(cell)
            except Diverged as error:
                line = f"{name}left out: {error}"
            progress.remove_task(bar)
            done += weight(cell)
            rest = to_train[index + 1 :]
            minutes = (time.perf_counter() - started) / done * sum(map(weight, rest)) / 60
            left = f"   {len(rest)} left, about {minutes:,.0f} min" if rest else ""
            progress.console.print(f"{line}   {time.process_time() - cpu:,.0f} s of CPU{left}")


def _bars() -> Progress:
    """A place for the bars of trainings that follow each other; `hindrl_jax.training.progress` has that of a single one."""
    columns = ("{task.description}", BarColumn(), "{task.completed:,.0f}/{task.total:,.0f} steps", "{task.fields[rates]}", "left")
    return Progress(*(TextColumn(c) if isinstance(c, str) else c for c in columns), TimeRemainingColumn(), console=console, transient=True)


def _advance(progress: Progress, bar: TaskID, name: str, result: Result) -> None:
    """Brings the bar of a training up to date."""
    success, runs, seconds = result.latest_success(), len(result.seeds), max(result.train_seconds, 1e-9)
    rates = f"{runs * result.env_steps / seconds:,.0f} steps/s, {runs * result.updates / seconds:,.0f} updates/s"
    progress.update(
        bar,
        completed=min(result.steps_done, result.config.num_steps),
        description=name + ("training" if success is None else f"success {success:4.0%}"),
        rates=rates if result.train_seconds else "",
    )


def _chosen(names: Sequence[str], known: Iterable[str], flag: str) -> list[str]:
    """The chosen ones of what is known, each once and in the order in which they are known; all of them where none is chosen."""
    known = list(known)
    for name in names:
        if name not in known:
            raise UserError(f"{flag} {name} is not known{did_you_mean(name, known)}: choose among {', '.join(known)}")
    return [name for name in known if name in names or not names]


def _option_table() -> Table:
    table = Table("option", "group", "what it changes", box=box.SIMPLE_HEAD)
    for option in OPTIONS:
        table.add_row(option.name, option.group, option.summary)
    return table


def _outcome_line(outcome: Outcome) -> str:
    spec, steps = outcome.cell.spec, outcome.steps_to_95.estimate
    median = f"median {steps:9,.0f} steps" if np.isfinite(steps) else f"median {'never':>9}      "
    return (
        f"{outcome.cell.task:<10}{outcome.cell.name:<22}{outcome.seeds_reaching_95:3d} of {len(spec.seeds)} reach 95%, {median}   "
        f"returned {outcome.returned_success.estimate:4.0%}   {outcome.seconds_per_seed * len(spec.seeds):6.1f} s"
    )
