"""`hindrl demos ...`: recording demonstrations and looking at them."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from rich import box
from rich.table import Table

from hindrl_jax.base.environments import Environment
from hindrl_jax.base.errors import UserError
from hindrl_jax.base.files import check_can_write, disk_trouble
from hindrl_jax.base.types import Episodes
from hindrl_jax.cli.common import ENV_HELP, console, counted, env_names, episode_key, parse, peek
from hindrl_jax.core.goals import epsilon_filter, epsilon_from_demonstrations, is_visited
from hindrl_jax.demonstrations.convert import MINARI_PREFIX, check_target, left_out, open_source, read, restore, understand, write
from hindrl_jax.demonstrations.episodes import padded
from hindrl_jax.demonstrations.foreign import ForeignRecording, Interpretation
from hindrl_jax.demonstrations.hdf5 import save_demonstrations
from hindrl_jax.demonstrations.recording import Recording, summarise_recording
from hindrl_jax.experts.by_hand import record_by_hand
from hindrl_jax.experts.robosuite_arm import DeviceName
from hindrl_jax.plotting.curves import save_filter
from hindrl_jax.runs.reader import draw_episodes
from hindrl_jax.tasks.registry import TASKS, make, task
from hindrl_jax.training.playing import plays_one_by_one
from hindrl_jax.training.recording import record_demonstrations


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
    if entry.expert is None:
        raise UserError(f"no expert is known for {name}: give one to hindrl_jax.register, or record a policy with hindrl_jax.record_gymnasium")
    namespace = dataclasses.make_dataclass(
        "Record",
        [
            ("options", Record),
            ("env", Annotated[env_names(name), tyro.conf.arg(help=ENV_HELP)], name),
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
        with console.status("recording") if plays_one_by_one(env) else contextlib.nullcontext():  # it takes seconds for each episode
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


def _record_by_hand(env: Any, options: Record) -> tuple[Environment, Episodes]:
    """The environment in robosuite, and what a person did there."""
    if not hasattr(env, "backend"):
        raise UserError(f"--device {options.device} steers a robot's arm, and {env.name} has none: choose a reach environment, or drop --device")
    if env.backend == "mjx":
        raise UserError(f"--device {options.device} steers the arm of robosuite: drop --backend mjx, or drop --device")
    env = dataclasses.replace(env, backend="robosuite")
    return env, record_by_hand(episode_key(options.seed), env, options.device, options.demos, report=console.print)


@dataclasses.dataclass(frozen=True)
class Info:
    """Options of `hindrl demos info`."""

    source: tyro.conf.Positional[str]
    """The file, of hindrl_jax or another tool (.hdf5, .npz), or minari:NAME-v0."""
    epsilon_steps: int = 0
    """Distance in steps for epsilon (m of thesis eq. 4.7)."""
    epsilon_deviations: float = 0.0
    """Weight of the standard deviation in epsilon (k of thesis eq. 4.7)."""


def info(arguments: list[str]) -> None:
    """Say what a file of demonstrations holds."""
    options, meaning, env = _parse_with_meaning(Info, arguments, "hindrl demos info", info.__doc__)
    _check_epsilon(options)
    found = open_source(options.source)
    if isinstance(found, ForeignRecording):
        _print_foreign(found)
    try:
        recording = understand(found, options.source, meaning, env)
    except UserError as error:
        if not isinstance(found, ForeignRecording) or meaning != Interpretation() or env is not None:
            raise
        console.print(f"not to be learned from as it is: {error}")
        return
    _print_recording(options, recording)


def _print_foreign(found: ForeignRecording) -> None:
    """What can be said before it is known which modality is what."""
    demos = found.demonstrations
    lengths = [len(demo.actions) for demo in demos]
    console.print(
        f"{found.source}: {found.format}, {found.env_name}, {counted(len(demos), 'demonstration')}, {sum(lengths)} transitions, "
        f"lengths {min(lengths)} to {max(lengths)}, median {np.median(lengths):g}"
    )
    for key, names in found.filters.items():
        console.print(f"filter key {key}: {counted(len(names), 'demonstration')}")
    table = Table("modality", "numbers", "min", "max", box=box.SIMPLE_HEAD)
    for key, width in found.shapes.items():
        rows = [demo.modalities[key] for demo in demos if key in demo.modalities]
        table.add_row(key, str(width), f"{min(row.min() for row in rows):.4g}", f"{max(row.max() for row in rows):.4g}")
    actions = np.concatenate([demo.actions for demo in demos])
    table.add_row("actions", str(actions.shape[1]), f"{actions.min():.4g}", f"{actions.max():.4g}")
    console.print(table)


def _print_recording(options: Info, recording: Recording) -> None:
    summary = summarise_recording(options.source, recording)
    achieved, lengths, epsilon = _goals(recording, options)
    kept = is_visited(lengths, achieved.shape[1]) & jax.vmap(lambda path: epsilon_filter(path, epsilon))(achieved)
    own = ":" in summary.env_name and not summary.env_name.startswith("gymnasium:")  # "module:Name", a task of the user's own
    ours = own or summary.env_name in TASKS
    arguments = ", ".join(f"{name}={value}" for name, value in summary.env_kwargs.items()) if ours else "..."
    console.print(f"{options.source}: {summary.env_name}({arguments})")
    console.print(
        f"{counted(summary.num_demonstrations, 'demonstration')}, {summary.num_solved} solved, {summary.num_transitions} transitions, "
        f"lengths {summary.length_min} to {summary.length_max}, median {summary.length_median:g}, "
        f"actions from {summary.action_low.min():g} to {summary.action_high.max():g}"
    )
    if summary.expert:
        console.print(f"expert: {', '.join(f'{name}={value}' for name, value in summary.expert.items())}")
    if recording.converted_from:
        console.print(f"converted from {recording.converted_from['format']}")
    console.print(f"the filter keeps {int(jnp.sum(kept))} of {int(jnp.sum(lengths + 1))} goals ({_how(options)})")
    reached = np.concatenate([demo.achieved_goals for demo in recording.demonstrations])
    columns = {
        "observation": _ranges(summary.observation_low, summary.observation_high),
        "goal": _ranges(reached.min(axis=0), reached.max(axis=0)),
        "epsilon": [f"{value:.3g}" for value in epsilon],
        "action": _ranges(summary.action_low, summary.action_high),
    }
    table = Table("dim", *columns, box=box.SIMPLE_HEAD)
    for column in table.columns:
        column.no_wrap = True
    for index, row in enumerate(itertools.zip_longest(*columns.values(), fillvalue="")):
        table.add_row(str(index), *row)
    console.print(table)


def _ranges(low: np.ndarray, high: np.ndarray) -> list[str]:
    return [f"{least:.3g} to {most:.3g}" for least, most in zip(low, high, strict=True)]


@dataclasses.dataclass(frozen=True)
class PlotDemo:
    """Options of `hindrl demos plot`."""

    source: tyro.conf.Positional[str]
    """The file, of hindrl_jax or another tool (.hdf5, .npz), or minari:NAME-v0."""
    to: Path | None = None
    """The .png file (default: the file's name with .png)."""
    demo: int = 0
    """Which demonstration, counted from 0."""
    epsilon_steps: int = 5
    """Distance in steps for epsilon (m of thesis eq. 4.7), over all demonstrations of the file."""
    epsilon_deviations: float = 0.0
    """Weight of the standard deviation in epsilon (k of thesis eq. 4.7)."""
    dims: tuple[int, int] | None = None
    """The two goal dimensions to draw (default: those with the largest extent)."""


def plot(arguments: list[str]) -> None:
    """Draw what the epsilon filter keeps of a demonstration."""
    options, meaning, env = _parse_with_meaning(PlotDemo, arguments, "hindrl demos plot", plot.__doc__)
    path = options.to or _beside(options.source, ".png")
    if path.suffix != ".png":
        raise UserError(f"cannot draw {path.name}: the name must end in .png")
    _check_epsilon(options)
    recording = read(options.source, meaning, env)
    _check_demo(options.demo, len(recording.demonstrations), options.source)
    goals = recording.demonstrations[options.demo].achieved_goals
    if goals.shape[1] < 2:
        raise UserError(f"{options.source}: its goals have one dimension, and the picture takes two; give more --achieved-goal-keys")
    dims = options.dims or tuple(sorted(int(dim) for dim in np.argsort(-np.ptp(_continuous(goals), axis=0), kind="stable")[:2]))
    if len(set(dims)) < 2 or not all(0 <= dim < goals.shape[1] for dim in dims):
        raise UserError(f"--dims {dims[0]} {dims[1]} is not usable: give two different numbers from 0 to {goals.shape[1] - 1}")
    _, _, epsilon = _goals(recording, options)
    kept = np.asarray(epsilon_filter(jnp.asarray(goals, jnp.float32), epsilon))
    title = f"{recording.env_name}, demonstration {options.demo}, {_how(options)}"
    with disk_trouble(path):
        save_filter(goals, kept, np.asarray(epsilon), path, dims=dims, title=title)
    console.print(f"wrote {path}: the filter keeps {kept.sum()} of {len(kept)} goals")


def _beside(source: str, suffix: str) -> Path:
    """Where a picture of demonstrations goes: beside their file, or for a dataset of Minari here."""
    return Path(source.removeprefix(MINARI_PREFIX).rpartition("/")[2] if source.startswith(MINARI_PREFIX) else source).with_suffix(suffix)


def _continuous(goals: np.ndarray) -> np.ndarray:
    """The goals (T, G) without what only jumps between whole numbers, such as masks, unless there is nothing else."""
    whole = (goals == np.round(goals)).all(axis=0)
    return goals if whole.all() else np.where(whole[None], 0.0, goals)


def _goals(recording: Recording, options: Info | PlotDemo) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The goals (N, T + 1, G) that the demonstrations achieved, their lengths (N,), and epsilon (G,) over all of them."""
    demos = recording.demonstrations
    lengths = jnp.asarray([len(demo) for demo in demos])
    achieved = jnp.asarray(padded([demo.achieved_goals for demo in demos], max(len(demo) for demo in demos) + 1))
    epsilon = epsilon_from_demonstrations(achieved, lengths, steps=options.epsilon_steps, deviations=options.epsilon_deviations)
    return achieved, lengths, epsilon


def _check_epsilon(options: Info | PlotDemo) -> None:
    if options.epsilon_steps < 0 or options.epsilon_deviations < 0:
        raise UserError(
            f"--epsilon-steps {options.epsilon_steps} --epsilon-deviations {options.epsilon_deviations} is not usable: both must be 0 or more"
        )


def _how(options: Info | PlotDemo) -> str:
    """How epsilon was made."""
    return f"epsilon over {options.epsilon_steps} steps with {options.epsilon_deviations:g} deviations"


def _parse_with_meaning(
    options_class: type[Any], arguments: list[str], program: str, description: str | None
) -> tuple[Any, Interpretation, Environment | None]:
    """The options of a command that reads files of any tool: its own, what the modalities mean, and the environment, if one is named."""
    name = peek(arguments, "env")
    fields: list[tuple[str, Any, Any]] = [
        ("options", options_class, dataclasses.MISSING),
        ("meaning", Interpretation, Interpretation()),
        (
            "env",
            Annotated[Literal[tuple(TASKS)] | None, tyro.conf.arg(help="The environment, if it is one of ours and the file does not say so.")],
            None,
        ),
    ]
    if name is not None:
        fields.append(("environment", task(name).environment, task(name).environment()))
    namespace = dataclasses.make_dataclass(
        "Options", [(field, kind) if default is dataclasses.MISSING else (field, kind, default) for field, kind, default in fields], frozen=True
    )
    parsed = parse(namespace, arguments, program, description)
    return parsed.options, parsed.meaning, getattr(parsed, "environment", None)


@dataclasses.dataclass(frozen=True)
class Convert:
    """Options of `hindrl demos convert`."""

    source: tyro.conf.Positional[str]
    """A file of hindrl_jax, robomimic or robosuite (.hdf5), an archive (.npz), or minari:NAME-v0."""
    target: tyro.conf.Positional[str]
    """What to write: NAME.hdf5 (a file of hindrl_jax, which robomimic can read too), NAME.npz, or minari:NAME-v0."""
    overwrite: bool = False
    """Replace what is already there."""
    restore: bool = False
    """Write the robomimic file that the source was once converted from, without what the conversion added."""


def convert(arguments: list[str]) -> None:
    """Convert demonstrations from and to robomimic, Minari and npz."""
    options, meaning, env = _parse_with_meaning(Convert, arguments, "hindrl demos convert", convert.__doc__)
    check_target(options.target, overwrite=options.overwrite)
    recording = read(options.source, meaning, env)
    if options.restore:
        restore(options.target, recording, source=options.source, overwrite=options.overwrite)
    else:
        write(options.target, recording, overwrite=options.overwrite)
    summary = summarise_recording(options.source, recording)
    console.print(
        f"wrote {options.target}: {counted(summary.num_demonstrations, 'demonstration')} of {summary.env_name}, {summary.num_solved} solved, "
        f"{summary.num_transitions} transitions"
    )
    for line in left_out(options.target, recording):
        console.print(line)


def _check_demo(demo: int, num_demos: int, file: Path | str) -> None:
    if not 0 <= demo < num_demos:
        raise UserError(f"{file} has no demonstration {demo}: choose one from 0 to {num_demos - 1}")


@dataclasses.dataclass(frozen=True)
class RenderDemo:
    """Film demonstrations."""

    source: tyro.conf.Positional[str]
    """The file, of hindrl_jax or another tool (.hdf5, .npz), or minari:NAME-v0, with states of one of our environments."""
    to: Path | None = None
    """A .gif or .mp4 file, or a .png file for the last state (default: the file's name with .gif). For .mp4 install av."""
    demo: int = 0
    """Which demonstration, counted from 0."""
    episodes: int = 1
    """How many, one after the other, from that one on."""


def render(arguments: list[str]) -> None:
    """Film demonstrations."""
    options, meaning, env = _parse_with_meaning(RenderDemo, arguments, "hindrl demos render", render.__doc__)
    recording = read(options.source, meaning, env)
    states = [demo.states for demo in recording.demonstrations]
    if any(one is None for one in states):
        raise UserError(f"{options.source}: holds no states of one of our environments, which a film takes; render what hindrl demos record wrote")
    if options.episodes < 1:
        raise UserError(f"--episodes {options.episodes} is too few: film at least 1")
    for demo in (options.demo, options.demo + options.episodes - 1):
        _check_demo(demo, len(states), options.source)
    path = options.to or _beside(options.source, ".gif")
    shown = states[options.demo : options.demo + options.episodes]
    draw_episodes(path, make(recording.env_name, **recording.env_kwargs), shown)
    console.print(f"wrote {path}: {sum(len(one) - 1 for one in shown)} steps{f' of {len(shown)} demonstrations' if len(shown) > 1 else ''}")
