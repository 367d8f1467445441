"""Reporters show a training elsewhere while it goes: in TensorBoard, in Weights & Biases. Both are optional, and imported only when asked for.

`hindrl train --tensorboard --wandb` attaches them to the run's directory; from Python each is a `report` of `fit`:

    hindrl.fit(env, demonstrations, config, seeds=range(8), report=hindrl.TensorBoardReporter("runs/mine"))
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterator, Sequence

import numpy as np

from hindrl_jax.base.errors import UserError, one_line
from hindrl_jax.base.extras import require
from hindrl_jax.runs.reporter import Reporter
from hindrl_jax.runs.spec import RunSpec


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
