"""`hindrl policies`: the trained policies that come with the package, which `hindrl eval` and `hindrl render` take as policy:NAME."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

from rich import box
from rich.table import Table

import hindrl_jax
from hindrl_jax.base.errors import UserError
from hindrl_jax.cli.common import console, parse
from hindrl_jax.runs.spec import SUMMARY, read_spec
from hindrl_jax.tasks.registry import did_you_mean

PREFIX = "policy:"


def shipped() -> dict[str, Path]:
    """The directories of the runs that come with the package, by their names."""
    folder = Path(hindrl_jax.__file__).parent / "policies"
    return {path.name: path for path in sorted(folder.iterdir()) if path.is_dir()}


def run_directory(given: str) -> Path:
    """The directory of a run as it was typed, or that of policy:NAME.

    Raises:
      UserError: if there is no such policy.
    """
    if not given.startswith(PREFIX):
        return Path(given)
    name, known = given.removeprefix(PREFIX), shipped()
    if name not in known:
        raise UserError(f"no policy {name!r} comes with hindrl_jax{did_you_mean(name, known)}: choose one of {', '.join(known)}")
    return known[name]


def show(arguments: list[str]) -> None:
    """List the trained policies that come with the package."""
    parse(dataclasses.make_dataclass("Policies", []), arguments, "hindrl policies", show.__doc__)
    table = Table("policy", "algo", "demos", "trained for", "success", "length", box=box.SIMPLE_HEAD)
    for name, path in shipped().items():
        spec, summary = read_spec(path), json.loads((path / SUMMARY).read_text())
        (seed,) = summary["seeds"]
        cells = (f"{seed['returned_env_steps']:,} steps", f"{seed['returned_success']:.0%}", f"{seed['returned_length']:.0f}")
        table.add_row(name, spec.config.algo, spec.demos, *cells)
    console.print(table)
    console.print(f"`hindrl render {PREFIX}NAME` films one, `hindrl eval {PREFIX}NAME` plays fresh episodes with it")
