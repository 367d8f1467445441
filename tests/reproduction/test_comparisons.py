"""Pairs of cells that claims compare, of runs whose figures are made up."""

import pytest
from made_up_runs import recorded

from hindrl_jax.plotting.statistics import Interval
from hindrl_jax.reproduction.comparisons import Pair, compare, pairs
from hindrl_jax.reproduction.thesis import Setting

PAIRS = {(pair.first, pair.second): pair for pair in pairs()}
HINDRL, TQCFD = Setting("fixed-1", "hindrl"), Setting("fixed-1", "tqcfd")


def test_the_pairs_are_those_that_the_claims_compare():
    assert [pair.claims for pair in PAIRS.values()] == ["a", "a", "a", "b", "b", "b", "c", "f", "g"]
    # Claim (g) compares both ways round.
    assert (Setting("reach-1", "smooth-hindrl"), Setting("reach-1", "hindrl")) not in PAIRS
    pair = PAIRS[Setting("fixed-1", "tqcfd"), Setting("fixed-5", "bc")]
    assert pair.title() == "FixedGridPickAndPlace: TQCfD, 1 demonstration, over BC, 5 demonstrations"


def test_chances_by_hand():
    # HinDRL: all four seeds solve everything at once, in 40 steps; TQCfD: two never do, and the other two later, in 50.
    better = recorded([[1.0] * 4, [1.0] * 4], episode_length=[[40.0] * 4] * 2)
    worse = recorded([[0.0] * 4, [1.0, 1.0, 0.0, 0.0]], episode_length=[[50.0] * 4] * 2)
    found = {one.measure: one for one in compare(PAIRS[HINDRL, TQCFD], {HINDRL: better, TQCFD: worse})}
    assert found["success"].chance.estimate == pytest.approx((2 * 4 + 2 * 2) / 16)  # two pairs in four are equal and count half
    assert (found["success"].said, found["steps"].said) == ("open", "first")  # drawn anew, all four of TQCfD's may be good, which is a half
    assert found["steps"].chance == Interval(1.0, 1.0, 1.0)
    assert (found["execution_steps"].chance, found["execution_steps"].said) == (Interval(1.0, 1.0, 1.0), "open")  # of two seeds of TQCfD alone
    (other_way,) = [one for one in compare(Pair("x", TQCFD, HINDRL), {HINDRL: better, TQCFD: worse}) if one.measure == "steps"]
    assert (other_way.chance.estimate, other_way.said) == (0.0, "second")
    assert compare(PAIRS[HINDRL, TQCFD], {HINDRL: better}) == []


def test_runs_that_are_too_short_leave_all_open():
    better, worse = (recorded([[share] * 8], episode_length=[[40.0] * 8]) for share in (1.0, 0.0))
    for settles, said in ((True, "first"), (False, "open")):
        (one,) = [one for one in compare(PAIRS[HINDRL, TQCFD], {HINDRL: better, TQCFD: worse}, settles=settles) if one.measure == "success"]
        assert one.said == said


def test_equal_cells_are_open():
    run = recorded([[0.96] * 8], episode_length=[[40.0] * 8])
    for one in compare(PAIRS[HINDRL, TQCFD], {HINDRL: run, TQCFD: run}):
        assert (one.chance.estimate, one.said) == (0.5, "open")
