"""What became of cells, beside the baseline of their task. Made from the directories alone, so it can be made again."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable, Sequence
from typing import Literal

import numpy as np

from hindrl_jax.plotting.statistics import Interval, bootstrap
from hindrl_jax.reproduction.cells import Cell, is_finished
from hindrl_jax.runs.recorded import RecordedRun, read_recorded


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What became of a cell. Intervals are 95% bootstrap intervals over its seeds."""

    cell: Cell
    is_baseline: bool
    """Whether it is the cell that those of its task are compared with."""
    seeds_reaching_95: int
    """Seeds of which an evaluation along the run was at 95% or more."""
    steps_to_95: Interval
    """Median of the environment steps to the first such evaluation; a seed without one counts as infinite."""
    returned_success: Interval
    """Mean of the returned policies' success in fresh episodes."""
    mean_success: Interval
    """Mean over seeds of the success along the run: the area under the curve of its evaluations, see `success_along`."""
    difference: Interval
    """The baseline's `mean_success` subtracted seed by seed; 0 for the baseline."""
    seconds_per_seed: float
    """Wall-clock training time of the run, evaluations included and compilation not, over the number of its seeds."""
    relative_cost: float
    """That time per gradient step, rollouts and evaluations included, over the baseline's."""

    def verdict(self) -> Literal["better", "worse", "open"]:
        """Whether the interval of the difference says what the change does."""
        if not self.difference.excludes(0.0):
            return "open"
        return "better" if self.difference.estimate > 0.0 else "worse"


def success_along(env_steps: Sequence[float] | np.ndarray, success: Sequence[float] | np.ndarray) -> float:
    """Mean success along a run: the area under its evaluations, joined by straight lines from 0 at step 0, over its length.

    Args:
      env_steps: (evaluations,) environment steps, increasing.
      success: (evaluations,) in [0, 1].
    """
    steps = np.asarray([0.0, *env_steps], np.float64)
    return float(np.trapezoid([0.0, *success], steps) / steps[-1])


def outcomes_of(cells: Iterable[Cell]) -> list[Outcome]:
    """The outcomes of those cells that are finished, in their order.

    Args:
      cells: task by task. The first cell of a task is its baseline; a task whose baseline is not finished is left out.

    Raises:
      UserError: if a run's files cannot be read.
    """
    outcomes = []
    for _, of_task in itertools.groupby(cells, key=lambda cell: cell.task):
        baseline_cell, *others = of_task
        if is_finished(baseline_cell):
            baseline = read_recorded(baseline_cell.path)
            outcomes.append(_outcome(baseline_cell, baseline, baseline))
            outcomes += [_outcome(cell, read_recorded(cell.path), baseline) for cell in others if is_finished(cell)]
    return outcomes


def _outcome(cell: Cell, run: RecordedRun, baseline: RecordedRun) -> Outcome:
    steps_to_95, along = run.to_95("steps"), _success_along_of_seeds(run)
    return Outcome(
        cell=cell,
        is_baseline=run is baseline,
        seeds_reaching_95=int(np.isfinite(steps_to_95).sum()),
        steps_to_95=bootstrap(steps_to_95, np.median),
        returned_success=bootstrap(run.returned_success),
        mean_success=bootstrap(along),
        difference=bootstrap(along - _success_along_of_seeds(baseline)),
        seconds_per_seed=run.train_seconds / len(run.returned_success),
        relative_cost=(run.train_seconds / run.updates[-1]) / (baseline.train_seconds / baseline.updates[-1]),
    )


def _success_along_of_seeds(run: RecordedRun) -> np.ndarray:
    return np.asarray([success_along(run.env_steps, success) for success in run.success.T])
