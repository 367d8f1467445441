"""Minari datasets, written `minari:NAME-v0` on the command line, in the folder that MINARI_DATASETS_PATH names (default: ~/.minari/datasets).

A dataset that we write holds Gymnasium's goal observations {observation, achieved_goal, desired_goal}, actions in [-1, 1], and among the infos the
environment's `state` (T + 1, S). Where Gymnasium knows the environment as hindrl/NAME-v0, Minari can recover it. What Minari has no place for, such
as the other modalities of a robomimic file, is left out.

A dataset of somebody else is read so that it can be learned from in the same environment. If that is one of Gymnasium's, the observation is
[observation, achieved_goal], as in `hindrl train --env gymnasium:ID`. The task counts as solved where the infos say success or is_success, if there
are such infos, else where the episode terminated. Converted back it is as it was: seeds, options, infos, metadata and the environment's specification
are kept in our file.

Nothing is downloaded: `minari download NAME-v0` does that.
"""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import json
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from hindrl_jax.base.errors import UserError, one_line
from hindrl_jax.base.files import why_unwritable
from hindrl_jax.demonstrations.foreign import MINARI_OBSERVATIONS, SOURCE, ForeignDemonstration, ForeignRecording
from hindrl_jax.demonstrations.hdf5 import OBSERVATION_KEYS, Demonstration, Recording, plain
from hindrl_jax.tasks.registry import TASKS

PREFIX = "minari:"
GYMNASIUM = "gymnasium:"  # begins the names of environments that are not ours
_INFOS, _TERMINATIONS, _TRUNCATIONS = "minari/infos/", "minari/terminations", "minari/truncations"
_SUCCESS = ("is_success", "success")  # what environments call it in their infos
_COMPUTED = ("id", "total_steps")  # what Minari itself writes about each episode
_OURS = "hindrl"  # the key in Minari's metadata of what only we know


def _minari() -> ModuleType:
    try:
        return importlib.import_module("minari")
    except ImportError as error:
        raise UserError(f"Minari is not usable ({one_line(error)}): install it with pip install 'hindrl-jax[minari]'") from error


def _folder(name: str) -> Path:
    """Where Minari keeps the dataset of that name."""
    if not re.fullmatch(r"([-_\w]+/)*[-_\w]+-v\d+", name):
        raise UserError(f"{PREFIX}{name}: is no name of a Minari dataset; write minari:NAME-v0, or minari:GROUP/NAME-v0")
    root = os.environ.get("MINARI_DATASETS_PATH")
    return (Path(root) if root else Path.home() / ".minari" / "datasets") / name


# ------------------------------------------------------------------------------------------------------------------------------- reading


def read(name: str) -> ForeignRecording:
    """Reads a dataset that is on this machine.

    Raises:
      UserError: it is not, or is damaged, or has observations or actions that are not numbers.
    """
    source, folder, minari = f"{PREFIX}{name}", _folder(name), _minari()
    if not (folder / "data").is_dir():
        raise UserError(f"{source}: is not in {folder.parent}; check the name and MINARI_DATASETS_PATH, or fetch it with: minari download {name}")
    try:
        dataset = minari.MinariDataset(folder / "data")
        storage = dataset.storage
        episodes = list(dataset.iterate_episodes())
        episode_metadata = list(storage.get_episode_metadata(dataset.episode_indices))
        raw = storage.read_raw_metadata(storage.data_path)
    except (OSError, ValueError, KeyError, AssertionError, RuntimeError, ImportError, NotImplementedError) as error:
        raise UserError(f"{source}: cannot be read ({one_line(error)}); fetch it again") from error
    if not episodes:
        raise UserError(f"{source}: holds no episodes; name another dataset")
    low, high = _bounds(source, dataset.action_space)
    ours = json.loads(raw.get(_OURS, "null"))
    env_name, env_kwargs = _environment(dataset.env_spec, ours)
    return ForeignRecording(
        source=source,
        format="minari",
        env_name=env_name,
        env_kwargs=env_kwargs,
        expert=ours and ours["expert"],
        demonstrations=tuple(
            _demonstration(source, n, episode, metadata, ours is not None)
            for n, (episode, metadata) in enumerate(zip(episodes, episode_metadata, strict=True))
        ),
        observation_keys=("observation", "achieved_goal") if ours is None and env_name.startswith(GYMNASIUM) else ("observation",),
        action_low=low,
        action_high=high,
        ours=ours is not None,
        about={} if ours is not None else {"metadata": json.dumps(raw)},
    )


def _environment(spec: Any, ours: dict[str, Any] | None) -> tuple[str, dict[str, Any]]:
    """Our name and arguments of the environment that a dataset was recorded in."""
    if ours is not None:
        return ours["env_name"], ours["env_kwargs"]
    if spec is None:
        return "unknown", {}
    arguments = {name: value for name, value in plain(spec.kwargs).items() if name != "render_mode"}
    name = spec.id.removeprefix("hindrl/").rpartition("-v")[0]
    if spec.id.startswith("hindrl/") and name in TASKS:
        arguments.pop("name", None)
        return name, arguments | ({} if spec.max_episode_steps is None else {"horizon": spec.max_episode_steps})
    return f"{GYMNASIUM}{spec.id}", {"make_kwargs": [f"{key}={json.dumps(value)}" for key, value in arguments.items()]}


def _bounds(source: str, space: Any) -> tuple[np.ndarray, np.ndarray]:
    if not (hasattr(space, "low") and len(space.shape) == 1):
        raise UserError(f"{source}: its actions are {space}; only vectors of real numbers are supported")
    return space.low, space.high


def _demonstration(source: str, number: int, episode: Any, metadata: dict[str, Any], ours: bool) -> ForeignDemonstration:
    where = f"{source}: episode {number}"
    leaves = _leaves(episode.observations, "observation")
    length = len(episode.rewards)
    modalities = {}
    for key, rows in leaves.items():
        if not isinstance(rows, np.ndarray) or rows.dtype.kind not in "biuf":
            raise UserError(f"{where}: observations {key} are not numbers, which is not supported")
        if rows.ndim <= 2:
            modalities[key] = rows[:, None] if rows.ndim == 1 else rows
    for what, rows in {**modalities, "actions": episode.actions, "rewards": episode.rewards}.items():
        if not np.isfinite(rows).all():
            raise UserError(f"{where}: {what} is not finite in row {np.argwhere(~np.isfinite(rows))[0][0]}; delete this episode")
    infos = _leaves(episode.infos or {}, "")
    states = infos.get("state") if ours else None
    extras: dict[str, np.ndarray] = {}
    if not ours:
        extras = {"actions": episode.actions, "rewards": episode.rewards, _TERMINATIONS: episode.terminations}
        extras |= {MINARI_OBSERVATIONS + key: rows for key, rows in leaves.items()} | {_INFOS + key: _storable(rows) for key, rows in infos.items()}
        if not np.array_equal(episode.truncations, _default_truncations(length, bool(episode.terminations[-1]))):
            extras[_TRUNCATIONS] = episode.truncations
    return ForeignDemonstration(
        name=f"demo_{number}",
        modalities=modalities,
        actions=episode.actions,
        rewards=episode.rewards,
        dones=_dones(episode.terminations, infos),
        states=states,
        extras=extras,
        attributes={} if ours else {"minari": json.dumps({key: value for key, value in plain(metadata).items() if key not in _COMPUTED})},
    )


def _dones(terminations: np.ndarray, infos: dict[str, Any]) -> np.ndarray:
    for key in _SUCCESS:
        if key in infos and np.shape(infos[key]) == (len(terminations) + 1,):
            return np.asarray(infos[key])[1:].astype(bool)
    return terminations


def _leaves(tree: Any, root: str) -> dict[str, Any]:
    """The arrays of nested dictionaries, by their path; `root` names a single array."""
    if not isinstance(tree, dict):
        return {root: tree}
    found: dict[str, Any] = {}
    for key, value in tree.items():
        found |= {f"{key}/{below}" if below else key: leaf for below, leaf in _leaves(value, "").items()}
    return found


def _storable(rows: Any) -> np.ndarray:
    """HDF5 has texts as bytes only."""
    rows = np.asarray(rows)
    return np.char.encode(rows) if rows.dtype.kind == "U" else rows.astype("S") if rows.dtype.kind == "O" else rows


def _default_truncations(length: int, terminated: bool) -> np.ndarray:
    return (np.arange(length) == length - 1) & (not terminated)


# ------------------------------------------------------------------------------------------------------------------------------- writing


def check_writable(name: str, *, overwrite: bool) -> None:
    """Makes sure, before any work is done, that a dataset of that name can be written.

    Raises:
      UserError: if not.
    """
    folder = _folder(name)
    if folder.exists() and not (folder / "data").is_dir():
        raise UserError(f"{PREFIX}{name}: {folder} exists already and is no dataset; choose another name")
    if folder.exists() and not overwrite:
        raise UserError(f"{PREFIX}{name}: exists already in {folder.parent}; allow overwriting it with --overwrite, or choose another name")
    reason = why_unwritable(folder.absolute().parent)
    if reason:
        raise UserError(f"{PREFIX}{name}: cannot be written, since {reason}; set MINARI_DATASETS_PATH to another place")


def write(name: str, recording: Recording, *, overwrite: bool) -> None:
    """Writes a dataset of that name, which afterwards holds either all of the recording or what it held before.

    Raises:
      UserError: it exists and `overwrite` is off, or it cannot be written.
    """
    check_writable(name, overwrite=overwrite)
    folder = _folder(name)
    with _temporary(folder, PREFIX + name) as new:
        _fill(new / "data", name, recording)
        check_writable(name, overwrite=overwrite)  # somebody else may have been quicker
        if folder.exists():
            old = new.with_name(f"{new.name}.old")
            os.replace(folder, old)  # folders cannot replace each other, so there is a moment without the dataset
            try:
                os.replace(new, folder)
            except OSError:
                os.replace(old, folder)
                raise
            shutil.rmtree(old, ignore_errors=True)
        else:
            os.replace(new, folder)
        _name_groups(name, folder)


@contextlib.contextmanager
def _temporary(folder: Path, source: str) -> Iterator[Path]:
    """A hidden folder beside the final one, which Minari does not list, and which does not outlive a failure."""
    new = folder.with_name(f".{folder.name}.{os.getpid()}.tmp")
    made = [parent for parent in folder.parents if not parent.exists()]
    try:
        (new / "data").mkdir(parents=True)
        yield new
    except OSError as error:
        raise UserError(f"{source}: cannot be written ({one_line(error)}); check the folder, its permissions and the free space") from error
    finally:
        shutil.rmtree(new, ignore_errors=True)
        for parent in made:
            with contextlib.suppress(OSError):
                parent.rmdir()  # only where nothing is in it


def _name_groups(name: str, folder: Path) -> None:
    """Minari knows a group of datasets by a file in its folder."""
    file_name = importlib.import_module("minari.namespace").NAMESPACE_METADATA_FILENAME
    for parent in list(folder.parents)[: name.count("/")]:
        if not (parent / file_name).exists():
            (parent / file_name).write_text("{}")


def _fill(data: Path, name: str, recording: Recording) -> None:
    minari = _minari()
    storage_class = importlib.import_module("minari.dataset.minari_storage").MinariStorage
    metadata = _source_metadata(recording)
    if metadata is not None:
        serialization = importlib.import_module("minari.serialization")
        spaces = {key: serialization.deserialize_space(metadata[key]) for key in ("observation_space", "action_space")}
        spec = None  # it is among the metadata, as text
        buffers = [_source_buffer(demo, spaces["observation_space"]) for demo in recording.demonstrations]
        about = {key: value for key, value in metadata.items() if key not in _WRITTEN_BY_MINARI}
        about |= {key: set(about[key]) for key in ("author", "author_email") if key in about}
        jpeg = bool(metadata.get("jpeg_encoding", True))
    else:
        spaces, jpeg, spec = _spaces(recording), True, _specification(recording)
        buffers = [_buffer(demo) for demo in recording.demonstrations]
        ours = {"env_name": recording.env_name, "env_kwargs": recording.env_kwargs, "expert": recording.expert}
        about = {"description": f"Demonstrations of {recording.env_name}, written by hindrl_jax.", _OURS: json.dumps(ours)}
    storage = storage_class.new(data, **spaces, env_spec=spec, jpeg_encoding=jpeg)
    storage.update_metadata(about | {"dataset_id": name, "minari_version": minari.__version__})
    storage.update_episodes(buffers)
    if metadata is not None:
        storage.update_episode_metadata([_episode_attributes(demo) for demo in recording.demonstrations])
    minari.MinariDataset(storage)  # it complains of what it could not read back


def _source_metadata(recording: Recording) -> dict[str, Any] | None:
    """Minari's metadata of the dataset that a recording was converted from, if that was one of somebody else."""
    source = recording.converted_from or {}
    return json.loads(source["metadata"]) if source.get("format") == "minari" and "metadata" in source else None


_WRITTEN_BY_MINARI = (
    "total_episodes",
    "total_steps",
    "data_format",
    "jpeg_encoding",
    "observation_space",
    "action_space",
    "dataset_id",
    "minari_version",
    "dataset_size",
)


def _specification(recording: Recording) -> Any:
    """What Gymnasium must know to make the environment again; None where it does not know it."""
    gymnasium = importlib.import_module("gymnasium")
    try:
        known = gymnasium.spec(f"hindrl/{recording.env_name}-v0")
    except gymnasium.error.Error:
        return None
    arguments = dict(recording.env_kwargs)
    return dataclasses.replace(known, max_episode_steps=arguments.pop("horizon"), kwargs=known.kwargs | arguments)


def _spaces(recording: Recording) -> dict[str, Any]:
    from gymnasium import spaces

    first = recording.demonstrations[0]
    arrays = zip(OBSERVATION_KEYS, (first.observations, first.achieved_goals, first.desired_goal), strict=True)
    goals: dict[str, spaces.Space[Any]] = {
        key: spaces.Box(-np.inf, np.inf, (array.shape[-1],), array.dtype.type if array.dtype.kind == "f" else np.float32) for key, array in arrays
    }
    return {"observation_space": spaces.Dict(goals), "action_space": spaces.Box(-1.0, 1.0, first.actions.shape[1:], np.float32)}


def _buffer(demo: Demonstration) -> Any:
    """An episode of a recording that is ours."""
    goals = np.repeat(demo.desired_goal[None], len(demo) + 1, axis=0)
    terminations = (np.arange(len(demo)) == len(demo) - 1) & demo.terminated
    return importlib.import_module("minari.data_collector.episode_buffer").EpisodeBuffer(
        observations=dict(zip(OBSERVATION_KEYS, (demo.observations, demo.achieved_goals, goals), strict=True)),
        actions=demo.actions,
        rewards=demo.rewards,
        terminations=terminations,
        truncations=_default_truncations(len(demo), demo.terminated),
        infos=None if demo.states is None else {"state": demo.states},
    )


def _source_buffer(demo: Demonstration, observation_space: Any) -> Any:
    """An episode of a dataset that was converted from Minari, as it was there."""
    extras = demo.extras
    about = json.loads(demo.attributes["minari"])

    def observations(space: Any, path: str) -> Any:
        if hasattr(space, "spaces"):
            return {key: observations(below, f"{path}/{key}" if path else key) for key, below in space.spaces.items()}
        path = path or "observation"
        along = dict(zip(OBSERVATION_KEYS, (demo.observations, demo.achieved_goals), strict=False))
        along["desired_goal"] = np.repeat(demo.desired_goal[None], len(demo) + 1, axis=0)
        return extras.get(MINARI_OBSERVATIONS + path, along.get(path))

    infos: dict[str, Any] = {}
    for key, rows in extras.items():
        if key.startswith(_INFOS):
            *groups, leaf = key.removeprefix(_INFOS).split("/")
            place = infos
            for group in groups:
                place = place.setdefault(group, {})
            place[leaf] = rows.astype(str).tolist() if rows.dtype.kind == "S" else rows
    terminations = extras[_TERMINATIONS]
    return importlib.import_module("minari.data_collector.episode_buffer").EpisodeBuffer(
        seed=about.get("seed"),
        options=about.get("options"),
        observations=observations(observation_space, ""),
        actions=extras.get(f"{SOURCE}actions", demo.actions),
        rewards=extras.get(f"{SOURCE}rewards", demo.rewards),
        terminations=terminations,
        truncations=extras.get(_TRUNCATIONS, _default_truncations(len(demo), bool(terminations[-1]))),
        infos=infos or None,
    )


def _episode_attributes(demo: Demonstration) -> dict[str, Any]:
    return {key: value for key, value in json.loads(demo.attributes["minari"]).items() if key not in ("seed", "options")}


def left_out(recording: Recording) -> list[str]:
    """What of a recording does not go into a Minari dataset, a line for each."""
    if _source_metadata(recording) is not None:
        return []
    names = sorted({name for demo in recording.demonstrations for name in demo.extras} | set(recording.extras))
    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
    return [f"left out what Minari has no place for: {', '.join(names[:3])}{more}"] if names else []
