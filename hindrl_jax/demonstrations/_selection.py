"""Which columns of which modalities make up the observation and the goals."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence

import numpy as np

from hindrl_jax.base.environments import Environment
from hindrl_jax.base.errors import UserError
from hindrl_jax.demonstrations.foreign import ForeignDemonstration, ForeignRecording, Interpretation

Columns = list[tuple[str, slice]]
"""Modalities, and which of their columns."""


@dataclasses.dataclass(frozen=True)
class Selection:
    """What stands for what; no columns for a goal that is derived."""

    observation: Columns
    achieved_goal: Columns
    desired_goal: Columns

    @property
    def used(self) -> list[str]:
        """The modalities that are of use, in alphabetical order."""
        return sorted({key for columns in (self.observation, self.achieved_goal, self.desired_goal) for key, _ in columns})


def select(foreign: ForeignRecording, meaning: Interpretation, env: Environment | None) -> Selection:
    """What a user has named, else the usual names.

    Args:
      foreign: from the reader of a format.
      meaning: what the user has named.
      env: the environment of the task, if it is one of ours, which derives the achieved goals.

    Raises:
      UserError: something is not there or has the wrong size; the message lists what there is.
    """
    shapes = foreign.shapes
    listed = ", ".join(f"{key} ({width})" for key, width in shapes.items()) or "none"

    def columns(keys: Sequence[str], flag: str) -> Columns:
        return [found for key in keys for found in _columns_of(key, shapes, f"{foreign.source}: --{flag} {key}", listed)]

    if not shapes:
        raise UserError(
            f"{foreign.source}: holds no observations, only actions and states; let the tool that wrote it extract observations first "
            "(robomimic: scripts/dataset_states_to_obs.py --done_mode 0)"
        )
    if not meaning.observation_keys and "observation" not in shapes:
        raise UserError(f"{foreign.source}: has no modality 'observation'; name some with --observation-keys, out of {listed}")
    observation = columns(meaning.observation_keys or foreign.observation_keys, "observation-keys")
    achieved, desired = columns(meaning.achieved_goal_keys, "achieved-goal-keys"), columns(meaning.desired_goal_keys, "desired-goal-keys")
    if not achieved and env is None:
        achieved = _columns_of("achieved_goal", shapes, None, listed)
        if not achieved:
            raise UserError(
                f"{foreign.source}: has no modality 'achieved_goal'; name some with --achieved-goal-keys, out of {listed}, "
                "or name the environment with --env if it is one of ours"
            )
    if not desired and not meaning.achieved_goal_keys:
        desired = _columns_of("desired_goal", shapes, None, listed)
    for name, found, dim in (
        ("observation", observation, env and env.observation_dim),
        ("achieved_goal", achieved, env and env.goal_dim),
        ("desired_goal", desired, env and env.goal_dim if env else _width(achieved)),
    ):
        if found and dim is not None and _width(found) != dim:
            owner = env.name if env is not None else "the achieved goal"
            raise UserError(
                f"{foreign.source}: the keys of the {name.replace('_', ' ')} have {_width(found)} numbers, but {owner} has {dim}; "
                f"choose others with --{name.replace('_', '-')}-keys, out of {listed}"
            )
    selection = Selection(observation, achieved, desired)
    _check_alike(foreign, selection)
    return selection


def _check_alike(foreign: ForeignRecording, selection: Selection) -> None:
    """All demonstrations must have the modalities that are used, with as many columns as the first, and as many rows as actions."""
    demos, used = foreign.demonstrations, selection.used
    for demo in demos:
        where = f"{foreign.source}: {demo.name}"
        if len(demo.actions) < 1:
            raise UserError(f"{where}: has no actions; delete this demonstration")
        for key in used:
            if key in demo.problems:
                raise UserError(demo.problems[key])
            if key not in demo.modalities or demo.modalities[key].shape[1] != foreign.shapes[key]:
                found = demo.modalities[key].shape[1] if key in demo.modalities else "no"
                raise UserError(f"{where}: has {found} columns of {key}, but {demos[0].name} has {foreign.shapes[key]}; delete one of them")
        for what, rows in {**{key: demo.modalities[key] for key in used}, "rewards": demo.rewards, "dones": demo.dones}.items():
            if rows is not None and len(rows) not in (len(demo.actions), len(demo.actions) + (what in used)):
                raise UserError(f"{where}: has {len(demo.actions)} actions, but {len(rows)} rows of {what}; the file is inconsistent, write it again")


def _columns_of(key: str, shapes: dict[str, int], where: str | None, listed: str) -> Columns:
    """One key, with [a:b] or [a] for some of its columns; a key of a group stands for all keys in it. Without `where`, a missing one is none."""
    match = re.fullmatch(r"(?P<key>[^\[\]]+)(\[(?P<start>\d+|\d*(?=:))(?P<colon>:?)(?P<stop>(?<=:)\d*|)\])?", key)
    name = match["key"] if match else key
    within = [name] if name in shapes else [other for other in shapes if other.startswith(f"{name}/")]
    if not within:
        if where is None:
            return []
        raise UserError(f"{where}: there is no such modality; there are {listed}")
    if match is None or match[2] is None:
        return [(other, slice(0, shapes[other])) for other in within]
    start = int(match["start"] or 0)
    stop = int(match["stop"] or shapes[within[0]]) if match["colon"] else start + 1
    if len(within) > 1 or not 0 <= start < stop <= shapes[within[0]]:
        raise UserError(f"{where}: has no such columns; write KEY[START:STOP] with numbers from 0 to {shapes[within[0]]}")
    return [(within[0], slice(start, stop))]


def _width(columns: Columns) -> int:
    return sum(columns.stop - columns.start for _, columns in columns)


def joined_columns(demo: ForeignDemonstration, columns: Columns) -> np.ndarray:
    """The chosen columns side by side: (L + 1, n)."""
    return np.concatenate([demo.modalities[key][:, part] for key, part in columns], axis=1)
