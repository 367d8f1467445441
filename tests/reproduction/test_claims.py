"""Measures, parts, claims and verdicts, of runs whose figures are made up."""

import dataclasses
import itertools

import numpy as np
import pytest
from made_up_runs import recorded

from hindrl_jax.plotting.statistics import Interval
from hindrl_jax.reproduction import measures
from hindrl_jax.reproduction.claims import ABOVE_ZERO, CLAIMS, MORE_THAN_HALF, Judged, Part, finding_of, judge, settings_of_claims, verdict
from hindrl_jax.reproduction.thesis import Setting

A, B = Setting("reach-1", "hindrl"), Setting("reach-1", "tqcfd")
CLAIM = {claim.letter: claim for claim in CLAIMS}


def test_measures_by_hand():
    # Seed 0 learns at once and falls back, seed 1 learns at the second evaluation, seed 2 never.
    run = recorded(
        [[1.0, 0.5, 0.0], [0.6, 0.95, 0.9], [0.8, 1.0, 0.9]],
        returned=[1.0, 0.99, 0.9],
        episode_length=[[50, 60, 100], [50, 40, 70], [45, 35, 60]],
        batch__hindsight_reward=[[0, 0, 0], [0, 2, 0], [0, 1, 0]],
    )
    assert measures.success(run).tolist() == [1.0, 0.99, 0.9]
    assert measures.converged(run).tolist() == [True, True, False]
    assert measures.steps(run).tolist() == [10.0, 20.0, np.inf]
    assert measures.execution_steps(run).tolist() == [35.0]  # at the end, only seed 1 is at 95%
    np.testing.assert_allclose(measures.success_once_learnt(run), [(1.0 + 0.6 + 0.8) / 3, (0.95 + 1.0) / 2])
    assert measures.most_hindsight_reward(run).tolist() == [0.0, 2.0, 0.0]
    assert measures.most_hindsight_reward(recorded([[1.0]])).tolist() == []


CONVERGED, FAILED = [[0.0] * 8, [1.0] * 8], [[0.0] * 8, [0.5] * 8]


@pytest.mark.parametrize(
    ("part", "runs", "interval", "finding"),
    [
        (Part("", "difference", "success", (A,), ABOVE_ZERO, (B,)), {A: CONVERGED, B: FAILED}, Interval(0.5, 0.5, 0.5), "holds"),
        (Part("", "difference", "success", (B,), ABOVE_ZERO, (A,)), {A: CONVERGED, B: FAILED}, Interval(-0.5, -0.5, -0.5), "does not hold"),
        (Part("", "difference", "success", (A,), ABOVE_ZERO, (B,)), {A: CONVERGED, B: CONVERGED}, Interval(0.0, 0.0, 0.0), "open"),
        # every seed of A succeeds more often than every seed of B; with steps, A's 20 are fewer than B's infinitely many
        (Part("", "probability", "success", (A,), MORE_THAN_HALF, (B,)), {A: CONVERGED, B: FAILED}, Interval(1.0, 1.0, 1.0), "holds"),
        (Part("", "probability", "steps", (A,), MORE_THAN_HALF, (B,)), {A: CONVERGED, B: FAILED}, Interval(0.0, 0.0, 0.0), "does not hold"),
        (Part("", "probability", "steps", (A,), MORE_THAN_HALF, (B,)), {A: FAILED, B: FAILED}, Interval(0.5, 0.5, 0.5), "open"),
        # Wilson's interval of 8 of 8: from 8 / (8 + 1.96^2) = 0.6756 to 1; of 8 of 16 it is symmetric, 0.5 -+ 0.2200
        (Part("", "share", "converged", (A,), MORE_THAN_HALF), {A: CONVERGED}, Interval(1.0, 0.6756, 1.0), "holds"),
        (Part("", "share", "converged", (A,), MORE_THAN_HALF), {A: FAILED}, Interval(0.0, 0.0, 0.3244), "does not hold"),
        (Part("", "share", "converged", (A, B), MORE_THAN_HALF), {A: CONVERGED, B: FAILED}, Interval(0.5, 0.28, 0.72), "open"),
        # three seeds may be all better by chance; four settle it
        (Part("", "probability", "success", (A,), MORE_THAN_HALF, (B,)), {A: [[1.0] * 3], B: FAILED}, Interval(1.0, 1.0, 1.0), "open"),
        (Part("", "probability", "success", (A,), MORE_THAN_HALF, (B,)), {A: [[1.0] * 4], B: FAILED}, Interval(1.0, 1.0, 1.0), "holds"),
        # nobody knows the interval of one seed
        (Part("", "difference", "success", (A,), ABOVE_ZERO, (B,)), {A: [[1.0]], B: FAILED}, Interval(0.5, -np.inf, np.inf), "open"),
    ],
)
def test_parts_by_hand(part, runs, interval, finding):
    judged = judge(part, {setting: recorded(success) for setting, success in runs.items()})
    assert (judged.interval.estimate, judged.interval.low, judged.interval.high) == pytest.approx(
        (interval.estimate, interval.low, interval.high), abs=1e-4
    )
    assert judged.finding == finding


def test_what_was_not_run_or_cannot_be_measured_is_not_judged():
    part = Part("", "difference", "execution_steps", (A,), ABOVE_ZERO, (B,))
    lengths = {"episode_length": [[30.0] * 8] * 2}
    assert judge(part, {A: recorded(CONVERGED, **lengths)}) == Judged(part, None, "not run")
    assert judge(part, {A: recorded(CONVERGED, **lengths), B: recorded(FAILED, **lengths)}) == Judged(part, None, "open")  # nobody of B converged


def test_runs_that_are_too_short_settle_nothing():
    part = Part("", "share", "converged", (A,), MORE_THAN_HALF)
    assert judge(part, {A: recorded(CONVERGED)}, settles=False) == dataclasses.replace(judge(part, {A: recorded(CONVERGED)}), finding="open")


def test_differences_are_averaged_over_pairs_of_interquartile_means():
    others = Setting("fixed-1", "hindrl"), Setting("fixed-1", "tqcfd")
    part = Part("", "difference", "success", (A, others[0]), ABOVE_ZERO, (B, others[1]))
    # Middle halves: of 0, .4, .6, 1 it is 0.5; of four 0.2, 0.2. The first pair differs by 0.3, the second by 0.1, on average by 0.2.
    runs = {A: [[0.0, 0.4, 0.6, 1.0]], B: [[0.2] * 4], others[0]: [[0.2] * 4], others[1]: [[0.1] * 4]}
    assert judge(part, {setting: recorded(success) for setting, success in runs.items()}).interval.estimate == pytest.approx(0.2)


def judged_claim(letter, runs):
    return finding_of([judge(part, runs) for part in CLAIM[letter].parts])


def test_claims_about_made_up_runs():
    quick, slow = [[1.0] * 8, [1.0] * 8], [[0.0] * 8, [1.0] * 8]
    runs = {setting: recorded(slow, episode_length=[[40.0] * 8] * 2, batch__hindsight_reward=[[0.0] * 8] * 2) for setting in settings_of_claims()}
    # All alike: one demonstration is enough, and the arm needs no cloning; nobody fails; nothing else can be told apart.
    assert {letter: judged_claim(letter, runs) for letter in CLAIM} == {
        "a": "open",
        "b": "open",
        "c": "open",
        "d": "holds",
        "e": "does not hold",
        "f": "open",
        "g": "open",
        "h": "holds",
    }
    runs[Setting("reach-1", "hindrl")] = recorded(quick)
    assert judged_claim("f", runs) == "holds"
    runs[Setting("reach-1", "tqcfd")] = recorded([[1.0] * 8])
    assert judged_claim("f", runs) == "open"
    for task in ("random-250", "random-100", "random-50"):
        runs[Setting(task, "hindrl")] = recorded(FAILED, batch__hindsight_reward=[[0.0] * 8] * 2)
    assert judged_claim("b", runs) == "holds"
    runs[Setting("random-50", "hindrl")] = recorded(FAILED, batch__hindsight_reward=[[0.0] * 8, [0.01] + [0.0] * 7])
    assert judged_claim("b", runs) == "does not hold"
    runs[Setting("fixed-1", "hindrl")] = recorded(slow, episode_length=[[27.0] * 8] * 2)
    assert judged_claim("c", runs) == "holds"
    for task in ("random-250", "fixed-5", "reach-100"):
        runs[Setting(task, "bc")] = recorded(FAILED)
    assert judged_claim("a", runs) == "holds"
    # Smooth HinDRL learns as late as HinDRL and keeps what it has learnt, where HinDRL loses half of it.
    runs[Setting("reach-1", "hindrl")] = recorded([[0.0] * 8, [1.0] * 8, [0.5] * 8])
    runs[Setting("reach-1", "smooth-hindrl")] = recorded([[0.0] * 8, [1.0] * 8, [1.0] * 8])
    assert judged_claim("g", runs) == "holds"
    del runs[Setting("reach-1", "smooth-hindrl")]
    assert judged_claim("g", runs) == "not run"


@pytest.mark.parametrize(
    ("findings", "expected"),
    [
        (("holds", "does not hold", "open"), "does not hold"),
        (("holds", "not run", "open"), "not run"),
        (("holds", "open", "holds"), "open"),
        (("holds", "holds"), "holds"),
    ],
)
def test_a_claim_is_as_its_worst_part(findings, expected):
    assert finding_of([Judged(CLAIMS[0].parts[0], None, finding) for finding in findings]) == expected


@pytest.mark.parametrize(
    ("default", "thesis", "original", "expected"),
    [
        ("holds", "not run", "not run", "holds"),
        ("does not hold", "holds", "not run", "holds"),
        ("holds", "does not hold", "does not hold", "does not hold"),
        ("does not hold", "open", "does not hold", "does not hold"),
        ("does not hold", "not run", "holds", "holds only under the original's quirks"),
        ("holds", "does not hold", "holds", "holds only under the original's quirks"),
        ("does not hold", "does not hold", "not run", "open"),
        ("does not hold", "does not hold", "open", "open"),
        ("open", "open", "holds", "open"),
        ("not run", "not run", "not run", "open"),
    ],
)
def test_verdicts(default, thesis, original, expected):
    assert verdict({"default": default, "thesis": thesis, "original": original}) == expected


def test_only_settled_findings_decide():
    for findings in itertools.product(("open", "not run"), repeat=3):
        assert verdict(dict(zip(("default", "thesis", "original"), findings, strict=True))) == "open"
