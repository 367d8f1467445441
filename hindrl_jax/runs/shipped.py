"""Trained policies that come with the package: the directories of runs, which `load_run` takes as "policy:NAME"."""

from __future__ import annotations

import os
from pathlib import Path

import hindrl_jax
from hindrl_jax.base.errors import UserError
from hindrl_jax.tasks.registry import did_you_mean

PREFIX = "policy:"


def shipped() -> dict[str, Path]:
    """The directories of the runs that come with the package, by their names."""
    folder = Path(hindrl_jax.__file__).parent / "policies"
    return {path.name: path for path in sorted(folder.iterdir()) if path.is_dir()}


def run_directory(given: str | os.PathLike[str]) -> Path:
    """The directory of a run: what is given, or for a text policy:NAME that of a policy that comes with the package.

    Args:
      given: a path. A directory whose own name begins so is given as a `Path`, or as ./policy:NAME.

    Raises:
      UserError: if there is no such policy.
    """
    if not (isinstance(given, str) and given.startswith(PREFIX)):
        return Path(given)
    name, known = given.removeprefix(PREFIX), shipped()
    if name not in known:
        raise UserError(f"no policy {name!r} comes with hindrl_jax{did_you_mean(name, known)}: choose one of {', '.join(known)}")
    return known[name]
