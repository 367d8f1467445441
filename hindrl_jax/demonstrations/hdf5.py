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

import contextlib
import dataclasses
import io
import json
import os
import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, cast

import h5py
import numpy as np

from hindrl_jax.base.environments import RestorableEnvironment
from hindrl_jax.base.errors import UserError, one_line
from hindrl_jax.base.files import check_can_write, check_is_file, write_atomically
from hindrl_jax.base.types import Episodes
from hindrl_jax.tasks.registry import full_name

FORMAT_VERSION = 1
SOLVED_ATTRIBUTE = "terminated"
_GYM_ENV_TYPE = 2
_ACTION_TOLERANCE = 1e-5
_GOAL_TOLERANCE = 1e-4
_LONGEST_FIXED_ATTRIBUTE = 60_000  # HDF5's limit is 64 KiB
OBSERVATION_KEYS = ("observation", "achieved_goal", "desired_goal")
CORE_DATASETS = (*(f"{group}/{key}" for group in ("obs", "next_obs") for key in OBSERVATION_KEYS), "actions", "rewards", "dones")
"""What every demonstration has."""
_OWN_ATTRIBUTES = ("env_args", "env", "total", "format_version", "expert", "hindrl_env", "converted_from")
_RECORD_AGAIN = "record the demonstrations again"


@dataclasses.dataclass(frozen=True)
class DemonstrationSummary:
    """What a file of demonstrations holds. Ranges are per dimension, over all steps of all demonstrations."""

    path: Path
    env_name: str
    env_kwargs: dict[str, Any]
    expert: dict[str, Any] | None
    num_demonstrations: int
    num_transitions: int
    num_solved: int
    length_min: int
    length_median: float
    length_max: int
    observation_low: np.ndarray  # (D,)
    observation_high: np.ndarray  # (D,)
    action_low: np.ndarray  # (A,)
    action_high: np.ndarray  # (A,)


@dataclasses.dataclass(frozen=True)
class Demonstration:
    """One demonstration of L transitions. Floats of any size, as they are in the file."""

    name: str
    """As in the file: demo_0, demo_1, ..."""
    observations: np.ndarray  # (L + 1, D)
    achieved_goals: np.ndarray  # (L + 1, G)
    desired_goal: np.ndarray  # (G,)
    actions: np.ndarray  # (L, A), in [-1, 1]
    rewards: np.ndarray  # (L,)
    terminated: bool
    """Whether the last transition solved the task."""
    states: np.ndarray | None = None  # (L + 1, S) of our own environment
    extras: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)
    """Other datasets of its group, by their path in it."""
    attributes: dict[str, Any] = dataclasses.field(default_factory=dict)
    """Other attributes of its group."""

    def __len__(self) -> int:
        return len(self.actions)


@dataclasses.dataclass(frozen=True)
class Recording:
    """All that a file of demonstrations holds."""

    env_name: str
    env_kwargs: dict[str, Any]
    expert: dict[str, Any] | None
    demonstrations: tuple[Demonstration, ...]
    converted_from: dict[str, Any] | None = None
    """What the source was, if this is a conversion."""
    extras: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)
    """Datasets outside the group `data`, by their path in the file."""
    attributes: dict[str, Any] = dataclasses.field(default_factory=dict)
    """Attributes of the source's group `data`; its env_args and env stand in the file in place of ours."""


@dataclasses.dataclass(frozen=True)
class _Header:
    """The attributes of the group `data`, and which demonstrations there are."""

    env_name: str
    env_kwargs: dict[str, Any]
    expert: dict[str, Any] | None
    converted_from: dict[str, Any] | None
    lengths: dict[str, int]  # name of each demonstration, in numeric order -> number of transitions


def save_demonstrations(
    path: str | os.PathLike[str],
    demonstrations: Episodes,
    *,
    env: RestorableEnvironment,
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
    path = Path(path)
    table: Any = Episodes(**{field.name: cast(Any, np.asarray(getattr(demonstrations, field.name))) for field in dataclasses.fields(Episodes)})
    expected = (*table.observations.shape[:2], env.state_dim)
    if table.states.shape != expected:
        raise ValueError(f"states must have shape {expected}, found {table.states.shape}")
    achieved_goals = np.asarray(env.achieved_goal(table.observations))
    recorded = tuple(
        Demonstration(
            name=f"demo_{i}",
            observations=table.observations[i, : length + 1].astype(np.float32),
            achieved_goals=achieved_goals[i, : length + 1].astype(np.float32),
            desired_goal=table.desired_goals[i].astype(np.float32),
            actions=table.actions[i, :length].astype(np.float32),
            rewards=table.rewards[i, :length].astype(np.float32),
            terminated=bool(table.terminated[i]),
            states=table.states[i, : length + 1],
        )
        for i, length in enumerate(table.lengths.tolist())
    )
    recording = Recording(env_name=full_name(env), env_kwargs=env_args, expert=expert, demonstrations=recorded)
    write_recording(path, recording, env=env, overwrite=overwrite)


def write_recording(path: str | os.PathLike[str], recording: Recording, *, env: RestorableEnvironment | None = None, overwrite: bool = False) -> None:
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
    content = hdf5_bytes(lambda file: _write_recording(file, recording))
    with _open(path, content) as file:
        header, demos = _read_open_file(path, file)
    if env is not None:
        _check_against_env(path, header.env_name, header.env_kwargs, demos, env)
    write_atomically(path, content.getbuffer(), overwrite=overwrite)


def check_recording(recording: Recording, where: str | os.PathLike[str]) -> None:
    """Raises a UserError, which begins with `where`, for a recording that would be refused as a file."""
    with _open(Path(where), hdf5_bytes(lambda file: _write_recording(file, recording))) as file:
        _read_open_file(Path(where), file)


def _write_recording(file: h5py.File, recording: Recording) -> None:
    data = file.create_group("data")
    ours = {"env_name": recording.env_name, "env_kwargs": recording.env_kwargs}
    data.attrs["env_args"] = _json_bytes(ours | {"type": _GYM_ENV_TYPE})
    data.attrs["env"] = np.bytes_(recording.env_name.encode())
    data.attrs["total"] = sum(map(len, recording.demonstrations))
    data.attrs["format_version"] = FORMAT_VERSION
    data.attrs["expert"] = _json_bytes(recording.expert)
    if recording.converted_from is not None:
        data.attrs["hindrl_env"] = _json_bytes(ours)
        data.attrs["converted_from"] = _json_bytes(recording.converted_from)
    for name, value in recording.attributes.items():
        data.attrs[name] = value
    for name, array in recording.extras.items():
        file[name] = array
    for demonstration in recording.demonstrations:
        _write_demonstration(data.create_group(demonstration.name), demonstration)


def layout(demonstration: Demonstration) -> dict[str, np.ndarray]:
    """The datasets of a demonstration's group, by name, without its extras."""
    length = len(demonstration)
    along = dict(
        observation=demonstration.observations,
        achieved_goal=demonstration.achieved_goals,
        desired_goal=np.broadcast_to(demonstration.desired_goal, (length + 1, *demonstration.desired_goal.shape)),
    )
    datasets = {f"obs/{key}": rows[:length] for key, rows in along.items()} | {f"next_obs/{key}": rows[1 : length + 1] for key, rows in along.items()}
    datasets |= {"actions": demonstration.actions, "rewards": demonstration.rewards}
    datasets["dones"] = (np.arange(length) == length - 1).astype(np.int64) * int(demonstration.terminated)
    if demonstration.states is not None:
        datasets |= {"states": demonstration.states[:length], "final_state": demonstration.states[length]}
    return datasets


def _write_demonstration(group: h5py.Group, demonstration: Demonstration) -> None:
    for name, array in (layout(demonstration) | demonstration.extras).items():
        group[name] = array
    group.attrs["num_samples"] = len(demonstration)
    if "dones" in demonstration.extras:
        group.attrs[SOLVED_ATTRIBUTE] = int(demonstration.terminated)
    for name, value in demonstration.attributes.items():
        group.attrs[name] = value


def hdf5_bytes(write: Callable[[h5py.File], None]) -> io.BytesIO:
    """An HDF5 file in memory. The HDF5 library may crash the whole process when a disk is full, so plain Python writes the bytes."""
    content = io.BytesIO()
    with h5py.File(content, "w") as file:
        write(file)
    return content


def load_demonstrations(path: str | os.PathLike[str], env: RestorableEnvironment, *, num_demos: int | None = None) -> Episodes:
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
    _check_number(path, num_demos)
    header, demos = _read(path, max_length=env.horizon, num_demos=num_demos)
    _check_lengths(path, list(header.lengths.values()), env.horizon, num_demos)
    _check_against_env(path, header.env_name, header.env_kwargs, demos, env)
    return _table(demos, env.horizon)


def as_episodes(recording: Recording, env: RestorableEnvironment, *, where: str | os.PathLike[str], num_demos: int | None = None) -> Episodes:
    """A recording as the table that `load_demonstrations` makes of a file, with the same checks; `where` begins their messages."""
    where = Path(where)
    _check_number(where, num_demos)
    _check_lengths(where, [len(demo) for demo in recording.demonstrations], env.horizon, num_demos)
    demos = [demo for demo in recording.demonstrations if len(demo) <= env.horizon][:num_demos]
    _check_against_env(where, recording.env_name, recording.env_kwargs, demos, env)
    return _table(demos, env.horizon)


def _check_number(path: Path, num_demos: int | None) -> None:
    if num_demos is not None and num_demos < 1:
        raise UserError(f"{path}: {num_demos} demonstrations asked for; ask for at least 1")


def _check_lengths(path: Path, lengths: Sequence[int], horizon: int, num_demos: int | None) -> None:
    """Refuses a recording with too few demonstrations that fit into the horizon, and warns if some do not."""
    num_dropped = sum(length > horizon for length in lengths)
    num_usable = len(lengths) - num_dropped
    if num_usable == 0:
        raise UserError(f"{path}: all {num_dropped} demonstrations are longer than the horizon of {horizon} steps; raise the horizon")
    if num_demos is not None and num_demos > num_usable:
        fit = f" that fit into the horizon of {horizon} steps" if num_dropped else ""
        raise UserError(f"{path}: {num_demos} demonstrations asked for, but it holds {num_usable}{fit}; ask for fewer or record more")
    if num_dropped:
        message = f"{path}: dropped {num_dropped} of {len(lengths)} demonstrations, longer than the horizon of {horizon} steps"
        warnings.warn(message, stacklevel=3)


def padded(rows: Sequence[np.ndarray], num_rows: int) -> np.ndarray:
    """Stacks arrays (l_n, ...) of different lengths as float32 (N, num_rows, ...), with zeros after their ends."""
    out = np.zeros((len(rows), num_rows, *rows[0].shape[1:]), np.float32)
    for i, row in enumerate(rows):
        out[i, : len(row)] = row
    return out


def _table(demos: Sequence[Demonstration], horizon: int) -> Episodes:
    with_states = all(demo.states is not None for demo in demos)
    table: dict[str, Any] = dict(
        observations=padded([demo.observations for demo in demos], horizon + 1),
        actions=padded([demo.actions for demo in demos], horizon),
        rewards=padded([demo.rewards for demo in demos], horizon),
        lengths=np.array([len(demo) for demo in demos], np.int32),
        terminated=np.array([demo.terminated for demo in demos], bool),
        desired_goals=np.stack([demo.desired_goal for demo in demos]).astype(np.float32),
        states=padded([demo.states for demo in demos], horizon + 1) if with_states else None,
    )
    return Episodes(**table)


def read_recording(path: str | os.PathLike[str]) -> Recording:
    """Reads and checks a whole file with everything in it, without the environment that it was recorded in.

    Raises:
      UserError: the file is missing, damaged or inconsistent, or was not written by hindrl_jax.
    """
    path = Path(path)
    check_is_file(path)
    with _open(path, path) as file:
        header, demos = _read_open_file(path, file, everything=True)
        extras = {name: array for top in file if top != "data" for name, array in datasets_within(file[top], f"{top}/").items()}
        attributes = dict(file["data"].attrs)
    kept = attributes.keys() - set(_OWN_ATTRIBUTES) if header.converted_from is None else header.converted_from.get("attributes", ())
    return Recording(
        env_name=header.env_name,
        env_kwargs=header.env_kwargs,
        expert=header.expert,
        demonstrations=tuple(demos),
        converted_from=header.converted_from,
        extras=extras,
        attributes={name: attributes[name] for name in kept if name in attributes},
    )


def datasets_within(group: h5py.Group, prefix: str = "") -> dict[str, np.ndarray]:
    """All datasets below a group by their path, which gets a prefix; texts as bytes of fixed length."""
    found = {}

    def visit(name: str, item: h5py.Group | h5py.Dataset) -> None:
        if isinstance(item, h5py.Dataset):
            array = np.asarray(item[()])
            found[prefix + name] = array.astype("S" if array.dtype.kind == "O" else array.dtype.str)  # without what h5py notes in types

    group.visititems(visit)
    return found


def read_states(path: str | os.PathLike[str], *, num_demos: int | None = None) -> list[np.ndarray]:
    """The simulator states along each demonstration, (length + 1, S) each, in the type that they were written in; for rendering."""
    _, demos = _read(Path(path), num_demos=num_demos)
    if any(demo.states is None for demo in demos):
        raise UserError(f"{path}: was converted from a file without our environment's states; render needs a file recorded by hindrl demos record")
    return [demo.states for demo in demos]


def describe_demonstrations(path: str | os.PathLike[str]) -> DemonstrationSummary:
    """Reads and checks a whole file, without the environment that it was recorded in."""
    path = Path(path)
    header, demos = _read(path)
    return summarise_recording(
        path, Recording(env_name=header.env_name, env_kwargs=header.env_kwargs, expert=header.expert, demonstrations=tuple(demos))
    )


def summarise_recording(path: str | os.PathLike[str], recording: Recording) -> DemonstrationSummary:
    """What a recording, read from `path`, holds."""
    demos = recording.demonstrations
    lengths = [len(demo) for demo in demos]
    observations = np.concatenate([demo.observations for demo in demos])
    actions = np.concatenate([demo.actions for demo in demos])
    return DemonstrationSummary(
        path=Path(path),
        env_name=recording.env_name,
        env_kwargs=recording.env_kwargs,
        expert=recording.expert,
        num_demonstrations=len(demos),
        num_transitions=sum(lengths),
        num_solved=sum(demo.terminated for demo in demos),
        length_min=min(lengths),
        length_median=float(np.median(lengths)),
        length_max=max(lengths),
        observation_low=observations.min(axis=0),
        observation_high=observations.max(axis=0),
        action_low=actions.min(axis=0),
        action_high=actions.max(axis=0),
    )


def _read(path: Path, *, max_length: int | None = None, num_demos: int | None = None) -> tuple[_Header, list[Demonstration]]:
    """Reads the header and the first `num_demos` demonstrations of at most `max_length` transitions; checks all that needs no environment."""
    check_is_file(path)
    with _open(path, path) as file:
        return _read_open_file(path, file, max_length=max_length, num_demos=num_demos)


@contextlib.contextmanager
def _open(path: Path, source: Path | io.BytesIO) -> Iterator[h5py.File]:
    with damage_reported(f"{path}", "is not an HDF5 file, or is cut off or damaged"), h5py.File(source, "r", locking="best-effort") as file:
        if not isinstance(file.get("data"), h5py.Group):
            raise UserError(f"{path}: has no group 'data', so it holds no demonstrations; name a file of demonstrations")
        yield file


def _read_open_file(
    path: Path, file: h5py.File, *, max_length: int | None = None, num_demos: int | None = None, everything: bool = False
) -> tuple[_Header, list[Demonstration]]:
    header = _read_header(path, file["data"])
    names = [name for name, length in header.lengths.items() if max_length is None or length <= max_length]
    options = dict(converted=header.converted_from is not None, everything=everything)
    demos = [_read_demonstration(path, name, file["data"][name], header.lengths[name], **options) for name in names[:num_demos]]
    for demo in demos:
        for what in ("observations", "actions", "achieved_goals", "states"):
            here, first = (None if getattr(d, what) is None else getattr(d, what).shape[1:] for d in (demo, demos[0]))
            if here != first:
                what = what.replace("_", " ")
                raise UserError(f"{path}: {demo.name}: {what} have shape {here} per step but {first} in {demos[0].name}; {_RECORD_AGAIN}")
    return header, demos


def _read_header(path: Path, data: h5py.Group) -> _Header:
    if "format_version" not in data.attrs:
        raise UserError(f"{path}: attribute format_version is missing, so hindrl_jax has not written it; try `hindrl demos convert {path} OURS.hdf5`")
    version = _attribute(f"{path}", data, "format_version")
    if int(version) != FORMAT_VERSION:
        raise UserError(f"{path}: has format version {version}, but this version of hindrl_jax reads {FORMAT_VERSION}; {_RECORD_AGAIN}")
    try:
        env_args = json.loads(data.attrs["hindrl_env"] if "hindrl_env" in data.attrs else _attribute(f"{path}", data, "env_args"))
        env_name, env_kwargs = str(env_args["env_name"]), dict(env_args["env_kwargs"])
        expert = json.loads(data.attrs.get("expert", "null"))
        converted_from = json.loads(data.attrs.get("converted_from", "null"))
    except (TypeError, KeyError, json.JSONDecodeError) as error:
        raise UserError(f"{path}: the attribute env_args or expert is not the JSON text that was expected; {_RECORD_AGAIN}") from error
    names = sorted((name for name in data if re.fullmatch(r"demo_\d+", name)), key=lambda name: int(name.removeprefix("demo_")))
    if not names:
        raise UserError(f"{path}: holds no demonstrations; {_RECORD_AGAIN}")
    lengths = {}
    for name in names:
        where = f"{path}: {name}"
        if not isinstance(data[name], h5py.Group):
            raise UserError(f"{where}: is not a group; {_RECORD_AGAIN}")
        lengths[name] = int(_attribute(where, data[name], "num_samples"))
        if lengths[name] < 1:
            raise UserError(f"{where}: has {lengths[name]} transitions, at least 1 is needed; delete this demonstration or {_RECORD_AGAIN}")
    return _Header(env_name=env_name, env_kwargs=env_kwargs, expert=expert, converted_from=converted_from, lengths=lengths)


def _read_demonstration(path: Path, name: str, group: h5py.Group, length: int, *, converted: bool, everything: bool) -> Demonstration:
    where = f"{path}: {name}"
    along = {}
    for key in OBSERVATION_KEYS:
        before = _array(where, group, f"obs/{key}", (length, None))
        after = _array(where, group, f"next_obs/{key}", (length, before.shape[1]))
        misaligned = np.flatnonzero((after[:-1] != before[1:]).any(axis=1))
        if misaligned.size:
            t = misaligned[0]
            raise UserError(f"{where}: row {t} of next_obs/{key} is not row {t + 1} of obs/{key}, the rows are misaligned; {_RECORD_AGAIN}")
        along[key] = np.concatenate([before, after[-1:]])
    if (along["desired_goal"] != along["desired_goal"][0]).any():
        raise UserError(f"{where}: desired_goal changes during the episode, which is not supported; record with one goal per demonstration")
    if along["achieved_goal"].shape != along["desired_goal"].shape:
        raise UserError(f"{where}: achieved_goal and desired_goal differ in shape; {_RECORD_AGAIN}")

    actions = _array(where, group, "actions", (length, None))
    largest = np.abs(actions).max(initial=0.0)
    if largest > 1.0 + _ACTION_TOLERANCE:
        raise UserError(f"{where}: actions reach {largest:g} in size but must lie in [-1, 1]; rescale them from the environment's units")
    if SOLVED_ATTRIBUTE in group.attrs:
        terminated = bool(_attribute(where, group, SOLVED_ATTRIBUTE))
    else:
        dones = _array(where, group, "dones", (length,))
        if dones[:-1].any() or dones[-1] not in (0, 1):
            raise UserError(f"{where}: dones must be 0, or 1 at the last step only; cut the demonstration there or {_RECORD_AGAIN}")
        terminated = bool(dones[-1])
    if converted and "final_state" not in group:
        states = None
    else:
        before = _array(where, group, "states", (length, None))
        states = np.concatenate([before, _array(where, group, "final_state", (before.shape[1],))[None]])
    demonstration = Demonstration(
        name=name,
        observations=along["observation"],
        achieved_goals=along["achieved_goal"],
        desired_goal=along["desired_goal"][0],
        actions=actions,
        rewards=_array(where, group, "rewards", (length,)),
        terminated=terminated,
        states=states,
    )
    if not everything:
        return demonstration
    known = {*CORE_DATASETS, *(("states", "final_state") if states is not None else ())}
    if SOLVED_ATTRIBUTE in group.attrs:
        known.remove("dones")
    with damage_reported(where, "cannot be read"):
        extras = {name: array for name, array in datasets_within(group).items() if name not in known}
        attributes = {name: value for name, value in group.attrs.items() if name not in ("num_samples", SOLVED_ATTRIBUTE)}
    return dataclasses.replace(demonstration, extras=extras, attributes=attributes)


def _check_against_env(path: Path, env_name: str, env_kwargs: dict[str, Any], demos: Sequence[Demonstration], env: RestorableEnvironment) -> None:
    if env.name not in (env_name, env_name.rpartition(":")[2]):  # the module of a task of the user's own may have moved
        raise UserError(f"{path}: was recorded in {env_name}, not in {env.name}; name a file of {env.name} or train in {env_name}")
    if dataclasses.is_dataclass(env):
        expected, missing = plain(dataclasses.asdict(env)), "nothing"
        may_differ = {"horizon", *getattr(env, "interchangeable", ())}
        for field in sorted((expected.keys() | env_kwargs.keys()) - may_differ):
            there, here = env_kwargs.get(field, missing), expected.get(field, missing)
            if there != here:
                raise UserError(
                    f"{path}: was recorded with {field} = {there}, but {env.name} here has {field} = {here}; use equal arguments or {_RECORD_AGAIN}"
                )
    dims = {"observations": env.observation_dim, "actions": env.action_dim, "achieved_goals": env.goal_dim, "states": env.state_dim}
    for demo in demos:
        for what, dim in dims.items():
            if getattr(demo, what) is not None and getattr(demo, what).shape[1] != dim:
                found, what = getattr(demo, what).shape[1], what.replace("_", " ")
                raise UserError(f"{path}: {demo.name}: {what} have {found} dimensions, but {dim} in {env.name}; {_RECORD_AGAIN}")
    # One call for the whole file: under JAX, one per demonstration would compile for every length.
    owners = np.repeat(np.arange(len(demos)), [len(demo.observations) for demo in demos])
    observations: Any = np.concatenate([demo.observations for demo in demos])
    expected_goals = np.asarray(env.achieved_goal(observations))
    stored_goals = np.concatenate([demo.achieved_goals for demo in demos])
    wrong = ~np.isclose(stored_goals, expected_goals, rtol=_GOAL_TOLERANCE, atol=_GOAL_TOLERANCE).all(axis=1)
    if wrong.any():
        name = demos[owners[wrong.argmax()]].name
        raise UserError(f"{path}: {name}: achieved_goal is not what {env.name} derives from the observations; {_RECORD_AGAIN}")


def _array(where: str, group: h5py.Group, name: str, shape: tuple[int | None, ...]) -> np.ndarray:
    """Reads a dataset of finite numbers, in the type that it has in the file; None in `shape` stands for any size."""
    with damage_reported(where, f"{name} cannot be read"):
        dataset = group.get(name)
        if not isinstance(dataset, h5py.Dataset):
            raise UserError(f"{where}: dataset {name} is missing; {_RECORD_AGAIN}")
        # Before any reading, since a damaged shape may be too large for the memory.
        if len(dataset.shape) != len(shape) or any(b is not None and a != b for a, b in zip(dataset.shape, shape, strict=True)):
            wanted = "(" + ", ".join("any" if n is None else str(n) for n in shape) + ")"
            raise UserError(f"{where}: {name} has shape {dataset.shape}, expected {wanted}; {_RECORD_AGAIN}")
        if dataset.dtype.kind not in "biuf":
            raise UserError(f"{where}: {name} holds {dataset.dtype}, not numbers; {_RECORD_AGAIN}")
        array = np.asarray(dataset[()])
    finite = np.isfinite(array)
    if not finite.all():
        row = np.argwhere(~finite)[0][0]
        raise UserError(f"{where}: {name} is not finite in row {row}; delete this demonstration or {_RECORD_AGAIN}")
    return array


def _attribute(where: str, group: h5py.Group, name: str) -> Any:
    with damage_reported(where, f"attribute {name} cannot be read"):
        if name not in group.attrs:
            raise UserError(f"{where}: attribute {name} is missing, so this is no file of hindrl_jax demonstrations; {_RECORD_AGAIN}")
        return group.attrs[name]


@contextlib.contextmanager
def damage_reported(where: str, what: str) -> Iterator[None]:
    """Turns whatever h5py raises on a damaged file into a UserError; which exception it is depends on the place of the damage."""
    try:
        yield
    except UserError:
        raise
    except (OSError, KeyError, RuntimeError, TypeError, ValueError, MemoryError) as error:
        raise UserError(f"{where}: {what} ({one_line(error)}); fetch the file again or {_RECORD_AGAIN}") from error


def plain(value: Any) -> Any:
    """The value as it comes back from JSON: tuples become lists, arrays and NumPy scalars become numbers."""
    return json.loads(json.dumps(value, default=lambda array: array.tolist()))


def _json_bytes(value: Any) -> np.bytes_ | str:
    """JSON as a string of fixed length, if it fits: on a damaged file, strings of variable length can crash the HDF5 library."""
    text = json.dumps(plain(value)).encode()
    return np.bytes_(text) if len(text) < _LONGEST_FIXED_ATTRIBUTE else text.decode()
