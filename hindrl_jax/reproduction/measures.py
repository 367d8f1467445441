"""What is measured of a finished run: one number per seed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np

from hindrl_jax.runs.recorded import RecordedRun
from hindrl_jax.training.result import SOLVED

HINDSIGHT_REWARD = "batch/hindsight_reward"
"""Column of the sum of the rewards of a batch's relabelled rows. Runs that do not record it have no hindsight reward to show."""

MeasureName = Literal["success", "converged", "steps", "execution_steps", "success_once_learnt", "most_hindsight_reward"]


def success(run: RecordedRun) -> np.ndarray:
    """(S,) share of 100 fresh episodes that the returned policies solve."""
    return run.returned_success


def converged(run: RecordedRun) -> np.ndarray:
    """(S,) bool, whether an evaluation along the run reached 95%."""
    return np.isfinite(steps(run))


def steps(run: RecordedRun) -> np.ndarray:
    """(S,) environment steps (bc: gradient steps) to that evaluation; infinite where there is none."""
    return run.to_95("updates" if run.cloning else "steps")


def execution_steps(run: RecordedRun) -> np.ndarray:
    """(C,) mean length of the last evaluation's episodes, of the C seeds that solve 95% of them."""
    return run.metrics["episode_length"][-1][run.success[-1] >= SOLVED]


def success_once_learnt(run: RecordedRun) -> np.ndarray:
    """(C,) mean success of all evaluations from the first at 95% on, of the C converged seeds: 1 if nothing is lost again."""
    reached = run.success >= SOLVED
    since = np.logical_or.accumulate(reached, axis=0)[:, reached.any(axis=0)]
    return np.sum(run.success[:, reached.any(axis=0)] * since, axis=0) / np.sum(since, axis=0)


def most_hindsight_reward(run: RecordedRun) -> np.ndarray:
    """(S,) largest mean hindsight reward between two evaluations; empty if it was not recorded."""
    return run.metrics[HINDSIGHT_REWARD].max(axis=0) if HINDSIGHT_REWARD in run.metrics else np.zeros(0)


MEASURES: dict[MeasureName, Callable[[RecordedRun], np.ndarray]] = {
    "success": success,
    "converged": converged,
    "steps": steps,
    "execution_steps": execution_steps,
    "success_once_learnt": success_once_learnt,
    "most_hindsight_reward": most_hindsight_reward,
}
