"""Pictures of trainings, and of what the epsilon filter does to a demonstration."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hindrl_jax.plotting.figures import DEMONSTRATION, MEAN, RETURNED, SEED, band, colours, figure, legend_beside, mark_success, mean_line, pyplot
from hindrl_jax.training.result import Result


def save_curve(result: Result, path: Path) -> None:
    """Draws success and episode length over training, one thin line per seed, their mean and its 95% bootstrap interval, as a PNG.

    Of mean actions; the success of sampled ones is a dotted line, the mean over seeds. The returned policies are marked, and where networks were
    reset.
    """
    x, success, length = _curves(result)
    with figure(path, rows=2, figsize=(7, 5.5), sharex=True, height_ratios=(3, 2)) as (_, axes):
        for axis, values in zip(axes, (success, length), strict=True):
            if len(result.seeds) > 1:
                axis.plot(x, values, color=SEED, linewidth=0.6)
                band(axis, x, values, MEAN)
            mean_line(axis, x, values, colour=MEAN, label=_mean_label(result))
        sampled = [row.sampled_success for row in result.rows if row.sampled_success is not None]
        if len(sampled) == len(result.rows):
            by_seed = 100 * np.reshape(sampled, success.shape)
            axes[0].plot(x, by_seed.mean(axis=1), color=MEAN, linewidth=1, linestyle=":", label="with sampled actions")
        _mark_resets(axes[0], result)
        _mark_returned(axes[0], result)
        lengths = np.asarray(result.guidance.demonstrations.lengths) * result.config.num_held
        axes[1].axhline(lengths.mean(), color=DEMONSTRATION, linestyle="--", linewidth=1, label="demonstrations")
        axes[0].legend(loc="lower right", frameon=False)
        axes[1].set(ylim=(0, result.env.horizon * 1.05), ylabel="episode length, steps", xlabel=_x_label(result))
        axes[1].legend(loc="lower left", frameon=False)
        axes[1].xaxis.set_major_formatter("{x:,.0f}")
        axes[0].set_title(_title(result), loc="left")
        mark_success(axes[0])


def save_sweep(parts: Sequence[Result], labels: Sequence[str], path: Path) -> None:
    """Draws success over training for each setting of a sweep: the mean of its seeds, and thinly each seed, as a PNG."""
    with figure(path, figsize=(8, 4.5)) as (_, (axis,)):
        for part, label, colour in zip(parts, labels, colours("viridis", len(parts), end=0.9), strict=True):
            x, success, _ = _curves(part)
            axis.plot(x, success, color=colour, linewidth=0.6, alpha=0.35)
            mean_line(axis, x, success, colour=colour, label=label)
        axis.set(xlabel=_x_label(parts[0]))
        legend_beside(axis)
        seeds = f", mean of {len(parts[0].seeds)} seeds" if len(parts[0].seeds) > 1 else ""
        axis.set_title(_title(parts[0]) + seeds, loc="left")
        mark_success(axis)


def save_filter(
    achieved_goals: np.ndarray, kept: np.ndarray, epsilon: np.ndarray, path: Path, *, dims: tuple[int, int], labels: Sequence[str], title: str
) -> None:
    """Draws what the epsilon filter does to one demonstration, as in thesis figures 4.1 and 4.2, as a PNG.

    On the left all goals that it reached, on the right those that are kept, with their boxes of half-width epsilon.

    Args:
      achieved_goals: (L + 1, G) goals along the demonstration.
      kept: (L + 1,) bool, see `goals.epsilon_filter`.
      epsilon: (G,) half-width of the goal box.
      path: the file.
      dims: the two goal dimensions to draw.
      labels: their names.
      title: what the demonstration is.
    """
    x, y = (achieved_goals[:, dim] for dim in dims)
    width, height = 2 * epsilon[list(dims)]
    with figure(path, columns=2, figsize=(10, 4.8), sharex=True, sharey=True) as (drawn, axes):
        for axis, shown, label in ((axes[0], np.ones_like(kept), "all goals reached"), (axes[1], kept, "kept by the filter")):
            axis.plot(x, y, color="0.75", linewidth=1, linestyle="--", zorder=1)
            axis.scatter(x[shown], y[shown], s=14, c=np.flatnonzero(shown), cmap="viridis", zorder=3)
            axis.set_title(f"{label}: {shown.sum()}", loc="left")
            axis.set(xlabel=labels[0], ylabel=labels[1])
        box = dict(facecolor=SEED, edgecolor=MEAN, alpha=0.25, linewidth=0.5, zorder=2)
        for left, bottom in zip(x[kept] - width / 2, y[kept] - height / 2, strict=True):
            axes[1].add_patch(pyplot().Rectangle((left, bottom), width, height, **box))
        drawn.suptitle(title, x=0.01, ha="left")


def _curves(result: Result) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Steps (evaluations,), success in percent and episode length (evaluations, S)."""
    rows = [(row.env_steps if result.config.learns_from_rollouts else row.updates, 100 * row.success, row.episode_length) for row in result.rows]
    table = np.asarray(rows, np.float64).reshape(-1, len(result.seeds), 3)
    return table[:, 0, 0], table[:, :, 1], table[:, :, 2]


def _mark_returned(axis: Any, result: Result) -> None:
    """The policies that are returned."""
    if result.returned is not None:
        steps = result.returned.env_steps if result.config.learns_from_rollouts else result.returned.updates
        axis.scatter(steps, 100 * result.returned.success, s=18, color=RETURNED, marker="o", zorder=5, label="returned")


def _mark_resets(axis: Any, result: Result) -> None:
    """Where networks were reset, on the curves of their runs."""
    of_runs = [(result.rows[index :: len(result.seeds)], steps) for index, steps in enumerate(result.resets)]
    points = [(row.env_steps, 100 * row.success) for rows, steps in of_runs for row in rows if row.env_steps in steps]
    if points:
        axis.scatter(*zip(*points, strict=True), s=18, color=MEAN, marker="v", zorder=4, label="networks reset")


def _x_label(result: Result) -> str:
    return "environment steps" if result.config.learns_from_rollouts else "gradient steps"


def _title(result: Result) -> str:
    demos = result.guidance.demonstrations.lengths.shape[1]
    return f"{result.env.name}, {result.config.algo}, {demos} demonstration{'s' if demos > 1 else ''}"


def _mean_label(result: Result) -> str:
    return f"mean of {len(result.seeds)} seeds, 95% interval" if len(result.seeds) > 1 else f"seed {result.seeds[0]}"
