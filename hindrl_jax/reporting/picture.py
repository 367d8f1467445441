"""The picture of a comparison."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from hindrl_jax.plotting.figures import band, colours, figure, legend_beside, mark_success, mean_line, pyplot
from hindrl_jax.runs.recorded import Axis, RecordedRun

_X_LABELS = {"steps": "environment steps", "updates": "gradient steps", "seconds": "seconds of training, all seeds side by side"}


def save_comparison(runs: Sequence[RecordedRun], path: Path, *, over: Axis) -> None:
    """Draws success over training for several runs: the mean over seeds and its 95% bootstrap interval, as a PNG.

    A run without steps of that kind, bc over environment steps, is a dashed line at the height of its end.
    """
    palette = pyplot().get_cmap("tab10").colors if len(runs) <= 10 else colours("viridis", len(runs), end=0.95)
    with figure(path, figsize=(8.5, 4.5)) as (_, (axis,)):
        for run, colour in zip(runs, palette, strict=False):
            x, success = run.axis(over), 100 * run.success
            label = run.label if run.finished else f"{run.label} (not finished)"
            if not x.any():
                axis.axhline(100 * run.returned_success.mean(), color=colour, linestyle="--", linewidth=1.5, label=f"{label}, at its end")
                continue
            mean_line(axis, x, success, colour=colour, label=label, size=2.5)
            if success.shape[1] > 1:
                band(axis, x, success, colour)
        axis.set(xlabel=_X_LABELS[over])
        axis.set_xlim(left=0)
        axis.xaxis.set_major_formatter("{x:,.0f}")
        legend_beside(axis)
        names = dict.fromkeys(run.spec.env.name for run in runs)
        axis.set_title(f"{', '.join(names)}: mean over seeds, 95% interval", loc="left")
        mark_success(axis)
