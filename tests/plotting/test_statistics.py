"""Bootstrap intervals, by hand where few values are drawn, against the normal distribution where many are."""

import numpy as np
import pytest
from scipy import stats

from hindrl_jax.plotting.statistics import (
    Interval,
    bootstrap,
    bootstrap_band,
    bootstrap_difference,
    interquartile_mean,
    performance_profile,
    probability_of_improvement,
    share,
    stratified_bootstrap,
)


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


def test_interquartile_means_by_hand():
    # Of 8 values 2 are left out at each end, of 5 or 4 one, of 3 none.
    assert interquartile_mean([9.0, 1.0, 2.0, 3.0, 4.0, 5.0, -50.0, 90.0]) == pytest.approx(3.5)
    assert interquartile_mean(np.array([[0.0, 1.0, 2.0, 6.0], [4.0, 4.0, 1.0, 9.0]])).tolist() == [1.5, 4.0]
    assert interquartile_mean([0.0, 1.0, 2.0, 6.0, 100.0]) == pytest.approx(3.0)
    assert interquartile_mean([0.0, 1.0, 5.0]) == pytest.approx(2.0)


def test_probability_of_improvement_by_hand():
    # Of the six pairs (1, 0) (1, 1) (1, 3), (2, 0) (2, 1) (2, 3) three are improvements and one is a draw.
    assert probability_of_improvement(np.array([1.0, 2.0]), np.array([0.0, 1.0, 3.0])) == pytest.approx(3.5 / 6)
    assert probability_of_improvement(np.array([np.inf, 1.0]), np.array([np.inf])) == pytest.approx(0.25)  # never and never is a draw
    assert probability_of_improvement(np.zeros((5, 4)), np.ones((5, 3))).tolist() == [0.0] * 5


def test_probability_of_improvement_is_mann_and_whitneys():
    rng = np.random.default_rng(3)
    values, baseline = rng.integers(6, size=9), rng.integers(6, size=7)
    assert probability_of_improvement(values, baseline) == pytest.approx(stats.mannwhitneyu(values, baseline).statistic / (9 * 7))


def test_performance_profiles_by_hand():
    # Above 0, 0.4 and 1 lie 3, 2 and 0 of the first group's four values and none of the second's two: averaged over groups 3/8, 1/4 and 0.
    shares, low, high = performance_profile([[0.0, 0.2, 0.6, 1.0], [0.0, 0.0]], np.array([0.0, 0.4, 1.0]))
    np.testing.assert_allclose(shares, [0.375, 0.25, 0.0])
    # 4 values drawn anew, each above 0.4 with chance 1/2: none with chance 1/16 and all with 1/16, more than 2.5% at each end; halved by the average.
    np.testing.assert_allclose([low[1], high[1], high[2]], [0.0, 0.5, 0.0])
    assert performance_profile([[0.5], [0.5, 0.7]], np.array([0.1]))[1:] == (0.0, 1.0)


def test_performance_profiles_are_bootstrapped_within_groups():
    rng, thresholds = np.random.default_rng(5), np.array([0.3, 0.7])
    groups = [rng.random(12), rng.random(9) / 2]
    shares, low, high = performance_profile(groups, thresholds)
    for index, threshold in enumerate(thresholds):

        def above(drawn, threshold=threshold):
            return np.mean([np.mean(group > threshold, axis=-1) for group in drawn], axis=0)

        whole = stratified_bootstrap(groups, above)
        assert shares[index] == pytest.approx(whole.estimate)
        np.testing.assert_allclose([low[index], high[index]], [whole.low, whole.high], atol=0.05)  # one value of twelve, halved, is 0.04


def test_shares_by_hand():
    # Wilson: (p + z^2 / 2n -+ z sqrt(p (1 - p) / n + z^2 / 4n^2)) / (1 + z^2 / n), z^2 = 3.8415. For 0 of 4 the upper end is z^2 / (4 + z^2).
    assert (share(0, 4).estimate, share(0, 4).low, share(0, 4).high) == pytest.approx((0.0, 0.0, 3.8415 / 7.8415), abs=1e-4)
    assert (share(4, 4).low, share(4, 4).high) == pytest.approx((4 / 7.8415, 1.0), abs=1e-4)


def test_strata_are_drawn_among_themselves():
    # Were the two groups mixed, the mean of a draw would vary; among themselves, equal values give equal means.
    mean = stratified_bootstrap([[0.0] * 6, [1.0] * 3], lambda groups: np.concatenate(groups, axis=-1).mean(axis=-1))
    assert (mean.estimate, mean.low, mean.high) == pytest.approx((1 / 3,) * 3)
    # A group of two is drawn as 0 0, 0 1, 1 0, 1 1, as in `bootstrap`; the other adds 10.
    total = stratified_bootstrap([[0.0, 1.0], [10.0, 10.0]], lambda groups: groups[0].mean(axis=-1) + groups[1].mean(axis=-1))
    assert total == Interval(10.5, 10.0, 11.0)
    assert stratified_bootstrap([[0.0, 1.0], [2.0]], lambda groups: groups[1].mean(axis=-1)) == Interval(2.0, -np.inf, np.inf)
