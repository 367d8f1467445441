"""`hindrl envs`."""

from __future__ import annotations

import dataclasses

from rich import box
from rich.table import Table

from hindrl_jax.base.environments import Environment
from hindrl_jax.cli.common import console, parse
from hindrl_jax.tasks.from_gymnasium import GymnasiumEnv
from hindrl_jax.tasks.registry import TASKS


def show(arguments: list[str]) -> None:
    """List the environments."""
    parse(dataclasses.make_dataclass("Envs", []), arguments, "hindrl envs", "List the environments with their dimensions.")
    table = Table("environment", "observation", "goal", "action", "horizon", box=box.SIMPLE_HEAD)
    for entry in TASKS.values():
        env: Environment = entry.environment()
        table.add_row(env.name, *map(str, (env.observation_dim, env.goal_dim, env.action_dim, env.horizon)))
    console.print(table)
    for entry in TASKS.values():
        console.print(f"{entry.environment.name}: {entry.summary}")
        for field in dataclasses.fields(entry.environment):
            console.print(f"  --{field.name.replace('_', '-')} (default {field.default})")
    console.print(
        "gymnasium:ID: an environment of Gymnasium, with goals or with flat observations and a sparse reward, as in gymnasium:FetchReach-v4 "
        "(from the extra gymnasium-robotics); gymnasium:MODULE:ID is registered by MODULE"
    )
    for field in dataclasses.fields(GymnasiumEnv):
        console.print(f"  --{field.name.replace('_', '-')} (default {field.default})")
