"""The options of `hindrl train` and `hindrl sweep`, and what they ask for."""

from __future__ import annotations

import dataclasses
import re
import warnings
from pathlib import Path
from typing import Annotated, Any

import tyro

from hindrl_jax.base.errors import UserError
from hindrl_jax.cli.common import ENV_HELP, env_names, environment_of, parse, peek, seeds_from
from hindrl_jax.cli.help_pages import as_typed
from hindrl_jax.config import TrainConfig, without_effect
from hindrl_jax.demonstrations.convert import MINARI_PREFIX, open_source
from hindrl_jax.runs.spec import FROM_PYTHON, RunSpec, read_spec
from hindrl_jax.tasks.presets import Preset, original_rules, preset
from hindrl_jax.tasks.registry import task
from hindrl_jax.training.checks import check_config, check_trainable

_FIRST_TASK = "FixedGridPickAndPlace"
_BRIEF = {  # what --help shows
    "what to train": {
        "env NAME": "a task of `hindrl envs`, gymnasium:ID, or MODULE:NAME for your own; a file of --demos says its own",
        "demos N|FILE": "how many demonstrations the task's expert records for each seed, or a file of them",
        "algo NAME": "bc, tqcfd, hindrl or smooth-hindrl",
        "preset NAME": "where the other defaults come from: default, thesis, original or rlpd",
        "steps N": "environment steps of each seed; for bc, which takes none, gradient steps (default: 50,000 decisions, at least 100,000 steps)",
        "stop-at SHARE": "stop when this share of episodes is solved, for example 0.95",
    },
    "the run": {
        "seeds N": "how many seeds are trained side by side (default: 1)",
        "seed N": "the first of them (default: 0)",
        "out DIR": "where the run is written (default: in runs/, named after task and time)",
        "overwrite": "replace a run that is already there",
        "resume DIR": "go on with a run that was stopped",
        "config DIR": "run again what a run's config.json says; other flags change it",
    },
    "learning": {
        "learning-rate X": "step size of Adam",
        "batch-size N": "rows of a gradient step",
        "net-arch N ...": "widths of the hidden layers",
        "bc-weight X": "how much the demonstrated actions are imitated",
        "relabelled-per-original X": "relabelled rows for each original one",
        "action-hold N": "control steps for which each action is held (default: by the demonstrations' length)",
    },
}
_EXAMPLES = {
    "hindrl train": (
        "hindrl train --env FixedParameterizedReach --demos 1 --seeds 4",
        "hindrl train --demos demos.hdf5 --steps 100000 --out runs/mine",
        "hindrl train --resume runs/mine",
    ),
    "hindrl sweep": ("hindrl sweep --over learning_rate=1e-4,3e-4,1e-3 --seeds 8",),
}


@dataclasses.dataclass(frozen=True)
class TrainOptions:
    """Options of `hindrl train` and `hindrl sweep` that belong to the run as a whole."""

    demos: str = "1"
    """How many demonstrations the task's expert records for each seed, or a file of them (.hdf5, .npz, or minari:NAME-v0) that all seeds share."""
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
    render_every: int | None = None
    """Also film an episode of the first seed every so many steps, into the folder films of the run's directory: always the same episode, with the
    policy of that moment. Drawing counts into the run's seconds."""
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
    render_every: int | None = None
    """Steps between two films from here on; they are not made without saying so."""
    tensorboard: bool = False
    """Also write event files for TensorBoard, with what went before; without saying so where the run did before."""
    wandb: bool = False
    """Likewise for Weights & Biases, which gets new runs with what went before."""


def parse_train(
    arguments: list[str], program: str = "hindrl train", description: str | None = None, options_class: type[TrainOptions] = TrainOptions
) -> tuple[RunSpec, Any]:
    """What is to be trained, and the options of the run as a whole.

    Environment, algorithm and preset decide which flags there are and their defaults, so they are read first.

    Raises:
      UserError: if something is not usable.
    """
    chosen = {name: peek(arguments, name) for name in ("env", "algo", "preset", "config", "demos")}
    spec = _defaults(chosen, arguments)
    fields: list[tuple[str, Any, Any, str]] = [
        ("env", env_names(chosen["env"] or spec.env.name), spec.env.name, ENV_HELP),
        (
            "preset",
            Preset,
            chosen["preset"] or "default",
            "Where the other defaults come from: this project, the thesis, its original code, or RLPD.",
        ),
        ("config", Path | None, None, "Run again what a config.json (or the directory of a run) says; other flags change it."),
        ("resume", Path | None, None, "Go on with the run, or sweep, of a directory that was stopped or killed, as if it had not been stopped."),
        ("run", options_class, options_class(demos=spec.demos), ""),
        ("environment", type(spec.env), spec.env, ""),
        ("training", TrainConfig, spec.config, ""),  # last, since its quirks are what fewest people look for
    ]
    namespace = dataclasses.make_dataclass(
        "Train",
        [(name, Annotated[kind, tyro.conf.arg(help=text)] if text else kind, default) for name, kind, default, text in fields],
        frozen=True,
    )
    chosen_flags = (
        _BRIEF
        if options_class is TrainOptions
        else {"what to sweep": {"over NAME=X,Y": "an option and its values; given several times, all combinations"}, **_BRIEF}
    )
    parsed = parse(namespace, arguments, program, description, (chosen_flags, _EXAMPLES[program]))
    check_trainable(parsed.environment)
    check_config(parsed.environment, parsed.training)
    _warn_of_what_has_no_effect(spec.config, parsed.training)
    demos = parsed.run.demos
    if not (is_number(demos) or demos == FROM_PYTHON or demos.startswith(MINARI_PREFIX)):
        demos = str(Path(demos).absolute())
    return RunSpec(env=parsed.environment, config=parsed.training, demos=demos, seeds=_seeds(parsed.run, spec.seeds)), parsed.run


def _defaults(chosen: dict[str, Any], arguments: list[str]) -> RunSpec:
    """What is trained where no other flag is given."""
    if chosen["config"] is not None:
        for name in ("env", "algo", "preset"):
            if chosen[name] is not None:
                raise UserError(f"--{name} and --config exclude each other: the configuration file says it; drop one of them")
        return read_spec(Path(chosen["config"]))
    env_arguments: dict[str, Any] = {}
    name = chosen["env"]
    if name is None:
        name, env_arguments = _task_of(chosen["demos"]) or (_FIRST_TASK, {})
    if chosen["preset"] == "original":
        env_arguments = env_arguments | original_rules(task(name).environment)
    env = environment_of(arguments, name, **env_arguments)
    config = preset(chosen["algo"] or "hindrl", chosen["preset"] or "default", env=env)
    return RunSpec(env=env, config=config, demos="1", seeds=(0,))


def _task_of(demos: str | None) -> tuple[str, dict[str, Any]] | None:
    """The name and the arguments of the task in which a file of demonstrations was recorded, as far as it can be trained in.

    None where there is no such file or it does not say so. A damaged one is refused when its demonstrations are read.
    """
    if demos is None or is_number(demos) or not (demos.startswith(MINARI_PREFIX) or Path(demos).is_file()):
        return None
    try:
        found = open_source(demos)
        entry = task(found.env_name)
        known = {field.name for field in dataclasses.fields(entry.environment)}
    except UserError:
        return None
    given = {name: value for name, value in found.env_kwargs.items() if name in known}
    if given.get("backend") == "robosuite":  # which records and evaluates, and does not train; its files fit the other back ends
        del given["backend"]
    return found.env_name, given


def _seeds(options: TrainOptions, default: tuple[int, ...]) -> tuple[int, ...]:
    if options.seeds is None and options.seed is None:
        return default
    count, first = (len(default) if options.seeds is None else options.seeds), (default[0] if options.seed is None else options.seed)
    if count < 1:
        raise UserError(f"--seeds {count} is too few: train at least 1 seed")
    return seeds_from(count, first)


def _warn_of_what_has_no_effect(before: Any, section: Any, config: TrainConfig | None = None) -> None:
    """About the fields that the user has changed, and which nothing will read; also those of the sections of a config."""
    config = config or section
    for field in dataclasses.fields(section):
        value, value_before = getattr(section, field.name), getattr(before, field.name)
        if dataclasses.is_dataclass(value) and not callable(value):  # a section, not a network of one's own
            _warn_of_what_has_no_effect(value_before, value, config)
        elif value != value_before and (reason := without_effect(config, field.name)):
            warnings.warn(f"{_as_given(field.name, value)} changes nothing: {reason}", stacklevel=2)


def _as_given(name: str, value: Any) -> str:
    """A field and its value as a flag of the command line."""
    flag = name.replace("_", "-")
    if isinstance(value, bool):
        return f"--{flag}" if value else f"--no-{flag}"
    return f"--{flag} {as_typed(value)}"


def parse_resume(arguments: list[str], program: str) -> ResumeOptions:
    """What `program --resume` is given."""
    return parse(ResumeOptions, arguments, f"{program} --resume DIRECTORY", "Go on with what was stopped or killed.")


def is_number(demos: str) -> bool:
    """Whether demonstrations are given as a number to record."""
    return re.fullmatch(r"[+-]?[0-9]{1,100}", demos) is not None
