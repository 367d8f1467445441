"""The thesis's experiments as tables: what each of its tables and figures is made of, and what it published.

A `Setting` is one cell of a table, whatever recipe and scale it is trained with; tables and figures share settings. What is published stands in
chapter 5 as text, or was read off the plots.
"""

from __future__ import annotations

import dataclasses
import itertools
from typing import Literal

from hindrl_jax.config import Algorithm
from hindrl_jax.reproduction.cells import Task

ALGORITHM_NAMES: dict[Algorithm, str] = {"bc": "BC", "tqcfd": "TQCfD", "hindrl": "HinDRL", "smooth-hindrl": "Smooth HinDRL"}

_TWO_OBJECTS = (("num_objects", 2),)  # the text has three; every config of the original code, two
TASKS: dict[str, Task] = {
    **{f"random-{number}": Task("GridPickAndPlace", _TWO_OBJECTS, number) for number in (250, 100, 50, 30)},
    **{f"fixed-{number}": Task("FixedGridPickAndPlace", _TWO_OBJECTS, number) for number in (5, 2, 1)},
    **{f"reach-{number}": Task("FixedParameterizedReach", (), number) for number in (100, 50, 10, 1)},
}


@dataclasses.dataclass(frozen=True)
class Setting:
    """One cell, whatever recipe and scale it is trained with."""

    task: str
    """Key of `TASKS`."""
    algo: Algorithm
    bc_weight: float | None = None
    """Weight of the cloning loss; None leaves it to the recipe."""

    def title(self) -> str:
        """What a reader calls it, beside others of the same kind of task."""
        demos = TASKS[self.task].num_demos
        weight = "" if self.bc_weight is None else f", cloning {self.bc_weight:g}"
        return f"{ALGORITHM_NAMES[self.algo]}, {demos} demonstration{'s' if demos > 1 else ''}{weight}"


@dataclasses.dataclass(frozen=True)
class Artifact:
    """A table, figure or section of the thesis."""

    title: str
    settings: tuple[Setting, ...]
    rows: Literal["demonstrations", "bc_weight"] = "demonstrations"
    """What the rows of a table differ in; its columns are algorithms."""
    published: tuple[tuple[Setting, str], ...] = ()
    """What the thesis says of a setting."""
    panels: tuple[str, ...] = ()
    """Of a figure: what is drawn over environment steps, names of `thesis_pictures.PANELS`; "steps_to_100" alone is a box plot."""
    apart: bool = False
    """Whether each setting has a panel of its own, with a line for each seed; else a line for each setting, the mean over its seeds."""
    marks: tuple[tuple[str, Literal["x", "y"], float], ...] = ()
    """What the thesis's figure shows, at a step (x) or a value of the first panel (y): (label, axis, where). Two at most."""
    remark: str = ""
    """What else must be known to read it."""


def _settings(tasks: tuple[str, ...], algorithms: tuple[Algorithm, ...]) -> tuple[Setting, ...]:
    return tuple(Setting(task, algo) for task, algo in itertools.product(tasks, algorithms))


def _published(settings: tuple[Setting, ...], figures: str) -> tuple[tuple[Setting, str], ...]:
    """The figures of a table of the thesis, row by row, percent."""
    return tuple((setting, f"{figure}%") for setting, figure in zip(settings, figures.split(), strict=True))


_THREE: tuple[Algorithm, ...] = ("bc", "tqcfd", "hindrl")
_RANDOM = _settings(tuple(name for name in TASKS if name.startswith("random")), _THREE)
_FIXED = _settings(tuple(name for name in TASKS if name.startswith("fixed")), _THREE)
_REACH = _settings(tuple(name for name in TASKS if name.startswith("reach")), _THREE)
_TQCFD, _HINDRL, _SMOOTH = _settings(("reach-1",), ("tqcfd", "hindrl", "smooth-hindrl"))
_BOTH: tuple[Algorithm, ...] = ("tqcfd", "hindrl")
_WEIGHTS = tuple(Setting("reach-1", algo, weight) for weight, algo in itertools.product((0.0, 0.1, 1.0), _BOTH))

ARTIFACTS: dict[str, Artifact] = {
    "table-5.1": Artifact(
        "Success on GridPickAndPlace",
        _RANDOM,
        published=_published(_RANDOM, "75 100 99  45 100 97  5 100 4  0 4 0"),
        remark="Two objects, as in the original code's configs.",
    ),
    "table-5.2": Artifact(
        "Success on FixedGridPickAndPlace",
        _FIXED,
        published=_published(_FIXED, "17 100 100  5 100 100  1 100 100"),
        remark="The thesis shows TQCfD and HinDRL of converged runs only; a third of its runs fail. Compare with the best seed.",
    ),
    "table-5.3": Artifact(
        "Success on FixedParameterizedReach",
        _REACH,
        published=_published(_REACH, "23 100 100  0 100 100  0 100 100  0 100 100"),
        remark="The thesis shows the best run. Compare with the best seed.",
    ),
    "figure-5.1": Artifact(
        "HinDRL on GridPickAndPlace by the number of demonstrations",
        tuple(setting for setting in _RANDOM if setting.algo == "hindrl"),
        panels=("success", "bc_loss", "hindsight_reward"),
        marks=(("thesis, 250 demonstrations: 95% at 130k", "x", 130_000), ("thesis, 100 demonstrations: 95% at 250k", "x", 250_000)),
        remark="The thesis's hindsight reward is 0 throughout.",
    ),
    "figure-5.2": Artifact(
        "Execution speed on FixedGridPickAndPlace",
        tuple(setting for setting in _FIXED if setting.task == "fixed-1" and setting.algo != "bc"),
        panels=("episode_length",),
        apart=True,
        marks=(("thesis, HinDRL: about 27", "y", 27), ("best ordered play: 41.5", "y", 41.5)),
        remark="The thesis does not say how many demonstrations: here it is 1. Play in order takes 41.5 steps on average at best; "
        "the thesis's 27 is possible only because its code lets the last object win alone.",
    ),
    "figure-5.3": Artifact("Averaged success on FixedParameterizedReach, 1 demonstration", (_TQCFD, _HINDRL), panels=("success",)),
    "figure-5.4": Artifact(
        "Success of each seed on FixedParameterizedReach, 1 demonstration",
        (_TQCFD, _HINDRL),
        panels=("success",),
        apart=True,
        remark="In the thesis 5 of 10 TQCfD runs could not solve the task, and 8 of 8 HinDRL runs did.",
    ),
    "figure-5.5": Artifact(
        "Steps to 100% on FixedParameterizedReach, 1 demonstration, of seeds that reach it",
        (_TQCFD, _HINDRL),
        panels=("steps_to_100",),
        marks=(("thesis, TQCfD: 208,000", "y", 208_000), ("thesis, HinDRL: 162,000", "y", 162_000)),
    ),
    "figure-5.6": Artifact(
        "Filtered and unfiltered goals on FixedParameterizedReach, 1 demonstration",
        (_HINDRL, _SMOOTH),
        panels=("success",),
        marks=(("thesis, Smooth HinDRL: stable at 86%", "y", 86),),
    ),
    "figure-5.7": Artifact(
        "HinDRL without the cloning loss on FixedParameterizedReach, 1 demonstration",
        (Setting("reach-1", "hindrl", 0.0),),
        panels=("success", "hindsight_reward", "all_rewards"),
        remark="Rewards are sums over a batch, whose size is that of the recipe and the scale; the thesis's is 12,000.",
    ),
    "section-5.3": Artifact(
        "Weights of the cloning loss on FixedParameterizedReach, 1 demonstration",
        _WEIGHTS,
        rows="bc_weight",
        published=tuple((setting, "learns" if setting.bc_weight == 0.0 else "does not learn") for setting in _WEIGHTS),
        remark="The thesis gives no figures: it says that both models learn this task with weight 0 only.",
    ),
}


def settings_of(names: tuple[str, ...]) -> list[Setting]:
    """The settings of some artifacts, each once, task by task, so that what a task's cells share is made once."""
    found = dict.fromkeys(setting for name in names for setting in ARTIFACTS[name].settings)
    return sorted(found, key=lambda setting: list(TASKS).index(setting.task))
