"""Fields that only enter arithmetic: configs that differ in nothing else share one compiled program."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, Literal

from hindrl_jax.base.checks import unchecked
from hindrl_jax.config.train import TrainConfig

SWEEPABLE: dict[str, Literal["batch", "goal", "agent"]] = {
    "union_sampling_ratio": "batch",
    "gamma": "batch",
    "epsilon_deviations": "goal",
    "learning_rate": "agent",
    "target_update_rate": "agent",
    "actor_average_span": "agent",
    "initial_alpha": "agent",
    "target_entropy": "agent",
    "final_target_entropy": "agent",
    "bc_weight": "agent",
}
"""The fields that only enter arithmetic, and their sections: configs that differ in nothing else share one compiled program."""


def sweepable_value(config: TrainConfig, name: str) -> float | None:
    """The value of a field of `SWEEPABLE`."""
    return getattr(getattr(config, SWEEPABLE[name]), name)


def with_values(config: TrainConfig, values: Mapping[str, Any]) -> TrainConfig:
    """The config with some fields of `SWEEPABLE` replaced, and checked.

    Raises:
      ValueError: if a value is refused.
    """
    for name, value in values.items():
        section = getattr(config, SWEEPABLE[name])
        config = dataclasses.replace(config, **{SWEEPABLE[name]: dataclasses.replace(section, **{name: value})})
    return config


def with_traced_values(config: TrainConfig, values: Mapping[str, Any]) -> TrainConfig:
    """As `with_values`, for arrays or tracers in place of numbers: not checked, and neither hashable nor static. For use inside a program."""
    for name, value in values.items():
        section = SWEEPABLE[name]
        config = unchecked(config, **{section: unchecked(getattr(config, section), **{name: value})})
    return config
