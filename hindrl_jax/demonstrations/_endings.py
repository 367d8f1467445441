"""Where a demonstration of another tool ends: the observation after its last action, whether it solved the task, and what is cut off."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from hindrl_jax.base.errors import UserError
from hindrl_jax.demonstrations.foreign import ForeignDemonstration, Interpretation


def with_last_observation(where: str, demo: ForeignDemonstration, used: Sequence[str], *, repeat: bool) -> ForeignDemonstration:
    """The demonstration with L + 1 rows of each modality that is used, if need be by repeating the last.

    Raises:
      UserError: rows are missing that are not to be repeated.
    """
    modalities = dict(demo.modalities)
    for key in used:
        if len(modalities[key]) == len(demo.actions):
            if not repeat:
                raise UserError(
                    f"{where}: {key} after the last action is not known, since next_obs is missing; write the file with next_obs, "
                    "or use the last one that is there with --repeat-last-observation"
                )
            modalities[key] = np.concatenate([modalities[key], modalities[key][-1:]])
    return dataclasses.replace(demo, modalities=modalities)


def zero_is_success(demos: Sequence[ForeignDemonstration]) -> bool:
    """Whether the rewards of a file are -1 and 0 rather than 0 and 1. One demonstration cannot tell: it may have failed."""
    rewards = [demo.rewards[np.isfinite(demo.rewards)] for demo in demos if demo.rewards is not None]
    rewards = [rows for rows in rewards if len(rows)]
    return bool(rewards) and max(rows.max() for rows in rewards) <= 0 and min(rows.min() for rows in rewards) < 0


def cut_at_end(where: str, demo: ForeignDemonstration, meaning: Interpretation, *, zero_is_success: bool) -> tuple[ForeignDemonstration, bool]:
    """The transitions to keep, and whether the last of them solves the task.

    Raises:
      UserError: it is not known, or the demonstration goes on and is not to be cut.
    """
    end, solved = _end(where, demo, meaning, zero_is_success=zero_is_success)
    return demo if end == len(demo.actions) else _shortened(demo, end), solved


def _end(where: str, demo: ForeignDemonstration, meaning: Interpretation, *, zero_is_success: bool) -> tuple[int, bool]:
    """Number of transitions to keep, and whether the last of them solves the task."""
    length = len(demo.actions)
    if meaning.solved == "all":
        return length, True
    rows, what = (demo.dones, "dones") if meaning.solved == "dones" else (demo.rewards, "rewards")
    if what in demo.problems and meaning.solved == "dones":
        raise UserError(f"{demo.problems[what]}; say --solved reward or --solved all")
    if rows is None:
        others = "reward or --solved all" if what == "dones" else "all"
        raise UserError(f"{where}: has no {what}, so it is not known which demonstrations solve the task; say --solved {others}")
    if not np.isfinite(rows).all():
        row = int(np.flatnonzero(~np.isfinite(rows))[0])
        raise UserError(f"{where}: {what} are not finite in row {row}, so it is not known whether the task is solved; say --solved otherwise")
    times = np.flatnonzero(rows == 0 if what == "rewards" and zero_is_success else rows > 0)
    if not times.size:
        return length, False
    first = int(times[0])
    if first < length - 1 and not meaning.cut:
        what = "done" if what == "dones" else "rewarded"
        raise UserError(f"{where}: is {what} after {first + 1} of {length} steps and goes on; cut off the rest with --cut, or see --solved")
    return first + 1, True


def _shortened(demo: ForeignDemonstration, end: int) -> ForeignDemonstration:
    """The first `end` transitions. Extras with a row for each action or each state are cut too."""
    length = len(demo.actions)

    def cut(rows: np.ndarray | None) -> np.ndarray | None:
        if rows is None or rows.ndim == 0 or len(rows) not in (length, length + 1):
            return rows
        return rows[: end + len(rows) - length]

    return dataclasses.replace(
        demo,
        modalities={key: rows[: end + 1] for key, rows in demo.modalities.items()},
        actions=demo.actions[:end],
        rewards=cut(demo.rewards),
        dones=cut(demo.dones),
        states=None if demo.states is None else demo.states[: end + 1],
        extras={name: cut(rows) for name, rows in demo.extras.items()},
    )
