"""A recording: the demonstrations of one task, in the form that every format is read into and written from, and a summary of it."""

from __future__ import annotations

import dataclasses
import json
import os
from pathlib import Path
from typing import Any

import numpy as np

OBSERVATION_KEYS = ("observation", "achieved_goal", "desired_goal")
"""What is observed in every state; the names are those of Gymnasium's goal environments."""
RECORD_AGAIN = "record the demonstrations again"
"""What a user can always do about a file of ours."""


@dataclasses.dataclass(frozen=True)
class Demonstration:
    """One demonstration of L transitions. Floats of any size, as they are in the file."""

    name: str
    """As in the file: demo_0, demo_1, ..."""
    observations: np.ndarray  # (L + 1, D)
    achieved_goals: np.ndarray  # (L + 1, G)
    desired_goal: np.ndarray  # (G,)
    actions: np.ndarray  # (L, A), in [-1, 1]
    rewards: np.ndarray  # (L,)
    terminated: bool
    """Whether the last transition solved the task."""
    states: np.ndarray | None = None  # (L + 1, S) of our own environment
    extras: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)
    """Other datasets of its group, by their path in it."""
    attributes: dict[str, Any] = dataclasses.field(default_factory=dict)
    """Other attributes of its group."""

    def __len__(self) -> int:
        return len(self.actions)

    @property
    def observed(self) -> dict[str, np.ndarray]:
        """What was observed in each state, by `OBSERVATION_KEYS`: (L + 1, D or G), the desired goal repeated."""
        desired_goals = np.broadcast_to(self.desired_goal, (len(self) + 1, *self.desired_goal.shape))
        return dict(zip(OBSERVATION_KEYS, (self.observations, self.achieved_goals, desired_goals), strict=True))


@dataclasses.dataclass(frozen=True)
class Recording:
    """All that a file of demonstrations holds."""

    env_name: str
    env_kwargs: dict[str, Any]
    expert: dict[str, Any] | None
    demonstrations: tuple[Demonstration, ...]
    converted_from: dict[str, Any] | None = None
    """What the source was, if this is a conversion."""
    extras: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)
    """Datasets outside the group `data`, by their path in the file."""
    attributes: dict[str, Any] = dataclasses.field(default_factory=dict)
    """Attributes of the source's group `data`; its env_args and env stand in the file in place of ours."""
    file_attributes: dict[str, Any] = dataclasses.field(default_factory=dict)
    """Attributes of the file as a whole."""


@dataclasses.dataclass(frozen=True)
class DemonstrationSummary:
    """What a file of demonstrations holds. Ranges are per dimension, over all steps of all demonstrations."""

    path: Path
    env_name: str
    env_kwargs: dict[str, Any]
    expert: dict[str, Any] | None
    num_demonstrations: int
    num_transitions: int
    num_solved: int
    length_min: int
    length_median: float
    length_max: int
    observation_low: np.ndarray  # (D,)
    observation_high: np.ndarray  # (D,)
    action_low: np.ndarray  # (A,)
    action_high: np.ndarray  # (A,)


def summarise_recording(path: str | os.PathLike[str], recording: Recording) -> DemonstrationSummary:
    """What a recording, read from `path`, holds."""
    demos = recording.demonstrations
    lengths = [len(demo) for demo in demos]
    observations = np.concatenate([demo.observations for demo in demos])
    actions = np.concatenate([demo.actions for demo in demos])
    return DemonstrationSummary(
        path=Path(path),
        env_name=recording.env_name,
        env_kwargs=recording.env_kwargs,
        expert=recording.expert,
        num_demonstrations=len(demos),
        num_transitions=sum(lengths),
        num_solved=sum(demo.terminated for demo in demos),
        length_min=min(lengths),
        length_median=float(np.median(lengths)),
        length_max=max(lengths),
        observation_low=observations.min(axis=0),
        observation_high=observations.max(axis=0),
        action_low=actions.min(axis=0),
        action_high=actions.max(axis=0),
    )


def plain(value: Any) -> Any:
    """The value as it comes back from JSON: tuples become lists, arrays and NumPy scalars become numbers."""
    return json.loads(json.dumps(value, default=lambda array: array.tolist()))
