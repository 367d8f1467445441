"""How a training goes, for a person: a bar that moves and about ten lines that stay. Says the same in a terminal, a notebook and a log file."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from rich.console import Console
from rich.text import Text

from hindrl_jax.training.result import Result, Row

_WIDTHS = (10, 30)  # the least and the most characters of the bar


class ProgressBar:
    """What `fit` shows where a person watches and no other `report` is given; `report=hindrl.ProgressBar()` shows it in log files, too.

    A line stays for the evaluation at each tenth of the run, and for the one that ended it; below them a bar moves, in a terminal or a notebook. A
    log file gets the lines alone, without control characters. Nothing runs beside the training, so nothing is left behind when it is interrupted.
    """

    def __init__(self, *, lines: int = 10, console: Console | None = None):
        """Shows nothing yet.

        Args:
          lines: of how many evaluations a line stays, at most.
          console: where to write; standard output by default.
        """
        self._lines = lines
        self._console = console or Console(highlight=False, soft_wrap=True, markup=False, emoji=False)
        self._live = self._console.is_terminal and not self._console.is_dumb_terminal and not self._console.legacy_windows
        self._drawn = False  # whether the cursor stands behind a bar
        self._handle: Any = None  # the bar of a notebook
        self._began: tuple[int, float] | None = None  # steps done and seconds when learning began
        self._rows_seen: int | None = None
        self._lines_said = 0
        self._last_is_said = True  # whether the newest evaluation has a line
        self._clone_is_said = False
        self._practice_said = 0  # its steps when a line told of it

    @property
    def is_watched(self) -> bool:
        """Whether a person is likely to see it: it goes to a terminal or a notebook."""
        return self._live or self._console.is_jupyter

    def __call__(self, result: Result) -> None:
        """Brings everything up to date."""
        tenths = math.floor(self._lines * result.steps_done / result.config.num_steps)
        if self._rows_seen is None or len(result.rows) < self._rows_seen:  # a training begins, or goes on after an interruption
            self._began, self._rows_seen, self._lines_said, self._last_is_said = None, len(result.rows), tenths, True
            self._clone_is_said, self._practice_said = False, int(result.practice_steps.sum())
        if result.cloned_success is not None and not self._clone_is_said:
            self._clone_is_said = True
            self.say(clone_line(result.cloned_success))
        if result.practised_success is not None and not result.steps_done and result.practice_steps.sum() > self._practice_said:
            self._practice_said = int(result.practice_steps.sum())
            self.say(practice_line(result.practised_success, result.practice_steps))
        if len(result.rows) > self._rows_seen:
            self._rows_seen, self._last_is_said = len(result.rows), tenths > self._lines_said
            if self._last_is_said:
                self._lines_said = tenths
                self.say(evaluation_line(result.rows[-len(result.seeds) :]))
            are_stuck = result.are_stuck
            if are_stuck.any():
                self.say(reset_line(result.seeds, are_stuck, result.env_steps))
        if result.final_success is None:
            if self._began is None and result.steps_done and result.train_seconds:
                self._began = (result.steps_done, result.train_seconds)
            self._draw(bar(result, self._began, width=self._console.width - 1, unicode="utf" in self._console.encoding.lower()))
        else:
            if not self._last_is_said:  # it ended before its time
                self._last_is_said = True
                self.say(evaluation_line(result.rows[-len(result.seeds) :]))
            self.close()

    def wait(self, what: str) -> None:
        """Shows what is being waited for: in place of the bar, or in a log file as a line. `fit` calls it before it compiles."""
        if self._live or self._console.is_jupyter:
            self._draw(Text(f"{what} ..."))
        else:
            self.say(f"{what} ...")

    def say(self, line: str) -> None:
        """Writes a line that stays, above the bar."""
        self._wipe()
        if self._console.is_jupyter:
            print(line)
        else:
            self._console.print(line)

    def close(self) -> None:
        """Takes the bar away; the lines stay."""
        self._wipe()
        if self._handle is not None:
            from IPython.display import HTML

            self._handle.update(HTML(""))
            self._handle = None

    def __enter__(self) -> ProgressBar:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _draw(self, text: Text) -> None:
        if self._console.is_jupyter:
            self._draw_in_notebook(text.plain)
        elif self._live:
            self._wipe()
            text.truncate(self._console.width - 1, overflow="ellipsis")
            self._console.print(text, end="")
            self._drawn = True

    def _draw_in_notebook(self, text: str) -> None:
        from IPython.display import HTML, display

        picture = HTML(f"<pre style='margin: 0'>{html.escape(text)}</pre>")
        if self._handle is None:
            self._handle = display(picture, display_id=True)
        else:
            self._handle.update(picture)

    def _wipe(self) -> None:
        if self._drawn:
            self._console.file.write("\r\x1b[2K")
            self._console.file.flush()
            self._drawn = False


def bar(result: Result, began: tuple[int, float] | None, *, width: int, unicode: bool = True) -> Text:
    """One line on a training under way: a bar, the steps done, the newest success, steps per second over all seeds, and the time that is left.

    Args:
      result: the training.
      began: steps done and seconds of training when learning began: the random steps before that take hardly any time.
      width: characters that there is room for.
      unicode: draw with more than ASCII.
    """
    done, total = min(result.steps_done, result.config.num_steps), result.config.num_steps
    words = f" {done:,}/{total:,} {result.steps_unit}"
    success = result.latest_success()
    if success is not None:
        words += f", success {success:.0%}"
    if began is not None and result.steps_done > began[0] and result.train_seconds > began[1]:
        speed = (result.steps_done - began[0]) / (result.train_seconds - began[1])
        left = round((total - done) / speed)
        words += f", {len(result.seeds) * speed:,.0f} {result.steps_unit}/s, {left // 60}:{left % 60:02d} left"
    length = min(max(width - len(words), _WIDTHS[0]), _WIDTHS[1])
    full = round(length * done / total)
    glyph, rest = "━─" if unicode else "#."
    return Text.assemble((glyph * full, "cyan"), (rest * (length - full), "bright_black"), words)


def clone_line(success: np.ndarray) -> str:
    """One line on the policies (S,) that were cloned at the start."""
    spread = f" (worst {success.min():.0%})" if len(success) > 1 else ""
    return f"a clone of the demonstrations solves {success.mean():.0%}{spread}; it is returned if nothing better is learnt"


def practice_line(success: np.ndarray, steps: np.ndarray) -> str:
    """One line on the same policies after practice of so many environment steps, both (S,)."""
    spread = f" (worst {success.min():.0%})" if len(success) > 1 else ""
    return f"after {steps.mean():,.0f} steps of practice {success.mean():.0%}{spread}"


def reset_line(seeds: Sequence[int], are_stuck: np.ndarray, env_steps: int) -> str:
    """One line on runs whose agents are stuck, (S,) bool; in a sweep, whose runs share seeds, on how many they are."""
    stuck = [str(seed) for seed, is_stuck in zip(seeds, are_stuck, strict=True) if is_stuck]
    which = f"seed{'s' if len(stuck) > 1 else ''} {', '.join(stuck)}" if len(set(seeds)) == len(seeds) else f"{len(stuck)} of {len(seeds)} runs"
    return f"{env_steps:9,d} steps   {which} got no better for long: fresh networks learn from what was played"


def evaluation_line(rows: Sequence[Row]) -> str:
    """One line on one evaluation, from the rows of all seeds: by mean actions, and by sampled ones where those were played, too.

    Its steps are the most that a seed took: clones practise for different times.
    """
    success = [row.success for row in rows]
    sampled = [row.sampled_success for row in rows if row.sampled_success is not None]
    spread = f" (worst {min(success):4.0%})" if len(rows) > 1 else ""
    spread += f"   sampled {np.mean(sampled):4.0%}" if sampled else ""
    env_steps = max(row.env_steps for row in rows)
    steps = f"{env_steps:9,d} steps " if env_steps else ""  # bc takes none
    return (
        f"{steps}{rows[0].updates:8,d} updates {rows[0].seconds:7.1f} s   "
        f"success {np.mean(success):4.0%}{spread}   length {np.mean([row.episode_length for row in rows]):5.1f}"
    )
