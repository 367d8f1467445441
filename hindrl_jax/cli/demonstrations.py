"""`hindrl demos ...`: recording demonstrations and looking at them."""

from __future__ import annotations

import contextlib
import dataclasses
from pathlib import Path
from typing import Annotated, Literal

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from rich import box
from rich.table import Table

from experts.by_hand import record_by_hand
from experts.recording import on_host
from experts.robosuite_arm import DeviceName
from hindrl_jax.cli.common import console, counted, episode_key, parse, peek
from hindrl_jax.datasets import DemonstrationSummary, check_can_write, describe_demonstrations, load_demonstrations, read_states, save_demonstrations
from hindrl_jax.errors import UserError
from hindrl_jax.experiment import record_demonstrations
from hindrl_jax.goals import epsilon_filter, epsilon_from_demonstrations, goal_table
from hindrl_jax.plots import save_filter
from hindrl_jax.registry import TASKS, make, task
from hindrl_jax.runs import disk_trouble, draw_episodes
from hindrl_jax.types import Episodes, RestorableEnvironment


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


def record(arguments: list[str]) -> None:
    """Record demonstrations with the task's expert, or by hand."""
    name = peek(arguments, "env") or "FixedGridPickAndPlace"
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
    parsed = parse(namespace, arguments, "hindrl demos record", record.__doc__)
    options, env = parsed.options, parsed.environment
    episode_key(options.seed)
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
    console.print(f"wrote {options.out}: {counted(len(lengths), 'demonstration')} of {env.name}, mean length {lengths.mean():.1f} steps")


def _record_by_hand(env: RestorableEnvironment, options: Record) -> tuple[RestorableEnvironment, Episodes]:
    """The environment in robosuite, and what a person did there."""
    if not hasattr(env, "backend"):
        raise UserError(f"--device {options.device} steers a robot's arm, and {env.name} has none: choose a reach environment, or drop --device")
    if env.backend == "mjx":
        raise UserError(f"--device {options.device} steers the arm of robosuite: drop --backend mjx, or drop --device")
    env = dataclasses.replace(env, backend="robosuite")
    return env, record_by_hand(episode_key(options.seed), env, options.device, options.demos, report=console.print)


@dataclasses.dataclass(frozen=True)
class Info:
    """Say what a file of demonstrations holds."""

    file: tyro.conf.Positional[Path]
    """The HDF5 file."""
    m: int = 0
    """Distance in steps for epsilon (thesis eq. 4.7)."""
    k: float = 0.0
    """Weight of the standard deviation in epsilon (thesis eq. 4.7)."""


def info(arguments: list[str]) -> None:
    """Say what a file of demonstrations holds."""
    options = parse(Info, arguments, "hindrl demos info")
    summary, achieved, lengths, epsilon = _with_epsilon(options.file, m=options.m, k=options.k)
    filtered = goal_table(achieved, lengths, epsilon, filtered=True)
    console.print(f"{options.file}: {summary.env_name}({', '.join(f'{name}={value}' for name, value in summary.env_kwargs.items())})")
    console.print(
        f"{counted(summary.num_demonstrations, 'demonstration')}, {summary.num_solved} solved, {summary.num_transitions} transitions, "
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


def plot(arguments: list[str]) -> None:
    """Draw what the epsilon filter keeps of a demonstration."""
    options = parse(PlotDemo, arguments, "hindrl demos plot")
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
    """Film demonstrations."""

    file: tyro.conf.Positional[Path]
    """The HDF5 file."""
    to: Path | None = None
    """A .gif or .mp4 file, or a .png file for the last state (default: the file's name with .gif). For .mp4 install av."""
    demo: int = 0
    """Which demonstration, counted from 0."""
    episodes: int = 1
    """How many, one after the other, from that one on."""


def render(arguments: list[str]) -> None:
    """Film demonstrations."""
    options = parse(RenderDemo, arguments, "hindrl demos render")
    summary = describe_demonstrations(options.file)
    states = read_states(options.file)
    if options.episodes < 1:
        raise UserError(f"--episodes {options.episodes} is too few: film at least 1")
    for demo in (options.demo, options.demo + options.episodes - 1):
        _check_demo(demo, len(states), options.file)
    path = options.to or options.file.with_suffix(".gif")
    shown = states[options.demo : options.demo + options.episodes]
    draw_episodes(path, make(summary.env_name, **summary.env_kwargs), shown)
    console.print(f"wrote {path}: {sum(len(one) - 1 for one in shown)} steps{f' of {len(shown)} demonstrations' if len(shown) > 1 else ''}")
