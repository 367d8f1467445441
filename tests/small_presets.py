"""Presets of hardly any steps, for the examples of the documentation and for the notebooks: those of `commands.TINY`, whose programs they share."""

import dataclasses
from typing import Any

from hindrl_jax.base.environments import Environment
from hindrl_jax.tasks import presets

_full = presets.preset


def preset(algo: str = "hindrl", name: str = "default", *, env: str | Environment = "FixedGridPickAndPlace") -> Any:
    """As `hindrl_jax.preset`, smaller."""
    config = _full(algo, name, env=env)
    return dataclasses.replace(
        config,
        steps=260,
        num_envs=2,
        updates_per_iteration=1,
        learning_starts=200,
        buffer_size=2000,
        eval_every=40,
        eval_episodes=3,
        batch=dataclasses.replace(config.batch, batch_size=16),
        agent=dataclasses.replace(config.agent, net_arch=(8,)),
    )


def install() -> None:
    """In place of the real ones, for the rest of this process."""
    presets.preset = preset
