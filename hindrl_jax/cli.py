"""The `hindrl` command. Every failure that is the user's to mend is one line on standard error and exit code 2."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import io
import itertools
import os
import re
import sys
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from rich import box
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeRemainingColumn
from rich.table import Table

from experts.by_hand import record_by_hand
from experts.recording import on_host
from experts.robosuite_arm import DeviceName
from hindrl_jax import STARTED, __version__, ablation
from hindrl_jax.config import SWEEPABLE, TrainConfig, without_effect
from hindrl_jax.datasets import DemonstrationSummary, check_can_write, describe_demonstrations, load_demonstrations, read_states, save_demonstrations
from hindrl_jax.errors import UserError, one_line
from hindrl_jax.experiment import Result, check_trainable, fit, record_demonstrations, steps_to_learn
from hindrl_jax.goals import epsilon_filter, epsilon_from_demonstrations, goal_table
from hindrl_jax.plots import save_filter
from hindrl_jax.presets import ORIGINAL_RULES, Preset, preset
from hindrl_jax.registry import TASKS, checked, did_you_mean, make, task
from hindrl_jax.runs import FROM_PYTHON, RunSpec, RunWriter, SweepWriter, disk_trouble, draw_episode, load_run, read_spec, summarise
from hindrl_jax.types import Episodes, RestorableEnvironment

_TYRO = (tyro.conf.OmitArgPrefixes, tyro.conf.OmitSubcommandPrefixes)
console = Console(highlight=False, soft_wrap=True)


# ---------------------------------------------------------------------------------------------------------------------------------- train


@dataclasses.dataclass(frozen=True)
class TrainOptions:
    """Options of `hindrl train` and `hindrl sweep` that belong to the run as a whole."""

    demos: str = "1"
    """Demonstrations: a number to record with the task's expert for each seed, or an HDF5 file that all seeds share."""
    seeds: int | None = None
    """Number of seeds trained side by side (default: 1)."""
    seed: int | None = None
    """The first seed; the others follow it (default: 0)."""
    out: Path | None = None
    """Directory of the run (default: runs/ENV_ALGO_TIME, for a sweep runs/ENV_ALGO_sweep_TIME)."""
    overwrite: bool = False
    """Replace a run that is already there."""
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


def _train(arguments: list[str]) -> None:
    """Train policies from demonstrations."""
    spec, options = _parse_train(arguments)
    out = options.out or _default_out(spec)
    writer = RunWriter(out, spec, overwrite=options.overwrite)
    with _hosts(options) as writes:
        result = _fit(spec, [spec.config], [writer] if writes else [])
        if writes:
            summary = writer.finish(result)
            console.print(_summary_table(summary))
            console.print(_speed_line(summary))
            console.print(f"wrote {out}: {', '.join(writer.files())}")


def _sweep(arguments: list[str]) -> None:
    """Train with several values of hyperparameters, side by side."""
    spec, options = _parse_train(arguments, SweepOptions, "hindrl sweep")
    settings = list(_grid(options.over, spec.config))
    out = options.out or _default_out(spec, "sweep")
    writer = checked(lambda: SweepWriter(out, spec, settings, overwrite=options.overwrite))
    with _hosts(options) as writes:
        result = _fit(spec, [run.spec.config for run in writer.runs], writer.runs if writes else [])
        if writes:
            console.print(_sweep_table(writer.finish(result), list(settings[0])))
            console.print(_speed_line(summarise(result)))
            console.print(f"wrote {out}: sweep.csv, sweep.png, and a run's directory for each setting")


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


def _default_out(spec: RunSpec, *words: str) -> Path:
    return Path("runs") / "_".join([spec.env.name, spec.config.algo, *words, time.strftime("%Y%m%d_%H%M%S")])


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
def _hosts(options: TrainOptions) -> Iterator[bool]:
    """Joins the other hosts, if there are any; yields whether this is the host that writes and prints."""
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


def _fit(spec: RunSpec, configs: Sequence[TrainConfig], writers: Sequence[RunWriter]) -> Result:
    """Trains all seeds of all configs at once, with a progress bar; each writer gets the runs of its config. Without writers, quietly."""
    demonstrations = _demonstrations(spec)
    num_seeds = len(spec.seeds)
    seeds = f"seed {spec.seeds[0]}" if num_seeds == 1 else f"{num_seeds} seeds from {spec.seeds[0]}"
    settings = f", {len(configs)} settings" if len(configs) > 1 else ""
    runs = dict(seeds=spec.seeds * len(configs), config=[config for config in configs for _ in spec.seeds])
    if not writers:
        return fit(spec.env, demonstrations * len(configs), **runs)
    console.print(f"{spec.env.name}, {spec.config.algo}, {_count(demonstrations[0].lengths.shape[0], 'demonstration')}, {seeds}{settings}")

    with _progress() as progress:
        bar = _add_bar(progress, spec.config)

        def report(result: Result) -> None:
            if not writers[0].started:
                for writer in writers:
                    writer.start()
                progress.console.print(f"compiled in {result.compile_seconds:.1f} s{_on_devices(result)}")
            elif not progress.tasks[bar].completed:
                progress.console.print(f"first updates after {time.perf_counter() - STARTED:.1f} s")
            new_rows = result.rows[len(configs) * writers[0].rows_written :]
            for index, writer in enumerate(writers):
                writer.report(result.rows_of(slice(index * num_seeds, (index + 1) * num_seeds)))
            if new_rows:
                progress.console.print(_evaluation_line(new_rows))
            _advance(progress, bar, result)

        return fit(spec.env, demonstrations * len(configs), **runs, report=report)


def _progress(*, transient: bool = False) -> Progress:
    """A place for the bars of trainings."""
    columns = ("{task.description}", BarColumn(), "{task.completed:,.0f}/{task.total:,.0f} {task.fields[unit]}", "{task.fields[rates]}", "left")
    return Progress(*(TextColumn(c) if isinstance(c, str) else c for c in columns), TimeRemainingColumn(), console=console, transient=transient)


def _add_bar(progress: Progress, config: TrainConfig, *, name: str = "") -> TaskID:
    """A bar for one training, which `_advance` moves; `name` says which, where there are several."""
    return progress.add_task(f"{name}compiling", total=config.steps, unit="updates" if config.algo == "bc" else "steps", rates="")


def _advance(progress: Progress, bar: TaskID, result: Result, *, name: str = "") -> None:
    """Brings a bar up to date."""
    success, runs, seconds = result.latest_success(), len(result.seeds), max(result.train_seconds, 1e-9)
    rates = f"{runs * result.env_steps / seconds:,.0f} steps/s, {runs * result.updates / seconds:,.0f} updates/s"
    progress.update(
        bar,
        completed=min(result.steps_done, result.config.steps),
        description=name + ("training" if success is None else f"success {success:4.0%}"),
        rates=rates if result.train_seconds else "",
    )


def _on_devices(result: Result) -> str:
    used, available = len(result.state.env_steps.sharding.device_set), jax.device_count()
    return "" if len(result.seeds) == 1 or available == 1 else f", on {used} of {available} devices"


def _speed_line(summary: dict[str, Any]) -> str:
    return (
        f"{summary['updates_per_second']:,.0f} updates/s and {summary['env_steps_per_second']:,.0f} environment steps/s over all seeds, "
        f"{summary['train_seconds']:.1f} s of training after {summary['compile_seconds']:.1f} s of compilation, "
        f"peak memory {summary['peak_memory_bytes'] / 2**20:,.0f} MiB"
    )


def _parse_train(arguments: list[str], options_class: type[TrainOptions] = TrainOptions, program: str = "hindrl train") -> tuple[RunSpec, Any]:
    """Environment, algorithm and preset decide which flags there are and their defaults, so they are read first."""
    chosen = {name: _peek(arguments, name) for name in ("env", "algo", "preset", "config")}
    if chosen["config"] is not None:
        for name in ("env", "algo", "preset"):
            if chosen[name] is not None:
                raise UserError(f"--{name} and --config exclude each other: the configuration file says it; drop one of them")
        spec = read_spec(Path(chosen["config"]))
    else:
        name = chosen["env"] or "FixedGridPickAndPlace"
        config = preset(chosen["algo"] or "hindrl", chosen["preset"] or "default", env=name)
        env_arguments = ORIGINAL_RULES[task(name).family] if chosen["preset"] == "original" else {}
        spec = RunSpec(env=make(name, **env_arguments), config=config, demos="1", seeds=(0,))

    environment_class = type(spec.env)
    fields = [
        ("env", Literal[tuple(TASKS)], spec.env.name, "The environment; `hindrl envs` lists them."),
        ("preset", Preset, chosen["preset"] or "default", "Where the other defaults come from: our recipe, the thesis, or its original code."),
        ("config", Path | None, None, "Run again what a config.json (or the directory of a run) says; other flags change it."),
        ("options", options_class, options_class(demos=spec.demos), ""),
        ("training", TrainConfig, spec.config, ""),
        ("environment", environment_class, spec.env, ""),
    ]
    namespace = dataclasses.make_dataclass(
        "Train",
        [(name, Annotated[kind, tyro.conf.arg(help=text)] if text else kind, default) for name, kind, default, text in fields],
        frozen=True,
    )
    parsed = _parse(namespace, arguments, program, COMMANDS[program.split()[1]].__doc__)
    check_trainable(parsed.environment)
    options = parsed.options
    seeds = spec.seeds
    if options.seeds is not None or options.seed is not None:
        count, first = (len(seeds) if options.seeds is None else options.seeds), (seeds[0] if options.seed is None else options.seed)
        if count < 1:
            raise UserError(f"--seeds {count} is too few: train at least 1 seed")
        seeds = _seeds(count, first)
    demos = options.demos if _is_number(options.demos) or options.demos == FROM_PYTHON else str(Path(options.demos).absolute())
    return RunSpec(env=parsed.environment, config=parsed.training, demos=demos, seeds=seeds), options


def _seeds(count: int, first: int) -> tuple[int, ...]:
    """That many seeds, one after the other."""
    if not 0 <= first <= 2**32 - count:
        raise UserError(f"--seed {first} is not usable: choose a whole number from 0 to {2**32 - count}")
    return tuple(range(first, first + count))


def _peek(arguments: Sequence[str], name: str) -> str | None:
    """The value of one flag, before the rest can be understood."""
    value = None
    for index, argument in enumerate(arguments):
        if argument == f"--{name}" and index + 1 < len(arguments):
            value = arguments[index + 1]
        elif argument.startswith(f"--{name}="):
            value = argument.partition("=")[2]
    return value


def _demonstrations(spec: RunSpec) -> list[Episodes]:
    """One table of demonstrations per seed."""
    if spec.demos == FROM_PYTHON:
        raise UserError("the demonstrations of this run were given from Python, not from a file: name others with --demos")
    if _is_number(spec.demos):
        return [record_demonstrations(spec.env, int(spec.demos), seed=seed) for seed in spec.seeds]
    episodes = load_demonstrations(spec.demos, spec.env)
    solved = np.asarray(episodes.terminated)
    if not solved.any():
        raise UserError(f"{spec.demos}: none of its demonstrations solves the task, so there is no goal to learn: record others")
    if not solved.all():
        warnings.warn(f"{spec.demos}: dropped {(~solved).sum()} of {solved.size} demonstrations that do not solve the task", stacklevel=2)
        episodes = jax.tree.map(lambda leaf: leaf[solved], episodes)
    return [episodes] * len(spec.seeds)


def _is_number(demos: str) -> bool:
    return re.fullmatch(r"[+-]?\d+", demos) is not None


def _evaluation_line(rows: Sequence[Any]) -> str:
    success = [row.success for row in rows]
    spread = f" (worst {min(success):4.0%})" if len(rows) > 1 else ""
    return (
        f"{rows[0].env_steps:9,d} steps {rows[0].updates:8,d} updates {rows[0].seconds:7.1f} s   "
        f"success {np.mean(success):4.0%}{spread}   length {np.mean([row.episode_length for row in rows]):5.1f}"
    )


def _summary_table(summary: dict[str, Any]) -> Table:
    table = Table("seed", "final", "best", "length", "95% after", "updates", "seconds", box=box.SIMPLE_HEAD)
    for column in table.columns:
        column.justify = "right"
    for seed in summary["seeds"]:
        reached = seed["env_steps_to_95"] is not None
        table.add_row(
            str(seed["seed"]),
            f"{seed['final_success']:.0%}",
            f"{seed['best_success']:.0%}",
            f"{seed['episode_length']:.1f}",
            f"{seed['env_steps_to_95']:,} steps" if reached else "never",
            f"{seed['updates_to_95']:,}" if reached else "",
            f"{seed['seconds_to_95']:.1f}" if reached else "",
        )
    return table


# ------------------------------------------------------------------------------------------------------------------------ eval and render


@dataclasses.dataclass(frozen=True)
class Eval:
    """Play fresh episodes with the policies of a run."""

    directory: tyro.conf.Positional[Path]
    """Directory of the run."""
    episodes: int = 100
    """Episodes per seed."""
    seed: int = 0
    """Which episodes: equal numbers give equal ones, in the same back end."""
    stochastic: bool = False
    """Sample the actions instead of taking the mean ones."""
    backend: str | None = None
    """Simulate the environment with another of its back ends, for example robosuite, which plays one episode after the other."""


def _eval(arguments: list[str]) -> None:
    """Play fresh episodes with the policies of a run."""
    options = _parse(Eval, arguments, "hindrl eval")
    if options.episodes < 1:
        raise UserError(f"--episodes {options.episodes} is too few: play at least 1")
    run = load_run(options.directory)
    if options.backend is not None:
        run = run.in_backend(options.backend)
    columns = (TextColumn("{task.completed}/{task.total} episodes"), BarColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=not on_host(run.spec.env)) as progress:
        bar = progress.add_task("", total=options.episodes * len(run.spec.seeds))
        outcomes = run.evaluate(
            episodes=options.episodes,
            key=_key(options.seed),
            stochastic=options.stochastic,
            report=lambda played: progress.update(bar, completed=played),
        )
    table = Table("seed", "success", "length", box=box.SIMPLE_HEAD)
    where = f" in {options.backend}" if options.backend else ""
    console.print(f"{run.spec.env.name}{where}, {_count(options.episodes, 'episode')} per seed")
    for outcome in outcomes:
        table.add_row(str(outcome["seed"]), f"{outcome['success']:.1%}", f"{outcome['episode_length']:.1f}")
    console.print(table)


@dataclasses.dataclass(frozen=True)
class Render:
    """Film an episode of a run's policy."""

    directory: tyro.conf.Positional[Path]
    """Directory of the run."""
    to: Path | None = None
    """A .gif file, or a .png file for the last state (default: in DIRECTORY, named after episode and seed)."""
    seed: int | None = None
    """Whose policy: one of the run's seeds (default: the first)."""
    episode: int = 0
    """Which episode: equal numbers give equal ones."""
    stochastic: bool = False
    """Sample the actions instead of taking the mean ones."""


def _render(arguments: list[str]) -> None:
    """Film an episode of a run's policy."""
    options = _parse(Render, arguments, "hindrl render")
    run = load_run(options.directory)
    path = options.to or options.directory / f"episode_{options.episode}_seed_{run.spec.seeds[0] if options.seed is None else options.seed}.gif"
    solved = run.render(path, seed=options.seed, key=_key(options.episode), stochastic=options.stochastic)
    console.print(f"wrote {path}: the episode is {'solved' if solved else 'not solved'}")


def _key(seed: int) -> jax.Array:
    if not 0 <= seed < 2**32:
        raise UserError(f"{seed} cannot name a random episode: choose a whole number from 0 to {2**32 - 1}")
    return jax.random.key(seed)


# ------------------------------------------------------------------------------------------------------------------------- demonstrations


@dataclasses.dataclass(frozen=True)
class Record:
    """Options of `hindrl demos record`."""

    demos: int
    """Number of demonstrations; only solved episodes are kept."""
    out: Path
    """The HDF5 file to write."""
    seed: int = 0
    """Equal seeds give equal demonstrations."""
    overwrite: bool = False
    """Replace a file that is already there."""
    device: DeviceName | None = None
    """Play yourself, instead of the expert: steer the arm of a reach task in robosuite, in real time. Give yourself a long --horizon."""


def _demos_record(arguments: list[str]) -> None:
    """Record demonstrations with the task's expert, or by hand."""
    name = _peek(arguments, "env") or "FixedGridPickAndPlace"
    entry = task(name)
    namespace = dataclasses.make_dataclass(
        "Record",
        [
            ("options", Record),
            ("env", Annotated[Literal[tuple(TASKS)], tyro.conf.arg(help="The environment; `hindrl envs` lists them.")], name),
            ("environment", entry.environment, entry.environment()),
            ("expert", entry.expert, entry.expert()),
        ],
        frozen=True,
    )
    parsed = _parse(namespace, arguments, "hindrl demos record", _demos_record.__doc__)
    options, env = parsed.options, parsed.environment
    _key(options.seed)
    check_can_write(options.out, overwrite=options.overwrite)
    if options.device is None:
        expert = dataclasses.asdict(parsed.expert)
        with console.status("recording") if on_host(env) else contextlib.nullcontext():  # it takes seconds for each episode
            demonstrations = record_demonstrations(env, options.demos, seed=options.seed, expert=parsed.expert)
    else:
        if parsed.expert != entry.expert():
            raise UserError(f"the expert's options are of no use when you play yourself with --device {options.device}: drop one or the other")
        expert = {"device": options.device}
        env, demonstrations = _record_by_hand(env, options)
    save_demonstrations(
        options.out,
        demonstrations,
        env=env,
        env_args=dataclasses.asdict(env),
        expert=expert,
        overwrite=options.overwrite,
    )
    lengths = np.asarray(demonstrations.lengths)
    console.print(f"wrote {options.out}: {_count(len(lengths), 'demonstration')} of {env.name}, mean length {lengths.mean():.1f} steps")


def _record_by_hand(env: RestorableEnvironment, options: Record) -> tuple[RestorableEnvironment, Episodes]:
    """The environment in robosuite, and what a person did there."""
    if not hasattr(env, "backend"):
        raise UserError(f"--device {options.device} steers a robot's arm, and {env.name} has none: choose a reach environment, or drop --device")
    if env.backend == "mjx":
        raise UserError(f"--device {options.device} steers the arm of robosuite: drop --backend mjx, or drop --device")
    env = dataclasses.replace(env, backend="robosuite")
    return env, record_by_hand(_key(options.seed), env, options.device, options.demos, report=console.print)


@dataclasses.dataclass(frozen=True)
class Info:
    """Say what a file of demonstrations holds."""

    file: tyro.conf.Positional[Path]
    """The HDF5 file."""
    m: int = 0
    """Distance in steps for epsilon (thesis eq. 4.7)."""
    k: float = 0.0
    """Weight of the standard deviation in epsilon (thesis eq. 4.7)."""


def _demos_info(arguments: list[str]) -> None:
    """Say what a file of demonstrations holds."""
    options = _parse(Info, arguments, "hindrl demos info")
    summary, achieved, lengths, epsilon = _with_epsilon(options.file, m=options.m, k=options.k)
    filtered = goal_table(achieved, lengths, epsilon, filtered=True)
    console.print(f"{options.file}: {summary.env_name}({', '.join(f'{name}={value}' for name, value in summary.env_kwargs.items())})")
    console.print(
        f"{_count(summary.num_demonstrations, 'demonstration')}, {summary.num_solved} solved, {summary.num_transitions} transitions, "
        f"lengths {summary.length_min} to {summary.length_max}, median {summary.length_median:g}, "
        f"actions from {summary.action_low.min():g} to {summary.action_high.max():g}"
    )
    if summary.expert:
        console.print(f"expert: {', '.join(f'{name}={value}' for name, value in summary.expert.items())}")
    console.print(f"the filter keeps {int(filtered.count)} of {int(jnp.sum(lengths + 1))} goals (m = {options.m}, k = {options.k:g})")
    table = Table("goal dimension", "min", "max", "epsilon", box=box.SIMPLE_HEAD)
    reached = np.concatenate([np.asarray(achieved[i, : int(length) + 1]) for i, length in enumerate(lengths)])
    for index, row in enumerate(zip(reached.min(axis=0), reached.max(axis=0), epsilon, strict=True)):
        table.add_row(str(index), *(f"{value:.4g}" for value in row))
    console.print(table)


@dataclasses.dataclass(frozen=True)
class PlotDemo:
    """Draw what the epsilon filter keeps of a demonstration."""

    file: tyro.conf.Positional[Path]
    """The HDF5 file."""
    to: Path | None = None
    """The .png file (default: the file's name with .png)."""
    demo: int = 0
    """Which demonstration, counted from 0."""
    m: int = 5
    """Distance in steps for epsilon (thesis eq. 4.7), over all demonstrations of the file."""
    k: float = 0.0
    """Weight of the standard deviation in epsilon (thesis eq. 4.7)."""
    dims: tuple[int, int] | None = None
    """The two goal dimensions to draw (default: those with the largest extent)."""


def _demos_plot(arguments: list[str]) -> None:
    """Draw what the epsilon filter keeps of a demonstration."""
    options = _parse(PlotDemo, arguments, "hindrl demos plot")
    path = options.to or options.file.with_suffix(".png")
    if path.suffix != ".png":
        raise UserError(f"cannot draw {path.name}: the name must end in .png")
    summary, achieved, lengths, epsilon = _with_epsilon(options.file, m=options.m, k=options.k)
    _check_demo(options.demo, len(lengths), options.file)
    goals = np.asarray(achieved[options.demo, : int(lengths[options.demo]) + 1])
    dims = options.dims or tuple(sorted(int(dim) for dim in np.argsort(-np.ptp(_continuous(goals), axis=0), kind="stable")[:2]))
    if len(set(dims)) < 2 or not all(0 <= dim < goals.shape[1] for dim in dims):
        raise UserError(f"--dims {dims[0]} {dims[1]} is not usable: give two different numbers from 0 to {goals.shape[1] - 1}")
    kept = np.asarray(epsilon_filter(goals, epsilon))
    title = f"{summary.env_name}, demonstration {options.demo}, m = {options.m}, k = {options.k:g}"
    with disk_trouble(path):
        save_filter(goals, kept, np.asarray(epsilon), path, dims=dims, title=title)
    console.print(f"wrote {path}: the filter keeps {kept.sum()} of {len(kept)} goals")


def _continuous(goals: np.ndarray) -> np.ndarray:
    """The goals (T, G) without what only jumps between whole numbers, such as masks, unless there is nothing else."""
    whole = (goals == np.round(goals)).all(axis=0)
    return goals if whole.all() else np.where(whole[None], 0.0, goals)


def _with_epsilon(file: Path, *, m: int, k: float) -> tuple[DemonstrationSummary, jax.Array, jax.Array, jax.Array]:
    """What a file holds, the goals (N, T + 1, G) that its demonstrations achieved, their lengths (N,), and epsilon (G,) over all of them."""
    if m < 0 or k < 0:
        raise UserError(f"--m {m} --k {k} is not usable: both must be 0 or more")
    summary = describe_demonstrations(file)
    env = make(summary.env_name, **summary.env_kwargs)
    episodes = load_demonstrations(file, env)
    achieved, lengths = env.achieved_goal(jnp.asarray(episodes.observations)), jnp.asarray(episodes.lengths)
    return summary, achieved, lengths, epsilon_from_demonstrations(achieved, lengths, m=m, k=k)


def _check_demo(demo: int, num_demos: int, file: Path) -> None:
    if not 0 <= demo < num_demos:
        raise UserError(f"{file} has no demonstration {demo}: choose one from 0 to {num_demos - 1}")


@dataclasses.dataclass(frozen=True)
class RenderDemo:
    """Film a demonstration."""

    file: tyro.conf.Positional[Path]
    """The HDF5 file."""
    to: Path | None = None
    """A .gif file, or a .png file for the last state (default: the file's name with .gif)."""
    demo: int = 0
    """Which demonstration, counted from 0."""


def _demos_render(arguments: list[str]) -> None:
    """Film a demonstration."""
    options = _parse(RenderDemo, arguments, "hindrl demos render")
    summary = describe_demonstrations(options.file)
    states = read_states(options.file)
    _check_demo(options.demo, len(states), options.file)
    path = options.to or options.file.with_suffix(".gif")
    draw_episode(path, make(summary.env_name, **summary.env_kwargs), states[options.demo])
    console.print(f"wrote {path}: {len(states[options.demo]) - 1} steps")


def _envs(arguments: list[str]) -> None:
    """List the environments."""
    _parse(dataclasses.make_dataclass("Envs", []), arguments, "hindrl envs", "List the environments with their dimensions.")
    table = Table("environment", "observation", "goal", "action", "horizon", box=box.SIMPLE_HEAD)
    for entry in TASKS.values():
        env: RestorableEnvironment = entry.environment()
        table.add_row(env.name, *map(str, (env.observation_dim, env.goal_dim, env.action_dim, env.horizon)))
    console.print(table)
    for entry in TASKS.values():
        console.print(f"{entry.environment.name}: {entry.summary}")
        for field in dataclasses.fields(entry.environment):
            console.print(f"  --{field.name.replace('_', '-')} (default {field.default})")


# ------------------------------------------------------------------------------------------------------------------------------ reproduce


@dataclasses.dataclass(frozen=True)
class Ablation:
    """Options of `hindrl reproduce ablation`."""

    out: Path = Path("runs/ablation")
    """Directory of the tables and of all runs. Started again with the same options, what is finished there is kept and the rest is trained."""
    tasks: tuple[str, ...] = ()
    """What to train on: fixed-1, fixed-5 or random-50, the fixed or the random grid with that many demonstrations (default: all)."""
    levers: tuple[str, ...] = ()
    """The changes to train, next to the recipe as it is (default: all; --list shows them)."""
    seeds: int = 16
    """Number of seeds, side by side; the same for all changes. With fewer than 8 or so the intervals are much too narrow."""
    seed: int = 2_000
    """The first seed; the others follow it."""
    steps: int | None = None
    """Environment steps of each run (default: the recipe's)."""
    overwrite: bool = False
    """Replace runs that were made with other options. To train one again with the same options, remove its directory."""
    list: bool = False
    """Show the changes there are, and train nothing."""


def _reproduce_ablation(arguments: list[str]) -> None:
    """Train the default recipe with one change at a time, and compare."""
    options = _parse(Ablation, arguments, "hindrl reproduce ablation", _reproduce_ablation.__doc__)
    if options.list:
        console.print(_lever_table())
        return
    tasks = _chosen(options.tasks, ablation.ABLATION_TASKS, "--tasks")
    levers = {lever.name: lever for lever in ablation.LEVERS}
    names = _chosen(options.levers, levers, "--levers")
    if options.seeds < 2:
        raise UserError(f"--seeds {options.seeds} is too few: an interval needs at least 2")
    settings_of = functools.partial(ablation.settings_of, options.out, seeds=_seeds(options.seeds, options.seed), steps=options.steps)
    settings = settings_of(tasks=tasks, levers=[levers[name] for name in names])
    # The tables hold all that is there, also from an earlier start with other levers, so all of it must be of the same options.
    everything = settings_of(tasks=ablation.ABLATION_TASKS, levers=ablation.LEVERS)
    ablation.check_can_train(settings if options.overwrite else everything, overwrite=options.overwrite)
    for setting in settings:
        steps_to_learn(setting.spec.env, setting.spec.config)
    to_train = [setting for setting in settings if not ablation.is_finished(setting)]
    kept = len(settings) - len(to_train)
    console.print(f"{_count(len(to_train), 'setting')} to train, {_count(options.seeds, 'seed')} from {options.seed}, {kept} finished before")

    started = time.perf_counter()
    with _progress(transient=True) as progress:
        for trained, setting in enumerate(to_train, 1):
            name = f"{setting.task} {setting.lever.name}: "
            bar = _add_bar(progress, setting.spec.config, name=name)
            ablation.train(setting, report=functools.partial(_advance, progress, bar, name=name))
            progress.remove_task(bar)
            outcomes = ablation.outcomes_of(everything)
            ablation.write_tables(options.out, outcomes)
            left = len(to_train) - trained
            minutes = (time.perf_counter() - started) / trained * left / 60
            (outcome,) = (outcome for outcome in outcomes if outcome.setting == setting)
            progress.console.print(_outcome_line(outcome) + (f"   {left} left, about {minutes:,.0f} min" if left else ""))
    if not to_train:
        ablation.write_tables(options.out, ablation.outcomes_of(everything))
    console.print(f"wrote {options.out}: {ablation.TABLE}, {ablation.TEXT}, {ablation.PICTURE}, and a run's directory for each setting")


def _chosen(names: Sequence[str], known: Iterable[str], flag: str) -> list[str]:
    """The chosen ones of what is known, each once and in the order in which they are known; all of them where none is chosen."""
    known = list(known)
    for name in names:
        if name not in known:
            raise UserError(f"{flag} {name} is not known{did_you_mean(name, known)}: choose among {', '.join(known)}")
    return [name for name in known if name in names or not names]


def _lever_table() -> Table:
    table = Table("lever", "group", "what it changes", box=box.SIMPLE_HEAD)
    for lever in ablation.LEVERS:
        table.add_row(lever.name, lever.group, lever.summary)
    return table


def _outcome_line(outcome: ablation.Outcome) -> str:
    spec, steps = outcome.setting.spec, outcome.steps_to_95.estimate
    median = f"median {steps:9,.0f} steps" if np.isfinite(steps) else f"median {'never':>9}      "
    return (
        f"{outcome.setting.task:<10}{outcome.setting.lever.name:<22}{outcome.seeds_reaching_95:3d} of {len(spec.seeds)} reach 95%, {median}   "
        f"final {outcome.final_success.estimate:4.0%}   {outcome.seconds_per_seed * len(spec.seeds):6.1f} s"
    )


# ------------------------------------------------------------------------------------------------------------------------------- plumbing

Command = Callable[[list[str]], None]
COMMANDS: dict[str, Command | dict[str, Command]] = {
    "train": _train,
    "sweep": _sweep,
    "eval": _eval,
    "render": _render,
    "demos": {"record": _demos_record, "info": _demos_info, "plot": _demos_plot, "render": _demos_render},
    "reproduce": {"ablation": _reproduce_ablation},
    "envs": _envs,
}


def _parse(arguments_class: type[Any], arguments: list[str], program: str, description: str | None = None) -> Any:
    """tyro, with its page of explanation on a mistake cut down to one line."""
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            return tyro.cli(arguments_class, args=arguments, prog=program, description=description, config=_TYRO)
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        raise UserError(_first_sentence(complaint.getvalue()) + f" (see {program} --help)") from None


def _first_sentence(complaint: str) -> str:
    """The message of tyro's box, and the flag it suggests, if any. Where the terminal is not known to speak UTF-8, the box has no visible border."""
    bordered = "│" in complaint
    lines = [line.strip("│ ") for line in complaint.splitlines() if line.startswith("│") or not bordered]
    sections: list[list[str]] = [[]]
    for line in lines:
        if line and set(line) <= {"─", "-"}:
            sections.append([])
        elif line:
            sections[-1].append(line)
    message, *rest = sections if bordered else sections[1:]  # without a border, the title is a section of its own
    text = re.sub(r"^Error parsing (?!-)\S+: ", "", " ".join(message))
    suggestion = next((line.split()[0] for section in rest for line in section if line.startswith("--")), None)
    return f"{text} (did you mean {suggestion}?)" if suggestion and text.startswith("Unrecognized") else text


def _usage() -> str:
    lines = [f"hindrl {__version__}: learn sparse-reward tasks from a handful of demonstrations", ""]
    for name, command in COMMANDS.items():
        for words, function in [(name, command)] if callable(command) else [(f"{name} {sub}", f) for sub, f in command.items()]:
            lines.append(f"  hindrl {words:<20}{function.__doc__}")
    return "\n".join([*lines, "", "Each takes --help."])


def _find(arguments: list[str]) -> tuple[Command, list[str]]:
    commands: Any = COMMANDS
    words = "hindrl"
    while isinstance(commands, dict):
        if not arguments or arguments[0] not in commands:
            given = (
                f"{arguments[0]!r} is not a command of {words!r}{did_you_mean(arguments[0], commands)}" if arguments else f"{words!r} needs a command"
            )
            raise UserError(f"{given}: choose one of {', '.join(commands)}")
        words, commands, arguments = f"{words} {arguments[0]}", commands[arguments[0]], arguments[1:]
    return commands, arguments


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def _set_up_jax() -> None:
    """Settings that the user should not have to know, unless set by the user.

    Compiled programs are kept in the user's cache folder, so that a second start takes seconds. JAX_COMPILATION_CACHE_DIR names another folder,
    JAX_ENABLE_COMPILATION_CACHE=false turns it off. Each core counts as a device, so that several seeds are spread over the cores:
    a core is busier with a seed of its own than with its share of every operation. JAX_NUM_CPU_DEVICES=1 turns that off.
    """
    if jax.config.jax_compilation_cache_dir is None:
        folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "hindrl_jax"
        jax.config.update("jax_compilation_cache_dir", str(folder))
    if "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS" not in os.environ:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
    if "JAX_NUM_CPU_DEVICES" not in os.environ and "xla_force_host_platform_device_count" not in os.environ.get("XLA_FLAGS", ""):
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
        jax.config.update("jax_num_cpu_devices", cores or 1)


def main(arguments: list[str] | None = None) -> None:
    """Entry point of the `hindrl` command; with arguments given, runs within this process as it is."""
    if arguments is None:
        arguments = sys.argv[1:]
        _set_up_jax()
    *group, last = arguments or [""]
    if last in ("--help", "-h") and (not group or (len(group) == 1 and isinstance(COMMANDS.get(group[0]), dict))):
        print(_usage())
        return
    try:
        with warnings.catch_warnings():
            warnings.showwarning = lambda message, *_, **__: print(f"hindrl: warning: {message}", file=sys.stderr)
            command, rest = _find(arguments)
            command(rest)
    except UserError as error:
        print(f"hindrl: {one_line(error)}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("hindrl: interrupted", file=sys.stderr)
        sys.exit(130)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
