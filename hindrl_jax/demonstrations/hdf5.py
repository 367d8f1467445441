"""Demonstrations on disk: HDF5 files in the layout of robomimic, written atomically and checked in full when read.

    data                      group; attributes env_args, env, total, format_version, expert
      demo_0                  group; attribute num_samples = L, the number of transitions
        obs/observation       (L, D) o_t
        obs/achieved_goal     (L, G) Phi(o_t)
        obs/desired_goal      (L, G) the goal that the episode was acted under
        next_obs/...          the same three for o_{t+1}, so that row t of all datasets is one transition (o_t, a_t, r_t, o_{t+1})
        actions               (L, A) in the policy's range [-1, 1], which is also what robomimic expects
        rewards               (L,)
        dones                 (L,) 1 at the last step of a demonstration that solved its task, else 0
        states                (L, S) simulator state before each action, for rendering
        final_state           (S,) simulator state after the last action (robomimic has no place for it)
      demo_1 ...

`env_args` is the JSON text of {"env_name", "type", "env_kwargs"}. `type` is robomimic's number for the family of an environment: 1 robosuite,
2 gym, 3 iGibson. It is 2 here, since ours are built from a name and keyword arguments, as gym environments are.

Numbers may have any type; `load_demonstrations` gives float32. A file that `hindrl demos convert` has made from another tool's may differ:

  * Datasets and attributes of the source that HinDRL has no use for stand where they stood there ("extras" below), so that a robomimic file's own
    modalities and filter keys (`mask`) can still be used in robomimic.
  * `env_args` is then the source's, and the attribute `hindrl_env` says which task it is to us: {"env_name", "env_kwargs"}.
  * `dones` is the source's, and the attribute `terminated` of each demonstration says whether it solved the task.
  * The attribute `converted_from`, JSON, says what the source was. Such a file may lack `final_state`; then there are no states for us, and the
    dataset `states`, if any, belongs to a simulator that is not ours.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from hindrl_jax.base.environments import Environment
from hindrl_jax.base.errors import UserError
from hindrl_jax.base.files import check_can_write, write_atomically
from hindrl_jax.base.types import Episodes
from hindrl_jax.demonstrations._hdf5_files import hdf5_bytes, opened
from hindrl_jax.demonstrations._layout import write_layout
from hindrl_jax.demonstrations._reading import read_all, read_demonstrations, read_header, with_extras
from hindrl_jax.demonstrations.episodes import as_recording, as_table, check_against_env, check_lengths, check_number, with_goals_chosen
from hindrl_jax.demonstrations.recording import DemonstrationSummary, Recording, summarise_recording


def save_demonstrations(
    path: str | os.PathLike[str],
    demonstrations: Episodes,
    *,
    env: Environment,
    env_args: dict[str, Any],
    expert: dict[str, Any] | None = None,
    overwrite: bool = False,
) -> None:
    """Writes demonstrations to `path`, which afterwards holds either all of them or what it held before.

    The data passes the checks of `load_demonstrations`, goes to a temporary file in the same folder, and takes its name only when it is on disk.

    Args:
      path: the file to write; missing folders are made.
      demonstrations: a table of N episodes with their states, as NumPy or JAX arrays.
      env: the environment that the demonstrations were recorded in.
      env_args: arguments that build this environment again, usually `dataclasses.asdict(env)`; must be convertible to JSON.
      expert: name and settings of the expert, for the record; must be convertible to JSON.
      overwrite: whether an existing file may be replaced.

    Raises:
      UserError: the file exists and `overwrite` is off, it cannot be written, or its content would be refused by `load_demonstrations`.
      ValueError: the episodes have no states, or not those of the environment.
    """
    recording = as_recording(demonstrations, env, env_args=env_args, expert=expert)
    write_recording(path, recording, env=env, overwrite=overwrite)


def write_recording(path: str | os.PathLike[str], recording: Recording, *, env: Environment | None = None, overwrite: bool = False) -> None:
    """Writes a recording to `path`, as `save_demonstrations` does.

    Args:
      path: the file to write.
      recording: what to write.
      env: the environment that it must fit, if there is one.
      overwrite: whether an existing file may be replaced.

    Raises:
      UserError: the file exists and `overwrite` is off, it cannot be written, or its content would be refused when it is read.
    """
    path = Path(path)
    check_can_write(path, overwrite=overwrite)
    content = hdf5_bytes(lambda file: write_layout(file, recording))
    with opened(path, content) as file:
        written = read_all(path, file)
    if env is not None:
        check_against_env(path, written, env)
    with content.getbuffer() as whole:  # given back also where writing fails: else the buffer's end complains of it
        write_atomically(path, whole, overwrite=overwrite)


def check_recording(recording: Recording, where: str | os.PathLike[str]) -> None:
    """Raises a UserError, which begins with `where`, for a recording that would be refused as a file."""
    with opened(Path(where), hdf5_bytes(lambda file: write_layout(file, recording))) as file:
        read_all(Path(where), file)


def load_demonstrations(path: str | os.PathLike[str], env: Environment, *, num_demos: int | None = None) -> Episodes:
    """Reads demonstrations as a table padded with zeros to the horizon of `env`, NumPy arrays throughout.

    Demonstrations longer than the horizon are dropped with a warning. They stand in the numeric order of their names.

    Args:
      path: a file written by `save_demonstrations`.
      env: the environment to learn in. It must be the one recorded in the file, with equal arguments; only the horizon may differ, and what
        the environment itself names as `interchangeable`.
      num_demos: how many to take, the first of those that fit into the horizon; None takes all.

    Raises:
      UserError: the file is missing, damaged, inconsistent or of another environment, or holds too few demonstrations.
    """
    path = Path(path)
    check_number(path, num_demos)
    with opened(path) as file:
        header, lengths = read_header(path, file)
        fitting = [(name, length) for name, length in lengths.items() if length <= env.horizon]
        recording = read_demonstrations(path, file, header, dict(fitting[:num_demos]))
    check_lengths(path, list(lengths.values()), env.horizon, num_demos)
    recording = with_goals_chosen(recording, env)
    check_against_env(path, recording, env)
    return as_table(recording.demonstrations, env.horizon)


def read_recording(path: str | os.PathLike[str]) -> Recording:
    """Reads and checks a whole file with everything in it, without the environment that it was recorded in.

    Raises:
      UserError: the file is missing, damaged or inconsistent, or was not written by hindrl_jax.
    """
    path = Path(path)
    with opened(path) as file:
        return with_extras(path, file, read_all(path, file))


def read_states(path: str | os.PathLike[str], *, num_demos: int | None = None) -> list[np.ndarray]:
    """The simulator states along each demonstration, (length + 1, S) each, in the type that they were written in; for rendering.

    Raises:
      UserError: the file is missing, damaged or inconsistent, or has no states of ours.
    """
    path = Path(path)
    with opened(path) as file:
        header, lengths = read_header(path, file)
        demos = read_demonstrations(path, file, header, dict(list(lengths.items())[:num_demos])).demonstrations
    if any(demo.states is None for demo in demos):
        raise UserError(f"{path}: was converted from a file without our environment's states; render needs a file recorded by hindrl demos record")
    return [demo.states for demo in demos]


def describe_demonstrations(path: str | os.PathLike[str]) -> DemonstrationSummary:
    """Reads and checks a whole file, without the environment that it was recorded in.

    Raises:
      UserError: the file is missing, damaged or inconsistent, or was not written by hindrl_jax.
    """
    path = Path(path)
    with opened(path) as file:
        recording = read_all(path, file)
    return summarise_recording(path, recording)
