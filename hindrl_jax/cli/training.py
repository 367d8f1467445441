"""`hindrl train` and `hindrl sweep`."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import math
import re
import signal
import sys
import time
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np
import tyro
from rich import box
from rich.table import Table

from hindrl_jax import STARTED
from hindrl_jax.base.errors import UserError, one_line
from hindrl_jax.base.types import Episodes
from hindrl_jax.cli.common import ENV_HELP, console, counted, env_names, parse, peek, seeds_from
from hindrl_jax.config import SWEEPABLE, TrainConfig, without_effect
from hindrl_jax.demonstrations.convert import MINARI_PREFIX, load
from hindrl_jax.reporting.progress import ProgressBar
from hindrl_jax.reporting.reporters import REPORTERS, Reporter
from hindrl_jax.runs.checkpoints import Checkpoints
from hindrl_jax.runs.spec import CHECKPOINTS, FROM_PYTHON, SUMMARY, SWEEP, RunSpec, read_spec
from hindrl_jax.runs.sweep import SweepWriter, read_sweep
from hindrl_jax.runs.writer import RunWriter, summarise
from hindrl_jax.tasks.presets import ORIGINAL_RULES, Preset, preset
from hindrl_jax.tasks.registry import checked, did_you_mean, make, task
from hindrl_jax.training.checks import check_config, check_trainable
from hindrl_jax.training.experiment import Diverged, fit
from hindrl_jax.training.recording import record_demonstrations
from hindrl_jax.training.result import Result


@dataclasses.dataclass(frozen=True)
class TrainOptions:
    """Options of `hindrl train` and `hindrl sweep` that belong to the run as a whole."""

    demos: str = "1"
    """Demonstrations: a number to record with the task's expert for each seed, or a file (.hdf5, .npz) or minari:NAME-v0 that all seeds share."""
    seeds: int | None = None
    """Number of seeds trained side by side (default: 1)."""
    seed: int | None = None
    """The first seed; the others follow it (default: 0)."""
    out: Path | None = None
    """Directory of the run (default: runs/ENV_ALGO_TIME, for a sweep runs/ENV_ALGO_sweep_TIME)."""
    overwrite: bool = False
    """Replace a run that is already there."""
    checkpoint_every: float = 60.0
    """Seconds between two checkpoints, which are also written at Ctrl-C and SIGTERM, and removed at the end; 0 writes none. Not with several
    hosts."""
    tensorboard: bool = False
    """Also write event files for TensorBoard, in the run's directory: all metrics for each seed, and their mean. Needs the package tensorboard."""
    wandb: bool = False
    """Also send all metrics to Weights & Biases, a run for each seed. Needs the package wandb; WANDB_MODE=offline needs no account."""
    distributed: bool = False
    """Share the seeds with other hosts: start the same command on each of them. The first one writes. Clusters that JAX knows (SLURM, Open
    MPI, Kubernetes, TPU) need nothing else; others need the three options below."""
    coordinator: str | None = None
    """With --distributed: address of the first host, as HOST:PORT."""
    num_hosts: int | None = None
    """With --distributed: number of hosts."""
    host: int | None = None
    """With --distributed: which of them this is, from 0."""


@dataclasses.dataclass(frozen=True)
class SweepOptions(TrainOptions):
    """Options of `hindrl sweep`."""

    over: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """A field and its values, as in learning_rate=1e-4,3e-4,1e-3. Given several times, all combinations are trained, with all their seeds side by
    side in one compiled program. The field is one that only enters arithmetic: learning_rate, bc_weight, gamma, ..."""


@dataclasses.dataclass(frozen=True)
class ResumeOptions:
    """Options of `hindrl train --resume` and `hindrl sweep --resume`."""

    resume: Path
    """Directory of the run or of the sweep."""
    checkpoint_every: float = TrainOptions.checkpoint_every
    """Seconds between two checkpoints; 0 writes none."""
    tensorboard: bool = False
    """Also write event files for TensorBoard, with what went before; without saying so where the run did before."""
    wandb: bool = False
    """Likewise for Weights & Biases, which gets new runs with what went before."""


def train(arguments: list[str]) -> None:
    """Train policies from demonstrations."""
    if peek(arguments, "resume") is not None:
        options = _parse_resume(arguments, "hindrl train")
        out, spec = options.resume, read_spec(options.resume)
        _check_unfinished(out, SUMMARY, f"look at it with `hindrl eval {out}`")
        writer = RunWriter(out, spec, resume=True, reporters=_reporters(options, out))
    else:
        spec, options = parse_train(arguments)
        out = options.out or _default_out(spec)
        writer = RunWriter(out, spec, overwrite=options.overwrite, reporters=_reporters(options))
    with contextlib.closing(writer), _hosts(options) as writes:
        result = _fit(spec, [spec.config], writer if writes else None, _checkpoints(out, options))
        if writes:
            summary = writer.finish(result)
            console.print(_summary_table(summary, spec.config))
            console.print(_speed_line(summary))
            console.print(f"wrote {out}: {', '.join(writer.files())}")


def sweep(arguments: list[str]) -> None:
    """Train with several values of hyperparameters, side by side."""
    if peek(arguments, "resume") is not None:
        options = _parse_resume(arguments, "hindrl sweep")
        out, (spec, settings) = options.resume, read_sweep(options.resume)
        _check_unfinished(out, SWEEP, f"look at {out / SWEEP}")
        writer = SweepWriter(out, spec, settings, resume=True, reporters=_reporters(options, out))
    else:
        spec, options = parse_train(arguments, SweepOptions, "hindrl sweep")
        settings = list(_grid(options.over, spec.config))
        out = options.out or _default_out(spec, "sweep")
        writer = checked(lambda: SweepWriter(out, spec, settings, overwrite=options.overwrite, reporters=_reporters(options)))
    with contextlib.closing(writer), _hosts(options) as writes:
        result = _fit(spec, [run.spec.config for run in writer.runs], writer if writes else None, _checkpoints(out, options))
        if writes:
            console.print(_sweep_table(writer.finish(result), list(settings[0])))
            console.print(_speed_line(summarise(result)))
            console.print(f"wrote {out}: sweep.csv, sweep.png, and a run's directory for each setting")


def _parse_resume(arguments: list[str], program: str) -> ResumeOptions:
    return parse(ResumeOptions, arguments, f"{program} --resume DIRECTORY", "Go on with what was stopped or killed.")


def _check_unfinished(out: Path, last: str, advice: str) -> None:
    """Refuses to resume what has all its files; the checkpoint is removed after the last of them."""
    if (out / last).exists() and not (out / CHECKPOINTS).exists():
        raise UserError(f"{out} is finished, so there is nothing to resume: {advice}")


def _checkpoints(out: Path, options: TrainOptions | ResumeOptions) -> Checkpoints | None:
    """Where checkpoints are kept, if they are; None with several hosts."""
    seconds = options.checkpoint_every
    if not seconds >= 0:
        raise UserError(f"--checkpoint-every {seconds} is not usable: give a number of seconds, or 0 for no checkpoints")
    resumes = isinstance(options, ResumeOptions)
    return Checkpoints(out / CHECKPOINTS, seconds=seconds or math.inf) if (seconds or resumes) and jax.process_count() == 1 else None


def _sweep_table(rows: Sequence[dict[str, Any]], swept: Sequence[str]) -> Table:
    unit = next(name for name in rows[0] if name.startswith("median_")).split("_")[1]
    table = Table(*swept, "95% reached", f"median {unit}", "mean final", "worst", box=box.SIMPLE_HEAD)
    for row in rows:
        median = row[f"median_{unit}_to_95"]
        table.add_row(
            *(f"{row[name]:g}" for name in swept),
            f"{row['seeds_reaching_95']} of {row['seeds']}",
            "never" if median is None else f"{median:,.0f}",
            f"{row['mean_final_success']:.0%}",
            f"{row['worst_final_success']:.0%}",
        )
    return table


def _reporters(options: TrainOptions | ResumeOptions, resumed: Path | None = None) -> list[type[Reporter]]:
    """The kinds that are asked for, and those that the run or the sweep which is resumed had before."""
    before = [] if resumed is None else [path.name for path in (*resumed.glob("*"), *resumed.glob("*/*"))]
    return [kind for kind in REPORTERS if getattr(options, kind.folder) or kind.folder in before]


def _default_out(spec: RunSpec, *words: str) -> Path:
    return Path("runs") / "_".join([re.sub(r"[:/]", "_", spec.env.name), spec.config.algo, *words, time.strftime("%Y%m%d_%H%M%S")])


def _grid(over: Sequence[str], config: TrainConfig) -> Iterator[dict[str, float]]:
    """All combinations of the values of --over, in order."""
    values: dict[str, list[float]] = {}
    for given in over:
        name, _, listed = given.partition("=")
        name = name.strip().lstrip("-").replace("-", "_")
        if name not in SWEEPABLE:
            raise UserError(f"--over {given}: {name!r} cannot be swept{did_you_mean(name, SWEEPABLE)}; choose one of {', '.join(SWEEPABLE)}")
        if name in values:
            raise UserError(f"--over {given}: {name} is given twice; list all its values in one --over")
        try:
            values[name] = [float(value) for value in listed.split(",")]
        except ValueError:
            raise UserError(f"--over {given} is not a field and its values: write for example --over {name}=0.1,0.2") from None
        if len(set(map(np.float32, values[name]))) < len(values[name]):
            raise UserError(f"--over {given}: a value is listed twice (values are rounded to float32)")
        reason = without_effect(config, name)
        if reason:
            raise UserError(f"--over {given} would change nothing: {reason}")
    if not values:
        raise UserError("--over is missing: say what to sweep, for example --over learning_rate=1e-4,3e-4,1e-3")
    return (dict(zip(values, combination, strict=True)) for combination in itertools.product(*values.values()))


@contextlib.contextmanager
def _hosts(options: TrainOptions | ResumeOptions) -> Iterator[bool]:
    """Joins the other hosts, if there are any; yields whether this is the host that writes and prints."""
    if isinstance(options, ResumeOptions):
        yield True
        return
    given = {name: getattr(options, name) for name in ("coordinator", "num_hosts", "host")}
    if not options.distributed:
        for name, value in given.items():
            if value is not None:
                raise UserError(f"--{name.replace('_', '-')} is for training on several hosts: add --distributed, or drop it")
        yield True
        return
    coordinator, num_hosts, host = given.values()
    if any(value is None for value in given.values()) and any(value is not None for value in given.values()):
        raise UserError("--coordinator, --num-hosts and --host belong together: give all three, or none where the cluster tells JAX")
    if coordinator is not None and not re.fullmatch(r"\S+:\d+", coordinator):
        raise UserError(f"--coordinator {coordinator} is not an address: write HOST:PORT")
    if num_hosts is not None and not 0 <= host < num_hosts:
        raise UserError(f"--host {host} is not one of --num-hosts {num_hosts}: count hosts from 0")
    jax.config.update("jax_enable_preemption_service", False)  # it would take the signals that are meant to end the run
    try:
        jax.distributed.initialize(coordinator, num_hosts, host)
    except (RuntimeError, ValueError) as error:
        raise UserError(f"cannot join the other hosts ({one_line(error)}): give --coordinator HOST:PORT --num-hosts N --host I on each") from error
    yield jax.process_index() == 0
    jax.distributed.shutdown()  # waits for the others; so after a failure, which they must notice, it is left out


def _fit(spec: RunSpec, configs: Sequence[TrainConfig], writer: RunWriter | SweepWriter | None, checkpoints: Checkpoints | None) -> Result:
    """Trains all seeds of all configs at once, with a progress bar; each of the writer's runs gets those of its config. Without it, quietly."""
    resumes = writer is not None and writer.resume
    demonstrations = checkpoints.load_demonstrations() if resumes and checkpoints.has_demonstrations else demonstrations_of(spec)
    num_seeds = len(spec.seeds)
    seeds = f"seed {spec.seeds[0]}" if num_seeds == 1 else f"{num_seeds} seeds from {spec.seeds[0]}"
    settings = f", {len(configs)} settings" if len(configs) > 1 else ""
    runs: dict[str, Any] = dict(seeds=spec.seeds * len(configs), config=[config for config in configs for _ in spec.seeds])
    if writer is None:
        return fit(spec.env, demonstrations * len(configs), **runs)
    console.print(f"{spec.env.name}, {spec.config.algo}, {counted(demonstrations[0].lengths.shape[0], 'demonstration')}, {seeds}{settings}")

    with ProgressBar(console=console) as progress, _StopSignals() as stop_signals:
        progress.wait("compiling")
        learning = False

        def begin(result: Result) -> None:
            writer.start()
            if checkpoints is not None:
                checkpoints.save_demonstrations(demonstrations)
            progress.say(f"compiled in {result.compile_seconds:.1f} s{_on_devices(result)}")
            for share in spec.config.agent_resets:
                progress.say(f"the agent begins anew at step {share * spec.config.steps:,.0f}, so success will drop there and come back")
            if resumes:
                progress.say(f"going on at step {result.steps_done:,}" if result.steps_done else "there is no checkpoint yet: beginning again")
            stop_signals.note()

        def report(result: Result) -> None:
            nonlocal learning
            if not writer.started:
                begin(result)
            elif not learning:
                learning = True
                progress.say(f"first updates after {time.perf_counter() - STARTED:.1f} s")
            for index, run in enumerate(writer.runs):
                run.report(result.rows_of(slice(index * num_seeds, (index + 1) * num_seeds)))
            progress(result)
            if checkpoints is not None:
                checkpoints.save_when_due(result)
            if stop_signals.received is not None and result.final_success is None:
                progress.close()
                _stop(result, stop_signals.received, writer, checkpoints)

        restore: dict[str, Any] = {} if checkpoints is None else {"restore": checkpoints.restore}
        try:
            return fit(spec.env, demonstrations * len(configs), **runs, report=report, **restore)
        except Diverged as error:
            if checkpoints is None or checkpoints.steps is None:
                raise
            raise UserError(f"{error}; the last good checkpoint, of step {checkpoints.steps}, is in {checkpoints.folder}") from error


class _StopSignals:
    """Notes the first SIGINT (Ctrl-C) or SIGTERM, so that the run can end at a place where it can be resumed; the second one ends it at once."""

    def __init__(self) -> None:
        self.received: int | None = None
        self._before: dict[int, Any] = {}

    def note(self) -> None:
        """From now on; until then, signals do what they always do."""
        self._before = {number: signal.signal(number, self._receive) for number in (signal.SIGINT, signal.SIGTERM)}

    def _receive(self, number: int, frame: Any) -> None:
        self.received = number
        self._put_back()

    def _put_back(self) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def __enter__(self) -> _StopSignals:
        return self

    def __exit__(self, *exception: Any) -> None:
        self._put_back()


def _stop(result: Result, number: int, writer: RunWriter | SweepWriter, checkpoints: Checkpoints | None) -> None:
    """Ends the process as the signal asks, with a checkpoint."""
    if checkpoints is None:
        said = "no checkpoint was asked for"
    else:
        checkpoints.save(result)
        said = f"go on with `hindrl {'sweep' if isinstance(writer, SweepWriter) else 'train'} --resume {writer.path}`"
    print(f"hindrl: stopped after {result.steps_done:,} of {result.config.steps:,} steps; {said}", file=sys.stderr)
    sys.exit(128 + number)


def _on_devices(result: Result) -> str:
    used, available = len(result.state.env_steps.sharding.device_set), jax.device_count()
    return "" if len(result.seeds) == 1 or available == 1 else f", on {used} of {available} devices"


def _speed_line(summary: dict[str, Any]) -> str:
    env_steps = f" and {summary['env_steps_per_second']:,.0f} environment steps/s" if summary["env_steps_per_second"] else ""
    return (
        f"{summary['updates_per_second']:,.0f} updates/s{env_steps} over all seeds, "
        f"{summary['train_seconds']:.1f} s of training after {summary['compile_seconds']:.1f} s of compilation, "
        f"peak memory {summary['peak_memory_bytes'] / 2**20:,.0f} MiB"
    )


def parse_train(arguments: list[str], options_class: type[TrainOptions] = TrainOptions, program: str = "hindrl train") -> tuple[RunSpec, Any]:
    """Environment, algorithm and preset decide which flags there are and their defaults, so they are read first."""
    chosen: dict[str, Any] = {name: peek(arguments, name) for name in ("env", "algo", "preset", "config")}
    if chosen["config"] is not None:
        for name in ("env", "algo", "preset"):
            if chosen[name] is not None:
                raise UserError(f"--{name} and --config exclude each other: the configuration file says it; drop one of them")
        spec = read_spec(Path(chosen["config"]))
    else:
        name = chosen["env"] or "FixedGridPickAndPlace"
        config = preset(chosen["algo"] or "hindrl", chosen["preset"] or "default", env=name)
        env_arguments = ORIGINAL_RULES[task(name).family] if chosen["preset"] == "original" else {}
        known = {field.name for field in dataclasses.fields(task(name).environment)}
        env_arguments = {field: value for field, value in env_arguments.items() if field in known}  # a task of one's own need not have such rules
        spec = RunSpec(env=make(name, **env_arguments), config=config, demos="1", seeds=(0,))

    environment_class = type(spec.env)
    fields: list[tuple[str, Any, Any, str]] = [
        ("env", env_names(chosen["env"] or spec.env.name), spec.env.name, ENV_HELP),
        ("preset", Preset, chosen["preset"] or "default", "Where the other defaults come from: our recipe, the thesis, or its original code."),
        ("config", Path | None, None, "Run again what a config.json (or the directory of a run) says; other flags change it."),
        ("resume", Path | None, None, "Go on with the run, or sweep, of a directory that was stopped or killed, as if it had never been."),
        ("options", options_class, options_class(demos=spec.demos), ""),
        ("training", TrainConfig, spec.config, ""),
        ("environment", environment_class, spec.env, ""),
    ]
    namespace = dataclasses.make_dataclass(
        "Train",
        [(name, Annotated[kind, tyro.conf.arg(help=text)] if text else kind, default) for name, kind, default, text in fields],
        frozen=True,
    )
    parsed = parse(namespace, arguments, program, train.__doc__ if options_class is TrainOptions else sweep.__doc__)
    check_trainable(parsed.environment)
    check_config(parsed.environment, parsed.training)
    _warn_of_what_has_no_effect(spec.config, parsed.training)
    options = parsed.options
    seeds = spec.seeds
    if options.seeds is not None or options.seed is not None:
        count, first = (len(seeds) if options.seeds is None else options.seeds), (seeds[0] if options.seed is None else options.seed)
        if count < 1:
            raise UserError(f"--seeds {count} is too few: train at least 1 seed")
        seeds = seeds_from(count, first)
    demos = options.demos
    if not (_is_number(demos) or demos == FROM_PYTHON or demos.startswith(MINARI_PREFIX)):
        demos = str(Path(demos).absolute())
    return RunSpec(env=parsed.environment, config=parsed.training, demos=demos, seeds=seeds), options


def _warn_of_what_has_no_effect(before: TrainConfig, config: TrainConfig) -> None:
    """About the fields that the user has changed, and which nothing will read."""
    for section_before, section in ((before, config), (before.batch, config.batch), (before.goal, config.goal), (before.agent, config.agent)):
        for field in dataclasses.fields(section):
            value = getattr(section, field.name)
            reason = None if value == getattr(section_before, field.name) else without_effect(config, field.name)
            if reason:
                warnings.warn(f"{field.name} = {value} changes nothing: {reason}", stacklevel=2)


def demonstrations_of(spec: RunSpec) -> list[Episodes]:
    """One table of demonstrations per seed."""
    if spec.demos == FROM_PYTHON:
        raise UserError("the demonstrations of this run were given from Python, not from a file: name others with --demos")
    if _is_number(spec.demos):
        return [record_demonstrations(spec.env, int(spec.demos), seed=seed) for seed in spec.seeds]
    episodes = load(spec.demos, spec.env)
    solved = np.asarray(episodes.terminated)
    if not solved.any():
        raise UserError(f"{spec.demos}: none of its demonstrations solves the task, so there is no goal to learn: record others")
    if not solved.all():
        warnings.warn(f"{spec.demos}: dropped {(~solved).sum()} of {solved.size} demonstrations that do not solve the task", stacklevel=2)
        episodes = jax.tree.map(lambda leaf: leaf[solved], episodes)
    return [episodes] * len(spec.seeds)


def _is_number(demos: str) -> bool:
    return re.fullmatch(r"[+-]?\d+", demos) is not None


def _summary_table(summary: dict[str, Any], config: TrainConfig) -> Table:
    cloning = config.algo == "bc"  # which takes no environment steps
    table = Table("seed", "final", "best", "length", "95% after", *([] if cloning else ["updates"]), "seconds", box=box.SIMPLE_HEAD)
    for column in table.columns:
        column.justify = "right"
    for seed in summary["seeds"]:
        cells = [str(seed["seed"]), f"{seed['final_success']:.0%}", f"{seed['best_success']:.0%}", f"{seed['episode_length']:.1f}"]
        if seed["updates_to_95"] is None:
            cells.append("never")
        else:
            updates = f"{seed['updates_to_95']:,}"
            cells += [f"{updates} updates"] if cloning else [f"{seed['env_steps_to_95']:,} steps", updates]
            cells.append(f"{seed['seconds_to_95']:.1f}")
        table.add_row(*cells)
    return table
