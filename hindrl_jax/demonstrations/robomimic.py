"""HDF5 files of robomimic and robosuite.

robomimic's files have the layout of ours (see `hindrl_jax.demonstrations.hdf5`) with modalities of their own in place of observation and goals:
`obs/KEY`, and `next_obs/KEY` unless they were left out. `mask/KEY` lists the demonstrations of a filter key. robosuite's own files (`demo.hdf5` of
its collect_human_demonstrations) have states and actions only; robomimic's dataset_states_to_obs makes observations of the states.

Our own files are robomimic files as they are. `restored` takes from a converted one what the conversion added.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from hindrl_jax.base.errors import UserError
from hindrl_jax.demonstrations._hdf5_files import datasets_beside, datasets_within, hdf5_bytes, opened
from hindrl_jax.demonstrations._layout import demonstration_names, joined, layout
from hindrl_jax.demonstrations.foreign import SOURCE, ForeignDemonstration, ForeignRecording
from hindrl_jax.demonstrations.recording import Demonstration, Recording

_MAX_MODALITY_DIMS = 2  # images have more: they are kept for robomimic, but are no modality of ours


def is_ours(path: Path) -> bool:
    """Whether hindrl_jax has written an HDF5 file."""
    with opened(path) as file:
        return isinstance(file.get("data"), h5py.Group) and "format_version" in file["data"].attrs


def read(path: Path) -> ForeignRecording:
    """Reads a file of robomimic or robosuite.

    Raises:
      UserError: it is missing or damaged, or is no such file.
    """
    with opened(path) as file:
        data = file.get("data")
        if not isinstance(data, h5py.Group):
            raise UserError(f"{path}: has no group 'data', so it is no file of robomimic or robosuite; name a file of demonstrations")
        names = demonstration_names(data)
        if not names:
            raise UserError(f"{path}: holds no demonstrations; name another file")
        attributes = {name: value for name, value in data.attrs.items() if name != "total"}
        texts: set[str] = set()
        extras = datasets_beside(file, "data", texts)
        env_args = _env_args(path, attributes)
        return ForeignRecording(
            source=f"{path}",
            format="robomimic",
            env_name=str(env_args["env_name"]),
            env_kwargs=env_args.get("env_kwargs") or {},
            demonstrations=tuple(_read_demonstration(f"{path}: {name}", name, data[name], texts) for name in names),
            filters={name.removeprefix("mask/"): _names(array) for name, array in extras.items() if name.startswith("mask/")},
            extras=extras,
            attributes=attributes,
            file_attributes=dict(file.attrs),
            about={"texts": sorted(texts)} if texts else {},
        )


def _names(mask: np.ndarray) -> list[str]:
    """The names of demonstrations that a filter key lists."""
    return [name.decode(errors="replace") if isinstance(name, bytes) else str(name) for name in mask.reshape(-1).tolist()]


def _env_args(path: Path, attributes: dict[str, Any]) -> dict[str, Any]:
    """robomimic says what environment it was in `env_args`, robosuite in `env` and `env_info`."""
    if "env_args" in attributes:
        try:
            env_args = json.loads(attributes["env_args"])
            if isinstance(env_args.get("env_name"), str):
                return env_args
        except (TypeError, AttributeError, json.JSONDecodeError):
            pass
        raise UserError(f"{path}: the attribute env_args is not the JSON text that robomimic writes; write the file again")
    name = attributes.get("env", "unknown")
    return {"env_name": name.decode() if isinstance(name, bytes) else str(name)}


def _read_demonstration(where: str, name: str, group: h5py.Group, texts: set[str]) -> ForeignDemonstration:
    texts_here: set[str] = set()
    datasets = datasets_within(group, texts=texts_here)
    texts.update(f"data/{name}/{path}" for path in texts_here)
    if "actions" not in datasets:
        raise UserError(f"{where}: dataset actions is missing; the file is damaged or no file of demonstrations")
    actions = _numbers(where, "actions", datasets["actions"], dims=2)
    modalities, problems = {}, {}
    for path, rows in datasets.items():
        if path.startswith("obs/") and 1 <= rows.ndim <= _MAX_MODALITY_DIMS and rows.dtype.kind in "biuf":
            key = path.removeprefix("obs/")
            try:
                modalities[key] = _rows(where, key, rows, datasets.get(f"next_obs/{key}"))
            except UserError as error:
                modalities[key], problems[key] = _as_columns(rows), str(error)
    along = {key: _numbers(where, key, datasets[key], dims=1) if key in datasets else None for key in ("rewards", "dones")}
    return ForeignDemonstration(
        name=name,
        modalities=modalities,
        actions=actions,
        **along,
        states=datasets.get("states"),
        extras=datasets,
        problems=problems,
        attributes={name: value for name, value in group.attrs.items() if name != "num_samples"},
    )


def _rows(where: str, key: str, before: np.ndarray, after: np.ndarray | None) -> np.ndarray:
    """obs and next_obs as one array along the demonstration; obs alone, if there is no next_obs."""
    before = _numbers(where, f"obs/{key}", before)
    if after is None or not len(before):
        return _as_columns(before)
    after = _numbers(where, f"next_obs/{key}", after)
    if after.shape != before.shape:
        raise UserError(f"{where}: obs/{key} has shape {before.shape}, but next_obs/{key} {after.shape}; write the file again")
    return joined(where, key, _as_columns(before), _as_columns(after), advice="write the file again, or name others with --observation-keys")


def _as_columns(rows: np.ndarray) -> np.ndarray:
    return rows[:, None] if rows.ndim == 1 else rows


def _numbers(where: str, name: str, array: np.ndarray, *, dims: int | None = None) -> np.ndarray:
    if dims is not None and array.ndim != dims and not (dims == 1 and array.ndim == 2 and array.shape[1] == 1):
        raise UserError(f"{where}: {name} has shape {array.shape}, expected {dims} dimension{'s' if dims > 1 else ''}; write the file again")
    if array.dtype.kind not in "biuf":
        raise UserError(f"{where}: {name} holds {array.dtype}, not numbers; write the file again")
    return array[:, 0] if dims == 1 and array.ndim == 2 else array


def restored(recording: Recording, where: str) -> bytes:
    """The robomimic file that a recording was converted from, with all that it holds now under the names that it had there.

    Demonstrations or steps that the conversion left out stay out.

    Raises:
      UserError: it was not converted from a robomimic file.
    """
    source = recording.converted_from or {}
    if source.get("format") != "robomimic":
        raise UserError(f"{where}: was not converted from a robomimic file, so there is none to give back; convert without --restore")

    texts = set(source.get("texts", ()))

    def as_it_was(prefix: str, datasets: dict[str, np.ndarray]) -> dict[str, Any]:
        """Texts of variable length are such again."""
        text = h5py.string_dtype()
        return {name: rows.astype(object).astype(text) if prefix + name in texts else rows for name, rows in datasets.items()}

    def write(file: h5py.File) -> None:
        data = file.create_group("data")
        data.attrs.update(recording.attributes | {"total": sum(map(len, recording.demonstrations))})
        file.attrs.update(recording.file_attributes)
        file.update(as_it_was("", recording.extras))
        for demo in recording.demonstrations:
            group = data.create_group(demo.name)
            group.update(as_it_was(f"data/{demo.name}/", _source_datasets(demo, source["datasets"])))
            group.attrs.update({"num_samples": len(demo)} | demo.attributes)

    return hdf5_bytes(write).getvalue()


def _source_datasets(demo: Demonstration, names: list[str]) -> dict[str, np.ndarray]:
    there = layout(demo) | demo.extras
    return {name: there.get(SOURCE + name, there.get(name)) for name in names if SOURCE + name in there or name in there}
