"""What all pictures share. Matplotlib is imported on first use and draws off screen, unless MPLBACKEND says where."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from hindrl_jax.plotting.statistics import bootstrap_band

MEAN, SEED, DEMONSTRATION, RETURNED = "#1f5fa8", "#9dbfe3", "#c77b00", "#b3261e"
"""Colours: the mean over seeds, a single seed, demonstrations, the policies that are returned."""
BETTER, WORSE, OPEN = "#1f5fa8", "#b3261e", "0.5"
"""Colours: what a difference says."""


def pyplot() -> Any:
    """Matplotlib's pyplot, ready to draw."""
    import matplotlib

    if "MPLBACKEND" not in os.environ:  # notebooks set it, and go on drawing after one of these pictures was made
        matplotlib.use("Agg")
    from matplotlib import pyplot

    return pyplot


@contextlib.contextmanager
def figure(path: Path, rows: int = 1, columns: int = 1, **options: Any) -> Iterator[tuple[Any, list[Any]]]:
    """A figure and its axes, row by row, to be drawn on; what is drawn is then written to `path` as a PNG.

    Args:
      path: the file.
      rows, columns: of axes.
      options: of matplotlib's `subplots`.

    Raises:
      OSError: if it cannot be written.
    """
    plt = pyplot()
    drawn, axes = plt.subplots(rows, columns, squeeze=False, layout="constrained", **options)
    try:
        yield drawn, list(axes.flat)
        for axis in axes.flat:
            axis.grid(alpha=0.25)
            axis.spines[["top", "right"]].set_visible(False)
        drawn.savefig(path, dpi=130)
    finally:
        plt.close(drawn)


def colours(name: str, number: int, *, end: float) -> Any:
    """(number, 4) colours, evenly spaced along matplotlib's map of that name from its beginning to `end`, at most 1."""
    return pyplot().get_cmap(name)(np.linspace(0.0, end, number))


def mean_line(axis: Any, x: np.ndarray, values: np.ndarray, *, colour: Any, label: str, size: float = 3) -> None:
    """Draws the mean over seeds of values (E, S) at x (E,), with a mark of that size at each."""
    axis.plot(x, values.mean(axis=1), color=colour, linewidth=2, marker="o", markersize=size, label=label)


def band(axis: Any, x: np.ndarray, values: np.ndarray, colour: Any) -> None:
    """Shades the 95% bootstrap interval of the mean over seeds of values (E, S), S > 1, at x (E,)."""
    low, high = bootstrap_band(values)
    axis.fill_between(x, low, high, color=colour, alpha=0.18, linewidth=0)


def mark_success(axis: Any) -> None:
    """Prepares an axis that shows success in percent."""
    axis.axhline(95, color="0.6", linestyle=":", linewidth=1)
    axis.set(ylim=(-3, 103), ylabel="success, %")


def legend_beside(axis: Any) -> None:
    """The legend, to the right of the axis."""
    axis.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False, fontsize="small")
