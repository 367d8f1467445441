"""Bootstrap intervals, by hand where few values are drawn, against the normal distribution where many are."""

import numpy as np
import pytest

from hindrl_jax.plotting.statistics import Interval, bootstrap, bootstrap_band, bootstrap_difference


def test_bootstrap_by_hand():
    # Two values are drawn as 0 0, 0 1, 1 0 or 1 1: the means 0, 0.5 and 1 with chances 1/4, 1/2 and 1/4, so both tails of 2.5% lie in the ends.
    assert bootstrap([0.0, 1.0]) == Interval(estimate=0.5, low=0.0, high=1.0)
    assert bootstrap([0.3, 0.3, 0.3]) == Interval(estimate=pytest.approx(0.3), low=pytest.approx(0.3), high=pytest.approx(0.3))
    # Of three values the median of the draw is the smallest if it is drawn twice or thrice: 3 (1/9)(2/3) + 1/27 = 7/27; likewise the largest.
    assert bootstrap([1.0, 2.0, np.inf], np.median) == Interval(estimate=2.0, low=1.0, high=np.inf)
    # Of 40 values, the chance that one that is drawn is the infinite one is 1/40; that half of the draw are is nothing.
    assert bootstrap([*np.full(39, 5.0), np.inf], np.median) == Interval(estimate=5.0, low=5.0, high=5.0)
    assert bootstrap([np.inf, np.inf], np.median) == Interval(estimate=np.inf, low=np.inf, high=np.inf)
    with pytest.raises(ValueError, match="at least 2"):
        bootstrap([1.0])


def test_bootstrap_of_many_values_agrees_with_the_normal_distribution():
    values = np.random.default_rng(1).normal(loc=3.0, size=400)
    half_width = 1.96 * values.std() / 20.0  # 20 is the root of 400
    found = bootstrap(values)
    np.testing.assert_allclose((found.low, found.high), (values.mean() - half_width, values.mean() + half_width), atol=0.05 * half_width)


def test_an_interval_excludes_what_lies_outside_it():
    assert not Interval(1.0, 0.0, 2.0).excludes(0.0)
    assert Interval(1.0, 0.1, 2.0).excludes(0.0)
    assert Interval(-1.0, -2.0, -0.1).excludes(0.0)


def test_intervals_of_differences_and_of_curves_agree_with_those_of_values():
    rng = np.random.default_rng(7)
    values, baseline = rng.normal(3.0, 1.0, 40), rng.normal(1.0, 1.0, 40)
    # of the difference of two independent means the standard error is sqrt(2 / 40) = 0.224, so the interval is about 2 x 1.96 x 0.224 = 0.88 wide
    unpaired = bootstrap_difference(values, baseline, paired=False)
    assert unpaired.estimate == pytest.approx(values.mean() - baseline.mean())
    assert 0.7 < unpaired.high - unpaired.low < 1.05
    assert bootstrap_difference(values, values - 1.0, paired=True).low == pytest.approx(1.0)
    low, high = bootstrap_band(np.stack([values, np.full(40, 0.3)]))
    alone = bootstrap(values)
    np.testing.assert_allclose([low[0], high[0]], [alone.low, alone.high], atol=0.03)
    np.testing.assert_allclose([low[1], high[1]], 0.3)
    with pytest.raises(ValueError, match="give at least 2"):
        bootstrap_band(np.ones((3, 1)))
