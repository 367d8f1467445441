"""The bars of several trainings, one after the other; a single one has `hindrl_jax.progress`."""

from __future__ import annotations

from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from hindrl_jax.cli.common import console
from hindrl_jax.config import TrainConfig
from hindrl_jax.experiment import Result


def progress_bars(*, transient: bool = False) -> Progress:
    """A place for the bars of trainings."""
    columns = ("{task.description}", BarColumn(), "{task.completed:,.0f}/{task.total:,.0f} {task.fields[unit]}", "{task.fields[rates]}", "left")
    return Progress(*(TextColumn(c) if isinstance(c, str) else c for c in columns), TimeRemainingColumn(), console=console, transient=transient)


def add_bar(progress: Progress, config: TrainConfig, *, name: str = "") -> TaskID:
    """A bar for one training, which `advance` moves; `name` says which, where there are several."""
    return progress.add_task(f"{name}compiling", total=config.steps, unit="updates" if config.algo == "bc" else "steps", rates="")


def advance(progress: Progress, bar: TaskID, result: Result, *, name: str = "") -> None:
    """Brings a bar up to date."""
    success, runs, seconds = result.latest_success(), len(result.seeds), max(result.train_seconds, 1e-9)
    rates = f"{runs * result.env_steps / seconds:,.0f} steps/s, {runs * result.updates / seconds:,.0f} updates/s"
    progress.update(
        bar,
        completed=min(result.steps_done, result.config.steps),
        description=name + ("training" if success is None else f"success {success:4.0%}"),
        rates=rates if result.train_seconds else "",
    )
