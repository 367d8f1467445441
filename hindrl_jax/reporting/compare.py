"""Runs side by side: each by itself, and beside the first."""

from __future__ import annotations

import csv
import dataclasses
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hindrl_jax.base.errors import UserError
from hindrl_jax.base.files import disk_trouble
from hindrl_jax.plotting.statistics import Interval, bootstrap, bootstrap_difference
from hindrl_jax.runs.recorded import RecordedRun, read_recorded
from hindrl_jax.runs.spec import CONFIG

FEW_SEEDS = 8
"""With fewer, bootstrap intervals are much too narrow."""


@dataclasses.dataclass(frozen=True)
class Comparison:
    """One run beside the first. Intervals of a single seed are infinitely wide."""

    run: RecordedRun
    returned_success: Interval
    seeds_reaching_95: int
    steps_to_95: float
    """Median over all seeds, infinite if half of them never get there. Environment steps; for bc, gradient steps."""
    seconds_to_95: float
    """Likewise."""
    difference: Interval | None
    """Of the returned policies' success from that of the first run's; None for the first."""
    paired: bool
    """Whether the difference is taken seed by seed: both runs have the same ones."""


def find_runs(paths: Sequence[Path]) -> list[Path]:
    """The directories of runs among these: each is one, or holds some, as a sweep's does.

    Raises:
      UserError: if one is neither.
    """
    found: list[Path] = []
    for path in paths:
        single = os.path.exists(path / CONFIG)  # unlike Path.exists, also answers for a name that is too long
        inside = [] if single or not os.path.isdir(path) else sorted(child.parent for child in path.glob(f"*/{CONFIG}"))
        if not single and not inside:
            raise UserError(f"{path} is not the directory of a run, nor of several: give what `hindrl train --out` or `hindrl sweep --out` wrote")
        found += inside or [path]
    return list({path.resolve(): path for path in found}.values())


def read_runs(paths: Sequence[Path]) -> list[RecordedRun]:
    """Reads what each of these directories holds so far.

    Raises:
      UserError: if one is damaged, or has no evaluation yet.
    """
    return [read_recorded(path, label) for path, label in zip(paths, _labels(paths), strict=True)]


def compare(runs: Sequence[RecordedRun]) -> list[Comparison]:
    """Each run by itself, and beside the first."""
    return [_compared(run, runs[0]) for run in runs]


def changes(run: RecordedRun, first: RecordedRun) -> dict[str, tuple[Any, Any]]:
    """What a run was asked to do in another way than the first: field -> (its value, the first's). A field that one lacks is None there."""
    own, others = (_flat({**run.spec.to_json(), "demos": _where(run.spec.demos), "seeds": _span(run.spec.seeds)}) for run in (run, first))
    return {name: (own.get(name), others.get(name)) for name in (own | others) if own.get(name) != others.get(name)}


def remarks(compared: Sequence[Comparison]) -> list[str]:
    """What must be known to read the comparison, a line each."""
    runs = [one.run for one in compared]
    lines = []
    for run in runs:
        if not run.finished:
            done, unit = (run.updates, "updates") if run.cloning else (run.env_steps, "steps")
            moment = f"{done[-1]:,} of {run.spec.config.num_steps:,} {unit}"
            lines.append(f"{run.label} is not finished: its success is that of the evaluation at {moment}")
        if run.ended_with_clones:
            lines.append(f"{run.label} ended with clones, before its method learnt anything: to compare methods, train with --imitation-steps 0")
    if len({(run.spec.env.name, json.dumps(dataclasses.asdict(run.spec.env), default=str)) for run in runs}) > 1:
        lines.append("the runs are of different environments: what they differ by is the task as well as the method")
    if any(run.cloning for run in runs) and not all(run.cloning for run in runs):
        lines.append("bc takes no environment steps: its steps are gradient steps")
    if any(one.difference is not None and not one.paired for one in compared):
        lines.append("where the seeds are not those of the first run, the difference is one of means (marked ~), else it is taken seed by seed")
    numbers = [len(run.spec.seeds) for run in runs]
    if 1 in numbers:
        lines.append(f"a single seed has no interval: train several, for example --seeds {FEW_SEEDS}")
    if any(1 < number < FEW_SEEDS for number in numbers):
        lines.append(f"with fewer than {FEW_SEEDS} seeds the intervals are much too narrow")
    return lines


def write_csv(compared: Sequence[Comparison], path: Path) -> None:
    """Writes a row for each run; success as a share, `inf` where 95% was not reached.

    Raises:
      UserError: if it cannot be written.
    """
    rows = [_csv_row(one) for one in compared]
    with disk_trouble(path), path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def _csv_row(one: Comparison) -> dict[str, Any]:
    run = one.run
    row: dict[str, Any] = {
        "run": run.label,
        "path": run.path,
        "env": run.spec.env.name,
        "algo": run.spec.config.algo,
        "demos": run.spec.demos,
        "seeds": len(run.spec.seeds),
        "finished": run.finished,
        "env_steps": run.env_steps[-1],
        "updates": run.updates[-1],
        "seconds": f"{run.seconds[-1]:.6g}",
        "seeds_reaching_95": one.seeds_reaching_95,
        "median_env_steps_to_95": "" if run.cloning else f"{one.steps_to_95:.6g}",
        "median_updates_to_95": f"{one.steps_to_95:.6g}" if run.cloning else "",
        "median_seconds_to_95": f"{one.seconds_to_95:.6g}",
    }
    for name, interval in (("returned_success", one.returned_success), ("difference", one.difference)):
        for suffix, field in (("", "estimate"), ("_low", "low"), ("_high", "high")):
            row[name + suffix] = "" if interval is None else f"{getattr(interval, field):.6g}"
    return row | {"paired": "" if one.difference is None else one.paired}


def _compared(run: RecordedRun, first: RecordedRun) -> Comparison:
    difference, paired = None, False
    if run is not first:
        order = {seed: index for index, seed in enumerate(first.spec.seeds)}
        paired = set(order) == set(run.spec.seeds)
        baseline = first.returned_success[[order[seed] for seed in run.spec.seeds]] if paired else first.returned_success
        if min(len(run.returned_success), len(baseline)) > 1:
            difference = bootstrap_difference(run.returned_success, baseline, paired=paired)
        else:
            difference = _without_interval(float(run.returned_success.mean() - baseline.mean()))
    steps = run.to_95("updates" if run.cloning else "steps")
    final = run.returned_success
    return Comparison(
        run=run,
        returned_success=bootstrap(final) if len(final) > 1 else _without_interval(float(final[0])),
        seeds_reaching_95=int(np.isfinite(steps).sum()),
        steps_to_95=float(np.median(steps)),
        seconds_to_95=float(np.median(run.to_95("seconds"))),
        difference=difference,
        paired=paired,
    )


def _without_interval(estimate: float) -> Interval:
    return Interval(estimate=estimate, low=-np.inf, high=np.inf)


def _labels(paths: Sequence[Path]) -> list[str]:
    """As much of the end of each path as tells it from the others."""
    parts = [path.resolve().parts for path in paths]
    for length in range(1, max(map(len, parts))):
        labels = ["/".join(of_path[-length:]) for of_path in parts]
        if len(set(labels)) == len(labels):
            return labels
    return ["/".join(of_path) for of_path in parts]


def _flat(tree: dict[str, Any]) -> dict[str, Any]:
    """The leaves of nested objects by the name of their field alone, as they are written on the command line."""
    leaves: dict[str, Any] = {}
    for name, value in tree.items():
        leaves |= _flat(value) if isinstance(value, dict) else {name: value}
    return leaves


def _where(demos: str) -> str:
    return Path(demos).name


def _span(seeds: Sequence[int]) -> str:
    consecutive = list(seeds) == list(range(seeds[0], seeds[0] + len(seeds)))
    return f"{seeds[0]} to {seeds[-1]}" if consecutive and len(seeds) > 1 else " ".join(map(str, seeds))
