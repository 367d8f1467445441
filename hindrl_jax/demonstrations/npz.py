"""Demonstrations as one flat archive of NumPy arrays, which `numpy.load` opens without pickle.

Demonstrations stand one after the other; L_n is the length of the n-th, in transitions, and sums go over n.

    lengths          (N,) integers, L_n >= 1
    observations     (sum (L_n + 1), D), the one after the last action included
    actions          (sum L_n, A), in [-1, 1]
    achieved_goals   (sum (L_n + 1), G)        may be missing where the environment is one of ours, which derives them
    desired_goals    (N, G)                    may be missing: the goal achieved at the end
    rewards          (sum L_n,)                may be missing: 1 at the end of a solved demonstration, else 0
    terminated       (N,) bool, solved or not  may be missing: all are solved
    states           (sum (L_n + 1), S)        may be missing; states of our own environment, to draw or to begin episodes in
    about            () text of a JSON object  may be missing; env_name, env_kwargs, expert, and what else a file of ours says
    extra/...        what else a file of ours holds, by its path there, for example extra/demo_0/obs/robot0_eef_pos
"""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np

from hindrl_jax.base.checks import LARGEST
from hindrl_jax.base.errors import UserError, one_line
from hindrl_jax.base.files import DAMAGED_ARCHIVE, check_is_file, read_arrays
from hindrl_jax.demonstrations.foreign import ForeignDemonstration, ForeignRecording
from hindrl_jax.demonstrations.recording import Demonstration, Recording

_FORMAT_VERSION = 1


def content(recording: Recording) -> bytes:
    """The archive of a recording. Nothing is lost, but that attributes which a source had as NumPy scalars become plain numbers."""
    demos = recording.demonstrations
    arrays = {
        "lengths": np.array([len(demo) for demo in demos]),
        "observations": np.concatenate([demo.observations for demo in demos]),
        "actions": np.concatenate([demo.actions for demo in demos]),
        "achieved_goals": np.concatenate([demo.achieved_goals for demo in demos]),
        "desired_goals": np.stack([demo.desired_goal for demo in demos]),
        "rewards": np.concatenate([demo.rewards for demo in demos]),
        "terminated": np.array([demo.terminated for demo in demos], bool),
    }
    if all(demo.states is not None for demo in demos):
        arrays["states"] = np.concatenate([demo.states for demo in demos])
    about = {
        "format_version": _FORMAT_VERSION,
        "env_name": recording.env_name,
        "env_kwargs": recording.env_kwargs,
        "expert": recording.expert,
        "converted_from": recording.converted_from,
        "names": [demo.name for demo in demos],
        "attributes": _plain_attributes(recording.attributes),
        "file_attributes": _plain_attributes(recording.file_attributes),
        "demonstration_attributes": [_plain_attributes(demo.attributes) for demo in demos],
    }
    arrays["about"] = np.array(json.dumps(about))
    arrays |= {f"extra/{name}": array for name, array in recording.extras.items()}
    arrays |= {f"extra/data/{demo.name}/{name}": array for demo in demos for name, array in demo.extras.items()}
    archive = io.BytesIO()
    written: dict[str, Any] = arrays
    np.savez_compressed(archive, **written)
    return archive.getvalue()


def _plain_attributes(attributes: dict[str, Any]) -> dict[str, Any]:
    return {
        name: value.decode() if isinstance(value, bytes) else value.tolist() if isinstance(value, np.ndarray | np.generic) else value
        for name, value in attributes.items()
    }


def read(path: Path) -> ForeignRecording | Recording:
    """Reads an archive: a recording if it is one that we wrote, else what is to be interpreted.

    Raises:
      UserError: it is missing or damaged, or has not the layout that is described above.
    """
    check_is_file(path)
    try:
        arrays = read_arrays(path)
    except DAMAGED_ARCHIVE as error:
        raise UserError(f"{path}: is not an archive of NumPy arrays, or is damaged ({one_line(error)}); fetch it again") from error
    about = _about(path, arrays)
    for name in ("lengths", "observations", "actions"):
        if name not in arrays:
            raise UserError(f"{path}: has no array {name!r}; it takes lengths, observations and actions (see help(hindrl_jax.demonstrations.npz))")
    lengths = arrays["lengths"]
    if lengths.ndim != 1 or lengths.dtype.kind not in "iu" or not lengths.size or lengths.min() < 1:
        raise UserError(f"{path}: lengths must be whole numbers (N,) of at least 1, one for each demonstration; write it again")
    lengths = arrays["lengths"] = lengths.astype(np.int64)  # in a narrow type, sums would begin anew
    if lengths.min() < 1 or int(lengths.max()) > LARGEST:
        raise UserError(f"{path}: lengths reach {lengths.max()}, which is more than an archive holds; write it again")
    after, before = np.cumsum(lengths + 1)[:-1], np.cumsum(lengths)[:-1]
    totals = {"observations": (after, 1), "achieved_goals": (after, 1), "states": (after, 1), "actions": (before, 0), "rewards": (before, 0)}
    split = {}
    for name, (places, more) in totals.items():
        if name in arrays:
            dims = 1 if name == "rewards" else 2
            _check(path, name, arrays[name], int((lengths + more).sum()), dims)
            split[name] = np.split(arrays[name], places)
    for name, dims in (("desired_goals", 2), ("terminated", 1)):
        if name in arrays:
            _check(path, name, arrays[name], len(lengths), dims)
    names = about.get("names") or [f"demo_{n}" for n in range(len(lengths))]
    if len(names) != len(lengths):
        raise UserError(f"{path}: about names {len(names)} demonstrations, but lengths has {len(lengths)}; write it again, or leave the names out")
    if "format_version" in about:
        try:
            return _recording(arrays, split, about, names)
        except (KeyError, IndexError, TypeError, AttributeError) as error:
            raise UserError(f"{path}: is damaged, or of another version of hindrl_jax ({one_line(error)}); write it again") from error
    return _foreign(path, arrays, split, about, names)


def _about(path: Path, arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    try:
        about = json.loads(str(arrays.pop("about", "{}")))
    except (ValueError, RecursionError):
        about = None
    if not isinstance(about, dict):
        raise UserError(f"{path}: the array about is not the text of a JSON object; write it again, or leave it out")
    names = about.get("names") or []
    if not (isinstance(names, list) and all(isinstance(name, str) for name in names) and len({*names}) == len(names)):
        raise UserError(f"{path}: names in about is no list of different texts; write it again, or leave it out")
    for name, kind, noun in (("env_kwargs", dict, "object"), ("env_name", str, "text")):
        if not isinstance(about.get(name) or kind(), kind):
            raise UserError(f"{path}: {name} in about is no {noun}; write it again, or leave it out")
    return about


def _check(path: Path, name: str, array: np.ndarray, num_rows: int, dims: int) -> None:
    if array.ndim != dims or len(array) != num_rows:
        wanted = f"({num_rows},)" if dims == 1 else f"({num_rows}, any)"
        raise UserError(f"{path}: {name} has shape {array.shape}, expected {wanted} by its lengths; write it again")
    if array.dtype.kind not in "biuf" or (name in ("desired_goals", "terminated") and not np.isfinite(array).all()):
        raise UserError(f"{path}: {name} does not hold finite numbers only; write it again")


def _recording(arrays: dict[str, np.ndarray], split: dict[str, list[np.ndarray]], about: dict[str, Any], names: list[str]) -> Recording:
    extras = {name.removeprefix("extra/"): array for name, array in arrays.items() if name.startswith("extra/")}
    demos = tuple(
        Demonstration(
            name=name,
            observations=split["observations"][n],
            achieved_goals=split["achieved_goals"][n],
            desired_goal=arrays["desired_goals"][n],
            actions=split["actions"][n],
            rewards=split["rewards"][n],
            terminated=bool(arrays["terminated"][n]),
            states=split["states"][n] if "states" in split else None,
            extras={key.removeprefix(f"data/{name}/"): array for key, array in extras.items() if key.startswith(f"data/{name}/")},
            attributes=about["demonstration_attributes"][n],
        )
        for n, name in enumerate(names)
    )
    return Recording(
        env_name=about["env_name"],
        env_kwargs=about["env_kwargs"],
        expert=about["expert"],
        demonstrations=demos,
        converted_from=about["converted_from"],
        extras={name: array for name, array in extras.items() if not name.startswith(tuple(f"data/{demo}/" for demo in names))},
        attributes=about["attributes"],
        file_attributes=about.get("file_attributes", {}),
    )


def _foreign(
    path: Path, arrays: dict[str, np.ndarray], split: dict[str, list[np.ndarray]], about: dict[str, Any], names: list[str]
) -> ForeignRecording:
    lengths = arrays["lengths"]
    terminated = arrays.get("terminated", np.ones(len(lengths), bool))
    demos = []
    for n, length in enumerate(lengths.tolist()):
        modalities = {"observation": split["observations"][n]}
        if "achieved_goals" in split:
            modalities["achieved_goal"] = split["achieved_goals"][n]
        if "desired_goals" in arrays:
            modalities["desired_goal"] = np.repeat(arrays["desired_goals"][n : n + 1], length + 1, axis=0)
        demos.append(
            ForeignDemonstration(
                name=names[n],
                modalities=modalities,
                actions=split["actions"][n],
                rewards=split["rewards"][n] if "rewards" in split else None,
                dones=(np.arange(length) == length - 1) * terminated[n],
                states=split["states"][n] if "states" in split else None,
            )
        )
    return ForeignRecording(
        source=f"{path}",
        format="npz",
        env_name=str(about.get("env_name", "unknown")),
        env_kwargs=dict(about.get("env_kwargs") or {}),
        expert=about.get("expert"),
        demonstrations=tuple(demos),
    )
