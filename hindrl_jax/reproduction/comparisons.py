"""The cells that claims compare, two by two: the chance that a seed of the one does better than a seed of the other."""

from __future__ import annotations

import dataclasses
from typing import Literal

from hindrl_jax.plotting.statistics import Interval, probability_of_improvement, stratified_bootstrap
from hindrl_jax.reproduction.claims import CLAIMS, FEWEST_SEEDS, Runs
from hindrl_jax.reproduction.measures import MEASURES, MeasureName
from hindrl_jax.reproduction.thesis import TASKS, Setting

IN_WORDS: dict[MeasureName, str] = {"success": "succeeds more often", "steps": "reaches 95% sooner", "execution_steps": "takes fewer steps"}
"""What is compared, and in what the better one is better."""
MORE_IS_BETTER: tuple[MeasureName, ...] = ("success",)


@dataclasses.dataclass(frozen=True)
class Pair:
    """Two cells that a claim compares."""

    claims: str
    """The letters of these claims."""
    first: Setting
    second: Setting

    def title(self) -> str:
        """What a reader calls it."""
        envs = dict.fromkeys(TASKS[setting.task].env for setting in (self.first, self.second))
        return f"{', '.join(envs)}: {self.first.title()}, over {self.second.title()}"


@dataclasses.dataclass(frozen=True)
class Compared:
    """A pair by one measure."""

    pair: Pair
    measure: MeasureName
    chance: Interval
    """That a seed of the first is better than one of the second; equal ones count half."""
    said: Literal["first", "second", "open"]
    """Which of the two is better; open where runs are too short, the interval holds 1/2, or a cell has fewer than 4 seeds to measure."""


def pairs() -> list[Pair]:
    """Those of all claims, each once, in the order of the claims."""
    letters: dict[tuple[Setting, Setting], str] = {}
    for claim in CLAIMS:
        for part in claim.parts:
            for first, second in zip(part.first, part.second, strict=False):  # a share has no second
                pair = (second, first) if (second, first) in letters else (first, second)
                letters[pair] = letters.get(pair, "") + claim.letter * (claim.letter not in letters.get(pair, ""))
    return [Pair(claims, *pair) for pair, claims in letters.items()]


def compare(pair: Pair, runs: Runs, *, settles: bool = True) -> list[Compared]:
    """A pair by each measure that both of its cells have; nothing if one was not run. Runs that are too short to settle anything leave it open."""
    if pair.first not in runs or pair.second not in runs:
        return []
    first, second, found = runs[pair.first], runs[pair.second], []
    for measure in IN_WORDS:
        if measure == "steps" and (first.cloning or second.cloning):
            continue  # cloning takes gradient steps, which are no environment steps
        values = [MEASURES[measure](run) for run in (first, second)]
        if not all(map(len, values)):
            continue
        if measure not in MORE_IS_BETTER:
            values = [-value for value in values]
        chance = stratified_bootstrap(values, lambda groups: probability_of_improvement(*groups))
        settled = settles and min(map(len, values)) >= FEWEST_SEEDS and chance.excludes(0.5)
        found.append(Compared(pair, measure, chance, "open" if not settled else "first" if chance.estimate > 0.5 else "second"))
    return found
