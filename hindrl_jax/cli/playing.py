"""`hindrl eval` and `hindrl render`: what the policies of a run do."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import jax.numpy as jnp
import tyro
from rich import box
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from hindrl_jax.cli.common import check_episodes, console, counted, episode_key, parse
from hindrl_jax.runs.reader import load_run
from hindrl_jax.runs.shipped import PREFIX
from hindrl_jax.training.playing import plays_one_by_one
from hindrl_jax.training.progress import ProgressBar


@dataclasses.dataclass(frozen=True)
class Eval:
    """Play fresh episodes with the policies of a run."""

    directory: tyro.conf.Positional[str]
    """Directory of the run, or policy:NAME for one that comes with the package (`hindrl policies` lists them)."""
    episodes: int = 100
    """Episodes per seed."""
    seed: int = 0
    """Which episodes: equal numbers give equal ones, in the same back end."""
    noise: float | None = None
    """Of the actions: 0 for the mean ones, 1 for sampled ones (default: what the run has found to be best)."""
    last: bool = False
    """The policies at the end of the run, instead of the best that it has seen."""
    backend: str | None = None
    """Simulate the environment with another of its back ends, for example robosuite, which plays one episode after the other."""


def evaluate(arguments: list[str]) -> None:
    """Play fresh episodes with the policies of a run."""
    options = parse(Eval, arguments, "hindrl eval")
    check_episodes(options.episodes, "play")
    run = load_run(options.directory, last=options.last)
    if options.backend is not None:
        run = run.in_backend(options.backend)
    columns = (TextColumn("{task.completed}/{task.total} episodes"), BarColumn(), TimeRemainingColumn())
    one_by_one = plays_one_by_one(run.spec.env)
    with ProgressBar(console=console) as waiting, Progress(*columns, console=console, transient=True, disable=not one_by_one) as progress:
        if not one_by_one:
            waiting.wait("compiling, and playing")
        bar = progress.add_task("", total=options.episodes * len(run.spec.seeds))
        outcomes = run.evaluate(
            episodes=options.episodes,
            key=episode_key(options.seed),
            noise=options.noise,
            report=lambda played: progress.update(bar, completed=played),
        )
    table = Table("seed", "success", "length", box=box.SIMPLE_HEAD)
    where = f" in {options.backend}" if options.backend else ""
    console.print(f"{run.spec.env.name}{where}, {counted(options.episodes, 'episode')} per seed")
    for outcome in outcomes:
        table.add_row(str(outcome["seed"]), f"{outcome['success']:.1%}", f"{outcome['episode_length']:.1f}")
    console.print(table)


@dataclasses.dataclass(frozen=True)
class Render:
    """Film episodes of a run's policy."""

    directory: tyro.conf.Positional[str]
    """Directory of the run, or policy:NAME for one that comes with the package (`hindrl policies` lists them)."""
    to: Path | None = None
    """A .gif or .mp4 file, or a .png file for the last state (default: a .gif in DIRECTORY, named after episode and seed; of
    policy:NAME, here). For .mp4 install av."""
    seed: int | None = None
    """Whose policy: one of the run's seeds (default: the first)."""
    episode: int = 0
    """Which episode: equal numbers give equal ones."""
    episodes: int = 1
    """How many, one after the other, from that one on."""
    noise: float | None = None
    """Of the actions: 0 for the mean ones, 1 for sampled ones (default: what the run has found to be best)."""
    last: bool = False
    """The policy at the end of the run, instead of the best that it has seen."""


def render(arguments: list[str]) -> None:
    """Film episodes of a run's policy."""
    options = parse(Render, arguments, "hindrl render")
    check_episodes(options.episodes, "film")
    run = load_run(options.directory, last=options.last)
    name = f"episode_{options.episode}_seed_{run.spec.seeds[0] if options.seed is None else options.seed}.gif"
    ships = options.directory.startswith(PREFIX)  # and so its directory is the installation's
    path = options.to or (Path(f"{options.directory.removeprefix(PREFIX)}_{name}") if ships else Path(options.directory) / name)
    keys = jnp.stack([episode_key(options.episode + number) for number in range(options.episodes)])
    with ProgressBar(console=console) as waiting:
        waiting.wait("compiling, playing and drawing")
        solved = run.render(path, seed=options.seed, key=keys, noise=options.noise)
    single = f"the episode is {'solved' if solved else 'not solved'}"
    console.print(f"wrote {path}: {single if options.episodes == 1 else f'{solved} of {options.episodes} episodes are solved'}")
