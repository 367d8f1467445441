"""Writing a run's directory, see `spec`: each file whole or not at all, metrics.csv row by row."""

from __future__ import annotations

import csv
import dataclasses
import json
import os
import re
import resource
import shutil
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import filelock
import numpy as np
from flax.traverse_util import flatten_dict

from hindrl_jax.base.errors import UserError
from hindrl_jax.base.files import disk_trouble, why_unwritable, write_text_atomically
from hindrl_jax.core.agent import policy
from hindrl_jax.plotting import curves as plots
from hindrl_jax.runs.reader import load_run
from hindrl_jax.runs.reporter import Reporter
from hindrl_jax.runs.spec import (
    CHECKPOINTS,
    CONFIG,
    CURVE,
    EPISODE,
    FILMS,
    FROM_PYTHON,
    LOCK,
    METRICS,
    PARAMETERS,
    ROW_FIELDS,
    RUN_FILES,
    SUMMARY,
    RunSpec,
    lost_functions,
)
from hindrl_jax.tasks.registry import is_drawn
from hindrl_jax.training.result import Result, Row


class RunWriter:
    """Writes a run's directory, file by file, as the run goes. Use `save_run` for a run that is already finished."""

    def __init__(self, path: Path, spec: RunSpec, *, overwrite: bool = False, resume: bool = False, reporters: Sequence[type[Reporter]] = ()):
        """Only checks; nothing is written or removed before `start`.

        Args:
          path: the directory.
          spec: what the run is asked to do.
          overwrite: replace a run that is there.
          resume: go on with the run that is there; its checkpoints are kept.
          reporters: kinds of reporters to tell everything.

        Raises:
          UserError: if the path is a file, cannot be written, is written by another process, or holds (part of) a run and neither
            `overwrite` nor `resume` is on; or if a reporter lacks something.
        """
        self.path, self.spec, self.resume = path, spec, resume
        self._lock = filelock.FileLock(path / LOCK, timeout=0)
        if os.path.exists(path) and not os.path.isdir(path):
            raise UserError(f"{path} is a file: choose another --out")
        reason = why_unwritable(path)
        if reason:
            raise UserError(f"cannot write {path} ({reason}): choose another --out")
        there = [name for name in (*RUN_FILES, CHECKPOINTS) if (path / name).exists()]
        if there and not (overwrite or resume):
            raise UserError(f"{path} already holds a run ({', '.join(there)}): choose another --out, or replace it with --overwrite")
        if (path / LOCK).exists():
            self._take_lock()
            self._lock.release()
        self.reporters = [kind(path) for kind in reporters]
        self.rows_written = 0
        self.started = False
        self.runs = [self]

    def _take_lock(self) -> None:
        """Keeps other processes out until `close`, or until this one ends, however it ends."""
        try:
            self._lock.acquire()
        except filelock.Timeout:
            raise UserError(f"another process is writing {self.path}: wait for it, stop it, or choose another --out") from None

    def start(self) -> None:
        """Removes what an earlier run left, or what this one left after its last checkpoint, then writes the configuration.

        Raises:
          UserError: if the directory cannot be written, or another process writes it.
        """
        with disk_trouble(self.path):
            self.path.mkdir(parents=True, exist_ok=True)
            self._take_lock()
            for reporter in self.reporters:  # before anything is removed, since they have the most reasons not to start
                reporter.start(self.spec)
            for name in RUN_FILES:
                (self.path / name).unlink(missing_ok=True)
            if not self.resume:
                for folder in (CHECKPOINTS, FILMS):
                    shutil.rmtree(self.path / folder, ignore_errors=True)
            write_text_atomically(self.path / CONFIG, json.dumps(self.spec.to_json(), indent=2) + "\n")
        self.started = True

    def report(self, rows: list[Row]) -> None:
        """Appends to `metrics.csv` those of the run's evaluations so far that are new since the last call."""
        for reporter in self.reporters:
            reporter.report(rows)
        rows = rows[self.rows_written :]
        if not rows:
            return
        fields = [*ROW_FIELDS, *rows[0].metrics]
        with disk_trouble(self.path), (self.path / METRICS).open("a", newline="") as file:
            writer = csv.DictWriter(file, fields)
            if self.rows_written == 0:
                writer.writeheader()
            for row in rows:
                values = {name: getattr(row, name) for name in ROW_FIELDS} | row.metrics
                writer.writerow({name: f"{value:.6g}" if isinstance(value, float) else value for name, value in values.items()})
        self.rows_written += len(rows)

    def finish(self, result: Result, *, film: bool = True) -> dict[str, Any]:
        """Writes the parameters, the summary, the curve and (unless `film` is off) the film of an episode; returns the summary.

        A film that cannot be drawn, for want of OpenGL or by a fault of the task's viewer, is a warning: the run is worth more. A task without a
        viewer has no film.
        """
        self.report(result.rows)
        summary = summarise(result)
        with disk_trouble(self.path):
            _save_parameters(self.path / PARAMETERS, result)
            write_text_atomically(self.path / SUMMARY, json.dumps(summary, indent=2) + "\n")
            plots.save_curve(result, self.path / CURVE)
        for reporter in self.reporters:
            reporter.finish(result.summaries())
        if film:
            try:
                run = load_run(self.path)
                if is_drawn(run.spec.env):
                    run.render(self.path / EPISODE)
            except UserError as error:
                warnings.warn(f"no {EPISODE}: {error}", stacklevel=2)
        shutil.rmtree(self.path / CHECKPOINTS, ignore_errors=True)  # last, so that a process killed on the way here can be resumed
        self.close()
        return summary

    def close(self) -> None:
        """Lets other processes write the directory. `finish` does it, too."""
        if self._lock.is_locked:
            (self.path / LOCK).unlink(missing_ok=True)
            self._lock.release()

    def files(self) -> list[str]:
        """Names of what has been written."""
        names = [*RUN_FILES, FILMS, *(reporter.folder for reporter in self.reporters)]
        return [name for name in names if (self.path / name).exists()]


def save_run(path: str | os.PathLike[str], result: Result, *, demos: str = FROM_PYTHON, overwrite: bool = False) -> dict[str, Any]:
    """Writes a finished experiment as a run directory, as `hindrl train` does; returns the summary.

    Args:
      path: the directory.
      result: from `fit`.
      demos: where the demonstrations came from, a number or a path; needed only to run it again with `hindrl train --config`.
      overwrite: replace a run that is there.

    Raises:
      UserError: if the directory already holds a run and `overwrite` is off, or cannot be written, or the result has several configs.
    """
    if len(set(result.configs)) > 1:
        raise UserError("the runs of this result have different configs: save each config's own, for example result.part(slice(0, 8))")
    if lost := lost_functions(result.config):
        warnings.warn(
            f"{', '.join(lost)} of this run will not be found when it is read: put it at the top of a module",
            stacklevel=2,
        )
    writer = RunWriter(Path(path), RunSpec(env=result.env, config=result.config, demos=demos, seeds=result.seeds), overwrite=overwrite)
    writer.start()
    return writer.finish(result)


def summarise(result: Result) -> dict[str, Any]:
    """The contents of `summary.json`.

    Rates are those of learning, without the cloning and practice before it, and of the result's own seeds; other settings of a sweep ran beside them
    in the same time.
    """
    learning, num_seeds = max(result.train_seconds - result.imitation_seconds, 1e-9), len(result.seeds)
    return {
        "seeds": [dataclasses.asdict(seed) for seed in result.summaries()],
        "updates_per_second": num_seeds * result.updates / learning,
        "env_steps_per_second": num_seeds * result.env_steps / learning,
        "compile_seconds": result.compile_seconds,
        "train_seconds": result.train_seconds,
        "peak_memory_bytes": peak_memory_bytes(),
    }


def peak_memory_bytes() -> int:
    """Largest resident memory of this process so far."""
    status = Path("/proc/self/status")
    if status.exists():  # on Linux, since getrusage there also counts the process that this one was started from
        found = re.search(r"VmHWM:\s*(\d+) kB", status.read_text())
        if found:
            return int(found[1]) * 1024
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def _save_parameters(path: Path, result: Result) -> None:
    agent, goals, scale = result.state.agent, result.guidance.behavioural_goals, result.state.agent.scale
    # cloning leaves its critics as they began
    trained = {"critics": agent.critics, "log_alpha": agent.log_alpha} if result.configs[0].learns_from_rollouts else {}
    tree = {
        "policy": result.returned.actor,
        "policy_noise": np.asarray(result.returned.noise, np.float32),
        "last_policy": policy(agent, result.configs[0], average=True).actor,
        "actor": agent.actor,
        **trained,
        "epsilon": result.guidance.epsilon,
        "behavioural_goals": {"goals": goals.goals, "count": goals.count},
        "input_scale": {field.name: getattr(scale, field.name) for field in dataclasses.fields(scale)},
    }
    temporary = path.with_suffix(".partial.npz")
    arrays: dict[str, Any] = {name: np.asarray(leaf) for name, leaf in flatten_dict(tree, sep="/").items()}
    np.savez(temporary, **arrays)
    os.replace(temporary, path)
