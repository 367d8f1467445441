"""Ablation: a recipe for the grid tasks, `options.RECIPE`, with one change at a time, on several tasks, with the same seeds for all.

    OUT/TASK/OPTION/   an ordinary run's directory for each cell; OUT/TASK/default/ has no change, the baseline
    ablation.csv       a row for each cell
    ablation.md        the same for people: a table for each task
    ablation.png       the differences to the baseline

The tables are made from the directories alone, so they can be made again, and an ablation that was interrupted goes on where it was.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Iterable, Sequence
from pathlib import Path

from hindrl_jax.base.files import disk_trouble
from hindrl_jax.reproduction.cells import Cell, Task, changed
from hindrl_jax.reproduction.options import BASELINE, OPTIONS, RECIPE, Option
from hindrl_jax.reproduction.outcomes import Outcome
from hindrl_jax.reproduction.picture import save_differences
from hindrl_jax.reproduction.tables import EXPLANATION, markdown, write_csv
from hindrl_jax.runs.spec import RunSpec
from hindrl_jax.tasks.registry import checked, make

TABLE, TEXT, PICTURE = "ablation.csv", "ablation.md", "ablation.png"

TASKS: dict[str, Task] = {
    "fixed-1": Task("FixedGridPickAndPlace", (("num_objects", 2),), 1),
    "fixed-5": Task("FixedGridPickAndPlace", (("num_objects", 2),), 5),
    "random-50": Task("GridPickAndPlace", (("num_objects", 2),), 50),
}


def cells_of(out: Path, *, tasks: Iterable[str], options: Iterable[Option], seeds: tuple[int, ...], steps: int | None = None) -> list[Cell]:
    """The cells of all tasks and options, task by task, each with the baseline first.

    Args:
      out: the ablation's directory.
      tasks: keys of `TASKS`.
      options: which of `OPTIONS`.
      seeds: the same for all cells.
      steps: environment steps of each run; None takes those of the recipe.

    Raises:
      UserError: if a config is refused.
    """
    cells = []
    for name, option in itertools.product(tasks, (BASELINE, *options)):
        task = TASKS[name]
        config = RECIPE
        if steps is not None:
            config = checked(functools.partial(dataclasses.replace, config, steps=steps))
        spec = RunSpec(env=make(task.env, **dict(task.env_args)), config=changed(config, option.changes), demos=str(task.num_demos), seeds=seeds)
        cells.append(Cell(task=name, group=option.group, name=option.name, path=out / name / option.name, spec=spec))
    return cells


def write_tables(out: Path, outcomes: Sequence[Outcome]) -> None:
    """Writes `ablation.csv`, `ablation.md` and `ablation.png` from at least one outcome.

    Raises:
      UserError: if they cannot be written.
    """
    with disk_trouble(out):
        write_csv(out / TABLE, outcomes, row_name="option")
        (out / TEXT).write_text(_as_text(outcomes))
        save_differences(outcomes, out / PICTURE, title="One change to the recipe")


_EXPLANATION = """# Ablation

A recipe for the grid tasks, with one change at a time, {seeds} seeds from {first}, {steps:,} environment steps each. Every
change is trained with the same seeds, which have the same demonstrations. In brackets: 95% bootstrap intervals over the seeds, somewhat too narrow
with 16 seeds and much too narrow with fewer than 8 or so. They describe single comparisons: of changes without any effect, one in twenty or more
shows a difference by chance.

"""


def _as_text(outcomes: Sequence[Outcome]) -> str:
    spec = outcomes[0].cell.spec
    lines = [_EXPLANATION.format(seeds=len(spec.seeds), first=spec.seeds[0], steps=spec.config.num_steps) + EXPLANATION.format(baseline="default")]
    lines += markdown(outcomes, row_name="change", title=lambda task: TASKS[task].title())
    lines += ["## The changes", "", "| change | what it is |", "|---|---|"]
    shown = {outcome.cell.name for outcome in outcomes}
    lines += [f"| {option.name} | {option.summary} |" for option in (BASELINE, *OPTIONS) if option.name in shown]
    return "\n".join(lines) + "\n"
