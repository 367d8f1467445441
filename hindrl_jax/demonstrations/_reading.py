"""Reading an open file of ours, with every check that needs no environment."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from hindrl_jax.base.errors import UserError
from hindrl_jax.demonstrations._hdf5_files import damage_reported, datasets_beside, datasets_within
from hindrl_jax.demonstrations._layout import CORE_DATASETS, FORMAT_VERSION, OWN_ATTRIBUTES, SOLVED_ATTRIBUTE, demonstration_names, joined
from hindrl_jax.demonstrations.recording import OBSERVATION_KEYS, RECORD_AGAIN, Demonstration, Recording

_ACTION_TOLERANCE = 1e-5


def read_header(path: Path, file: h5py.File) -> tuple[Recording, dict[str, int]]:
    """Reads what a file says about its demonstrations.

    Args:
      path: begins the messages.
      file: open.

    Returns:
      The recording without its demonstrations, and their names in numeric order with their numbers of transitions.

    Raises:
      UserError: something is missing, damaged or of another version.
    """
    data = file.get("data")
    if not isinstance(data, h5py.Group):
        raise UserError(f"{path}: has no group 'data', so it holds no demonstrations; name a file of demonstrations")
    if "format_version" not in data.attrs:
        raise UserError(f"{path}: attribute format_version is missing, so hindrl_jax has not written it; try `hindrl demos convert {path} OURS.hdf5`")
    version = _attribute(f"{path}", data, "format_version")
    if int(version) != FORMAT_VERSION:
        raise UserError(f"{path}: has format version {version}, but this version of hindrl_jax reads {FORMAT_VERSION}; {RECORD_AGAIN}")
    try:
        env_args = json.loads(data.attrs["hindrl_env"] if "hindrl_env" in data.attrs else _attribute(f"{path}", data, "env_args"))
        env_name, env_kwargs = str(env_args["env_name"]), dict(env_args["env_kwargs"])
        expert = json.loads(data.attrs.get("expert", "null"))
        converted_from = json.loads(data.attrs.get("converted_from", "null"))
    except (TypeError, KeyError, json.JSONDecodeError) as error:
        raise UserError(f"{path}: the attribute env_args or expert is not the JSON text that was expected; {RECORD_AGAIN}") from error
    names = demonstration_names(data)
    if not names:
        raise UserError(f"{path}: holds no demonstrations; {RECORD_AGAIN}")
    lengths = {}
    for name in names:
        where = f"{path}: {name}"
        if not isinstance(data[name], h5py.Group):
            raise UserError(f"{where}: is not a group; {RECORD_AGAIN}")
        number = np.asarray(_attribute(where, data[name], "num_samples"))
        if number.size != 1 or number.dtype.kind not in "iuf" or number.reshape(()) % 1 != 0:
            raise UserError(f"{where}: attribute num_samples is no whole number; {RECORD_AGAIN}")
        lengths[name] = int(number.reshape(()))
        if lengths[name] < 1:
            raise UserError(f"{where}: has {lengths[name]} transitions, at least 1 is needed; delete this demonstration or {RECORD_AGAIN}")
    return Recording(env_name=env_name, env_kwargs=env_kwargs, expert=expert, demonstrations=(), converted_from=converted_from), lengths


def read_demonstrations(path: Path, file: h5py.File, header: Recording, lengths: Mapping[str, int]) -> Recording:
    """Reads demonstrations, without their extras.

    Args:
      path: begins the messages.
      file: open.
      header: from `read_header`.
      lengths: name -> number of transitions of each demonstration to read.

    Raises:
      UserError: one is damaged or inconsistent, or differs from the first in its dimensions.
    """
    converted = header.converted_from is not None
    demos = [_read_demonstration(f"{path}: {name}", name, file["data"][name], length, converted=converted) for name, length in lengths.items()]
    for demo in demos:
        for what in ("observations", "actions", "achieved_goals", "states"):
            here, first = (None if getattr(d, what) is None else getattr(d, what).shape[1:] for d in (demo, demos[0]))
            if here != first:
                what = what.replace("_", " ")
                raise UserError(f"{path}: {demo.name}: {what} have shape {here} per step but {first} in {demos[0].name}; {RECORD_AGAIN}")
    return dataclasses.replace(header, demonstrations=tuple(demos))


def read_all(path: Path, file: h5py.File) -> Recording:
    """Reads all demonstrations, without their extras; `path` begins the messages.

    Raises:
      UserError: as `read_header` and `read_demonstrations`.
    """
    header, lengths = read_header(path, file)
    return read_demonstrations(path, file, header, lengths)


def with_extras(path: Path, file: h5py.File, recording: Recording) -> Recording:
    """Adds the datasets and attributes of a file that HinDRL has no use for to the recording that was read from it.

    Raises:
      UserError: they are damaged; the message begins with `path`.
    """
    about = dict(file["data"].attrs)
    kept = about.keys() - set(OWN_ATTRIBUTES) if recording.converted_from is None else recording.converted_from.get("attributes", ())
    return dataclasses.replace(
        recording,
        demonstrations=tuple(_with_extras(f"{path}: {demo.name}", file["data"][demo.name], demo) for demo in recording.demonstrations),
        extras=datasets_beside(file, "data"),
        file_attributes=dict(file.attrs),
        attributes={name: about[name] for name in kept if name in about},
    )


def _read_demonstration(where: str, name: str, group: h5py.Group, length: int, *, converted: bool) -> Demonstration:
    along = {}
    for key in OBSERVATION_KEYS:
        before = _array(where, group, f"obs/{key}", (length, None))
        after = _array(where, group, f"next_obs/{key}", (length, before.shape[1]))
        along[key] = joined(where, key, before, after, advice=RECORD_AGAIN)
    if (along["desired_goal"] != along["desired_goal"][0]).any():
        raise UserError(f"{where}: desired_goal changes during the episode, which is not supported; record with one goal per demonstration")
    if along["achieved_goal"].shape != along["desired_goal"].shape:
        raise UserError(f"{where}: achieved_goal and desired_goal differ in shape; {RECORD_AGAIN}")

    actions = _array(where, group, "actions", (length, None))
    largest = np.abs(actions).max(initial=0.0)
    if largest > 1.0 + _ACTION_TOLERANCE:
        raise UserError(f"{where}: actions reach {largest:g} in size but must lie in [-1, 1]; rescale them from the environment's units")
    if SOLVED_ATTRIBUTE in group.attrs:
        terminated = bool(_attribute(where, group, SOLVED_ATTRIBUTE))
    else:
        dones = _array(where, group, "dones", (length,))
        if dones[:-1].any() or dones[-1] not in (0, 1):
            raise UserError(f"{where}: dones must be 0, or 1 at the last step only; cut the demonstration there or {RECORD_AGAIN}")
        terminated = bool(dones[-1])
    if converted and "final_state" not in group:
        states = None
    else:
        before = _array(where, group, "states", (length, None))
        states = np.concatenate([before, _array(where, group, "final_state", (before.shape[1],))[None]])
    return Demonstration(
        name=name,
        observations=along["observation"],
        achieved_goals=along["achieved_goal"],
        desired_goal=along["desired_goal"][0],
        actions=actions,
        rewards=_array(where, group, "rewards", (length,)),
        terminated=terminated,
        states=states,
    )


def _with_extras(where: str, group: h5py.Group, demo: Demonstration) -> Demonstration:
    known = {*CORE_DATASETS, *(("states", "final_state") if demo.states is not None else ())}
    if SOLVED_ATTRIBUTE in group.attrs:
        known.remove("dones")
    with damage_reported(where, "cannot be read"):
        extras = {name: array for name, array in datasets_within(group).items() if name not in known}
        attributes = {name: value for name, value in group.attrs.items() if name not in ("num_samples", SOLVED_ATTRIBUTE)}
    return dataclasses.replace(demo, extras=extras, attributes=attributes)


def _array(where: str, group: h5py.Group, name: str, shape: tuple[int | None, ...]) -> np.ndarray:
    """Reads a dataset of finite numbers, in the type that it has in the file; None in `shape` stands for any size."""
    with damage_reported(where, f"{name} cannot be read"):
        dataset = group.get(name)
        if not isinstance(dataset, h5py.Dataset):
            raise UserError(f"{where}: dataset {name} is missing; {RECORD_AGAIN}")
        # Before any reading, since a damaged shape may be too large for the memory.
        if len(dataset.shape) != len(shape) or any(b is not None and a != b for a, b in zip(dataset.shape, shape, strict=True)):
            wanted = "(" + ", ".join("any" if n is None else str(n) for n in shape) + ")"
            raise UserError(f"{where}: {name} has shape {dataset.shape}, expected {wanted}; {RECORD_AGAIN}")
        if dataset.dtype.kind not in "biuf":
            raise UserError(f"{where}: {name} holds {dataset.dtype}, not numbers; {RECORD_AGAIN}")
        array = np.asarray(dataset[()])
    finite = np.isfinite(array)
    if not finite.all():
        row = np.argwhere(~finite)[0][0]
        raise UserError(f"{where}: {name} is not finite in row {row}; delete this demonstration or {RECORD_AGAIN}")
    return array


def _attribute(where: str, group: h5py.Group, name: str) -> Any:
    with damage_reported(where, f"attribute {name} cannot be read"):
        if name not in group.attrs:
            raise UserError(f"{where}: attribute {name} is missing, so this is no file of hindrl_jax demonstrations; {RECORD_AGAIN}")
        return group.attrs[name]
