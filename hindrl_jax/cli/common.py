"""What the commands share: the screen, the reading of options, and how numbers are said."""

from __future__ import annotations

import contextlib
import io
import itertools
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import jax
import tyro
from rich.console import Console
from rich.table import Table

from hindrl_jax.base.errors import UserError
from hindrl_jax.cli.help_pages import Group, full_page, groups_of, missing, nearest, short_page
from hindrl_jax.tasks.from_gymnasium import PREFIX
from hindrl_jax.tasks.functions import find_function, function_name
from hindrl_jax.tasks.registry import TASKS, did_you_mean, make

_TYRO = (tyro.conf.OmitArgPrefixes, tyro.conf.OmitSubcommandPrefixes)
ENV_HELP = "The environment; `hindrl envs` lists them. One of Gymnasium is gymnasium:ID, as in gymnasium:FetchReach-v4, one of your own MODULE:NAME."
Brief = tuple[Mapping[str, Mapping[str, str]], Sequence[str]]  # as `short_page` takes them
_PLAIN: dict[str, Any] = dict(highlight=False, soft_wrap=True, markup=False, emoji=False)
console = Console(**_PLAIN)


MOST_SEEDS, MOST_EPISODES = 65_536, 1_000_000


def print_table(table: Table, *, least_width: int) -> None:
    """Prints a table in so many characters at least, also where the terminal is narrower: a cut name or a cell in two lines is hard to read."""
    Console(**_PLAIN, width=max(console.width, least_width)).print(table)


def check_episodes(episodes: int, doing: str) -> None:
    """Refuses a number of episodes that cannot be played, or takes for ever."""
    if not 1 <= episodes <= MOST_EPISODES:
        raise UserError(f"--episodes {episodes} is too {'few' if episodes < 1 else 'many'}: {doing} 1 to {MOST_EPISODES}")


def seeds_from(count: int, first: int) -> tuple[int, ...]:
    """That many seeds, one after the other."""
    if count > MOST_SEEDS:
        raise UserError(f"--seeds {count} is too many: train at most {MOST_SEEDS} side by side")
    if not 0 <= first <= 2**32 - count:
        raise UserError(f"--seed {first} is not usable: choose a whole number from 0 to {2**32 - count}")
    return tuple(range(first, first + count))


def env_names(name: str) -> Any:
    """The type of --env: what it may be, `name`, which was looked up before, included."""
    return Literal[(*TASKS, *({name} - {*TASKS}))]


def peek(arguments: Sequence[str], name: str) -> str | None:
    """The value of one flag, before the rest can be understood."""
    values = peek_all(arguments, name)
    return values[0] if values else None


def peek_all(arguments: Sequence[str], name: str) -> list[str]:
    """The values of one flag, which may have several: what follows it up to the next flag. The last one counts where it is given several times."""
    values: list[str] = []
    for index, argument in enumerate(arguments):
        flag, equals, value = argument.partition("=")
        if flag.replace("_", "-") != f"--{name}":
            continue
        if equals:
            values = [value]
        elif index + 1 < len(arguments):
            rest = arguments[index + 1 :]
            values = [rest[0], *itertools.takewhile(lambda word: not word.startswith("-"), rest[1:])]
    return values


def environment_of(arguments: Sequence[str], name: str, **others: Any) -> Any:
    """The environment of a name, before the rest can be understood.

    One of Gymnasium is made and looked at to know what it is, so the options without which it may not be made are read first.

    Raises:
      UserError: as `make`.
    """
    if name.startswith(PREFIX):
        horizon, make_kwargs = peek(arguments, "horizon"), peek_all(arguments, "make-kwargs")
        if make_kwargs:
            others["make_kwargs"] = tuple(make_kwargs)
        if horizon is not None and re.fullmatch(r"[+-]?[0-9]{1,18}", horizon):  # what is no number is refused where all options are read
            others["horizon"] = int(horizon)
    return make(name, **others)


def episode_key(seed: int) -> jax.Array:
    if not 0 <= seed < 2**32:
        raise UserError(f"{seed} cannot name a random episode: choose a whole number from 0 to {2**32 - 1}")
    return jax.random.key(seed)


def parse(arguments_class: type[Any], arguments: list[str], program: str, description: str | None = None, brief: Brief | None = None) -> Any:
    """tyro, with its page of explanation on a mistake cut down to one line, and help pages of our own.

    Args:
      arguments_class: a dataclass.
      arguments: what was typed after the command.
      program: the command, for example "hindrl train".
      description: one sentence; the docstring of the class by default.
      brief: the options and the examples that --help shows, where it is not to show all of them; --help-all does.

    Raises:
      UserError: for what cannot be understood.
      SystemExit: after a help page, with code 0.
    """
    asked = {"-h", "--help", "--help-all"} & set(arguments)
    if asked:
        groups, said = groups_of(arguments_class), description or arguments_class.__doc__ or ""
        print(short_page(program, said, groups, *brief) if brief and "--help-all" not in asked else full_page(program, said, groups))
        raise SystemExit(0)
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            return tyro.cli(arguments_class, args=arguments, prog=program, config=_TYRO, registry=_OWN_FUNCTIONS)
    except SystemExit:
        said = _in_our_words(_first_sentence(complaint.getvalue()), arguments, program, groups_of(arguments_class))
        raise UserError(f"{said} (see {program} --help)") from None


_OWN_FUNCTIONS = tyro.constructors.ConstructorRegistry()


@_OWN_FUNCTIONS.primitive_rule
def _function_by_name(type_info: tyro.constructors.PrimitiveTypeInfo) -> tyro.constructors.PrimitiveConstructorSpec[Any] | None:
    """How tyro reads MODULE:NAME for a field that holds a function."""
    origin: Any = type_info.type_origin
    if origin is not Callable:
        return None
    return tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar="MODULE:NAME",
        instance_from_str=lambda words: find_function(words[0]),
        is_instance=callable,
        str_from_instance=lambda function: [function_name(function)],
    )


_WANTED = {"INT": "a whole number", "FLOAT": "a number", "INT ...": "whole numbers", "FLOAT ...": "numbers", "PATH": "a path"}


def _in_our_words(said: str, arguments: Sequence[str], program: str, groups: Sequence[Group]) -> str:
    """What is wrong with the arguments, and what to do. Where tyro says something else than what is known here, what it says."""
    values = {f"--{flag.name}": flag.values for group in groups for flag in group.flags}
    flag = next((word.strip("':.,") for word in said.split() if word.strip("'").startswith("--")), "")
    wanted = _WANTED.get(values.get(flag, ""), "a value")
    given = " ".join([flag, *peek_all(arguments, flag.removeprefix("--"))])
    if said.startswith("Unrecognized options: "):
        unknown = said.removeprefix("Unrecognized options: ").split(", ")
        flags = [word.partition("=")[0] for word in unknown if word.startswith("--")]
        if not flags:
            return f"{program} does not know what {' '.join(map(repr, unknown))} is for: values stand behind their options"
        meant = nearest(flags[0], groups)
        return f"{program} has no option {', '.join(flags)}" + (f" (did you mean {meant}?)" if meant else "")
    if said.startswith("Missing"):
        if f"'{flag}'" in said and flag in values:
            return f"{flag} needs {wanted} after it"
        lacking = missing(arguments, groups)
        return f"{program} needs {', '.join(lacking)}" if lacking else said
    if said.startswith("Error parsing --") and wanted != "a value":
        return f"{given} is not usable: give {wanted}"
    function = re.search(r"- collections\.abc\.Callable\[.*?\]: (.*)$", said)
    if function:
        return f"{flag}: {function[1]}"
    choices = re.search(r"^invalid choice '(.*)' for argument .*Expected one of \((.*?),?\)\.$", said)
    if choices:
        known = re.findall(r"'([^']*)'", choices[2])
        return f"{flag} {choices[1]} is not usable{did_you_mean(choices[1], known)}: choose one of {', '.join(known)}"
    return said


def _first_sentence(complaint: str) -> str:
    """The message of tyro's box. Where the terminal is not known to speak UTF-8, the box has no border."""
    bordered = "│" in complaint
    lines = [line.strip("│ ") for line in complaint.splitlines() if line.startswith("│") or not bordered]
    sections: list[list[str]] = [[]]
    for line in lines:
        if line and set(line) <= {"─", "-"}:
            sections.append([])
        elif line:
            sections[-1].append(line)
    message, *_ = sections if bordered else sections[1:]  # without a border, the title is a section of its own
    return re.sub(r"^Error parsing (?!-)\S+: ", "", " ".join(message))


def counted(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"
