"""Minari datasets, written `minari:NAME-v0` on the command line, in the folder that MINARI_DATASETS_PATH names (default: ~/.minari/datasets).

A dataset that we write holds Gymnasium's goal observations {observation, achieved_goal, desired_goal}, actions in [-1, 1], and among the infos the
environment's `state` (T + 1, S). Where Gymnasium knows the environment as hindrl/NAME-v0, Minari can recover it. What Minari has no place for, such
as the other modalities of a robomimic file, is left out.

A dataset of somebody else is read so that it can be learned from in the same environment. If that is one of Gymnasium's, the observation is
[observation, achieved_goal], or what is observed where that is flat, as in `hindrl train --env gymnasium:ID`. The task counts as solved where the
infos say success or is_success, if there are such infos, else where the episode terminated. Converted back it is as it was: seeds, options, infos,
metadata and the environment's specification are kept in our file.

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
from hindrl_jax.base.files import check_free
from hindrl_jax.demonstrations._minari_episodes import as_demonstration, as_episode, as_source_episode, source_metadata
from hindrl_jax.demonstrations.foreign import ForeignRecording
from hindrl_jax.demonstrations.recording import Recording, plain
from hindrl_jax.tasks.describing import action_bounds
from hindrl_jax.tasks.registry import TASKS, make

PREFIX = "minari:"
GYMNASIUM = "gymnasium:"  # begins the names of environments that are not ours
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
            as_demonstration(source, n, episode, metadata, ours=ours is not None)
            for n, (episode, metadata) in enumerate(zip(episodes, episode_metadata, strict=True))
        ),
        observation_keys=("observation", "achieved_goal") if ours is None and _gives_goals(env_name, episodes[0]) else ("observation",),
        action_low=low,
        action_high=high,
        ours=ours is not None,
        about={} if ours is not None else {"metadata": json.dumps(raw)},
    )


def _gives_goals(env_name: str, episode: Any) -> bool:
    """Whether an episode is of an environment of Gymnasium whose observations come with goals, rather than flat."""
    return env_name.startswith(GYMNASIUM) and isinstance(episode.observations, dict) and "achieved_goal" in episode.observations


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
    if space.dtype.kind == "f":
        return space.low, space.high  # perhaps without bounds, which the user may then give
    return action_bounds(source, space)


def check_writable(name: str, *, overwrite: bool) -> None:
    """Makes sure, before any work is done, that a dataset of that name can be written.

    Raises:
      UserError: if not.
    """
    folder = _folder(name)
    if folder.exists() and not (folder / "data").is_dir():
        raise UserError(f"{PREFIX}{name}: {folder} exists already and is no dataset; choose another name")
    check_free(folder, f"{PREFIX}{name} in {folder.parent}", overwrite=overwrite, otherwise="set MINARI_DATASETS_PATH to another place")


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
        buffers = [as_source_episode(demo, spaces["observation_space"]) for demo in recording.demonstrations]
        about = {key: value for key, value in metadata.items() if key not in _WRITTEN_BY_MINARI}
        about |= {key: set(about[key]) for key in ("author", "author_email") if key in about}
        jpeg = bool(metadata.get("jpeg_encoding", True))
    else:
        spaces, jpeg, spec = _spaces(recording), True, _specification(recording)
        buffers = [as_episode(demo) for demo in recording.demonstrations]
        ours = {"env_name": recording.env_name, "env_kwargs": recording.env_kwargs, "expert": recording.expert}
        about = {"description": f"Demonstrations of {recording.env_name}, written by hindrl_jax.", _OURS: json.dumps(ours)}
    storage = storage_class.new(data, **spaces, env_spec=spec, jpeg_encoding=jpeg)
    storage.update_metadata(about | {"dataset_id": name, "minari_version": minari.__version__})
    storage.update_episodes(buffers)
    if metadata is not None:
        storage.update_episode_metadata([source_metadata(demo) for demo in recording.demonstrations])
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
    low, high = _observation_bounds(recording)
    goals: dict[str, spaces.Space[Any]] = {
        key: spaces.Box(low[key], high[key], rows.shape[1:], rows.dtype.type if rows.dtype.kind == "f" else np.float32)
        for key, rows in first.observed.items()
    }
    return {"observation_space": spaces.Dict(goals), "action_space": spaces.Box(-1.0, 1.0, first.actions.shape[1:], np.float32)}


def _observation_bounds(recording: Recording) -> tuple[dict[str, Any], dict[str, Any]]:
    """The bounds of what is observed, by its name: the environment's own, where it is one of ours and the recording keeps to them."""
    observed = recording.demonstrations[0].observed
    low, high = {key: -np.inf for key in observed}, {key: np.inf for key in observed}
    if recording.env_name not in TASKS:
        return low, high
    env: Any = make(recording.env_name, **recording.env_kwargs)
    if hasattr(env, "observation_low"):
        bounds = [
            {"observation": bound} | dict.fromkeys(("achieved_goal", "desired_goal"), np.asarray(env.achieved_goal(bound)))
            for bound in (env.observation_low, env.observation_high)
        ]
        inside = all(
            ((rows >= bounds[0][key]) & (rows <= bounds[1][key])).all() for demo in recording.demonstrations for key, rows in demo.observed.items()
        )
        if inside:
            return bounds[0], bounds[1]
    return low, high


def left_out(recording: Recording) -> list[str]:
    """What of a recording does not go into a Minari dataset, a line for each."""
    if _source_metadata(recording) is not None:
        return []
    names = sorted({name for demo in recording.demonstrations for name in demo.extras} | set(recording.extras))
    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
    return [f"left out what Minari has no place for: {', '.join(names[:3])}{more}"] if names else []
