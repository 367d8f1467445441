"""How a run went, read back from its directory: of a finished run, and of one that is under way or was killed."""

from __future__ import annotations

import csv
import dataclasses
import json
from pathlib import Path
from typing import Any, Literal

import numpy as np

from hindrl_jax.base.errors import UserError, one_line
from hindrl_jax.runs.spec import METRICS, SUMMARY, RunSpec, read_spec
from hindrl_jax.training.result import SOLVED

Axis = Literal["steps", "updates", "seconds"]
_NEEDED = ("env_steps", "updates", "seconds", "success")


@dataclasses.dataclass(frozen=True)
class RecordedRun:
    """What a run's directory says about how it went: E evaluations of S seeds."""

    path: Path
    label: str
    """A short name; those of runs that are read together differ."""
    spec: RunSpec
    env_steps: np.ndarray
    """(E,) environment steps of each seed, the most that one took where clones have practised for different times; 0 for bc."""
    updates: np.ndarray
    """(E,) gradient steps of each seed."""
    seconds: np.ndarray
    """(E,) of training, all seeds side by side."""
    success: np.ndarray
    """(E, S) share of an evaluation's episodes that are solved."""
    metrics: dict[str, np.ndarray]
    """(E, S) each: the other columns of `metrics.csv` by name, as in "episode_length" or "actor/bc_loss"; not a number where a field is empty."""
    returned_success: np.ndarray
    """(S,) share of 100 fresh episodes that the returned policies solve; of the last evaluation's, if the run is not finished."""
    train_seconds: float
    """Of the whole training so far, evaluations included and compilation not."""
    finished: bool
    steps_of_seeds: np.ndarray | None = None
    """(E, S) environment steps of each seed; None where all have taken as many."""

    @property
    def ended_with_clones(self) -> bool:
        """Whether the run was over before it learnt anything, since its clones were good enough."""
        return self.finished and not self.cloning and int(self.updates[-1]) == 0

    @property
    def cloning(self) -> bool:
        """Whether the run counts gradient steps alone."""
        return not self.spec.config.learns_from_rollouts

    def axis(self, over: Axis) -> np.ndarray:
        """(E,) what the evaluations are drawn over."""
        return {"steps": self.env_steps, "updates": self.updates, "seconds": self.seconds}[over]

    def to_95(self, over: Axis) -> np.ndarray:
        """(S,) where each seed's first evaluation at 95% stands; infinite where there is none."""
        reached, along = self.success >= SOLVED, np.broadcast_to(self.axis(over)[:, None], self.success.shape)
        if over == "steps" and self.steps_of_seeds is not None:
            along = self.steps_of_seeds
        return np.where(reached.any(axis=0), np.take_along_axis(along, reached.argmax(axis=0)[None], axis=0)[0], np.inf)


def read_recorded(path: Path, label: str | None = None) -> RecordedRun:
    """Reads what a run's directory holds so far; the label is its name unless another is given.

    Raises:
      UserError: if it is damaged, or has no evaluation yet.
    """
    spec = read_spec(path)
    try:
        text = (path / METRICS).read_text()
        summary = json.loads((path / SUMMARY).read_text()) if (path / SUMMARY).exists() else None
        columns = _whole_evaluations(text, spec.seeds)
        final = None if summary is None else np.asarray([float(seed["returned_success"]) for seed in summary["seeds"]])
        if final is not None and final.shape != (len(spec.seeds),):
            raise ValueError(f"{SUMMARY} is of {len(final)} seeds, and {len(spec.seeds)} were asked for")
        for name, shares in ((METRICS, columns["success"]), (SUMMARY, np.zeros(0) if final is None else final)):
            if not ((shares >= 0.0) & (shares <= 1.0)).all():
                raise ValueError(f"a success in {name} is no share from 0 to 1")
        total = None if summary is None else float(summary["train_seconds"])
    except FileNotFoundError:
        raise UserError(f"{path} has no {METRICS} yet: wait for its first evaluation, or leave it out") from None
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise UserError(f"{path} is damaged ({one_line(error)}): leave it out, or remove it and train again") from error
    if not len(columns["success"]):
        raise UserError(f"{path} has no evaluation of all its seeds yet: wait for the first, or leave it out")
    return RecordedRun(
        path=path,
        label=path.name if label is None else label,
        spec=spec,
        env_steps=columns["env_steps"].max(axis=1).astype(int),
        updates=columns["updates"][:, 0].astype(int),
        seconds=columns["seconds"][:, 0],
        success=columns["success"],
        metrics={name: values for name, values in columns.items() if name not in _NEEDED},
        returned_success=columns["success"][-1] if final is None else final,
        train_seconds=float(columns["seconds"][-1, 0]) if total is None else total,
        finished=final is not None,
        steps_of_seeds=columns["env_steps"],
    )


def _whole_evaluations(text: str, seeds: tuple[int, ...]) -> dict[str, Any]:
    """Columns (E, S) of the metrics, of those evaluations that hold all seeds, in order of the seeds. That before learning is one, after however many
    steps of practice each seed was found good enough."""
    lines = text[: text.rfind("\n") + 1].splitlines()  # what follows the last line's end is still being written
    evaluations: dict[tuple[int, int], dict[int, dict[str, str]]] = {}
    for row in csv.DictReader(lines):
        steps, updates = int(row["env_steps"]), int(row["updates"])
        evaluations.setdefault((steps if updates else 0, updates), {})[int(row["seed"])] = row
    whole = [[rows[seed] for seed in seeds] for rows in evaluations.values() if set(rows) == set(seeds)]
    others = [name for name in (whole[0][0] if whole else ()) if name not in ("seed", *_NEEDED)]
    columns: dict[str, Any] = {name: np.asarray([[float(row[name]) for row in rows] for rows in whole]) for name in _NEEDED}
    return columns | {name: np.asarray([[float(row[name] or "nan") for row in rows] for rows in whole]) for name in others}
