"""The thesis's claims, as statements about numbers, and what runs say of them.

A claim has one or more parts. A part is a statistic of the seeds of some cells, and where that statistic lies if the part is true. Under one recipe a
part is true where the whole 95% interval lies there, false where none of it does, and open in between, or where it compares cells of fewer than 4
seeds, so that a difference that the seeds cannot carry is called open. A claim holds under a recipe if all of its parts do, and does not if one does
not.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np

from hindrl_jax.config import Algorithm
from hindrl_jax.plotting.statistics import Interval, interquartile_mean, probability_of_improvement, share, stratified_bootstrap
from hindrl_jax.reproduction.measures import MEASURES, MeasureName
from hindrl_jax.reproduction.scales import SCALES, Recipe, ScaleName
from hindrl_jax.reproduction.thesis import Setting, settings_of
from hindrl_jax.runs.recorded import RecordedRun

Runs = Mapping[Setting, RecordedRun]
"""The finished runs of one recipe."""
Finding = Literal["holds", "does not hold", "open", "not run"]
Verdict = Literal["holds", "holds only under the original's quirks", "does not hold", "open"]
FEWEST_SEEDS = 4
"""With fewer in a cell no comparison is settled: of 3 and 3 seeds, even a complete separation comes about by chance once in ten times, of 4 and 4
once in 35, and a bootstrap of so few cannot see that."""
ABOVE_ZERO, BELOW_ZERO, MORE_THAN_HALF = (0.0, np.inf), (-np.inf, 0.0), (0.5, np.inf)


@dataclasses.dataclass(frozen=True)
class Part:
    """A statistic of some cells, and where it lies if the part is true."""

    what: str
    """The statistic, for people."""
    statistic: Literal["probability", "difference", "share", "largest"]
    """The probability that a seed of `first` has more than one of `second`, or the difference of their interquartile means, both averaged over the
    pairs; or the share of all seeds of `first` of which the measure is true; or its largest value, which is what it is and has no interval."""
    measure: MeasureName
    first: tuple[Setting, ...]
    true_between: tuple[float, float]
    """Both ends excluded: an interval that touches one is open."""
    second: tuple[Setting, ...] = ()
    """The partner of each of `first`."""


@dataclasses.dataclass(frozen=True)
class Claim:
    """A claim of the thesis."""

    letter: str
    text: str
    parts: tuple[Part, ...]


@dataclasses.dataclass(frozen=True)
class Judged:
    """A part under one recipe."""

    part: Part
    interval: Interval | None
    """None where there is no run, or no seed to measure."""
    finding: Finding


def _of(algo: Algorithm, *tasks: str, bc_weight: float | None = None) -> tuple[Setting, ...]:
    return tuple(Setting(task, algo, bc_weight) for task in tasks)


_RANDOM = ("random-250", "random-100", "random-50")
_FIXED = ("fixed-5", "fixed-2", "fixed-1")
_SOONER = "chance that a seed of {} reaches 95% in fewer steps than one of {}; one that never does comes last"

CLAIMS: tuple[Claim, ...] = (
    Claim(
        "a",
        "Behaviour cloning needs far more demonstrations",
        tuple(
            Part(f"success of TQCfD less that of BC, {what}", "difference", "success", _of("tqcfd", few), ABOVE_ZERO, _of("bc", many))
            for what, few, many in (
                ("of 50 against 250 demonstrations of the random grid", "random-50", "random-250"),
                ("of 1 against 5 of the fixed grid", "fixed-1", "fixed-5"),
                ("of 1 against 100 of reach", "reach-1", "reach-100"),
            )
        ),
    ),
    Claim(
        "b",
        "TQCfD beats HinDRL on the random grid, because no hindsight reward is ever non-zero",
        (
            Part(
                "chance that a seed of TQCfD succeeds more often than one of HinDRL (250, 100 and 50 demonstrations)",
                "probability",
                "success",
                _of("tqcfd", *_RANDOM),
                MORE_THAN_HALF,
                _of("hindrl", *_RANDOM),
            ),
            Part(
                "largest mean hindsight reward in a batch of HinDRL, between two evaluations",
                "largest",
                "most_hindsight_reward",
                _of("hindrl", *_RANDOM),
                (-np.inf, 1e-9),
            ),
        ),
    ),
    Claim(
        "c",
        "HinDRL executes faster than TQCfD on the fixed grid",
        (
            Part(
                "steps of an episode of HinDRL less those of TQCfD, of converged seeds (1 demonstration)",
                "difference",
                "execution_steps",
                _of("hindrl", "fixed-1"),
                BELOW_ZERO,
                _of("tqcfd", "fixed-1"),
            ),
        ),
    ),
    Claim(
        "d",
        "One demonstration is enough on fixed tasks",
        (
            Part("share of HinDRL's seeds that converge on the fixed grid", "share", "converged", _of("hindrl", "fixed-1"), MORE_THAN_HALF),
            Part("share of HinDRL's seeds that converge on reach", "share", "converged", _of("hindrl", "reach-1"), MORE_THAN_HALF),
        ),
    ),
    Claim(
        "e",
        "A third of the runs fail on the fixed grid",
        (
            Part(
                "share of TQCfD's and HinDRL's seeds that converge (1, 2 and 5 demonstrations); the claim is taken as 1/2 to 5/6",
                "share",
                "converged",
                _of("tqcfd", *_FIXED) + _of("hindrl", *_FIXED),
                (1 / 2, 5 / 6),
            ),
        ),
    ),
    Claim(
        "f",
        "HinDRL converges more often and sooner than TQCfD on reach",
        (
            Part(
                _SOONER.format("HinDRL", "TQCfD"),
                "probability",
                "steps",
                _of("tqcfd", "reach-1"),
                MORE_THAN_HALF,
                _of("hindrl", "reach-1"),
            ),
        ),
    ),
    Claim(
        "g",
        "Epsilon-filtering does not speed up, but stabilises",
        (
            Part(
                f"{_SOONER.format('Smooth HinDRL', 'HinDRL')}; a speed-up would be 3/4 or more",
                "probability",
                "steps",
                _of("hindrl", "reach-1"),
                (-np.inf, 0.75),
                _of("smooth-hindrl", "reach-1"),
            ),
            Part(
                "success after the first 95% of Smooth HinDRL less that of HinDRL",
                "difference",
                "success_once_learnt",
                _of("smooth-hindrl", "reach-1"),
                ABOVE_ZERO,
                _of("hindrl", "reach-1"),
            ),
        ),
    ),
    Claim(
        "h",
        "The cloning loss is unnecessary on reach: mixing demonstrations is enough",
        (
            Part(
                "share of TQCfD's and HinDRL's seeds that converge with weight 0",
                "share",
                "converged",
                _of("tqcfd", "reach-1", bc_weight=0.0) + _of("hindrl", "reach-1", bc_weight=0.0),
                MORE_THAN_HALF,
            ),
        ),
    ),
)


def settings_of_claims() -> set[Setting]:
    """The settings that some claim needs."""
    return {setting for claim in CLAIMS for part in claim.parts for setting in part.first + part.second}


def settings_to_run(names: tuple[str, ...], *, recipe: Recipe, scale: ScaleName) -> list[Setting]:
    """The settings of some artifacts that a scale runs with a recipe."""
    needed = settings_of_claims()
    only_needed = SCALES[scale].theirs_for_claims_only and recipe != "default"
    return [setting for setting in settings_of(names) if setting in needed or not only_needed]


def judge(part: Part, runs: Runs, *, settles: bool = True) -> Judged:
    """A part under the recipe of these runs; always open where they are too short to settle anything."""
    if not set(part.first + part.second) <= set(runs):
        return Judged(part, None, "not run")
    measure = MEASURES[part.measure]
    first, second = ([measure(runs[setting]) for setting in settings] for settings in (part.first, part.second))
    if not all(map(len, first + second)):
        return Judged(part, None, "open")
    interval = _estimate(part.statistic, first, second)
    too_few = bool(second) and min(map(len, first + second)) < FEWEST_SEEDS
    return Judged(part, interval, "open" if too_few or not settles else _place(interval, part.true_between))


def _estimate(statistic: str, first: Sequence[np.ndarray], second: Sequence[np.ndarray]) -> Interval:
    if statistic == "share":
        values = np.concatenate(first)
        return share(int(values.sum()), len(values))
    if statistic == "largest":
        return Interval(*3 * (float(np.concatenate(first).max()),))
    number = len(first)

    def over_pairs(groups: Sequence[np.ndarray]) -> np.ndarray:
        pairs = zip(groups[:number], groups[number:], strict=True)
        if statistic == "probability":
            return np.mean([probability_of_improvement(a, b) for a, b in pairs], axis=0)
        return np.mean([interquartile_mean(a) - interquartile_mean(b) for a, b in pairs], axis=0)

    return stratified_bootstrap([*first, *second], over_pairs)


def _place(interval: Interval, true_between: tuple[float, float]) -> Finding:
    low, high = true_between
    if low < interval.low and interval.high < high:
        return "holds"
    return "does not hold" if interval.high < low or interval.low > high else "open"


def finding_of(judged: Sequence[Judged]) -> Finding:
    """A claim under one recipe, from its parts."""
    findings = [one.finding for one in judged]
    worst: tuple[Finding, ...] = ("does not hold", "not run", "open", "holds")
    return next(finding for finding in worst if finding in findings)


def verdict(findings: Mapping[Recipe, Finding]) -> Verdict:
    """A claim, from what the recipes say of it.

    The thesis's text is the claim's own ground, and our recipe where that is not run or open. Where the claim does not hold there, the original code
    decides whether its quirks made it.
    """
    plain = findings["thesis"] if findings["thesis"] in ("holds", "does not hold") else findings["default"]
    if plain == "holds":
        return "holds"
    if plain == "does not hold" and findings["original"] == "does not hold":
        return "does not hold"
    if plain == "does not hold" and findings["original"] == "holds":
        return "holds only under the original's quirks"
    return "open"
