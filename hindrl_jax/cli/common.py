"""What the commands share: the screen, the reading of options, and how numbers are said."""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Sequence
from typing import Any, Literal

import jax
import tyro
from rich.console import Console

from hindrl_jax.base.errors import UserError
from hindrl_jax.tasks.registry import TASKS

_TYRO = (tyro.conf.OmitArgPrefixes, tyro.conf.OmitSubcommandPrefixes)
ENV_HELP = "The environment; `hindrl envs` lists them. Any goal-conditioned one of Gymnasium is gymnasium:ID, as in gymnasium:FetchReach-v4."
console = Console(highlight=False, soft_wrap=True, markup=False, emoji=False)


def seeds_from(count: int, first: int) -> tuple[int, ...]:
    """That many seeds, one after the other."""
    if not 0 <= first <= 2**32 - count:
        raise UserError(f"--seed {first} is not usable: choose a whole number from 0 to {2**32 - count}")
    return tuple(range(first, first + count))


def env_names(name: str) -> Any:
    """The type of --env: what it may be, `name`, which was looked up before, included."""
    return Literal[(*TASKS, *({name} - {*TASKS}))]


def peek(arguments: Sequence[str], name: str) -> str | None:
    """The value of one flag, before the rest can be understood."""
    value = None
    for index, argument in enumerate(arguments):
        if argument == f"--{name}" and index + 1 < len(arguments):
            value = arguments[index + 1]
        elif argument.startswith(f"--{name}="):
            value = argument.partition("=")[2]
    return value


def episode_key(seed: int) -> jax.Array:
    if not 0 <= seed < 2**32:
        raise UserError(f"{seed} cannot name a random episode: choose a whole number from 0 to {2**32 - 1}")
    return jax.random.key(seed)


def parse(arguments_class: type[Any], arguments: list[str], program: str, description: str | None = None) -> Any:
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


def counted(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"
