"""One training of `hindrl train` or `hindrl sweep`: what it is given, what is shown and kept on the way, and how it stops."""

from __future__ import annotations

import dataclasses
import math
import re
import shlex
import sys
import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from hindrl_jax import STARTED
from hindrl_jax.base.environments import can_step
from hindrl_jax.base.errors import UserError
from hindrl_jax.base.steppers import SimulationFailed
from hindrl_jax.base.types import Episodes
from hindrl_jax.cli.common import console, counted
from hindrl_jax.cli.signals import StopSignals
from hindrl_jax.cli.train_options import ResumeOptions, TrainOptions, is_number
from hindrl_jax.config import TrainConfig
from hindrl_jax.demonstrations.convert import load
from hindrl_jax.reporting.reporters import REPORTERS
from hindrl_jax.runs.checkpoints import Checkpoints
from hindrl_jax.runs.films import Films
from hindrl_jax.runs.reporter import Reporter
from hindrl_jax.runs.spec import CHECKPOINTS, FROM_PYTHON, RunSpec
from hindrl_jax.runs.sweep import SweepWriter
from hindrl_jax.runs.writer import RunWriter
from hindrl_jax.tasks.checking import check_environment
from hindrl_jax.tasks.registry import full_name
from hindrl_jax.training.checks import check_demonstrations, check_memory
from hindrl_jax.training.evaluating import Diverged
from hindrl_jax.training.experiment import fit
from hindrl_jax.training.progress import ProgressBar
from hindrl_jax.training.recording import record_demonstrations
from hindrl_jax.training.result import Result


def default_out(spec: RunSpec, *words: str) -> Path:
    """The directory of a run, or of a sweep, that was not given one: named after what it does, and the time."""
    return Path("runs") / "_".join([re.sub(r"[:/]", "_", spec.env.name), spec.config.algo, *words, time.strftime("%Y%m%d_%H%M%S")])


def check_unfinished(out: Path, last: str, advice: str) -> None:
    """Refuses to resume what has all its files; the checkpoint is removed after the last of them."""
    if (out / last).exists() and not (out / CHECKPOINTS).exists():
        raise UserError(f"{out} is finished, so there is nothing to resume: {advice}")


def checkpoints_of(out: Path, options: TrainOptions | ResumeOptions) -> Checkpoints | None:
    """Where checkpoints are kept, if they are; None with several hosts."""
    seconds = options.checkpoint_every
    if not seconds >= 0:
        raise UserError(f"--checkpoint-every {seconds} is not usable: give a number of seconds, or 0 for no checkpoints")
    resumes = isinstance(options, ResumeOptions)
    return Checkpoints(out / CHECKPOINTS, seconds=seconds or math.inf) if (seconds or resumes) and jax.process_count() == 1 else None


def reporters_of(options: TrainOptions | ResumeOptions, resumed: Path | None = None) -> list[type[Reporter]]:
    """The kinds that are asked for, and those that the run or the sweep which is resumed had before."""
    before = [] if resumed is None else [path.name for path in (*resumed.glob("*"), *resumed.glob("*/*"))]
    return [kind for kind in REPORTERS if getattr(options, kind.folder) or kind.folder in before]


def demonstrations_of(spec: RunSpec) -> list[Episodes]:
    """One table of demonstrations per seed."""
    if spec.demos == FROM_PYTHON:
        raise UserError("the demonstrations of this run were given from Python, not from a file: name others with --demos")
    if is_number(spec.demos):
        return [record_demonstrations(spec.env, int(spec.demos), seed=seed) for seed in spec.seeds]
    episodes = load(spec.demos, spec.env)
    solved = np.asarray(episodes.terminated)
    if not solved.any():
        raise UserError(f"{spec.demos}: none of its demonstrations solves the task, so there is no goal to learn: record others")
    if not solved.all():
        warnings.warn(f"{spec.demos}: dropped {(~solved).sum()} of {solved.size} demonstrations that do not solve the task", stacklevel=2)
        episodes = jax.tree.map(lambda leaf: leaf[solved], episodes)
    return [episodes] * len(spec.seeds)


def run(
    spec: RunSpec,
    configs: Sequence[TrainConfig],
    writer: RunWriter | SweepWriter | None,
    checkpoints: Checkpoints | None,
    render_every: int | None = None,
) -> Result:
    """Trains all seeds of all configs at once, with a progress bar; each of the writer's runs gets those of its config. Without it, quietly."""
    resumes = writer is not None and writer.resume
    num_seeds = len(spec.seeds)
    films: list[Films] = []
    if writer is not None and render_every is not None:
        films = [Films(of_setting.path, spec.env, render_every, index=index * num_seeds) for index, of_setting in enumerate(writer.runs)]
    num_demos = int(spec.demos) if is_number(spec.demos) else 1
    check_demonstrations(num_demos)
    check_memory(spec.env, configs[0], len(spec.seeds) * len(configs), num_demos)
    if not resumes and ":" in full_name(spec.env) and can_step(spec.env):  # a task of the user's own
        check_environment(spec.env)
    with ProgressBar(console=console) as waiting:
        if resumes and checkpoints.has_demonstrations:
            demonstrations = checkpoints.load_demonstrations()
        else:
            if is_number(spec.demos) and writer is not None:
                waiting.wait("recording demonstrations")
            demonstrations = demonstrations_of(spec)
    seeds = f"seed {spec.seeds[0]}" if num_seeds == 1 else f"{num_seeds} seeds from {spec.seeds[0]}"
    settings = f", {len(configs)} settings" if len(configs) > 1 else ""
    runs: dict[str, Any] = dict(seeds=spec.seeds * len(configs), config=[config for config in configs for _ in spec.seeds])
    if writer is None:
        return fit(spec.env, demonstrations * len(configs), **runs)
    console.print(f"{spec.env.name}, {spec.config.algo}, {counted(demonstrations[0].lengths.shape[0], 'demonstration')}, {seeds}{settings}")

    with ProgressBar(console=console) as progress, StopSignals() as stop_signals:
        progress.wait("compiling")
        learning = False

        def begin(result: Result) -> None:
            for of_setting, config in zip(writer.runs, result.configs[::num_seeds], strict=True):
                of_setting.spec = dataclasses.replace(of_setting.spec, config=config)  # with what `fit` has chosen
            writer.start()
            if checkpoints is not None:
                checkpoints.save_demonstrations(demonstrations)
            progress.say(f"compiled in {result.compile_seconds:.1f} s{_on_devices(result)}")
            num_held = result.config.num_held
            if num_held > 1:
                steps = int(np.median([table.lengths for table in demonstrations]))
                what = f"a decision is {num_held} actions" if result.config.action_chunks else f"each action is held for {num_held} steps"
                progress.say(f"{what}, so a demonstration of {steps} steps takes {-(-steps // num_held)} decisions")
            if resumes:
                progress.say(_where_it_goes_on(result))
            stop_signals.note()

        def report(result: Result) -> None:
            nonlocal learning
            if not writer.started:
                begin(result)
            elif not learning and result.updates:
                learning = True
                progress.say(f"first updates after {time.perf_counter() - STARTED:.1f} s; the seconds below count training only")
            for index, of_setting in enumerate(writer.runs):
                of_setting.report(result.rows_of(slice(index * num_seeds, (index + 1) * num_seeds)))
            progress(result)
            for of_setting_films in films:
                of_setting_films.film_when_due(result)
            if checkpoints is not None:
                checkpoints.save_when_due(result)
            if stop_signals.received is not None and result.final_success is None:
                progress.close()
                _stop(result, stop_signals.received, writer, checkpoints)

        # A run that is overwritten may have left checkpoints, which are removed when this one starts.
        restore: dict[str, Any] = {"restore": checkpoints.restore} if resumes and checkpoints is not None else {}
        try:
            return fit(spec.env, demonstrations * len(configs), **runs, report=report, **restore)
        except (Diverged, SimulationFailed) as error:
            if checkpoints is None or checkpoints.newest is None:
                raise
            raise UserError(f"{error}; the last good checkpoint, {checkpoints.newest}, is in {checkpoints.folder}") from error


def _rounds_of(result: Result) -> str | None:
    """What a run has done that is still practising; None if it has not begun to, or learns."""
    return None if result.practising is None or not result.practising.rounds else f"{counted(result.practising.rounds, 'round')} of practice"


def _where_it_goes_on(result: Result) -> str:
    if rounds := _rounds_of(result):
        return f"going on after {rounds}"
    return f"going on at step {result.steps_done:,}" if result.steps_done else "there is no checkpoint yet: beginning again"


def speed_line(summary: dict[str, Any]) -> str:
    """How fast a training was, from its summary."""
    rates = f"{summary['updates_per_second']:,.0f} updates/s" if summary["updates_per_second"] else "nothing was learnt but clones"
    env_steps = f" and {summary['env_steps_per_second']:,.0f} environment steps/s" if summary["env_steps_per_second"] else ""
    return (
        f"{rates}{env_steps} over all seeds, "
        f"{summary['train_seconds']:.1f} s of training after {summary['compile_seconds']:.1f} s of compilation, "
        f"peak memory {summary['peak_memory_bytes'] / 2**20:,.0f} MiB"
    )


def _stop(result: Result, number: int, writer: RunWriter | SweepWriter, checkpoints: Checkpoints | None) -> None:
    """Ends the process as the signal asks, with a checkpoint."""
    if checkpoints is None:
        said = "no checkpoint was asked for"
    else:
        checkpoints.save(result)
        said = f"go on with `hindrl {'sweep' if isinstance(writer, SweepWriter) else 'train'} --resume {shlex.quote(str(writer.path))}`"
    steps = f"{result.steps_done:,} of {result.config.num_steps:,} {result.steps_unit}"
    print(f"hindrl: stopped after {_rounds_of(result) or steps}; {said}", file=sys.stderr)
    sys.exit(128 + number)


def _on_devices(result: Result) -> str:
    used, available = len(result.state.env_steps.sharding.device_set), jax.device_count()
    return "" if len(result.seeds) == 1 or available == 1 else f", on {used} of {available} devices"
