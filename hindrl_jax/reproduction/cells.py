"""Cells of a table: runs that are trained one after the other, each in an ordinary run's directory of its own.

A cell whose directory holds its finished run is not trained again, and one that was interrupted goes on at its last checkpoint, so an experiment
that was interrupted goes on where it was.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from flax.traverse_util import flatten_dict

from hindrl_jax.base.environments import RestorableEnvironment
from hindrl_jax.base.errors import UserError
from hindrl_jax.base.types import Episodes
from hindrl_jax.config import TrainConfig
from hindrl_jax.runs.checkpoints import Checkpoints
from hindrl_jax.runs.spec import CHECKPOINTS, CONFIG, SUMMARY, RunSpec, read_spec
from hindrl_jax.runs.writer import RunWriter
from hindrl_jax.tasks.registry import checked
from hindrl_jax.training.experiment import fit
from hindrl_jax.training.recording import record_demonstrations
from hindrl_jax.training.result import Result

SECONDS_BETWEEN_CHECKPOINTS = 120.0
"""The most that a killed run loses, but for compilation; with many seeds a checkpoint takes seconds itself."""


@dataclasses.dataclass(frozen=True)
class Task:
    """What cells are trained on."""

    env: str
    """Name of the environment."""
    env_args: tuple[tuple[str, Any], ...]
    """Its arguments."""
    num_demos: int
    """Demonstrations recorded for each seed: equal seeds have equal ones."""

    def title(self) -> str:
        """What a reader calls it."""
        arguments = "".join(f", {name} {value}" for name, value in self.env_args)
        return f"{self.env}{arguments}, {self.num_demos} demonstration{'s' if self.num_demos > 1 else ''}"


@dataclasses.dataclass(frozen=True)
class Cell:
    """One run with all its seeds."""

    task: str
    """The table that it stands in."""
    group: str
    """The rows that it stands among."""
    name: str
    """Its row."""
    path: Path
    """The run's directory."""
    spec: RunSpec


Changes = tuple[tuple[str, Any], ...]
"""Fields of `TrainConfig`, as in "steps" or "batch.n_step", and their new values. A value may be a function of the unchanged config."""


def changed(config: TrainConfig, changes: Changes) -> TrainConfig:
    """The config with all these changes, made at once.

    Raises:
      UserError: if the changed config is refused.
    """
    sections: dict[str, dict[str, Any]] = {"": {}}
    for field, value in changes:
        section, _, name = field.rpartition(".")
        sections.setdefault(section, {})[name] = value(config) if callable(value) else value
    outermost = sections.pop("")

    def made() -> TrainConfig:
        parts = {section: dataclasses.replace(getattr(config, section), **values) for section, values in sections.items()}
        return dataclasses.replace(config, **outermost, **parts)

    return checked(made)


def is_finished(cell: Cell, *, any_seeds: bool = False) -> bool:
    """Whether the directory holds the finished run of just this cell, or of this cell with any seeds.

    Raises:
      UserError: if it holds a configuration that cannot be read.
    """
    if not all((cell.path / name).exists() for name in (CONFIG, SUMMARY)):
        return False
    found = _read_as_asked(cell)
    return (dataclasses.replace(found, seeds=cell.spec.seeds) if any_seeds else found) == cell.spec


def check_can_train(cells: Iterable[Cell], *, overwrite: bool) -> None:
    """Makes sure, before anything is trained, that no cell stands in the way of what is there.

    An interrupted run of the same cell does not: it is gone on with.

    Raises:
      UserError: if a directory holds something else and `overwrite` is off, or cannot be written.
    """
    for cell in cells:
        if overwrite or not (cell.path / CONFIG).exists():
            RunWriter(cell.path, cell.spec, overwrite=overwrite)
            continue
        there, asked = (flatten_dict(spec.to_json(), sep=".") for spec in (_read_as_asked(cell), cell.spec))
        different = [name for name in asked | there if name not in asked or name not in there or asked[name] != there[name]]
        if different:
            raise UserError(
                f"{cell.path} holds a run of other options ({', '.join(different)}): choose another --out, or replace it with --overwrite"
            )


def _read_as_asked(cell: Cell) -> RunSpec:
    """What the directory's run was asked to do. What the cell leaves to `fit` to choose is left out."""
    found = read_spec(cell.path)
    return found if cell.spec.config.action_hold else dataclasses.replace(found, config=dataclasses.replace(found.config, action_hold=None))


def train(cell: Cell, *, report: Callable[[Result], None] = lambda result: None) -> None:
    """Trains a cell and writes its directory, in place of what is there; of the same cell's interrupted run, it goes on at the last checkpoint.

    Raises:
      UserError: if the cell cannot be trained, or the directory cannot be written, or a checkpoint is damaged.
    """
    spec = cell.spec
    demonstrations = _demonstrations(spec.env, int(spec.demos), spec.seeds)
    resume = (cell.path / CONFIG).exists() and _read_as_asked(cell) == spec
    writer = RunWriter(cell.path, spec, overwrite=not resume, resume=resume)
    checkpoints = Checkpoints(cell.path / CHECKPOINTS, seconds=SECONDS_BETWEEN_CHECKPOINTS)
    restore: dict[str, Any] = {"restore": checkpoints.restore} if resume else {}

    def write_and_report(result: Result) -> None:
        if not writer.started:
            writer.spec = dataclasses.replace(spec, config=result.config)  # with what `fit` has chosen
            writer.start()
        writer.report(result.rows)
        checkpoints.save_when_due(result)
        report(result)

    writer.finish(fit(spec.env, demonstrations, spec.config, seeds=spec.seeds, report=write_and_report, **restore), film=False)


@functools.lru_cache(maxsize=1)
def _demonstrations(env: RestorableEnvironment, num_demos: int, seeds: tuple[int, ...]) -> tuple[Episodes, ...]:
    """One table per seed, kept for the next cell of the same task."""
    return tuple(record_demonstrations(env, num_demos, seed=seed) for seed in seeds)
