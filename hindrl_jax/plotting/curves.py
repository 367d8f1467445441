"""Pictures of runs. Matplotlib is imported on first use and draws off screen, unless MPLBACKEND says where."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hindrl_jax.plotting.statistics import bootstrap_band

if TYPE_CHECKING:
    from hindrl_jax.reporting.compare import Axis, RecordedRun
    from hindrl_jax.reproduction.ablation import Outcome
    from hindrl_jax.training.result import Result

_MEAN, _SEED, _DEMO = "#1f5fa8", "#9dbfe3", "#c77b00"
_VERDICTS = {"better": "#1f5fa8", "worse": "#b3261e", "open": "0.5"}


def save_curve(result: Result, path: Path) -> None:
    """Draws success and episode length over training, one thin line per seed, their mean and its 95% bootstrap interval, as a PNG."""
    plt = _pyplot()
    x, success, length = _curves(result)
    figure, axes = plt.subplots(2, 1, figsize=(7, 5.5), sharex=True, height_ratios=(3, 2), layout="constrained")
    for axis, values in zip(axes, (success, length), strict=True):
        if len(result.seeds) > 1:
            axis.plot(x, values, color=_SEED, linewidth=0.6)
            _band(axis, x, values, _MEAN)
        axis.plot(x, values.mean(axis=1), color=_MEAN, linewidth=2, marker="o", markersize=3, label=_mean_label(result))
    lengths = np.asarray(result.guidance.demonstrations.lengths)
    axes[1].axhline(lengths.mean(), color=_DEMO, linestyle="--", linewidth=1, label="demonstrations")
    axes[0].legend(loc="lower right", frameon=False)
    axes[1].set(ylim=(0, result.env.horizon * 1.05), ylabel="episode length, steps", xlabel=_x_label(result))
    axes[1].legend(loc="lower left", frameon=False)
    axes[1].xaxis.set_major_formatter("{x:,.0f}")
    axes[0].set_title(_title(result), loc="left")
    _mark_success(axes[0])
    _tidy(axes)
    figure.savefig(path, dpi=130)
    plt.close(figure)


def save_sweep(parts: Sequence[Result], labels: Sequence[str], path: Path) -> None:
    """Draws success over training for each setting of a sweep: the mean of its seeds, and thinly each seed, as a PNG."""
    plt = _pyplot()
    colours = plt.get_cmap("viridis")(np.linspace(0.0, 0.9, len(parts)))
    figure, axis = plt.subplots(figsize=(8, 4.5), layout="constrained")
    for part, label, colour in zip(parts, labels, colours, strict=True):
        x, success, _ = _curves(part)
        axis.plot(x, success, color=colour, linewidth=0.6, alpha=0.35)
        axis.plot(x, success.mean(axis=1), color=colour, linewidth=2, marker="o", markersize=3, label=label)
    axis.set(xlabel=_x_label(parts[0]))
    axis.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False, fontsize="small")
    seeds = f", mean of {len(parts[0].seeds)} seeds" if len(parts[0].seeds) > 1 else ""
    axis.set_title(_title(parts[0]) + seeds, loc="left")
    _mark_success(axis)
    _tidy([axis])
    figure.savefig(path, dpi=130)
    plt.close(figure)


def save_comparison(runs: Sequence[RecordedRun], path: Path, *, over: Axis) -> None:
    """Draws success over training for several runs: the mean over seeds and its 95% bootstrap interval, as a PNG.

    A run without steps of that kind, bc over environment steps, is a dashed line at the height of its end.
    """
    plt = _pyplot()
    palette = plt.get_cmap("tab10").colors if len(runs) <= 10 else plt.get_cmap("viridis")(np.linspace(0.0, 0.95, len(runs)))
    figure, axis = plt.subplots(figsize=(8.5, 4.5), layout="constrained")
    for run, colour in zip(runs, palette, strict=False):
        x, success = run.axis(over), 100 * run.success
        label = run.label if run.finished else f"{run.label} (not finished)"
        if not x.any():
            axis.axhline(100 * run.final_success.mean(), color=colour, linestyle="--", linewidth=1.5, label=f"{label}, at its end")
            continue
        axis.plot(x, success.mean(axis=1), color=colour, linewidth=2, marker="o", markersize=2.5, label=label)
        if success.shape[1] > 1:
            _band(axis, x, success, colour)
    axis.set(xlabel={"steps": "environment steps", "updates": "gradient steps", "seconds": "seconds of training, all seeds side by side"}[over])
    axis.set_xlim(left=0)
    axis.xaxis.set_major_formatter("{x:,.0f}")
    axis.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False, fontsize="small")
    names = dict.fromkeys(run.spec.env.name for run in runs)
    axis.set_title(f"{', '.join(names)}: mean over seeds, 95% interval", loc="left")
    _mark_success(axis)
    _tidy([axis])
    figure.savefig(path, dpi=130)
    plt.close(figure)


def save_ablation(outcomes: Sequence[Outcome], path: Path) -> None:
    """Draws, for each task of an ablation, how each change moves the mean success along the run, with 95% intervals, as a PNG.

    A row for each change, by groups; the same rows for all tasks.
    """
    plt = _pyplot()
    tasks = list(dict.fromkeys(outcome.setting.task for outcome in outcomes))
    levers = dict.fromkeys(outcome.setting.lever for outcome in outcomes if outcome.setting.lever.changes)
    groups = dict.fromkeys(lever.group for lever in levers)
    rows = [row for group in groups for row in (group, *(lever for lever in levers if lever.group == group))]
    size = (3.0 + 3.6 * len(tasks), 1.5 + 0.2 * len(rows))
    figure, grid = plt.subplots(1, len(tasks), figsize=size, sharex=True, sharey=True, squeeze=False, layout="constrained")
    for axis, task in zip(grid[0], tasks, strict=True):
        axis.axvline(0.0, color="0.3", linewidth=1)
        for outcome in outcomes:
            if outcome.setting.task == task and outcome.setting.lever in levers:
                y, colour = rows.index(outcome.setting.lever), _VERDICTS[outcome.verdict()]
                estimate, low, high = (100 * value for value in (outcome.difference.estimate, outcome.difference.low, outcome.difference.high))
                axis.plot((low, high), (y, y), color=colour, linewidth=3, solid_capstyle="butt", alpha=0.55)
                axis.plot(estimate, y, color=colour, marker="o", markersize=5)
                axis.text(1.01, y, f"{estimate:+.1f}", color=colour, transform=axis.get_yaxis_transform(), va="center", fontsize=8)
        axis.set_title(task, loc="left")
        axis.set(xlabel="change of mean success along the run, points")
        axis.set_yticks(range(len(rows)), [row if isinstance(row, str) else row.name for row in rows])
        axis.tick_params(axis="y", length=0)
        axis.set(ylim=(len(rows) - 0.4, -0.6))
    for label, row in zip(grid[0, 0].get_yticklabels(), rows, strict=True):
        if isinstance(row, str):
            label.set(fontweight="bold")
    _tidy(grid[0])
    seeds = len(outcomes[0].setting.spec.seeds)
    legend = f"{seeds} seeds, 95% intervals; blue better, red worse, grey open"
    figure.suptitle(f"One change to the default recipe\n{legend}", x=0.01, ha="left", fontsize="medium")  # as wide as a single panel
    figure.savefig(path, dpi=130)
    plt.close(figure)


def save_filter(achieved_goals: np.ndarray, kept: np.ndarray, epsilon: np.ndarray, path: Path, *, dims: tuple[int, int], title: str) -> None:
    """Draws what the epsilon filter does to one demonstration, as in thesis figures 4.1 and 4.2, as a PNG.

    On the left all goals that it reached, on the right those that are kept, with their boxes of half-width epsilon.

    Args:
      achieved_goals: (L + 1, G) goals along the demonstration.
      kept: (L + 1,) bool, see `goals.epsilon_filter`.
      epsilon: (G,) half-width of the goal box.
      path: the file.
      dims: the two goal dimensions to draw.
      title: what the demonstration is.
    """
    plt = _pyplot()
    x, y = (achieved_goals[:, dim] for dim in dims)
    figure, axes = plt.subplots(1, 2, figsize=(10, 4.8), sharex=True, sharey=True, layout="constrained")
    for axis, shown, label in ((axes[0], np.ones_like(kept), "all goals reached"), (axes[1], kept, "kept by the filter")):
        axis.plot(x, y, color="0.75", linewidth=1, linestyle="--", zorder=1)
        axis.scatter(x[shown], y[shown], s=14, c=np.flatnonzero(shown), cmap="viridis", zorder=3)
        axis.set_title(f"{label}: {shown.sum()}", loc="left")
        axis.set(xlabel=f"goal dimension {dims[0]}", ylabel=f"goal dimension {dims[1]}")
    _tidy(axes)
    width, height = 2 * epsilon[list(dims)]
    for left, bottom in zip(x[kept] - width / 2, y[kept] - height / 2, strict=True):
        axes[1].add_patch(plt.Rectangle((left, bottom), width, height, facecolor=_SEED, edgecolor=_MEAN, alpha=0.25, linewidth=0.5, zorder=2))
    figure.suptitle(title, x=0.01, ha="left")
    figure.savefig(path, dpi=130)
    plt.close(figure)


def _pyplot() -> Any:
    import matplotlib

    if "MPLBACKEND" not in os.environ:  # notebooks set it, and go on drawing after one of these pictures was made
        matplotlib.use("Agg")
    from matplotlib import pyplot

    return pyplot


def _curves(result: Result) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Steps (evaluations,), success in percent and episode length (evaluations, S)."""
    rows = [(row.updates if result.config.algo == "bc" else row.env_steps, 100 * row.success, row.episode_length) for row in result.rows]
    table = np.asarray(rows, np.float64).reshape(-1, len(result.seeds), 3)
    return table[:, 0, 0], table[:, :, 1], table[:, :, 2]


def _band(axis: Any, x: np.ndarray, values: np.ndarray, colour: Any) -> None:
    """Shades the 95% interval of the mean of values (evaluations, S), S > 1."""
    low, high = bootstrap_band(values)
    axis.fill_between(x, low, high, color=colour, alpha=0.18, linewidth=0)


def _mark_success(axis: Any) -> None:
    """Prepares an axis that shows success."""
    axis.axhline(95, color="0.6", linestyle=":", linewidth=1)
    axis.set(ylim=(-3, 103), ylabel="success, %")


def _tidy(axes: Sequence[Any]) -> None:
    """What all pictures share."""
    for axis in axes:
        axis.grid(alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)


def _x_label(result: Result) -> str:
    return "gradient steps" if result.config.algo == "bc" else "environment steps"


def _title(result: Result) -> str:
    demos = result.guidance.demonstrations.lengths.shape[1]
    return f"{result.env.name}, {result.config.algo}, {demos} demonstration{'s' if demos > 1 else ''}"


def _mean_label(result: Result) -> str:
    return f"mean of {len(result.seeds)} seeds, 95% interval" if len(result.seeds) > 1 else f"seed {result.seeds[0]}"
