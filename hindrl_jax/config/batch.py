"""How a training batch is put together."""

from __future__ import annotations

import dataclasses
from typing import Any, Literal

from hindrl_jax.base.checks import check, check_types

Source = Literal["final", "future", "episode", "random", "task_conditioned", "joint_intersection"]
"""Where a relabelled goal may come from, explained in `hindrl_jax.core.hindsight`."""
Strategy = Literal["final", "future", "rollout_conditioned", "episode", "random", "task_conditioned", "joint_union", "joint_intersection"]
"""Hindsight strategies: one of the sources, or task_conditioned and future side by side (joint_union)."""


@dataclasses.dataclass(frozen=True)
class BatchConfig:
    """How a training batch is put together (thesis section 4.1.2)."""

    batch_size: int = 256
    """Rows of the batch of a gradient step, demonstrations included."""
    max_demo_ratio: float = 0.5
    """Share of demonstration rows in the batch at the start of training (MAX_d of thesis eq. 4.9, as a ratio)."""
    reach_zero: int | None = None
    """Environment step at which the demonstration share has fallen linearly to zero (thesis eq. 4.9); None keeps it constant."""
    relabelled_per_original: float = 0.25
    """Relabelled rows for each original replay row, n: the relabelled share of the replay rows is n / (n + 1). Zero turns relabelling off."""
    hindrl_sampling_strategy: Strategy = "task_conditioned"
    """Where relabelled goals come from; rollout_conditioned is the thesis's name for future."""
    union_sampling_ratio: float = 0.5
    """For joint_union: the share of relabelled goals that comes from the demonstrations."""
    intersection_goals: Literal["rollout", "demonstrations"] = "rollout"
    """For joint_intersection: goals that the rollout reached within epsilon of a demonstrated one, or the demonstrated ones that it came near."""
    n_step: int = 5
    """Steps of reward before the value estimate takes over."""
    gamma: float = 0.98
    """Discount factor."""

    def __post_init__(self) -> None:
        check_types(self)
        if self.hindrl_sampling_strategy == "rollout_conditioned":
            object.__setattr__(self, "hindrl_sampling_strategy", "future")
        check(
            self,
            batch_size=(self.batch_size >= 1, "at least 1"),
            max_demo_ratio=(0.0 <= self.max_demo_ratio <= 1.0, "between 0 and 1"),
            reach_zero=(self.reach_zero is None or self.reach_zero >= 1, "at least 1 environment step, or None"),
            relabelled_per_original=(self.relabelled_per_original >= 0, "0 (no relabelling) or more"),
            union_sampling_ratio=(0.0 <= self.union_sampling_ratio <= 1.0, "between 0 and 1"),
            n_step=(self.n_step >= 1, "at least 1"),
            gamma=(0.0 < self.gamma <= 1.0, "in (0, 1]"),
        )
        if self.batch_size - self.max_demo_rows < 1:
            raise ValueError(
                f"max_demo_ratio = {self.max_demo_ratio} of batch_size = {self.batch_size} leaves no replay row: "
                "lower max_demo_ratio or raise batch_size"
            )

    @property
    def max_demo_rows(self) -> int:
        """Number of demonstration rows at the start of training."""
        return int(self.max_demo_ratio * self.batch_size)

    @property
    def uses_intersections(self) -> bool:
        """Whether some relabelled goals are those of an intersection, for which the replay notes what lies near."""
        return "joint_intersection" in dict(self.sources)

    @property
    def sources(self) -> tuple[tuple[Any, Any], ...]:
        """The sources of relabelled goals and their shares; none if nothing is relabelled."""
        if self.relabelled_per_original == 0:
            return ()
        if self.hindrl_sampling_strategy == "joint_union":
            return ("task_conditioned", self.union_sampling_ratio), ("future", 1.0 - self.union_sampling_ratio)
        return ((self.hindrl_sampling_strategy, 1.0),)
