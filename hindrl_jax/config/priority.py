"""Prioritised replay."""

from __future__ import annotations

import dataclasses

from hindrl_jax.base.checks import check, check_types


@dataclasses.dataclass(frozen=True)
class PriorityConfig:
    """How transitions are drawn by their temporal-difference errors, see `hindrl_jax.training.prioritised`."""

    priority_exponent: float = 0.0
    """0 draws uniformly, an episode, then one of its transitions. More draws transitions in proportion to their temporal-difference error to this
    power (Schaul et al., prioritised experience replay, 2016), from demonstrations and replay together: max_demo_ratio and reach_zero then have no
    say."""
    importance_exponent: float = 0.4
    """With priorities: 1 corrects the critics' loss wholly for what is drawn too often, 0 not at all. Schaul's first value, kept: his rise to 1
    makes the end of training unbiased, and sparse rewards are found long before."""
    demo_priority_bonus: float = 0.0
    """With priorities: what is added to the error of a demonstration's transitions, so that they keep being drawn (DDPGfD, Vecerik et al., 2017)."""

    def __post_init__(self) -> None:
        check_types(self)
        check(
            self,
            priority_exponent=(0.0 <= self.priority_exponent <= 1.0, "between 0 (uniform) and 1"),
            importance_exponent=(0.0 <= self.importance_exponent <= 1.0, "between 0 and 1"),
            demo_priority_bonus=(self.demo_priority_bonus >= 0.0, "0 or more"),
        )
        if self.demo_priority_bonus > 0.0 and not self.is_used:
            raise ValueError(f"demo_priority_bonus = {self.demo_priority_bonus} is of no use while priority_exponent = 0: raise that, too")

    @property
    def is_used(self) -> bool:
        """Whether transitions are drawn by their priorities rather than uniformly."""
        return self.priority_exponent > 0.0
