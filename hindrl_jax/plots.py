"""Pictures of runs. Matplotlib is imported on first use and draws off screen."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from hindrl_jax.experiment import Result

_MEAN, _SEED, _DEMO = "#1f5fa8", "#9dbfe3", "#c77b00"


def save_curve(result: Result, path: Path) -> None:
    """Draws success and episode length over training, one thin line per seed and their mean, as a PNG."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    cloning = result.config.algo == "bc"
    rows = np.asarray([(row.updates if cloning else row.env_steps, row.success, row.episode_length) for row in result.rows], np.float64).reshape(
        -1, len(result.seeds), 3
    )
    x = rows[:, 0, 0]
    figure, axes = plt.subplots(2, 1, figsize=(7, 5.5), sharex=True, height_ratios=(3, 2), layout="constrained")
    for axis, values in zip(axes, (100 * rows[:, :, 1], rows[:, :, 2]), strict=True):
        if len(result.seeds) > 1:
            axis.plot(x, values, color=_SEED, linewidth=0.9)
        axis.plot(x, values.mean(axis=1), color=_MEAN, linewidth=2, marker="o", markersize=3, label=_mean_label(result))
        axis.grid(alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)
    lengths = np.asarray(result.guidance.demonstrations.lengths)
    axes[1].axhline(lengths.mean(), color=_DEMO, linestyle="--", linewidth=1, label="demonstrations")
    axes[0].axhline(95, color="0.6", linestyle=":", linewidth=1)
    axes[0].set(ylim=(-3, 103), ylabel="success, %")
    axes[0].legend(loc="lower right", frameon=False)
    axes[1].set(ylim=(0, result.env.horizon * 1.05), ylabel="episode length, steps", xlabel="gradient steps" if cloning else "environment steps")
    axes[1].legend(loc="lower left", frameon=False)
    demos = f"{lengths.shape[1]} demonstration{'s' if lengths.shape[1] > 1 else ''}"
    axes[0].set_title(f"{result.env.name}, {result.config.algo}, {demos}", loc="left")
    figure.savefig(path, dpi=130)
    plt.close(figure)


def _mean_label(result: Result) -> str:
    return f"mean of {len(result.seeds)} seeds" if len(result.seeds) > 1 else f"seed {result.seeds[0]}"
