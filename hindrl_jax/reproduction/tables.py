"""Outcomes as tables, for programs and for people."""

from __future__ import annotations

import csv
import itertools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hindrl_jax.plotting.statistics import Interval
from hindrl_jax.reproduction.outcomes import Outcome

EXPLANATION = """- **95%**: seeds of which an evaluation along the run reached 95% success.
- **steps to 95%**: environment steps to the first such evaluation, median over all seeds; > and the length of the run where most never did.
- **final**: success of the final policy in fresh episodes, mean over seeds, in %.
- **along**: success along the whole run, mean over its steps and over seeds, in %. It sees both speed and the level that is reached.
- **difference**: the {baseline}'s "along" subtracted seed by seed, in points; bold where the interval leaves out 0.
- **s/seed**: seconds of training per seed, all seeds side by side, without compilation.
- **cost**: seconds per gradient step, rollouts and evaluations included, relative to the {baseline}'s. Times were
  measured once, along the way, and mean something only where the machine had nothing else to do.
"""
"""What the columns of `markdown` are; to be given the name of the baseline."""


def write_csv(path: Path, outcomes: Sequence[Outcome], *, row_name: str) -> None:
    """Writes a row for each outcome, of which there is at least one; success as a share, steps `inf` where not reached.

    Args:
      path: the file.
      outcomes: in order.
      row_name: what the names of cells are, as the name of their column.

    Raises:
      OSError: if it cannot be written.
    """
    rows = [_csv_row(outcome, row_name) for outcome in outcomes]
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def _csv_row(outcome: Outcome, row_name: str) -> dict[str, Any]:
    spec = outcome.cell.spec
    row: dict[str, Any] = {
        "task": outcome.cell.task,
        row_name: outcome.cell.name,
        "group": outcome.cell.group,
        "seeds": len(spec.seeds),
        "steps": spec.config.num_steps,
        "seeds_reaching_95": outcome.seeds_reaching_95,
    }
    for name, field in (("median_steps_to_95", "steps_to_95"), *((name, name) for name in ("returned_success", "mean_success", "difference"))):
        interval = getattr(outcome, field)
        row |= {name: f"{interval.estimate:.6g}", f"{name}_low": f"{interval.low:.6g}", f"{name}_high": f"{interval.high:.6g}"}
    return row | {"seconds_per_seed": f"{outcome.seconds_per_seed:.6g}", "relative_cost": f"{outcome.relative_cost:.6g}"}


def markdown(outcomes: Sequence[Outcome], *, row_name: str, title: Callable[[str], str]) -> list[str]:
    """The lines of a table for each task, in Markdown: the baseline, then the others by their groups.

    Args:
      outcomes: task by task, and group by group.
      row_name: what the names of cells are, as the head of their column.
      title: of a task.
    """
    lines = []
    for task, of_task in itertools.groupby(outcomes, key=lambda outcome: outcome.cell.task):
        lines += [f"## {task}: {title(task)}", ""]
        lines += [f"| {row_name} | 95% | steps to 95% | returned | along | difference | s/seed | cost |", "|---|---|---|---|---|---|---|---|"]
        for group, of_group in itertools.groupby(of_task, key=lambda outcome: outcome.cell.group):
            rows = list(of_group)
            if not rows[0].is_baseline:
                lines.append(f"| *{group}* | | | | | | | |")
            lines += [_markdown_row(outcome) for outcome in rows]
        lines.append("")
    return lines


def _markdown_row(outcome: Outcome) -> str:
    steps, limit = outcome.steps_to_95, outcome.cell.spec.config.num_steps
    difference = f"{100 * outcome.difference.estimate:+.1f} [{100 * outcome.difference.low:+.1f}, {100 * outcome.difference.high:+.1f}]"
    if outcome.is_baseline:
        difference = ""
    elif outcome.verdict() != "open":
        difference = f"**{difference}**"
    cells = (
        outcome.cell.name,
        f"{outcome.seeds_reaching_95}/{len(outcome.cell.spec.seeds)}",
        f"{thousands(steps.estimate, limit)} [{thousands(steps.low, limit)}, {thousands(steps.high, limit)}]",
        _percent(outcome.returned_success),
        _percent(outcome.mean_success),
        difference,
        f"{outcome.seconds_per_seed:.1f}",
        f"{outcome.relative_cost:.2f}",
    )
    return f"| {' | '.join(cells)} |"


def thousands(steps: float, limit: int) -> str:
    """Steps in thousands; beyond the limit, the length of the run, if they were not enough."""
    sign, number = ("", steps / 1000) if np.isfinite(steps) else (">", limit / 1000)
    return f"{sign}{number:.0f}k" if number >= 10 else f"{sign}{number:.2g}k"


def _percent(share: Interval) -> str:
    return f"{100 * share.estimate:.1f} [{100 * share.low:.1f}, {100 * share.high:.1f}]"
