"""One episode of Minari as a demonstration, and back."""

from __future__ import annotations

import importlib
import json
from typing import Any

import numpy as np

from hindrl_jax.base.errors import UserError, one_line
from hindrl_jax.demonstrations.foreign import MINARI_OBSERVATIONS, SOURCE, ForeignDemonstration
from hindrl_jax.demonstrations.recording import Demonstration, plain

_INFOS, _TERMINATIONS, _TRUNCATIONS = "minari/infos/", "minari/terminations", "minari/truncations"
_SUCCESS = ("is_success", "success")  # what environments call it in their infos
_COMPUTED = ("id", "total_steps")  # what Minari itself writes about each episode


def as_demonstration(source: str, number: int, episode: Any, metadata: dict[str, Any], *, ours: bool) -> ForeignDemonstration:
    """An episode of a dataset, all of it among the extras if the dataset is not one that we wrote.

    Args:
      source: begins the messages.
      number: of the episode.
      episode: Minari's EpisodeData.
      metadata: what Minari knows about it.
      ours: whether we wrote the dataset.

    Raises:
      UserError: it holds what cannot be kept.
    """
    where = f"{source}: episode {number}"
    leaves = _leaves(episode.observations, "observation")
    length = len(episode.rewards)
    modalities = {
        key: rows[:, None] if rows.ndim == 1 else rows
        for key, rows in leaves.items()
        if isinstance(rows, np.ndarray) and rows.dtype.kind in "biuf" and 1 <= rows.ndim <= 2
    }
    infos = _leaves(episode.infos or {}, "")
    states = infos.get("state") if ours else None
    extras: dict[str, np.ndarray] = {}
    if not ours:
        extras = {"actions": episode.actions, "rewards": episode.rewards, _TERMINATIONS: episode.terminations}
        extras |= {MINARI_OBSERVATIONS + key: _storable(f"{where}: observations {key}", rows) for key, rows in leaves.items()} | {
            _INFOS + key: _storable(f"{where}: infos {key}", rows) for key, rows in infos.items()
        }
        if not np.array_equal(episode.truncations, _default_truncations(length, bool(episode.terminations[-1]))):
            extras[_TRUNCATIONS] = episode.truncations
    dones, problem = _dones(where, episode.terminations, infos)
    return ForeignDemonstration(
        name=f"demo_{number}",
        modalities=modalities,
        actions=episode.actions,
        rewards=episode.rewards,
        dones=dones,
        problems={} if problem is None else {"dones": problem},
        states=states,
        extras=extras,
        attributes={} if ours else {"minari": json.dumps({key: value for key, value in plain(metadata).items() if key not in _COMPUTED})},
    )


def _dones(where: str, terminations: np.ndarray, infos: dict[str, Any]) -> tuple[np.ndarray, str | None]:
    """(L,) bool, where the infos say success, if there are such infos, else where the episode terminated; and why they do not say it, if so.

    Infos have a row for each step, or, with that of the reset before them, for each state.
    """
    key = next((key for key in _SUCCESS if key in infos), None)
    if key is None:
        return terminations, None
    length, problem = len(terminations), f"{where}: the infos {key} do not say of each of its {len(terminations)} steps whether it solves the task"
    try:
        rows = np.asarray(infos[key], np.float64)
        rows = rows.reshape(len(rows), -1)
    except (TypeError, ValueError):
        return np.zeros(length), f"{problem}, since they are not numbers"
    if len(rows) not in (length, length + 1) or rows.shape[1] != 1 or not np.isfinite(rows).all():
        return np.zeros(length), f"{problem}, since they are an array of shape {np.shape(infos[key])}"
    return rows[-length:, 0] > 0.5, None


def _leaves(tree: Any, root: str) -> dict[str, Any]:
    """The arrays of nested dictionaries, by their path; `root` names a single array."""
    if not isinstance(tree, dict):
        return {root: tree}
    found: dict[str, Any] = {}
    for key, value in tree.items():
        found |= {f"{key}/{below}" if below else key: leaf for below, leaf in _leaves(value, "").items()}
    return found


def _storable(where: str, rows: Any) -> np.ndarray:
    """HDF5 has texts as bytes only.

    Raises:
      UserError: they are no array.
    """
    try:
        rows = np.asarray(rows)
        if rows.dtype.kind == "O" and not all(isinstance(row, str | bytes) for row in rows.reshape(-1)):
            raise ValueError("objects of other kinds than texts")
    except ValueError as error:
        raise UserError(f"{where} are no array of numbers or texts ({one_line(error)}), and cannot be kept; leave them out of the dataset") from error
    return np.char.encode(rows) if rows.dtype.kind == "U" else rows.astype("S") if rows.dtype.kind == "O" else rows


def _default_truncations(length: int, terminated: bool) -> np.ndarray:
    """An episode that does not terminate is truncated at its end."""
    return (np.arange(length) == length - 1) & (not terminated)


def as_episode(demo: Demonstration) -> Any:
    """Minari's EpisodeBuffer of a demonstration that is ours."""
    terminations = (np.arange(len(demo)) == len(demo) - 1) & demo.terminated
    return _buffer(
        observations=demo.observed,
        actions=demo.actions,
        rewards=demo.rewards,
        terminations=terminations,
        truncations=_default_truncations(len(demo), demo.terminated),
        infos=None if demo.states is None else {"state": demo.states},
    )


def as_source_episode(demo: Demonstration, observation_space: Any) -> Any:
    """Minari's EpisodeBuffer of a demonstration that was converted from Minari, as it was there."""
    extras, observed = demo.extras, demo.observed
    about = json.loads(demo.attributes["minari"])

    def observations(space: Any, path: str) -> Any:
        if hasattr(space, "spaces"):
            return {key: observations(below, f"{path}/{key}" if path else key) for key, below in space.spaces.items()}
        path = path or "observation"
        rows = extras.get(MINARI_OBSERVATIONS + path, observed.get(path))
        return rows.astype(str).tolist() if rows.dtype.kind == "S" else rows

    infos: dict[str, Any] = {}
    for key, rows in extras.items():
        if key.startswith(_INFOS):
            *groups, leaf = key.removeprefix(_INFOS).split("/")
            place = infos
            for group in groups:
                place = place.setdefault(group, {})
            place[leaf] = rows.astype(str).tolist() if rows.dtype.kind == "S" else rows
    terminations = extras[_TERMINATIONS]
    return _buffer(
        seed=about.get("seed"),
        options=about.get("options"),
        observations=observations(observation_space, ""),
        actions=extras.get(f"{SOURCE}actions", demo.actions),
        rewards=extras.get(f"{SOURCE}rewards", demo.rewards),
        terminations=terminations,
        truncations=extras.get(_TRUNCATIONS, _default_truncations(len(demo), bool(terminations[-1]))),
        infos=infos or None,
    )


def _buffer(**fields: Any) -> Any:
    return importlib.import_module("minari.data_collector.episode_buffer").EpisodeBuffer(**fields)


def source_metadata(demo: Demonstration) -> dict[str, Any]:
    """What Minari knew about an episode, beside what its buffer holds."""
    return {key: value for key, value in json.loads(demo.attributes["minari"]).items() if key not in ("seed", "options")}
