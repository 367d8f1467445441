"""Demonstrations as other tools keep them, and what a user can say about their meaning.

A reader of a format gives a `ForeignRecording`: the observations under the names that they have there, actions in the units that they have there.
`hindrl_jax.demonstrations.interpret` makes a `Recording` of it.
"""

from __future__ import annotations

import dataclasses
from typing import Any, Literal

import numpy as np

from hindrl_jax.base.errors import UserError

SOURCE = "source/"
"""Where our file keeps a dataset of the source whose name we need for something else."""
MINARI_OBSERVATIONS = "minari/observations/"
"""Where it keeps the observations of a Minari dataset."""

Solved = Literal["dones", "reward", "all"]


@dataclasses.dataclass(frozen=True)
class Interpretation:
    """What the names and numbers of another tool's file mean."""

    observation_keys: tuple[str, ...] = ()
    """Modalities that make up the observation, in this order (default: observation). KEY[2:5] takes some columns of one."""
    achieved_goal_keys: tuple[str, ...] = ()
    """Modalities that make up the achieved goal (default: what the environment derives from the observation, else achieved_goal)."""
    desired_goal_keys: tuple[str, ...] = ()
    """Modalities that make up the desired goal (default: desired_goal if there is one, else the goal achieved at the end)."""
    solved: Solved = "dones"
    """Which demonstrations solve the task: those that end with done (in Minari: success, or terminated), those that end with a reward (above 0; or 0
    where all rewards of the file are 0 or below, and some below), or all."""
    sparse_rewards: bool = False
    """Put a reward of 1 at the end of each solved demonstration and 0 everywhere else, in place of the rewards in the file."""
    cut: bool = False
    """Cut off what follows the first done (with --solved reward: the first such reward) of a demonstration."""
    repeat_last_observation: bool = False
    """Where the observation after the last action is missing, use the last one that is there."""
    action_low: tuple[float, ...] = ()
    """Lowest actions, one number or one per dimension, if not -1: actions are mapped to [-1, 1]."""
    action_high: tuple[float, ...] = ()
    """Highest actions, likewise."""
    filter_key: str | None = None
    """Take the demonstrations of this filter key only (robomimic's mask)."""

    def __post_init__(self) -> None:
        if self.cut and self.solved == "all":
            raise UserError("cut = True needs solved to be 'dones' or 'reward', which say where to cut; with 'all', demonstrations are kept whole")


@dataclasses.dataclass(frozen=True)
class ForeignDemonstration:
    """One demonstration of L transitions."""

    name: str
    modalities: dict[str, np.ndarray]
    """By key: (L + 1, n), or (L, n) where what follows the last action is not known."""
    actions: np.ndarray  # (L, A), in the units of the source
    rewards: np.ndarray | None  # (L,)
    dones: np.ndarray | None  # (L,), not 0 where the task was solved or over
    states: np.ndarray | None = None
    """(L + 1, S), or (L, S) where the last is not known; only of use if they are those of our own environment."""
    extras: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)
    """All datasets that our file is to keep, by the name that they have there."""
    problems: dict[str, str] = dataclasses.field(default_factory=dict)
    """What is wrong with a modality, or with `dones`; said where it is to be used."""
    attributes: dict[str, Any] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class ForeignRecording:
    """What a file or dataset of another tool holds."""

    source: str
    """Its name, for messages."""
    format: str
    env_name: str
    env_kwargs: dict[str, Any]
    demonstrations: tuple[ForeignDemonstration, ...]
    expert: dict[str, Any] | None = None
    observation_keys: tuple[str, ...] = ("observation",)
    """The modalities that make up the observation, where nobody says otherwise."""
    action_low: np.ndarray | None = None  # (A,) bounds of the actions, where the source gives them
    action_high: np.ndarray | None = None
    filters: dict[str, list[str]] = dataclasses.field(default_factory=dict)
    """Names of the demonstrations that belong to each filter key."""
    extras: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)
    attributes: dict[str, Any] = dataclasses.field(default_factory=dict)
    file_attributes: dict[str, Any] = dataclasses.field(default_factory=dict)
    ours: bool = False
    """Whether we have written it, so that a conversion back gives a file as if it had been recorded."""
    about: dict[str, Any] = dataclasses.field(default_factory=dict)
    """What else a conversion back needs to know."""

    @property
    def shapes(self) -> dict[str, int]:
        """Number of columns of each modality."""
        return {key: rows.shape[1] for key, rows in self.demonstrations[0].modalities.items()}
