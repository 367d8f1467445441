"""What a run's writer tells of a training: a `Reporter`, which shows it elsewhere while it goes.

A reporter is told of evaluations and nothing else, so it costs the training nothing between them. Those that there are stand in
`hindrl_jax.reporting.reporters`.
"""

from __future__ import annotations

import abc
import os
from collections.abc import Sequence
from pathlib import Path

from hindrl_jax.base.errors import UserError
from hindrl_jax.runs.spec import FROM_PYTHON, RunSpec
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
        """Shows what 100 fresh episodes of the returned and of the last policies (S of each) gave, and closes."""
        ends = [
            {
                "returned/success": seed.returned_success,
                "returned/episode_length": seed.returned_length,
                "final/success": seed.final_success,
                "final/episode_length": seed.episode_length,
            }
            for seed in summaries
        ]
        self._write(self._last.seconds, steps_of(self._last), ends)
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
