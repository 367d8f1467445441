"""The layout of robomimic's files and ours, which `hindrl_jax.demonstrations.hdf5` lists: names, rows, and how a recording is laid out in it."""

from __future__ import annotations

import re
from typing import Any

import h5py
import numpy as np

from hindrl_jax.base.errors import UserError
from hindrl_jax.demonstrations._hdf5_files import json_attribute
from hindrl_jax.demonstrations.recording import OBSERVATION_KEYS, Demonstration, Recording

FORMAT_VERSION = 1
SOLVED_ATTRIBUTE = "terminated"
CORE_DATASETS = (*(f"{group}/{key}" for group in ("obs", "next_obs") for key in OBSERVATION_KEYS), "actions", "rewards", "dones")
"""What every demonstration has."""
OWN_ATTRIBUTES = ("env_args", "env", "total", "format_version", "expert", "hindrl_env", "converted_from")
"""What we write about a recording."""
_GYM_ENV_TYPE = 2


def demonstration_names(data: h5py.Group) -> list[str]:
    """The groups in it, in the order of the numbers in their names: demo_0, demo_1, ..., or whatever else they are called."""

    def natural(name: str) -> list[Any]:
        return [int(part) if part.isdecimal() else part for part in re.split(r"([0-9]+)", name)]

    return sorted((name for name in data if re.fullmatch(r"demo_[0-9]+", name) or data.get(name, getclass=True) is not h5py.Dataset), key=natural)


def joined(where: str, key: str, before: np.ndarray, after: np.ndarray, *, advice: str) -> np.ndarray:
    """obs (L, n) and next_obs (L, n) as one array (L + 1, n) along the demonstration.

    Raises:
      UserError: they do not belong together; the message begins with `where` and ends with the advice.
    """
    floats = [rows.dtype for rows in (before, after) if rows.dtype.kind == "f"]
    coarser = min(floats, key=lambda dtype: dtype.itemsize) if floats else np.result_type(before, after)
    first, second = after[:-1].astype(coarser), before[1:].astype(coarser)  # equal also where one of them was rounded
    both_nan = (first != first) & (second != second)
    misaligned = np.flatnonzero(((first != second) & ~both_nan).any(axis=1))
    if misaligned.size:
        t = misaligned[0]
        raise UserError(f"{where}: row {t} of next_obs/{key} is not row {t + 1} of obs/{key}, the rows are misaligned; {advice}")
    return np.concatenate([before, after[-1:]])


def layout(demonstration: Demonstration) -> dict[str, np.ndarray]:
    """The datasets of a demonstration's group, by name, without its extras."""
    length, observed = len(demonstration), demonstration.observed
    datasets = {f"obs/{key}": rows[:length] for key, rows in observed.items()}
    datasets |= {f"next_obs/{key}": rows[1 : length + 1] for key, rows in observed.items()}
    datasets |= {"actions": demonstration.actions, "rewards": demonstration.rewards}
    datasets["dones"] = (np.arange(length) == length - 1).astype(np.int64) * int(demonstration.terminated)
    if demonstration.states is not None:
        datasets |= {"states": demonstration.states[:length], "final_state": demonstration.states[length]}
    return datasets


def write_layout(file: h5py.File, recording: Recording) -> None:
    """Writes a recording to an empty file."""
    ours = {"env_name": recording.env_name, "env_kwargs": recording.env_kwargs}
    about = {
        "env_args": json_attribute(ours | {"type": _GYM_ENV_TYPE}),
        "env": np.bytes_(recording.env_name.encode()),
        "total": sum(map(len, recording.demonstrations)),
        "format_version": FORMAT_VERSION,
        "expert": json_attribute(recording.expert),
    }
    if recording.converted_from is not None:
        about |= {"hindrl_env": json_attribute(ours), "converted_from": json_attribute(recording.converted_from)}
    data = file.create_group("data")
    data.attrs.update(about | recording.attributes)
    file.attrs.update(recording.file_attributes)
    file.update(recording.extras)
    for demo in recording.demonstrations:
        group = data.create_group(demo.name)
        group.update(layout(demo) | demo.extras)
        solved = {SOLVED_ATTRIBUTE: int(demo.terminated)} if "dones" in demo.extras else {}
        group.attrs.update({"num_samples": len(demo)} | solved | demo.attributes)
