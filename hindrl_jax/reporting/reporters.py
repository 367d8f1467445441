"""Reporters show a training elsewhere while it goes: in TensorBoard, in Weights & Biases. Both are optional, and imported only when asked for.

A reporter is told of evaluations and nothing else, so it costs the training nothing between them. `hindrl train --tensorboard --wandb` attaches
them to the run's directory; from Python each is a `report` of `fit`:

    hindrl.fit(env, demonstrations, config, seeds=range(8), report=hindrl.TensorBoardReporter("runs/mine"))
"""

from __future__ import annotations

import abc
import contextlib
import os
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hindrl_jax.base.errors import UserError, one_line
from hindrl_jax.base.extras import require

if TYPE_CHECKING:
    from hindrl_jax.runs.spec import RunSpec
    from hindrl_jax.training.result import Result, Row, SeedSummary


class Reporter(abc.ABC):
    """Told of one run's evaluations: `start` once, `report` whenever there may be new ones, `finish` at the end. Or called with a `Result`."""

    folder: str
    """Where it writes, below the run's directory; also the name of the option that asks for it."""

    def __init__(self, directory: str | os.PathLike[str]):
        """Only checks; nothing is written before `start`.

        Args:
          directory: the run's.

        Raises:
          UserError: if something that it needs is missing.
        """
        self.directory = Path(directory)
        self._seeds: Sequence[int] = ()
        self._num_seeds = 0
        self._reported = 0

    def __call__(self, result: Result) -> None:
        """For `fit(..., report=...)`."""
        from hindrl_jax.runs.spec import FROM_PYTHON, RunSpec

        if self._num_seeds and (self._seeds != result.seeds or len(result.rows) < self._reported):
            self._close()  # of a run that was interrupted
            self._num_seeds = 0
        if not self._num_seeds:
            if len(set(result.configs)) > 1:
                raise UserError("a reporter shows runs of one config: train the others apart, or use `hindrl sweep`")
            self.start(RunSpec(env=result.env, config=result.config, demos=FROM_PYTHON, seeds=result.seeds))
        self.report(result.rows)
        if result.final_success is not None:
            self.finish(result.summaries())

    def start(self, spec: RunSpec) -> None:
        """Opens what will be written to; a reporter that was used before begins anew.

        Raises:
          UserError: if it cannot.
        """
        self._seeds, self._num_seeds, self._reported = spec.seeds, len(spec.seeds), 0
        self._open(spec)

    def report(self, rows: Sequence[Row]) -> None:
        """Shows those of the run's rows so far (S per evaluation, in order of the seeds) that are new since the last call."""
        while self._reported < len(rows):
            evaluation = rows[self._reported : self._reported + self._num_seeds]
            self._write(evaluation[0].seconds, steps_of(evaluation[0]), [scalars(row) for row in evaluation])
            self._reported += self._num_seeds
            self._last = evaluation[0]

    def finish(self, summaries: Sequence[SeedSummary]) -> None:
        """Shows what the 100 fresh episodes of the final policies (S of them) gave, and closes."""
        final = [{"final/success": seed.final_success, "final/episode_length": seed.episode_length} for seed in summaries]
        self._write(self._last.seconds, steps_of(self._last), final)
        self._close()
        self._num_seeds = 0

    @abc.abstractmethod
    def _open(self, spec: RunSpec) -> None: ...

    @abc.abstractmethod
    def _write(self, seconds: float, steps: int, values: Sequence[dict[str, float]]) -> None:
        """Shows the values of each seed, after so many seconds of training and steps of each seed."""

    @abc.abstractmethod
    def _close(self) -> None: ...


def steps_of(row: Row) -> int:
    """Where a row stands on the horizontal axis: after that many environment steps, or gradient steps for bc, which takes no others."""
    return row.env_steps or row.updates


def scalars(row: Row) -> dict[str, float]:
    """What is shown of a row, by name."""
    evaluation = {"evaluation/success": row.success, "evaluation/episode_length": row.episode_length}
    return evaluation | row.metrics | {"time/seconds": row.seconds, "time/updates": row.updates}


class TensorBoardReporter(Reporter):
    """Writes event files for TensorBoard: DIRECTORY/tensorboard/seed_0 and so on and, of several seeds, their mean in DIRECTORY/tensorboard/mean.

    Look at them with `tensorboard --logdir DIRECTORY`, or at several runs with the folder of all of them. Wall-clock times count training only.
    """

    folder = "tensorboard"
    _SUFFIX = ".hindrl"

    def __init__(self, directory: str | os.PathLike[str]):
        super().__init__(directory)
        require("tensorboard.summary.writer.event_file_writer", "go without --tensorboard")

    def _open(self, spec: RunSpec) -> None:
        from tensorboard.summary.writer.event_file_writer import EventFileWriter

        folder = self.directory / self.folder
        names = [f"seed_{seed}" for seed in spec.seeds] + (["mean"] if len(spec.seeds) > 1 else [])
        try:
            for old in folder.glob(f"*/events.out.tfevents.*{self._SUFFIX}"):  # TensorBoard would mix an earlier run's points into this one
                old.unlink()
                if not any(old.parent.iterdir()):
                    old.parent.rmdir()
            self._files = [EventFileWriter(str(folder / name), filename_suffix=self._SUFFIX) for name in names]
        except OSError as error:
            raise UserError(f"cannot write {folder} ({error.strerror or error}): free some space or choose another place") from error
        self._began = time.time()

    def _write(self, seconds: float, steps: int, values: Sequence[dict[str, float]]) -> None:
        from tensorboard.compat.proto.event_pb2 import Event
        from tensorboard.compat.proto.summary_pb2 import Summary

        if len(values) > 1:
            values = [*values, {name: float(np.mean([of_seed[name] for of_seed in values])) for name in values[0]}]
        for file, shown in zip(self._files, values, strict=True):
            summary = Summary(value=[Summary.Value(tag=name, simple_value=value) for name, value in shown.items()])
            file.add_event(Event(wall_time=self._began + seconds, step=steps, summary=summary))
            file.flush()  # so that whoever looks, or kills the run, has everything up to here

    def _close(self) -> None:
        for file in self._files:
            file.close()


class WandbReporter(Reporter):
    """Sends runs to Weights & Biases: one for each seed, in a group named as the directory.

    W&B's own variables are respected. WANDB_MODE=offline needs neither account nor network and leaves files in DIRECTORY/wandb, which `wandb sync`
    sends later; WANDB_MODE=disabled does nothing; WANDB_PROJECT names the project (hindrl_jax by default).
    """

    folder = "wandb"

    def __init__(self, directory: str | os.PathLike[str]):
        super().__init__(directory)
        self._wandb = require("wandb.sdk", "go without --wandb")
        self._mode = self._wandb.setup().settings.mode
        if self._mode in ("offline", "disabled", "dryrun"):
            return
        with self._trouble():
            known = self._wandb.login(prompt=False)
        if not known:
            raise UserError("W&B knows no account here: log in with `wandb login`, or set WANDB_MODE=offline to send the runs later")

    def _open(self, spec: RunSpec) -> None:
        wandb, group = self._wandb, self.directory.resolve().name
        if self._mode != "disabled":
            (self.directory / self.folder).mkdir(parents=True, exist_ok=True)  # else wandb writes elsewhere
        # Several runs of one process side by side; what is printed belongs to none of them, and W&B would print a dozen lines for each.
        settings = wandb.Settings(silent=True, console="off")
        self._runs = []
        with self._trouble():
            for seed in spec.seeds:
                run = wandb.init(
                    project=os.environ.get("WANDB_PROJECT") or "hindrl_jax",
                    group=group,
                    name=f"{group}/seed_{seed}",
                    config=spec.to_json() | {"seed": seed},
                    dir=os.environ.get("WANDB_DIR") or self.directory,
                    reinit="create_new",
                    settings=settings,
                )
                self._runs.append(run)
                run.define_metric("steps")
                run.define_metric("*", step_metric="steps")

    def _write(self, seconds: float, steps: int, values: Sequence[dict[str, float]]) -> None:
        for run, shown in zip(self._runs, values, strict=True):
            run.log({"steps": steps} | shown)

    def _close(self) -> None:
        for run in self._runs:
            run.finish()

    @contextlib.contextmanager
    def _trouble(self) -> Iterator[None]:
        """Turns what W&B refuses into one line for the user."""
        try:
            yield
        except self._wandb.errors.Error as error:
            raise UserError(f"W&B does not start ({one_line(error)}): mend that, or set WANDB_MODE=offline to send the runs later") from error


REPORTERS: tuple[type[Reporter], ...] = (TensorBoardReporter, WandbReporter)
