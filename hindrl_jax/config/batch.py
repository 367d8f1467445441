"""How a training batch is put together."""

from __future__ import annotations

import dataclasses
from typing import Any, Literal

from hindrl_jax.base.checks import check, check_types

Source = Literal["final", "future", "episode", "random", "task_conditioned", "joint_intersection"]
"""Where a relabelled goal may come from, explained in `hindrl_jax.core.hindsight`."""
Strategy = Literal["final", "future", "rollout_conditioned", "episode", "random", "task_conditioned", "joint_union", "joint_intersection", "mixture"]
"""Hindsight strategies: one of the sources, or a mixture of them."""


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
    strategy_mixture: tuple[tuple[Source, float], ...] = ()
    """For mixture: the sources of goals and their weights, as in future 0.5 random 0.2 task_conditioned 0.3."""
    n_step: int = 5
    """Steps of reward before the value estimate takes over."""
    gamma: float = 0.98
    """Discount factor."""
    bound_by_obtained_return: bool = False
    """No target lies below the return that the row's own episode went on to obtain, which is a lower bound of the optimal value where neither
    actions nor rewards are random (He et al., optimality tightening, 2017; Oh et al., self-imitation learning, 2018)."""

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
            strategy_mixture=(
                all(weight > 0.0 for _, weight in self.strategy_mixture) and len(dict(self.strategy_mixture)) == len(self.strategy_mixture),
                "sources that differ, with weights greater than 0",
            ),
            n_step=(self.n_step >= 1, "at least 1"),
            gamma=(0.0 < self.gamma <= 1.0, "in (0, 1]"),
        )
        if (self.hindrl_sampling_strategy == "mixture") != bool(self.strategy_mixture):
            raise ValueError(
                f"strategy_mixture = {self.strategy_mixture!r} and hindrl_sampling_strategy = {self.hindrl_sampling_strategy!r} do not belong "
                "together: give both mixture and its parts, or neither"
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
        """The sources of relabelled goals and their weights, which need not sum to 1; none if nothing is relabelled."""
        if self.relabelled_per_original == 0:
            return ()
        if self.hindrl_sampling_strategy == "joint_union":
            return ("task_conditioned", self.union_sampling_ratio), ("future", 1.0 - self.union_sampling_ratio)
        return self.strategy_mixture or ((self.hindrl_sampling_strategy, 1.0),)
