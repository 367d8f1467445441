"""`hindrl demos record`, `convert` and `render`; `hindrl_jax.cli.inspection` shows what they hold."""

from __future__ import annotations

import contextlib
import dataclasses
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro

from hindrl_jax.base.environments import Environment
from hindrl_jax.base.errors import UserError
from hindrl_jax.base.files import check_can_write
from hindrl_jax.base.types import Episodes
from hindrl_jax.cli.common import ENV_HELP, check_episodes, console, counted, env_names, environment_of, episode_key, parse, peek
from hindrl_jax.demonstrations.convert import MINARI_PREFIX, check_target, left_out, read, restore, write
from hindrl_jax.demonstrations.foreign import Interpretation
from hindrl_jax.demonstrations.hdf5 import save_demonstrations
from hindrl_jax.demonstrations.recording import summarise_recording
from hindrl_jax.experts.by_hand import record_by_hand
from hindrl_jax.experts.robosuite_arm import DeviceName
from hindrl_jax.runs.reader import draw_episodes
from hindrl_jax.tasks.registry import TASKS, checked, make, task
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
    """Play yourself, instead of the expert: steer the arm of a reach task in robosuite, in real time, or with the keyboard those of a cable task.
    Give yourself a long --horizon."""


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
            ("environment", entry.environment, environment_of(arguments, name)),
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
        raise UserError(
            f"--device {options.device} steers a robot's arm, and {env.name} has none: choose a reach or a cable environment, or drop --device"
        )
    if env.backend not in ("closed_form", "robosuite"):
        raise UserError(f"--device {options.device} steers the arm of robosuite: drop --backend {env.backend}, or drop --device")
    env = checked(lambda: dataclasses.replace(env, backend="robosuite"))
    return env, record_by_hand(episode_key(options.seed), env, options.device, options.demos, report=console.print)


def beside(source: str, suffix: str) -> Path:
    """Where a picture of demonstrations goes: beside their file, or for a dataset of Minari here."""
    return Path(source.removeprefix(MINARI_PREFIX).rpartition("/")[2] if source.startswith(MINARI_PREFIX) else source).with_suffix(suffix)


_SOURCE_ENV = "The environment, where the file does not say so: one of ours, gymnasium:ID, or MODULE:NAME for a task of your own."
_AS_ENV = "The environment, likewise, whatever the file says: demonstrations of another program's task are declared to be of this one."


def parse_with_meaning(
    options_class: type[Any], arguments: list[str], program: str, description: str | None
) -> tuple[Any, Interpretation, dict[str, Any]]:
    """The options of a command that reads files of any tool: its own, what the modalities mean, and what `convert.read` is told of the environment.

    Raises:
      UserError: for what cannot be understood, and for two environments.
    """
    given = {flag: name for flag in ("env", "as-env") if (name := peek(arguments, flag)) is not None}
    if len(given) > 1:
        raise UserError(f"--env {given['env']} and --as-env {given['as-env']} exclude each other: drop one of them")
    name = next(iter(given.values()), None)
    fields: list[tuple[str, Any, Any]] = [
        ("options", options_class, dataclasses.MISSING),
        ("meaning", Interpretation, Interpretation()),
    ]
    if name is not None:
        environment = environment_of(arguments, name)
        fields.append(("environment", type(environment), environment))
    names = env_names(name) if name is not None else Literal[tuple(TASKS)]
    fields += [(flag, Annotated[names | None, tyro.conf.arg(help=text)], None) for flag, text in (("env", _SOURCE_ENV), ("as_env", _AS_ENV))]
    namespace = dataclasses.make_dataclass(
        "Options", [(field, kind) if default is dataclasses.MISSING else (field, kind, default) for field, kind, default in fields], frozen=True
    )
    parsed = parse(namespace, arguments, program, description)
    return parsed.options, parsed.meaning, {"env": getattr(parsed, "environment", None), "as_env": "as-env" in given}


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
    options, meaning, environment = parse_with_meaning(Convert, arguments, "hindrl demos convert", convert.__doc__)
    check_target(options.target, overwrite=options.overwrite)
    recording = read(options.source, meaning, **environment)
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


def check_demo(demo: int, num_demos: int, file: Path | str) -> None:
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
    options, meaning, environment = parse_with_meaning(RenderDemo, arguments, "hindrl demos render", render.__doc__)
    recording = read(options.source, meaning, **environment)
    states = [demo.states for demo in recording.demonstrations]
    if any(one is None for one in states):
        raise UserError(f"{options.source}: holds no states of one of our environments, which a film takes; render what hindrl demos record wrote")
    check_episodes(options.episodes, "film")
    for demo in (options.demo, options.demo + options.episodes - 1):
        check_demo(demo, len(states), options.source)
    path = options.to or beside(options.source, ".gif")
    shown = states[options.demo : options.demo + options.episodes]
    draw_episodes(path, make(recording.env_name, **recording.env_kwargs), shown)
    console.print(f"wrote {path}: {sum(len(one) - 1 for one in shown)} steps{f' of {len(shown)} demonstrations' if len(shown) > 1 else ''}")
