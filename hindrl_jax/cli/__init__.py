"""The `hindrl` command: what is typed, and what is printed. Every failure that is the user's to mend is one line on standard error and exit code 2.

`main` runs a command, and `COMMANDS` lists them: a function of the arguments for each, which stands in the module of its kind.
"""

from __future__ import annotations

import os
import platform
import sys
import warnings
from collections.abc import Callable
from typing import Any

import jax

from hindrl_jax import __version__
from hindrl_jax.base.compilation import in_float32, keep_compiled_programs
from hindrl_jax.base.errors import UserError, one_line
from hindrl_jax.cli import comparison, completion, demonstrations, environments, inspection, playing, policies, reproduction, sweeping, training
from hindrl_jax.cli.signals import interrupts_that_last
from hindrl_jax.tasks.registry import did_you_mean

Command = Callable[[list[str]], None]
COMMANDS: dict[str, Command | dict[str, Command]] = {  # in the order in which people come to need them
    "policies": policies.show,
    "envs": environments.show,
    "train": training.train,
    "eval": playing.evaluate,
    "render": playing.render,
    "compare": comparison.compare,
    "demos": {
        "record": demonstrations.record,
        "info": inspection.info,
        "plot": inspection.plot,
        "render": demonstrations.render,
        "convert": demonstrations.convert,
    },
    "sweep": sweeping.sweep,
    "reproduce": reproduction.COMMANDS,
}
_GROUPS = {
    "demos": "Record, inspect, draw, film or convert demonstrations.",
    "reproduce": "Train by a plan: each option by itself, or the thesis's tables and figures.",
}

_STEPS = """\
start with:
  hindrl render policy:FixedParameterizedReach
  hindrl train --env FixedGridPickAndPlace --demos 1 --seed 2 --stop-at 0.98 --out runs/first
  hindrl render runs/first"""


_COMPLETION = 'In bash, `eval "$(hindrl completion)"` has Tab complete commands, options and tasks.'


def _usage() -> str:
    lines = [f"hindrl {__version__}: learn sparse-reward tasks from a handful of demonstrations", "", _STEPS, "", "commands:"]
    lines += [f"  hindrl {name:<11}{command.__doc__ if callable(command) else _GROUPS[name]}" for name, command in COMMANDS.items()]
    return "\n".join([*lines, "", "`hindrl COMMAND --help` explains a command, `hindrl --version` prints the version.", _COMPLETION])


def _usage_of(group: str, commands: dict[str, Command]) -> str:
    """The commands that begin with the same word."""
    width = max(map(len, commands)) + 2
    lines = [f"  hindrl {group} {name:<{width}}{command.__doc__}" for name, command in commands.items()]
    return "\n".join([f"hindrl {group}: {_GROUPS[group]}", "", *lines, "", f"`hindrl {group} COMMAND --help` explains a command."])


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


def _set_up_jax() -> None:
    """Settings that the user should not have to know, unless set by the user.

    Compiled programs are kept (`keep_compiled_programs`). Each core counts as a device, so that several seeds are spread over the cores: a core is
    busier with a seed of its own than with its share of every operation. JAX_NUM_CPU_DEVICES=1 turns that off.
    """
    keep_compiled_programs()
    if "JAX_NUM_CPU_DEVICES" not in os.environ and "xla_force_host_platform_device_count" not in os.environ.get("XLA_FLAGS", ""):
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
        jax.config.update("jax_num_cpu_devices", cores or 1)


def _why_jax_cannot_start() -> str | None:
    """What JAX says where it has no device, for example on a platform that is not known; None where it has one."""
    try:
        jax.devices()
    except Exception as error:  # plug-ins fail in many ways
        return one_line(error)
    return None


def _complain(text: str) -> None:
    """Writes a line to standard error, whatever is in it: names of files need not be texts."""
    print(f"hindrl: {text}".encode(errors="backslashreplace").decode(), file=sys.stderr)


def main(arguments: list[str] | None = None) -> None:
    """Entry point of the `hindrl` command; with arguments given, runs within this process as it is."""
    if arguments is None:
        arguments = sys.argv[1:]
        _set_up_jax()
    *group, last = arguments or ["--help"]
    try:
        if arguments in (["--version"], ["-V"], ["version"]):
            print(f"hindrl_jax {__version__}, jax {jax.__version__}, Python {platform.python_version()}", flush=True)
            return
        if arguments == ["completion"]:
            print(completion.script(COMMANDS), flush=True)
            return
        if last in ("--help", "-h", "--help-all") and len(group) < 2:
            commands = COMMANDS.get(group[0]) if group else None
            if not group or isinstance(commands, dict):
                print(_usage_of(group[0], commands) if isinstance(commands, dict) else _usage(), flush=True)
                return
        with warnings.catch_warnings(), interrupts_that_last():
            warnings.showwarning = lambda message, *_, **__: _complain(f"warning: {message}")
            command, rest = _find(arguments)
            in_float32(command)(rest)
    except UserError as error:
        _complain(one_line(error))
        sys.exit(2)
    except KeyboardInterrupt:
        print("hindrl: interrupted", file=sys.stderr)
        sys.exit(130)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except Exception:
        reason = _why_jax_cannot_start()
        if reason is None:
            raise
        _complain(f"JAX cannot compute on JAX_PLATFORMS = {os.environ.get('JAX_PLATFORMS', '')} ({reason}): choose another, or leave it out")
        sys.exit(2)
