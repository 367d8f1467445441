"""Outcomes as a picture: what each change does to each task."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from hindrl_jax.plotting.figures import BETTER, OPEN, WORSE, figure
from hindrl_jax.reproduction.outcomes import Outcome

_COLOURS = {"better": BETTER, "worse": WORSE, "open": OPEN}


def save_differences(outcomes: Sequence[Outcome], path: Path, *, title: str) -> None:
    """Draws, for each task, how each cell's mean success along the run differs from the baseline's, with 95% intervals, as a PNG.

    A row for each name, by groups; the same rows for all tasks.
    """
    tasks = list(dict.fromkeys(outcome.cell.task for outcome in outcomes))
    compared = [outcome for outcome in outcomes if not outcome.is_baseline]
    groups = dict.fromkeys(outcome.cell.group for outcome in compared)
    # A heading (group, None), then its names.
    rows = [row for group in groups for row in ((group, None), *dict.fromkeys((group, o.cell.name) for o in compared if o.cell.group == group))]
    size = (3.0 + 3.6 * len(tasks), 1.5 + 0.2 * len(rows))
    with figure(path, columns=len(tasks), figsize=size, sharex=True, sharey=True) as (drawn, axes):
        for axis, task in zip(axes, tasks, strict=True):
            axis.axvline(0.0, color="0.3", linewidth=1)
            for outcome in compared:
                if outcome.cell.task == task:
                    y, colour = rows.index((outcome.cell.group, outcome.cell.name)), _COLOURS[outcome.verdict()]
                    estimate, low, high = (100 * value for value in (outcome.difference.estimate, outcome.difference.low, outcome.difference.high))
                    axis.plot((low, high), (y, y), color=colour, linewidth=3, solid_capstyle="butt", alpha=0.55)
                    axis.plot(estimate, y, color=colour, marker="o", markersize=5)
                    axis.text(1.01, y, f"{estimate:+.1f}", color=colour, transform=axis.get_yaxis_transform(), va="center", fontsize=8)
            axis.set_title(task, loc="left")
            axis.set(xlabel="change of mean success along the run, points")
            axis.set_yticks(range(len(rows)), [group if name is None else name for group, name in rows])
            axis.tick_params(axis="y", length=0)
            axis.set(ylim=(len(rows) - 0.4, -0.6))
        for label, (_, name) in zip(axes[0].get_yticklabels(), rows, strict=True):
            if name is None:
                label.set(fontweight="bold")
        seeds = len(outcomes[0].cell.spec.seeds)
        legend = f"{seeds} seeds, 95% intervals; blue better, red worse, grey open"
        drawn.suptitle(f"{title}\n{legend}", x=0.01, ha="left", fontsize="medium")  # as wide as a single panel
