"""Presets of hardly any steps, for the examples of the documentation and for the notebooks: those of `commands.TINY`, whose programs they share."""

import dataclasses
from typing import Any

from commands import BATCH_SIZE, SIZES, WIDTH

from hindrl_jax.base.environments import Environment
from hindrl_jax.tasks import presets

_full = presets.preset


def preset(algo: str = "hindrl", name: str = "default", *, env: str | Environment = "FixedGridPickAndPlace") -> Any:
    """As `hindrl_jax.preset`, smaller."""
    config = _full(algo, name, env=env)
    return dataclasses.replace(
        config,
        **SIZES,
        batch=dataclasses.replace(config.batch, batch_size=BATCH_SIZE),
        agent=dataclasses.replace(config.agent, net_arch=(WIDTH,)),
    )


def install() -> None:
    """In place of the real ones, for the rest of this process."""
    presets.preset = preset
