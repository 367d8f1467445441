"""A run's directory: what it was asked to do, how it went, and the policies that came of it.

    config.json       everything needed to run it again (`hindrl train --config`)
    metrics.csv       a row per evaluation and seed, written as the run goes
    summary.json      the outcome per seed and the totals
    parameters.npz    networks and behavioural goals, leading axis the seeds; no pickle
    curve.png, episode.gif
    checkpoint/       while it is under way, or if it was stopped: what it needs to go on

Each file is written whole or not at all, metrics.csv row by row.
"""

from __future__ import annotations

import contextlib
import csv
import dataclasses
import json
import os
import re
import resource
import shutil
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args, get_type_hints

import filelock
import jax
import jax.numpy as jnp
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict

from experts.recording import on_host, player
from hindrl_jax import host, plots, rollout
from hindrl_jax import train as training
from hindrl_jax.agent import InputScale
from hindrl_jax.config import TrainConfig, with_values
from hindrl_jax.datasets import DAMAGED_ARCHIVE, read_arrays, why_unwritable
from hindrl_jax.devices import seed_mesh
from hindrl_jax.errors import UserError, one_line
from hindrl_jax.experiment import Result, Row
from hindrl_jax.films import check_film, save_film, save_pictures
from hindrl_jax.from_gymnasium import Simulators, is_gymnasium
from hindrl_jax.goals import GoalTable, sample_goals
from hindrl_jax.registry import checked, did_you_mean, full_name, make, viewer
from hindrl_jax.types import Episodes, RestorableEnvironment, action_to_env, compiler_options

if TYPE_CHECKING:
    from hindrl_jax.reporters import Reporter

CONFIG, METRICS, SUMMARY, PARAMETERS = "config.json", "metrics.csv", "summary.json", "parameters.npz"
CURVE, EPISODE = "curve.png", "episode.gif"
CHECKPOINTS, LOCK = "checkpoint", ".lock"
SWEEP_SETTINGS, SWEEP, SWEEP_CURVES = "sweep.json", "sweep.csv", "sweep.png"
FROM_PYTHON = "given from Python"
_FILES = (CONFIG, METRICS, SUMMARY, PARAMETERS, CURVE, EPISODE)
_ROW_FIELDS = [field.name for field in dataclasses.fields(Row) if field.name != "metrics"]


@dataclasses.dataclass(frozen=True)
class RunSpec:
    """Everything that a run was asked to do."""

    env: RestorableEnvironment
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
            "config": dataclasses.asdict(self.config),
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
        if not isinstance(env_args, dict):
            raise UserError(f"{where}: env_args = {env_args!r} is not usable: it must be an object of the environment's arguments")
        if not (isinstance(seeds, list) and seeds and all(type(seed) is int and 0 <= seed < 2**32 for seed in seeds)):
            raise UserError(f"{where}: seeds = {seeds!r} is not usable: it must be a list of whole numbers from 0 to {2**32 - 1}")
        return RunSpec(
            env=make(str(data["env"]), **env_args),
            config=_config_from_dict(TrainConfig, data["config"], where),
            demos=str(data["demos"]),
            seeds=tuple(seeds),
        )


def read_spec(path: Path) -> RunSpec:
    """Reads a run's `config.json`; `path` is the file or the run's directory.

    Raises:
      UserError: if it is not there or not usable.
    """
    path = path / CONFIG if path.is_dir() else path
    try:
        data = json.loads(path.read_text())
    except FileNotFoundError:
        raise UserError(f"{path} does not exist: give the directory of a run, or its {CONFIG}") from None
    except (OSError, UnicodeDecodeError, ValueError) as error:
        raise UserError(f"{path} cannot be read as JSON ({one_line(error)}): use a {CONFIG} that `hindrl train` wrote") from error
    return RunSpec.from_json(data, path)


def _config_from_dict(config_class: type[Any], data: Any, where: Path) -> Any:
    if not isinstance(data, dict):
        raise UserError(f"{where}: {config_class.__name__} is {data!r}, not an object of fields")
    hints = get_type_hints(config_class)
    _refuse_unknown(data, hints, where)
    values = {}
    for name, value in data.items():
        if dataclasses.is_dataclass(hints[name]):
            values[name] = _config_from_dict(hints[name], value, where)
        else:
            values[name] = _tuples(value) if get_args(hints[name]) else value
    try:
        return config_class(**values)
    except ValueError as error:
        raise UserError(f"{where}: {error}") from error


def _tuples(value: Any) -> Any:
    """JSON's lists, also those within lists, as the tuples that they were."""
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


def _refuse_unknown(data: dict[str, Any], known: Any, where: Path) -> None:
    for name in data:
        if name not in known:
            raise UserError(f"{where} has an unknown field {name!r}{did_you_mean(name, known)}; it may have {', '.join(known)}")


class RunWriter:
    """Writes a run's directory, file by file, as the run goes. Use `save_run` for a run that is already finished."""

    def __init__(self, path: Path, spec: RunSpec, *, overwrite: bool = False, resume: bool = False, reporters: Sequence[type[Reporter]] = ()):
        """Only checks; nothing is written or removed before `start`.

        Args:
          path: the directory.
          spec: what the run is asked to do.
          overwrite: replace a run that is there.
          resume: go on with the run that is there; its checkpoints are kept.
          reporters: kinds of reporters to tell everything.

        Raises:
          UserError: if the path is a file, cannot be written, is written by another process, or holds (part of) a run and neither
            `overwrite` nor `resume` is on; or if a reporter lacks something.
        """
        self.path, self.spec, self.resume = path, spec, resume
        self._lock = filelock.FileLock(path / LOCK, timeout=0)
        if path.exists() and not path.is_dir():
            raise UserError(f"{path} is a file: choose another --out")
        there = [name for name in (*_FILES, CHECKPOINTS) if (path / name).exists()]
        if there and not (overwrite or resume):
            raise UserError(f"{path} already holds a run ({', '.join(there)}): choose another --out, or replace it with --overwrite")
        reason = why_unwritable(path)
        if reason:
            raise UserError(f"cannot write {path} ({reason}): choose another --out")
        if (path / LOCK).exists():
            self._take_lock()
            self._lock.release()
        self.reporters = [kind(path) for kind in reporters]
        self.rows_written = 0
        self.started = False
        self.runs = [self]

    def _take_lock(self) -> None:
        """Keeps other processes out until `close`, or until this one ends, however it ends."""
        try:
            self._lock.acquire()
        except filelock.Timeout:
            raise UserError(f"another process is writing {self.path}: wait for it, stop it, or choose another --out") from None

    def start(self) -> None:
        """Removes what an earlier run left, or what this one left after its last checkpoint, then writes the configuration.

        Raises:
          UserError: if the directory cannot be written, or another process writes it.
        """
        with disk_trouble(self.path):
            self.path.mkdir(parents=True, exist_ok=True)
            self._take_lock()
            for reporter in self.reporters:  # before anything is removed, since they have the most reasons not to start
                reporter.start(self.spec)
            for name in _FILES:
                (self.path / name).unlink(missing_ok=True)
            if not self.resume:
                shutil.rmtree(self.path / CHECKPOINTS, ignore_errors=True)
            _write_atomically(self.path / CONFIG, json.dumps(self.spec.to_json(), indent=2) + "\n")
        self.started = True

    def report(self, rows: list[Row]) -> None:
        """Appends to `metrics.csv` those of the run's evaluations so far that are new since the last call."""
        for reporter in self.reporters:
            reporter.report(rows)
        rows = rows[self.rows_written :]
        if not rows:
            return
        fields = [*_ROW_FIELDS, *rows[0].metrics]
        with disk_trouble(self.path), (self.path / METRICS).open("a", newline="") as file:
            writer = csv.DictWriter(file, fields)
            if self.rows_written == 0:
                writer.writeheader()
            for row in rows:
                values = {name: getattr(row, name) for name in _ROW_FIELDS} | row.metrics
                writer.writerow({name: f"{value:.6g}" if isinstance(value, float) else value for name, value in values.items()})
        self.rows_written += len(rows)

    def finish(self, result: Result, *, film: bool = True) -> dict[str, Any]:
        """Writes the parameters, the summary, the curve and (unless `film` is off) the film of an episode; returns the summary.

        A film that cannot be drawn, for want of OpenGL, is a warning: the run is worth more. A task without a viewer has no film.
        """
        self.report(result.rows)
        summary = summarise(result)
        with disk_trouble(self.path):
            _save_parameters(self.path / PARAMETERS, result)
            _write_atomically(self.path / SUMMARY, json.dumps(summary, indent=2) + "\n")
            plots.save_curve(result, self.path / CURVE)
        for reporter in self.reporters:
            reporter.finish(result.summaries())
        if film:
            try:
                run = load_run(self.path)
                if is_gymnasium(run.spec.env) or viewer(run.spec.env) is not None:
                    run.render(self.path / EPISODE)
            except UserError as error:
                warnings.warn(f"no {EPISODE}: {error}", stacklevel=2)
        shutil.rmtree(self.path / CHECKPOINTS, ignore_errors=True)  # last, so that a process killed on the way here can be resumed
        self.close()
        return summary

    def close(self) -> None:
        """Lets other processes write the directory. `finish` does it, too."""
        if self._lock.is_locked:
            (self.path / LOCK).unlink(missing_ok=True)
            self._lock.release()

    def files(self) -> list[str]:
        """Names of what has been written."""
        names = [*_FILES, *(reporter.folder for reporter in self.reporters)]
        return [name for name in names if (self.path / name).exists()]


class SweepWriter:
    """Writes a sweep: a run's directory for each setting, `sweep.csv` with a row for each, and their curves in `sweep.png`.

    `sweep.json` lists the settings, in order; checkpoints are those of the whole sweep.
    """

    def __init__(
        self,
        path: Path,
        spec: RunSpec,
        settings: list[dict[str, float]],
        *,
        overwrite: bool = False,
        resume: bool = False,
        reporters: Sequence[type[Reporter]] = (),
    ):
        """Only checks, as `RunWriter` does; `settings` are the swept fields and their values, in order of the runs.

        Raises:
          ValueError: if a config refuses a value.
          UserError: if the path holds something else, or a sweep and neither `overwrite` nor `resume` is on, or cannot be written.
        """
        self.path, self.settings, self.resume = path, settings, resume
        there = [name for name in (*_FILES, SWEEP_SETTINGS, SWEEP, SWEEP_CURVES) if (path / name).exists()]
        if there and not ((overwrite or resume) and SWEEP_SETTINGS in there):
            raise UserError(f"{path} already holds {', '.join(there)}: choose another --out, or replace a sweep with --overwrite")
        specs = [dataclasses.replace(spec, config=with_values(spec.config, setting)) for setting in settings]
        choices: dict[str, Any] = dict(overwrite=overwrite, resume=resume, reporters=reporters)
        self.runs = [RunWriter(path / _setting_folder(setting), spec, **choices) for setting, spec in zip(settings, specs, strict=True)]

    @property
    def started(self) -> bool:
        """Whether `start` was called."""
        return self.runs[-1].started

    def start(self) -> None:
        """Starts the run of each setting.

        Raises:
          UserError: if the directory cannot be written, or another process writes it.
        """
        for run in self.runs:
            run.start()
        with disk_trouble(self.path):
            for name in (SWEEP, SWEEP_CURVES):
                (self.path / name).unlink(missing_ok=True)
            if not self.resume:
                shutil.rmtree(self.path / CHECKPOINTS, ignore_errors=True)
            _write_atomically(self.path / SWEEP_SETTINGS, json.dumps(self.settings, indent=2) + "\n")

    def finish(self, result: Result) -> list[dict[str, Any]]:
        """Finishes the run of each setting, then writes the table and the picture; returns the rows of the table.

        The median is over the seeds that reached 95%, None if none did; in environment steps, for bc in updates.
        """
        num_seeds = len(result.seeds) // len(self.runs)
        guidance, agent = jax.device_get((result.guidance, result.state.agent))  # once, not for each part
        result = dataclasses.replace(result, guidance=guidance, state=result.state.replace(agent=agent))
        parts = [result.part(slice(index * num_seeds, (index + 1) * num_seeds)) for index in range(len(self.runs))]
        unit = "updates" if result.config.algo == "bc" else "env_steps"
        table = []
        for setting, writer, part in zip(self.settings, self.runs, parts, strict=True):
            seeds = writer.finish(part, film=False)["seeds"]
            final = [seed["final_success"] for seed in seeds]
            steps = [seed[f"{unit}_to_95"] for seed in seeds if seed[f"{unit}_to_95"] is not None]
            outcome = {
                "seeds": num_seeds,
                "seeds_reaching_95": len(steps),
                f"median_{unit.removeprefix('env_')}_to_95": float(np.median(steps)) if steps else None,
                "mean_final_success": float(np.mean(final)),
                "worst_final_success": min(final),
            }
            table.append(setting | outcome)
        with disk_trouble(self.path):
            with (self.path / SWEEP).open("w", newline="") as file:
                rows = csv.DictWriter(file, list(table[0]))
                rows.writeheader()
                rows.writerows(table)
            plots.save_sweep(parts, [writer.path.name for writer in self.runs], self.path / SWEEP_CURVES)
        shutil.rmtree(self.path / CHECKPOINTS, ignore_errors=True)
        return table

    def close(self) -> None:
        """Lets other processes write the directories of the settings. `finish` does it, too."""
        for run in self.runs:
            run.close()


def _setting_folder(setting: dict[str, float]) -> str:
    return ",".join(f"{name}={value!r}" for name, value in setting.items())


def read_sweep(path: Path) -> tuple[RunSpec, list[dict[str, float]]]:
    """What a sweep was asked to do, and its settings in order.

    Raises:
      UserError: if the directory does not hold one.
    """
    file = path / SWEEP_SETTINGS
    try:
        settings = json.loads(file.read_text())
        spec = read_spec(path / _setting_folder(settings[0]))
        for setting in settings:
            with_values(spec.config, setting)
    except UserError:
        raise
    except (OSError, UnicodeDecodeError, ValueError, KeyError, IndexError, TypeError, AttributeError) as error:
        raise UserError(f"{file} does not tell the settings of a sweep ({one_line(error)}): start the sweep again") from error
    return spec, settings


def save_run(path: str | os.PathLike[str], result: Result, *, demos: str = FROM_PYTHON, overwrite: bool = False) -> dict[str, Any]:
    """Writes a finished experiment as a run directory, as `hindrl train` does; returns the summary.

    Args:
      path: the directory.
      result: from `fit`.
      demos: where the demonstrations came from, a number or a path; needed only to run it again with `hindrl train --config`.
      overwrite: replace a run that is there.

    Raises:
      UserError: if the directory already holds a run and `overwrite` is off, or cannot be written, or the result has several configs.
    """
    if len(set(result.configs)) > 1:
        raise UserError("the runs of this result have different configs: save each config's own, for example result.part(slice(0, 8))")
    writer = RunWriter(Path(path), RunSpec(env=result.env, config=result.config, demos=demos, seeds=result.seeds), overwrite=overwrite)
    writer.start()
    return writer.finish(result)


def summarise(result: Result) -> dict[str, Any]:
    """The contents of `summary.json`. Rates are those of the result's own seeds; other settings of a sweep ran beside them in the same time."""
    seconds, num_seeds = result.train_seconds, len(result.seeds)
    return {
        "seeds": [dataclasses.asdict(seed) for seed in result.summaries()],
        "updates_per_second": num_seeds * result.updates / seconds,
        "env_steps_per_second": num_seeds * result.env_steps / seconds,
        "compile_seconds": result.compile_seconds,
        "train_seconds": seconds,
        "peak_memory_bytes": peak_memory_bytes(),
    }


def peak_memory_bytes() -> int:
    """Largest resident memory of this process so far."""
    status = Path("/proc/self/status")
    if status.exists():  # on Linux, since getrusage there also counts the process that this one was started from
        found = re.search(r"VmHWM:\s*(\d+) kB", status.read_text())
        if found:
            return int(found[1]) * 1024
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


@dataclasses.dataclass(frozen=True)
class Run:
    """A finished run, read back from its directory."""

    path: Path
    spec: RunSpec
    policies: Any
    """Parameters of the policies, leaves (S, ...)."""
    behavioural_goals: GoalTable
    """Leaves (S, ...)."""
    scale: InputScale
    """Leaves (S, ...)."""

    def in_backend(self, backend: str) -> Run:
        """The same policies, with the task simulated by another back end.

        Raises:
          UserError: if the task has no such back end.
        """
        env = self.spec.env
        if not hasattr(env, "backend"):
            raise UserError(f"{env.name} has one back end only: drop the choice of {backend!r}")
        return dataclasses.replace(self, spec=dataclasses.replace(self.spec, env=checked(lambda: dataclasses.replace(env, backend=backend))))

    def evaluate(
        self,
        *,
        episodes: int = 100,
        key: jax.Array | None = None,
        stochastic: bool = False,
        report: Callable[[int], None] = lambda played: None,
    ) -> list[dict[str, float]]:
        """Plays fresh episodes with each seed's policy: a list of {seed, success, episode_length}, in order of the seeds.

        Args:
          episodes: how many, per seed.
          key: which.
          stochastic: sample the actions.
          report: called with the number of episodes played so far, all seeds together, where they are played one by one: in robosuite.
        """
        keys = jax.random.split(jax.random.key(0) if key is None else key, len(self.spec.seeds))
        if is_gymnasium(self.spec.env):
            result = self._play_in_gymnasium(keys, episodes, stochastic=stochastic)
        elif on_host(self.spec.env):
            result = self._play_one_by_one(keys, episodes, stochastic=stochastic, report=report)
        else:
            result = self._play_side_by_side(keys, episodes, stochastic=stochastic)
        return [
            {"seed": seed, "success": float(result.success[i].mean()), "episode_length": float(result.length[i].mean())}
            for i, seed in enumerate(self.spec.seeds)
        ]

    def _play_side_by_side(self, keys: jax.Array, episodes: int, *, stochastic: bool) -> rollout.Evaluation:
        """All episodes of all seeds in one compiled program; leaves (S, episodes)."""
        env, config = self.spec.env, self.spec.config

        @jax.vmap
        def play_episodes(key: jax.Array, actor: Any, goals: GoalTable, scale: InputScale) -> rollout.Evaluation:
            return rollout.evaluate(key, env, goals, training.make_policy(actor, scale, env, config, stochastic=stochastic), episodes)

        program = jax.jit(play_episodes, compiler_options=compiler_options(env))
        return jax.device_get(program(keys, self.policies, self.behavioural_goals, self.scale))

    def _play_in_gymnasium(self, keys: jax.Array, episodes: int, *, stochastic: bool) -> rollout.Evaluation:
        """Episodes of all seeds side by side, up to `num_envs` for each; leaves (S, episodes)."""
        num_seeds = len(self.spec.seeds)
        env: Any = self.spec.env
        policies = host.Policies(env, self.spec.config, seed_mesh(num_seeds), stochastic=stochastic)
        with contextlib.closing(Simulators(env, num_seeds * min(self.spec.config.num_envs, episodes))) as simulators:
            return host.evaluate(keys, simulators, policies, self.policies, self.scale, episodes)

    def _play_one_by_one(self, keys: jax.Array, episodes: int, *, stochastic: bool, report: Callable[[int], None]) -> rollout.Evaluation:
        """One episode after the other; leaves (S, episodes)."""
        success: Any = np.zeros((len(keys), episodes), bool)
        length: Any = np.zeros((len(keys), episodes), np.int32)
        for i, key in enumerate(keys):
            play_episode = player(self.spec.env, self._act(i, stochastic=stochastic, any_goal=True), 1)
            for n, key_episode in enumerate(jax.random.split(key, episodes)):
                outcome = play_episode(key_episode)
                success[i, n], length[i, n] = outcome.terminated[0], outcome.lengths[0]
                report(i * episodes + n + 1)
        return rollout.Evaluation(success=success, length=length)

    def _act(self, index: int, *, stochastic: bool, any_goal: bool) -> Callable[[jax.Array, Any, jax.Array], jax.Array]:
        """The policy of one seed, for `player`. It aims at the first behavioural goal, or with `any_goal` at one drawn for the episode."""
        env = self.spec.env
        actor, goals, scale = jax.tree.map(lambda leaf: leaf[index], (self.policies, self.behavioural_goals, self.scale))
        policy = training.make_policy(actor, scale, env, self.spec.config, stochastic=stochastic)

        def act(key: jax.Array, state: Any, observation: jax.Array) -> jax.Array:
            # The state's key is constant within an episode, and so is the goal drawn with it.
            goal = sample_goals(jax.random.fold_in(state.key, 0), goals, 1) if any_goal else goals.goals[:1]
            return action_to_env(policy(key, observation[None], goal)[0], env)

        return act

    def render(self, path: Path, *, seed: int | None = None, key: jax.Array | None = None, stochastic: bool = False) -> int:
        """Films fresh episodes of one seed's policy (the first seed's by default); returns how many of them solved the task.

        Args:
          path: a .gif or .mp4 file, or a .png file for the last state alone.
          seed: one of the run's seeds.
          key: which episode, or (N,) keys of N episodes to be shown one after the other.
          stochastic: sample the actions.

        Raises:
          UserError: if the run has no such seed, or the film cannot be drawn.
        """
        env = self.spec.env
        keys = jnp.atleast_1d(jax.random.key(0) if key is None else key)
        check_film(path, len(keys))
        index = self._index_of(seed)
        if is_gymnasium(env):
            return self._film(path, index, keys, stochastic=stochastic)
        play_episode = player(env, self._act(index, stochastic=stochastic, any_goal=False), 1)
        played = [jax.device_get(play_episode(key_episode)) for key_episode in keys]
        draw_episodes(path, env, [episodes.states[0, : int(episodes.lengths[0]) + 1] for episodes in played])
        return sum(bool(episodes.terminated[0]) for episodes in played)

    def _film(self, path: Path, index: int, keys: jax.Array, *, stochastic: bool) -> int:
        """`render` of an environment of Gymnasium, which draws itself."""
        env: Any = self.spec.env
        actor, scale = jax.tree.map(lambda leaf: leaf[index : index + 1], (self.policies, self.scale))
        policies = host.Policies(env, self.spec.config, seed_mesh(1), stochastic=stochastic)
        pictures, num_solved = [], 0
        for key in keys:
            key_seed, key_act = jax.random.split(key)
            episode, solved = host.film(env, int(jax.random.bits(key_seed)), policies.acting(key_act[None], actor, scale))
            pictures += episode
            num_solved += solved
        with disk_trouble(path):
            save_pictures(pictures, [1.0 / env.description.render_fps] * len(pictures), path)
        return num_solved

    def play(self, episodes: int = 1, *, seed: int | None = None, key: jax.Array | None = None, stochastic: bool = False) -> Episodes:
        """Plays fresh episodes with one seed's policy (the first seed's by default), to be looked at step by step; solved or not.

        The policy aims at the first behavioural goal, the end of the first demonstration.

        Args:
          episodes: N, how many.
          seed: one of the run's seeds.
          key: which.
          stochastic: sample the actions.

        Returns:
          A table of N episodes with their states, repeated after the end.

        Raises:
          UserError: if the run has no such seed.
        """
        act = self._act(self._index_of(seed), stochastic=stochastic, any_goal=False)
        return player(self.spec.env, act, episodes)(jax.random.key(0) if key is None else key)

    def _index_of(self, seed: int | None) -> int:
        """Where a seed, the first one by default, stands among those of the run."""
        seed = self.spec.seeds[0] if seed is None else seed
        if seed not in self.spec.seeds:
            raise UserError(f"{self.path} has no seed {seed}: choose one of {', '.join(map(str, self.spec.seeds))}")
        return self.spec.seeds.index(seed)


def draw_episodes(path: Path, env: RestorableEnvironment, episodes: Sequence[np.ndarray]) -> None:
    """Draws episodes from their states (length + 1, S each): a film of them, one after the other, or as a PNG the last state.

    Raises:
      UserError: for another kind of file, a place that cannot be written, states of another environment, or one that nothing draws.
    """
    check_film(path, len(episodes))
    if is_gymnasium(env):
        raise UserError(f"demonstrations of {env.name} hold no states, so they cannot be drawn; `hindrl render` films the policies of a run")
    for states in episodes:
        if states.shape[-1] != env.state_dim:
            raise UserError(f"states of {states.shape[-1]} numbers are not those of {env.name}, which has {env.state_dim}: record them again")
    key = jax.random.key(0)
    unpacked = [[env.vector_to_state(key, jnp.asarray(state)) for state in states] for states in episodes]
    with disk_trouble(path):
        save_film(env, unpacked, path)


@contextlib.contextmanager
def disk_trouble(path: Path) -> Iterator[None]:
    """Turns what the disk refuses into one line for the user."""
    try:
        yield
    except OSError as error:
        raise UserError(f"cannot write {path} ({error.strerror or error}): free some space or choose another place") from error


def load_run(path: str | os.PathLike[str]) -> Run:
    """Reads a run's directory.

    Raises:
      UserError: if it is not the directory of a finished run.
    """
    path = Path(path)
    spec = read_spec(path)
    file = path / PARAMETERS
    if not file.exists():
        raise UserError(f"{path} holds no {PARAMETERS}: the run did not finish; go on with it by `hindrl train --resume {path}`")
    try:
        tree = unflatten_dict({name: jnp.asarray(array) for name, array in read_arrays(file).items()}, sep="/")
        goals = GoalTable(goals=tree["behavioural_goals"]["goals"], count=tree["behavioural_goals"]["count"])
        scale = _input_scale(tree["input_scale"])
        policies = tree["policy"]
    except DAMAGED_ARCHIVE as error:
        raise UserError(f"{file} is damaged ({one_line(error)}): train again") from error
    return Run(path=path, spec=spec, policies=policies, behavioural_goals=goals, scale=scale)


def _input_scale(saved: dict[str, jax.Array]) -> InputScale:
    """The scale as it was saved. Runs from before inputs had a centre have theirs at 0."""
    observation, goal = saved["observation"], saved["goal"]
    centres = [saved.get(f"{name}_centre", jnp.zeros_like(saved[name])) for name in ("observation", "goal")]
    return InputScale(observation=observation, goal=goal, observation_centre=centres[0], goal_centre=centres[1])


def _save_parameters(path: Path, result: Result) -> None:
    agent, goals, scale = result.state.agent, result.guidance.behavioural_goals, result.guidance.scale
    tree = {
        "policy": agent.average_actor,
        "actor": agent.actor,
        "critics": agent.critics,
        "log_alpha": agent.log_alpha,
        "epsilon": result.guidance.epsilon,
        "behavioural_goals": {"goals": goals.goals, "count": goals.count},
        "input_scale": {field.name: getattr(scale, field.name) for field in dataclasses.fields(scale)},
    }
    temporary = path.with_suffix(".partial.npz")
    arrays: dict[str, Any] = {name: np.asarray(leaf) for name, leaf in flatten_dict(tree, sep="/").items()}
    np.savez(temporary, **arrays)
    os.replace(temporary, path)


def _write_atomically(path: Path, text: str) -> None:
    temporary = path.with_suffix(path.suffix + ".partial")
    temporary.write_text(text)
    os.replace(temporary, path)
