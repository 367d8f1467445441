"""Writing and reading the directory of a sweep."""

from __future__ import annotations

import csv
import dataclasses
import json
import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from hindrl_jax.base.errors import UserError, one_line
from hindrl_jax.base.files import disk_trouble, write_text_atomically
from hindrl_jax.config import with_values
from hindrl_jax.plotting import curves as plots
from hindrl_jax.runs.reporter import Reporter
from hindrl_jax.runs.spec import CHECKPOINTS, RUN_FILES, SWEEP, SWEEP_CURVES, SWEEP_SETTINGS, RunSpec, read_spec
from hindrl_jax.runs.writer import RunWriter
from hindrl_jax.training.result import Result


class SweepWriter:
    """Writes a sweep: a run's directory for each setting, `sweep.csv` with a row for each, and their curves in `sweep.png`.

    `sweep.json` lists the settings, in order; checkpoints are those of the whole sweep.
    """

    def __init__(
        self,
        path: Path,
        spec: RunSpec,
        settings: list[dict[str, float]],
        *,
        overwrite: bool = False,
        resume: bool = False,
        reporters: Sequence[type[Reporter]] = (),
    ):
        """Only checks, as `RunWriter` does; `settings` are the swept fields and their values, in order of the runs.

        Raises:
          ValueError: if a config refuses a value.
          UserError: if the path holds something else, or a sweep and neither `overwrite` nor `resume` is on, or cannot be written.
        """
        self.path, self.settings, self.resume = path, settings, resume
        there = [name for name in (*RUN_FILES, SWEEP_SETTINGS, SWEEP, SWEEP_CURVES) if os.path.exists(path / name)]
        if there and not ((overwrite or resume) and SWEEP_SETTINGS in there):
            raise UserError(f"{path} already holds {', '.join(there)}: choose another --out, or replace a sweep with --overwrite")
        specs = [dataclasses.replace(spec, config=with_values(spec.config, setting)) for setting in settings]
        choices: dict[str, Any] = dict(overwrite=overwrite, resume=resume, reporters=reporters)
        self.runs = [RunWriter(path / _setting_folder(setting), spec, **choices) for setting, spec in zip(settings, specs, strict=True)]

    @property
    def started(self) -> bool:
        """Whether `start` was called."""
        return self.runs[-1].started

    def start(self) -> None:
        """Starts the run of each setting.

        Raises:
          UserError: if the directory cannot be written, or another process writes it.
        """
        for run in self.runs:
            run.start()
        with disk_trouble(self.path):
            for name in (SWEEP, SWEEP_CURVES):
                (self.path / name).unlink(missing_ok=True)
            if not self.resume:
                shutil.rmtree(self.path / CHECKPOINTS, ignore_errors=True)
            write_text_atomically(self.path / SWEEP_SETTINGS, json.dumps(self.settings, indent=2) + "\n")

    def finish(self, result: Result) -> list[dict[str, Any]]:
        """Finishes the run of each setting, then writes the table and the picture; returns the rows of the table.

        The median is over the seeds that reached 95%, None if none did; in environment steps, for bc in updates.
        """
        num_seeds = len(result.seeds) // len(self.runs)
        guidance, agent = jax.device_get((result.guidance, result.state.agent))  # once, not for each part
        result = dataclasses.replace(result, guidance=guidance, state=result.state.replace(agent=agent))
        parts = [result.part(slice(index * num_seeds, (index + 1) * num_seeds)) for index in range(len(self.runs))]
        unit = "env_steps" if result.config.learns_from_rollouts else "updates"
        table = []
        for setting, writer, part in zip(self.settings, self.runs, parts, strict=True):
            seeds = writer.finish(part, film=False)["seeds"]
            returned = [seed["returned_success"] for seed in seeds]
            steps = [seed[f"{unit}_to_95"] for seed in seeds if seed[f"{unit}_to_95"] is not None]
            outcome = {
                "seeds": num_seeds,
                "seeds_reaching_95": len(steps),
                f"median_{unit.removeprefix('env_')}_to_95": float(np.median(steps)) if steps else None,
                "mean_returned_success": float(np.mean(returned)),
                "worst_returned_success": min(returned),
            }
            table.append(setting | outcome)
        with disk_trouble(self.path):
            with (self.path / SWEEP).open("w", newline="") as file:
                rows = csv.DictWriter(file, list(table[0]))
                rows.writeheader()
                rows.writerows(table)
            plots.save_sweep(parts, [writer.path.name for writer in self.runs], self.path / SWEEP_CURVES)
        shutil.rmtree(self.path / CHECKPOINTS, ignore_errors=True)
        return table

    def close(self) -> None:
        """Lets other processes write the directories of the settings. `finish` does it, too."""
        for run in self.runs:
            run.close()


def _setting_folder(setting: dict[str, float]) -> str:
    return ",".join(f"{name}={value!r}" for name, value in setting.items())


def read_sweep(path: Path) -> tuple[RunSpec, list[dict[str, float]]]:
    """What a sweep was asked to do, and its settings in order.

    Raises:
      UserError: if the directory does not hold one.
    """
    file = path / SWEEP_SETTINGS
    try:
        settings = json.loads(file.read_text())
        spec = read_spec(path / _setting_folder(settings[0]))
        for setting in settings:
            with_values(spec.config, setting)
    except UserError:
        raise
    except (OSError, UnicodeDecodeError, ValueError, KeyError, IndexError, TypeError, AttributeError, RecursionError) as error:
        raise UserError(f"{file} does not tell the settings of a sweep ({one_line(error)}): start the sweep again") from error
    return spec, settings
