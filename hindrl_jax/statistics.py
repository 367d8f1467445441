"""Estimates over seeds with bootstrap intervals (Agarwal et al., deep reinforcement learning at the edge of the statistical precipice, 2021)."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

CONFIDENCE = 0.95
RESAMPLES = 10_000


@dataclasses.dataclass(frozen=True)
class Interval:
    """An estimate and the interval around it; infinite where what is estimated is."""

    estimate: float
    low: float
    high: float

    def excludes(self, value: float) -> bool:
        """Whether a value lies outside the interval."""
        return not self.low <= value <= self.high


def bootstrap(values: Sequence[float] | np.ndarray, statistic: Callable[..., np.ndarray] = np.mean) -> Interval:
    """A statistic of independent values, and its 95% interval by the percentile bootstrap (Efron 1979).

      The values are drawn anew, with replacement, 10,000 times; the interval reaches from the 2.5% to the 97.5% quantile of the statistic of these
    draws. Quantiles are values that did occur, never something between two of them, so infinite values are allowed. With few values the interval is
    somewhat too narrow: of 16 normally distributed ones, it holds the true mean in 92% of all cases. Equal values give equal intervals.

    Args:
      values: (S,) one number per seed, at least two.
      statistic: np.mean, np.median or the like: takes an array and `axis`.
    """
    values = np.asarray(values, np.float64)
    if len(values) < 2:
        raise ValueError(f"{len(values)} value has no bootstrap interval: give at least 2")
    draws = np.random.default_rng(0).integers(len(values), size=(RESAMPLES, len(values)))
    tail = (1.0 - CONFIDENCE) / 2.0
    low, high = np.quantile(statistic(values[draws], axis=1), (tail, 1.0 - tail), method="inverted_cdf")
    return Interval(estimate=float(statistic(values, axis=0)), low=float(low), high=float(high))
