"""The thesis's figures, drawn from runs, in its axes."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hindrl_jax.plotting.figures import DEMONSTRATION, MEAN, SEED, band, colours, figure, mean_line
from hindrl_jax.plotting.statistics import performance_profile
from hindrl_jax.reproduction.measures import HINDSIGHT_REWARD
from hindrl_jax.reproduction.thesis import ALGORITHM_NAMES, Artifact, Setting
from hindrl_jax.runs.recorded import RecordedRun


@dataclasses.dataclass(frozen=True)
class Panel:
    """What is drawn over environment steps."""

    label: str
    values: Callable[[RecordedRun], np.ndarray | None]
    """(E, S); None where the run does not record it."""


PANELS: dict[str, Panel] = {
    "success": Panel("success, %", lambda run: 100 * run.success),
    "episode_length": Panel("episode length, steps", lambda run: run.metrics.get("episode_length")),
    "bc_loss": Panel("cloning loss", lambda run: run.metrics.get("actor/bc_loss")),
    "hindsight_reward": Panel("hindsight rewards in a batch", lambda run: run.metrics.get(HINDSIGHT_REWARD)),
    "all_rewards": Panel("all rewards in a batch", lambda run: run.metrics.get("batch/reward")),
}


def draw(artifact: Artifact, runs: Mapping[Setting, RecordedRun], path: Path, *, recipe: str) -> None:
    """Draws a figure of the thesis as a PNG, with what is known of the thesis's own as broken lines.

    Args:
      artifact: which.
      runs: those of its settings that are finished, at least one.
      path: the file.
      recipe: what they were trained with, for people.

    Raises:
      OSError: if it cannot be written.
    """
    there = {setting: runs[setting] for setting in artifact.settings if setting in runs}
    number = len(artifact.settings) if artifact.apart else len(artifact.panels)
    with figure(path, columns=number, figsize=(1.5 + 4.5 * number, 4.2), sharex=True, sharey=artifact.apart) as (drawn, axes):
        if artifact.panels == ("steps_to_100",):
            _boxes(axes[0], artifact, there)
        elif artifact.apart:
            for axis, setting in zip(axes, artifact.settings, strict=True):
                axis.set_title(setting.title(), loc="left", fontsize="medium")
                _seeds(axis, PANELS[artifact.panels[0]], there.get(setting))
        else:
            for axis, name in zip(axes, artifact.panels, strict=True):
                _means(axis, PANELS[name], there)
        for axis in axes if artifact.apart else axes[:1]:
            _mark(axis, artifact)
            if artifact.panels[0] == "success":
                axis.set_ylim(-3, 103)
            else:
                axis.set_ylim(bottom=0)
        shown = "" if artifact.apart or artifact.panels == ("steps_to_100",) else "; mean over seeds and its 95% bootstrap interval"
        drawn.suptitle(f"{artifact.title}\n{recipe}{shown}", x=0.01, ha="left", fontsize="medium")


def draw_profiles(tables: Sequence[Artifact], runs: Mapping[Setting, RecordedRun], path: Path, *, recipe: str) -> None:
    """Draws the performance profiles of tables as a PNG: a line for each algorithm, of all its cells that are there, with 95% intervals.

    Args:
      tables: a panel each.
      runs: those of their settings that are finished.
      path: the file.
      recipe: what they were trained with, for people.

    Raises:
      OSError: if it cannot be written.
    """
    thresholds = np.linspace(0.0, 1.0, 101)
    with figure(path, columns=len(tables), figsize=(1.5 + 4.5 * len(tables), 4.2), sharex=True, sharey=True) as (drawn, axes):
        for axis, table in zip(axes, tables, strict=True):
            algorithms = dict.fromkeys(setting.algo for setting in table.settings)
            for algo, colour, style in zip(algorithms, colours("viridis", len(algorithms), end=0.85), ("-", "--", ":"), strict=True):
                groups = [runs[setting].returned_success for setting in table.settings if setting.algo == algo and setting in runs]
                if groups:
                    shares, low, high = performance_profile(groups, thresholds)
                    label = f"{ALGORITHM_NAMES[algo]} ({sum(map(len, groups))} runs)"
                    axis.step(100 * thresholds, shares, where="post", color=colour, linestyle=style, linewidth=2.5, label=label)
                    axis.fill_between(100 * thresholds, low, high, step="post", color=colour, alpha=0.18, linewidth=0)
            axis.set_title(table.title, loc="left", fontsize="medium")
            axis.set(xlabel="success x of the returned policy, %", xlim=(-1, 101), ylim=(-0.03, 1.03))
            if axis.get_legend_handles_labels()[1]:
                axis.legend(frameon=False, fontsize="small", loc="lower left")
            else:
                _say(axis, "not run")
        axes[0].set_ylabel("share of runs above x")
        drawn.suptitle(f"Performance profiles\n{recipe}; bands are 95% bootstrap intervals", x=0.01, ha="left", fontsize="medium")


def steps_to_100(run: RecordedRun) -> np.ndarray:
    """(C,) environment steps to the first evaluation at 100%, of the C seeds that have one."""
    reached = run.success >= 1.0
    return run.env_steps[reached.argmax(axis=0)][reached.any(axis=0)]


def _means(axis: Any, panel: Panel, runs: Mapping[Setting, RecordedRun]) -> None:
    """A line for each setting: the mean over its seeds, and its interval."""
    _prepare(axis, panel)
    recorded = {setting: (run.env_steps, panel.values(run)) for setting, run in runs.items() if panel.values(run) is not None}
    if not recorded:
        _say(axis, "not recorded")
    for (setting, (env_steps, values)), colour in zip(recorded.items(), colours("viridis", len(recorded), end=0.85), strict=True):
        mean_line(axis, env_steps, values, colour=colour, label=f"{setting.title()} ({values.shape[1]} seeds)")
        if values.shape[1] > 1 and np.isfinite(values).all():
            band(axis, env_steps, values, colour)


def _seeds(axis: Any, panel: Panel, run: RecordedRun | None) -> None:
    """A line for each seed of a setting, and their mean."""
    _prepare(axis, panel)
    values = None if run is None else panel.values(run)
    if values is None:
        _say(axis, "not run" if run is None else "not recorded")
        return
    axis.plot(run.env_steps, values, color=SEED, linewidth=1)
    axis.plot(run.env_steps, values.mean(axis=1), color=MEAN, linewidth=2, label=f"mean of {values.shape[1]} seeds")


def _boxes(axis: Any, artifact: Artifact, runs: Mapping[Setting, RecordedRun]) -> None:
    """A box for each setting, of the seeds that reach 100%, which are counted in its label."""
    labels = []
    for place, setting in enumerate(artifact.settings):
        steps = steps_to_100(runs[setting]) if setting in runs else np.zeros(0)
        of = f"{len(steps)} of {len(runs[setting].spec.seeds)} seeds" if setting in runs else "not run"
        labels.append(f"{setting.title()}\n{of}")
        if len(steps):
            axis.boxplot([steps], positions=[place], widths=0.5, medianprops={"color": MEAN})
            axis.scatter(np.full(len(steps), place), steps, color=SEED, s=14, zorder=3)
    axis.set_xticks(range(len(labels)), labels)
    axis.set(xlim=(-0.6, len(labels) - 0.4), ylabel="environment steps to 100%")
    axis.yaxis.set_major_formatter("{x:,.0f}")


def _prepare(axis: Any, panel: Panel) -> None:
    axis.set(xlabel="environment steps", ylabel=panel.label)
    axis.xaxis.set_major_formatter(lambda x, _: f"{x / 1000:g}k")


def _mark(axis: Any, artifact: Artifact) -> None:
    """The thesis's own, as broken lines; those at steps that no run has come to are out of view, and said to be."""
    end = axis.get_xlim()
    for (label, along, where), style in zip(artifact.marks, ("--", ":"), strict=False):
        shown = label if along == "y" or end[0] <= where <= end[1] else f"{label} (out of view)"
        (axis.axvline if along == "x" else axis.axhline)(where, color=DEMONSTRATION, linestyle=style, linewidth=1.5, label=shown)
    axis.set_xlim(end)
    if axis.get_legend_handles_labels()[1]:
        axis.legend(edgecolor="none", framealpha=0.85, fontsize="small")  # a mark may run beneath it


def _say(axis: Any, text: str) -> None:
    axis.text(0.5, 0.5, text, transform=axis.transAxes, ha="center", va="center", color="0.5")
