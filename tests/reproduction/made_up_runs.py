"""Runs of the thesis's cells that nobody trained, so that every figure is known."""

import csv
import dataclasses
import json
from pathlib import Path

import numpy as np
from tiny import CONFIG, ENV

from hindrl_jax.runs.recorded import RecordedRun
from hindrl_jax.runs.spec import RunSpec


def recorded(success, *, returned=None, **metrics):
    """A finished run of S seeds with these evaluations, (E, S), at steps 10, 20, 30 ..."""
    success = np.asarray(success, np.float64)
    steps = 10 * np.arange(1, len(success) + 1)
    seeds = tuple(range(success.shape[1]))
    return RecordedRun(
        path=Path("nowhere"),
        label="made up",
        spec=RunSpec(env=ENV, config=CONFIG, demos="1", seeds=seeds),
        env_steps=steps,
        updates=steps,
        seconds=steps.astype(float),
        success=success,
        metrics={name.replace("__", "/"): np.asarray(values, np.float64) for name, values in metrics.items()},
        returned_success=success[-1] if returned is None else np.asarray(returned, np.float64),
        train_seconds=60.0,
        finished=True,
    )


def write_run(cell, success, *, returned, episode_length=30.0, seconds=60.0, seeds=None, **metrics):
    """The directory of a finished run of a cell, with these evaluations, (E, S), at steps 1,000, 2,000, ..."""
    spec = cell.spec if seeds is None else dataclasses.replace(cell.spec, seeds=tuple(seeds))
    cell.path.mkdir(parents=True)
    (cell.path / "config.json").write_text(json.dumps(spec.to_json()))
    with (cell.path / "metrics.csv").open("w", newline="") as file:
        columns = ("seed", "env_steps", "updates", "seconds", "success", "episode_length", *(name.replace("__", "/") for name in metrics))
        writer = csv.writer(file)
        writer.writerow(columns)
        for index, evaluation in enumerate(success, 1):
            for seed, value in zip(spec.seeds, evaluation, strict=True):
                writer.writerow((seed, 1_000 * index, 250 * index, float(index), value, episode_length, *metrics.values()))
    summary = {"seeds": [{"returned_success": value} for value in returned], "train_seconds": seconds}
    (cell.path / "summary.json").write_text(json.dumps(summary))
