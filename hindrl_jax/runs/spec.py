"""A run's directory and what its run was asked to do.

    config.json       everything needed to run it again (`hindrl train --config`)
    metrics.csv       a row per evaluation and seed, written as the run goes
    summary.json      the outcome per seed and the totals
    parameters.npz    networks and behavioural goals, leading axis the seeds; no pickle
    curve.png, episode.gif
    films/            with --render-every, episodes along the run
    checkpoint/       while it is under way, or if it was stopped: what it needs to go on

Each file is written whole or not at all, metrics.csv row by row.
"""

from __future__ import annotations

import dataclasses
import json
import os
from pathlib import Path
from typing import Any, get_args, get_type_hints

from hindrl_jax.base.environments import Environment
from hindrl_jax.base.errors import UserError, one_line
from hindrl_jax.config import TrainConfig
from hindrl_jax.tasks.functions import find_function, function_name, is_found_again, is_function
from hindrl_jax.tasks.registry import did_you_mean, full_name, make
from hindrl_jax.training.result import Row

CONFIG, METRICS, SUMMARY, PARAMETERS = "config.json", "metrics.csv", "summary.json", "parameters.npz"
CURVE, EPISODE, FILMS = "curve.png", "episode.gif", "films"
CHECKPOINTS, LOCK = "checkpoint", ".lock"
SWEEP_SETTINGS, SWEEP, SWEEP_CURVES = "sweep.json", "sweep.csv", "sweep.png"
FROM_PYTHON = "given from Python"
RUN_FILES = (CONFIG, METRICS, SUMMARY, PARAMETERS, CURVE, EPISODE)
ROW_FIELDS = [field.name for field in dataclasses.fields(Row) if field.name != "metrics"]


@dataclasses.dataclass(frozen=True)
class RunSpec:
    """Everything that a run was asked to do."""

    env: Environment
    config: TrainConfig
    demos: str
    """A number of demonstrations to record for each seed, or the path of a file."""
    seeds: tuple[int, ...]

    def to_json(self) -> dict[str, Any]:
        """Plain data for `config.json`."""
        return {
            "env": full_name(self.env),
            "env_args": dataclasses.asdict(self.env),
            "demos": self.demos,
            "seeds": list(self.seeds),
            "config": _with_names(dataclasses.asdict(self.config)),
        }

    @staticmethod
    def from_json(data: Any, where: Path) -> RunSpec:
        """The inverse of `to_json`.

        Raises:
          UserError: naming the file and the first field that is missing, unknown or unusable.
        """
        known = ("env", "env_args", "demos", "seeds", "config")
        if not isinstance(data, dict):
            raise UserError(f"{where} does not hold a run's configuration: use a config.json that `hindrl train` wrote")
        _refuse_unknown(data, known, where)
        for name in known:
            if name not in data:
                raise UserError(f"{where} lacks {name!r}: use a config.json that `hindrl train` wrote")
        seeds, env_args = data["seeds"], data["env_args"]
        for name in ("env", "demos"):
            if not isinstance(data[name], str):
                raise UserError(f"{where}: {name} = {data[name]!r} is not usable: it must be a text")
        if not isinstance(env_args, dict):
            raise UserError(f"{where}: env_args = {env_args!r} is not usable: it must be an object of the environment's arguments")
        if not (isinstance(seeds, list) and seeds and all(type(seed) is int and 0 <= seed < 2**32 for seed in seeds)):
            raise UserError(f"{where}: seeds = {seeds!r} is not usable: it must be a list of whole numbers from 0 to {2**32 - 1}")
        fields = data["config"]
        if isinstance(fields, dict) and fields.get("imitation_proposal") == 0:  # a number of steps, before it was a switch
            fields = fields | {"imitation_proposal": False}
        env, config = make(data["env"], **env_args), _config_from_dict(TrainConfig, fields, "config", where)
        if config.own_goals and hasattr(env, "success") and "success" not in env_args:
            raise UserError(
                f"{where} is of a version in which networks saw goals otherwise and episodes ended at them, so its policies would be misread: train "
                f'again, from flags or with "success": "reached" among its env_args'
            )
        return RunSpec(env=env, config=config, demos=data["demos"], seeds=tuple(seeds))


def read_spec(path: Path) -> RunSpec:
    """Reads a run's `config.json`; `path` is the file or the run's directory.

    Raises:
      UserError: if it is not there or not usable.
    """
    path = path / CONFIG if os.path.isdir(path) else path
    if not os.path.exists(path):
        raise UserError(f"{path} does not exist: give the directory of a run, or its {CONFIG}")
    try:
        data = json.loads(path.read_text())
    except (OSError, UnicodeDecodeError, ValueError, RecursionError) as error:
        raise UserError(f"{path} cannot be read as JSON ({one_line(error)}): use a {CONFIG} that `hindrl train` wrote") from error
    return RunSpec.from_json(data, path)


def _config_from_dict(config_class: type[Any], data: Any, name: str, where: Path) -> Any:
    if not isinstance(data, dict):
        raise UserError(f"{where}: {name} = {data!r} is not usable: it must be an object of fields")
    hints = get_type_hints(config_class)
    _refuse_unknown(data, hints, where)
    values = {}
    for field, value in data.items():
        if dataclasses.is_dataclass(hints[field]):
            values[field] = _config_from_dict(hints[field], value, field, where)
        elif is_function(hints[field]) and isinstance(value, str):
            values[field] = find_function(value)
        else:
            values[field] = _tuples(value) if get_args(hints[field]) else value
    try:
        return config_class(**values)
    except ValueError as error:
        raise UserError(f"{where}: {error}") from error


def lost_functions(config: TrainConfig) -> list[str]:
    """Names of the config's functions that cannot be found again when its run is read."""
    fields = {field.name: getattr(config.agent, field.name) for field in dataclasses.fields(config.agent)}
    return [name for name, value in fields.items() if callable(value) and not is_found_again(value)]


def _with_names(values: dict[str, Any]) -> dict[str, Any]:
    """The fields of a config and its sections, with names in place of functions."""
    plain = {name: _with_names(value) if isinstance(value, dict) else value for name, value in values.items()}
    return {name: function_name(value) if callable(value) else value for name, value in plain.items()}


def _tuples(value: Any) -> Any:
    """JSON's lists, also those within lists, as the tuples that they were."""
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


def _refuse_unknown(data: dict[str, Any], known: Any, where: Path) -> None:
    for name in data:
        if name not in known:
            raise UserError(f"{where} has an unknown field {name!r}{did_you_mean(name, known)}; it may have {', '.join(known)}")
