"""`hindrl compare`."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from rich import box
from rich.table import Table

from hindrl_jax.base.errors import UserError
from hindrl_jax.base.files import disk_trouble
from hindrl_jax.cli.common import console, parse, print_table
from hindrl_jax.plotting.statistics import Interval
from hindrl_jax.reporting.compare import Comparison, changes, find_runs, read_runs, remarks, write_csv
from hindrl_jax.reporting.compare import compare as compared_runs
from hindrl_jax.reporting.picture import save_comparison
from hindrl_jax.runs.recorded import Axis

_MOST_CHANGES = 6  # that are named for each run
_UNSET = {  # what a field means where it is None
    "action_hold": "chosen by the run",
    "epsilon": "by the demonstrations",
    "final_target_entropy": "constant",
    "num_target_critics": "all",
    "reach_zero": "never",
    "steps": "by default",
    "stop_at": "never",
    "updates_per_iteration": "by default",
}
_TABLE_WIDTH = 160  # characters


@dataclasses.dataclass(frozen=True)
class Compare:
    """Options of `hindrl compare`."""

    directories: tyro.conf.Positional[tuple[Path, ...]]
    """Directories of runs, finished or not, or of sweeps. All are compared with the first."""
    to: Path | None = None
    """Also draw the curves, as a .png file."""
    csv: Path | None = None
    """Also write the table, as a .csv file."""
    over: Axis = "steps"
    """What the curves are drawn over: environment steps, gradient steps, or seconds of training."""


def compare(arguments: list[str]) -> None:
    """Set runs side by side: success, speed, and the difference from the first."""
    options = parse(Compare, arguments, "hindrl compare", compare.__doc__)
    for path, suffix in ((options.to, ".png"), (options.csv, ".csv")):
        if path is not None and path.suffix != suffix:
            raise UserError(f"cannot write {path.name}: the name must end in {suffix}")
        if path is not None and not os.path.isdir(path.parent):
            raise UserError(f"cannot write {path}: there is no folder {path.parent}; make it first")
    if not options.directories:
        raise UserError("nothing to compare: give the directories of two or more runs, or of a sweep")
    runs = read_runs(find_runs(options.directories))
    compared = compared_runs(runs)
    print_table(_table(compared), least_width=_TABLE_WIDTH)
    for run in runs[1:]:
        console.print(f"{run.label}: {_changes_line(changes(run, runs[0]))}")
    for line in remarks(compared):
        console.print(f"note: {line}")
    if options.csv is not None:
        write_csv(compared, options.csv)
        console.print(f"wrote {options.csv}")
    if options.to is not None:
        over: Any = "updates" if options.over == "steps" and all(run.cloning for run in runs) else options.over
        with disk_trouble(options.to):
            save_comparison(runs, options.to, over=over)
        console.print(f"wrote {options.to}")


def _table(compared: list[Comparison]) -> Table:
    table = Table("run", "returned policies", "95% reached", "median steps", "seconds", "difference", box=box.SIMPLE_HEAD)
    for column in table.columns[1:]:
        column.justify = "right"
    for one in compared:
        run = one.run
        table.add_row(
            run.label + ("" if run.finished else " *"),
            _interval(one.returned_success, "{:.1f}%"),
            f"{one.seeds_reaching_95} of {len(run.spec.seeds)}",
            f"{one.steps_to_95:,.0f}{' updates' if run.cloning else ''}" if np.isfinite(one.steps_to_95) else "never",
            f"{one.seconds_to_95:,.1f}" if np.isfinite(one.seconds_to_95) else "never",
            "" if one.difference is None else ("" if one.paired else "~ ") + _interval(one.difference, "{:+.1f}"),
        )
    return table


def _interval(interval: Interval, form: str) -> str:
    """A share in percent, or a difference in points, with its interval where there is one."""
    estimate, low, high = (100 * value for value in (interval.estimate, interval.low, interval.high))
    number = form.removesuffix("%").replace(".1f", ".0f")
    return form.format(estimate) + (f" [{number.format(low)}, {number.format(high)}]" if np.isfinite(low) else "")


def _changes_line(changed: dict[str, tuple[object, object]]) -> str:
    if not changed:
        return "asked for the same"
    named = [f"{name} {_said(name, own)} instead of {_said(name, first)}" for name, (own, first) in list(changed.items())[:_MOST_CHANGES]]
    left = len(changed) - len(named)
    return ", ".join(named) + (f", and {left} more" if left else "")


def _said(name: str, value: object) -> str:
    if value is None:
        return _UNSET.get(name, "not set")
    return (" ".join(map(str, value)) or "none") if isinstance(value, list | tuple) else str(value)
