"""`hindrl policies`: the trained policies that come with the package, which `hindrl eval` and `hindrl render` take as policy:NAME."""

from __future__ import annotations

import dataclasses
import json

from rich import box
from rich.table import Table

from hindrl_jax.cli.common import console, parse
from hindrl_jax.runs.shipped import PREFIX, shipped
from hindrl_jax.runs.spec import SUMMARY, read_spec


def show(arguments: list[str]) -> None:
    """List the trained policies that come with the package."""
    parse(dataclasses.make_dataclass("Policies", []), arguments, "hindrl policies", show.__doc__)
    table = Table("policy", "algo", "demos", "best after", "success", "length", box=box.SIMPLE_HEAD)
    for name, path in shipped().items():
        spec, summary = read_spec(path), json.loads((path / SUMMARY).read_text())
        (seed,) = summary["seeds"]
        taken = f"{seed['returned_env_steps']:,} steps" if spec.config.learns_from_rollouts else f"{seed['returned_updates']:,} updates"
        cells = (taken, f"{seed['returned_success']:.0%}", f"{seed['returned_length']:.0f}")
        table.add_row(name, spec.config.algo, spec.demos, *cells)
    console.print(table)
    console.print(f"`hindrl render {PREFIX}NAME` films one, `hindrl eval {PREFIX}NAME` plays fresh episodes with it;")
    console.print(f'in Python, hindrl_jax.load_run("{PREFIX}NAME") reads it')
