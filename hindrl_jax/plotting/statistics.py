"""Estimates over seeds with bootstrap intervals (Agarwal et al., deep reinforcement learning at the edge of the statistical precipice, 2021).

`scipy.stats` is imported where it is used: it would take a third of the start of every command.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

CONFIDENCE = 0.95
RESAMPLES = 10_000
_TAILS = ((1.0 - CONFIDENCE) / 2.0, (1.0 + CONFIDENCE) / 2.0)


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

      The values are drawn again, with replacement, 10,000 times; the interval reaches from the 2.5% to the 97.5% quantile of the statistic of these
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
    low, high = np.quantile(statistic(values[draws], axis=1), _TAILS, method="inverted_cdf")
    return Interval(estimate=float(statistic(values, axis=0)), low=float(low), high=float(high))


def bootstrap_difference(values: Sequence[float] | np.ndarray, baseline: Sequence[float] | np.ndarray, *, paired: bool) -> Interval:
    """How much higher the mean of some values is than that of others, with a 95% interval by the same bootstrap.

    Args:
      values: (S,) one number per seed, at least two.
      baseline: (T,) likewise.
      paired: whether both are of the same seeds, in the same order (S = T). What a seed makes of both, an easy demonstration for one, then drops out.
    """
    values, baseline = np.asarray(values, np.float64), np.asarray(baseline, np.float64)
    if paired:
        return bootstrap(values - baseline)
    low, high = np.quantile(_mean_draws(values[None]) - _mean_draws(baseline[None], seed=1), _TAILS, axis=0, method="inverted_cdf")[:, 0]
    return Interval(estimate=float(values.mean() - baseline.mean()), low=float(low), high=float(high))


def stratified_bootstrap(strata: Sequence[Sequence[float] | np.ndarray], statistic: Callable[[Sequence[np.ndarray]], np.ndarray]) -> Interval:
    """A statistic of several groups of values, and its 95% interval, the values of each group being drawn anew among themselves.

    As in `bootstrap`. Of a group of a single value nothing is known: the interval is infinitely wide.

    Args:
      strata: one group of values, (S,) each, for each cell of the experiment; the groups may differ in their size.
      statistic: of the groups, (..., S) each, gives (...).
    """
    groups = [np.asarray(group, np.float64) for group in strata]
    estimate = float(statistic(groups))
    if min(map(len, groups)) < 2:
        return Interval(estimate, -np.inf, np.inf)
    rng = np.random.default_rng(0)
    drawn = statistic([group[rng.integers(len(group), size=(RESAMPLES, len(group)))] for group in groups])
    low, high = np.quantile(drawn, _TAILS, method="inverted_cdf")
    return Interval(estimate, float(low), float(high))


def interquartile_mean(values: Sequence[float] | np.ndarray) -> np.ndarray:
    """The mean of the middle half: (..., S) -> (...). A quarter of the values, rounded down, is left out at each end."""
    from scipy import stats

    return stats.trim_mean(values, 0.25, axis=-1)


def probability_of_improvement(values: np.ndarray, baseline: np.ndarray) -> np.ndarray:
    """The chance that a value is larger than one of the baseline's, where equal ones count half (Mann and Whitney's U over its maximum).

    Args:
      values: (..., S).
      baseline: (..., T).

    Returns:
      (...) in [0, 1].
    """
    values, baseline = values[..., :, None], baseline[..., None, :]
    return (np.mean(values > baseline, axis=(-2, -1)) + np.mean(values >= baseline, axis=(-2, -1))) / 2.0


def performance_profile(strata: Sequence[Sequence[float] | np.ndarray], thresholds: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The share of values above each threshold, averaged over groups, and its 95% interval by the stratified bootstrap, each point for itself.

    Args:
      strata: one group of values, (S,) each, for each cell of the experiment.
      thresholds: (N,).

    Returns:
      The share, and the lower and upper end of its interval, (N,) each. Of a group of a single value nothing is known: they are 0 and 1.
    """
    from scipy import stats

    shares = np.stack([stats.ecdf(group).sf.evaluate(thresholds) for group in strata])
    if min(map(len, strata)) < 2:
        return shares.mean(axis=0), np.zeros(len(thresholds)), np.ones(len(thresholds))
    # Of S values that are drawn anew, the number above a threshold is binomial.
    rng, numbers = np.random.default_rng(0), np.asarray([len(group) for group in strata])[:, None]
    drawn = np.mean(rng.binomial(numbers, shares, size=(RESAMPLES, *shares.shape)) / numbers, axis=1)
    low, high = np.quantile(drawn, _TAILS, axis=0, method="inverted_cdf")
    return shares.mean(axis=0), low, high


def share(count: int, number: int) -> Interval:
    """The share count / number, with Wilson's 95% interval (Wilson, 1927), which is also of use where all or none are counted."""
    from scipy import stats

    interval = stats.binomtest(count, number).proportion_ci(CONFIDENCE, method="wilson")
    return Interval(count / number, float(interval.low), float(interval.high))


def bootstrap_band(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The 95% intervals of the means of a curve over seeds, each point for itself.

    Args:
      values: (E, S) E points of S seeds, at least two.

    Returns:
      The lower and upper ends, (E,) each.
    """
    low, high = np.quantile(_mean_draws(np.asarray(values, np.float64)), _TAILS, axis=0, method="inverted_cdf")
    return low, high


def _mean_draws(values: np.ndarray, *, seed: int = 0) -> np.ndarray:
    """(RESAMPLES, E) means of (E, S) values over resampled seeds; the same draws for all points."""
    num_seeds = values.shape[1]
    if num_seeds < 2:
        raise ValueError(f"{num_seeds} value has no bootstrap interval: give at least 2")
    shares = np.random.default_rng(seed).multinomial(num_seeds, np.full(num_seeds, 1.0 / num_seeds), size=RESAMPLES) / num_seeds
    return shares @ values.T
