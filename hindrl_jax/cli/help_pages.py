"""What a command answers to --help and --help-all, made of the dataclasses that it reads its arguments into."""

from __future__ import annotations

import ast
import dataclasses
import difflib
import inspect
import itertools
import shutil
import textwrap
import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, Literal

import tyro

from hindrl_jax.tasks.functions import function_name, is_function

_MARKER = typing.get_args(tyro.conf.Positional[int])[1]
_KINDS = {int: "INT", float: "FLOAT", str: "TEXT"}
_INDENT = 6  # of a flag's text, in characters
_WIDEST = 100  # characters of a line
_COLUMN = 28  # of the texts on a short page, in characters
_JOINED = ("options", "run")  # fields whose options stand with those of the command itself
_TITLES = {
    "": "options",
    "environment": "the task",
    "expert": "the expert",
    "meaning": "how to read files of other tools",
    "training": "training",
    "training batch": "training: the batch",
    "training goal": "training: goals",
    "training agent": "training: networks and losses",
    "training quirks": "training: peculiarities of the thesis and its code",
}
_SYNONYMS = {  # of other libraries, and of the papers
    "algorithm": "algo",
    "bc-coef": "bc-weight",
    "discount": "gamma",
    "epochs": "steps",
    "lambda": "bc-weight",
    "logdir": "out",
    "model": "algo",
    "num-demos": "demos",
    "num-seeds": "seeds",
    "num-steps": "steps",
    "num-timesteps": "steps",
    "output": "out",
    "polyak": "target-update-rate",
    "task": "env",
    "tau": "target-update-rate",
    "timesteps": "steps",
    "total-timesteps": "steps",
}


@dataclasses.dataclass(frozen=True)
class Flag:
    """One option of a command."""

    name: str
    """With hyphens, without the leading two."""
    values: str
    """What follows it, or "" for a switch."""
    text: str
    default: str
    """As it is typed, or ""."""
    required: bool = False
    positional: bool = False
    switch: bool = False


@dataclasses.dataclass(frozen=True)
class Group:
    """Options that stand together."""

    title: str
    text: str
    flags: tuple[Flag, ...]


def groups_of(arguments_class: type[Any]) -> list[Group]:
    """The options that tyro reads for this dataclass, those of each nested dataclass after them in a group of their own."""
    merged: dict[str, Group] = {}
    for group in _groups(arguments_class, None, ""):
        before = merged.get(group.title)
        merged[group.title] = group if before is None else dataclasses.replace(before, flags=before.flags + group.flags)
    return list(merged.values())


def _groups(kind: type[Any], defaults: Any, title: str) -> Iterator[Group]:
    hints = typing.get_type_hints(kind, include_extras=True)
    texts: Mapping[str, str] = field_texts(kind)
    flags: list[Flag] = []
    nested: list[Group] = []
    for field in dataclasses.fields(kind):
        default = _default_of(field) if defaults is None else getattr(defaults, field.name)
        hint: Any = hints[field.name]
        metadata: Sequence[Any] = ()
        if typing.get_origin(hint) is Annotated:
            hint, *metadata = typing.get_args(hint)
        if dataclasses.is_dataclass(hint):
            below = title if field.name in _JOINED else f"{title} {field.name}".strip()
            nested += _groups(hint, None if default is dataclasses.MISSING else default, below)  # type: ignore[arg-type]
            continue
        text = next((given.help for given in metadata if getattr(given, "help", None)), texts.get(field.name, ""))
        said = "" if "(default: " in text or default in (None, (), dataclasses.MISSING) else f"(default: {as_typed(default)})"
        if default is dataclasses.MISSING and _MARKER not in metadata:
            said = "(required)"
        if hint is bool:
            said = "(default: on)" if default is True else ""
        flag = Flag(field.name.replace("_", "-"), _values(hint), text, said, required=default is dataclasses.MISSING, switch=hint is bool)
        flags.append(dataclasses.replace(flag, positional=_MARKER in metadata))
    if flags:
        yield Group(title, (kind.__doc__ or "").strip() if title else "", tuple(flags))
    yield from nested


def _default_of(field: dataclasses.Field[Any]) -> Any:
    return field.default if field.default_factory is dataclasses.MISSING else field.default_factory()


def as_typed(value: Any) -> str:
    """A value as the command line takes it."""
    if callable(value):
        return function_name(value)
    return " ".join(map(str, value)) if isinstance(value, tuple | list) else str(value)


def _values(hint: Any) -> str:
    """What may follow a flag of this type."""
    origin, arguments = typing.get_origin(hint), [one for one in typing.get_args(hint) if one is not types.NoneType]
    if hint is bool:
        return ""
    if origin is Literal:
        return "{" + ",".join(map(str, arguments)) + "}"
    if origin is tuple:
        return f"{_values(arguments[0])} ..." if Ellipsis in arguments else " ".join(map(_values, arguments))
    if is_function(hint):
        return "MODULE:NAME"
    if origin in (typing.Union, types.UnionType):
        return "|".join(map(_values, arguments))
    return _KINDS.get(hint, "PATH" if getattr(hint, "__name__", "") == "Path" else "TEXT")


def field_texts(kind: Any) -> Mapping[str, str]:
    """The line under each field of a dataclass, and of those that it inherits from, by the field's name."""
    found: dict[str, str] = {}
    for parent in reversed(kind.__mro__):
        try:
            source = textwrap.dedent(inspect.getsource(parent))
        except (OSError, TypeError):  # made by dataclasses.make_dataclass, in a notebook or in C
            continue
        body = ast.parse(source).body[0]
        lines = body.body if isinstance(body, ast.ClassDef) else []
        for field, text in itertools.pairwise(lines):
            said = text.value.value if isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant) else None
            if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and isinstance(said, str):
                found[field.target.id] = " ".join(said.split())
    return found


def full_page(program: str, description: str, groups: Sequence[Group]) -> str:
    """All options of a command, in the order of its dataclasses."""
    positional = [flag for group in groups for flag in group.flags if flag.positional]
    lines = [f"usage: {' '.join([program, *(flag.name.upper() for flag in positional), '[OPTIONS]'])}", "", *_wrapped(description, 0)]
    for group in groups:
        lines += ["", f"{_TITLES.get(group.title, group.title)}:"]
        lines += _wrapped(group.text.partition("\n\n")[0], 2) if group.title else []
        for flag in group.flags:
            lines += _described(flag, flag.text)
    return "\n".join(lines)


def short_page(program: str, description: str, groups: Sequence[Group], chosen: Mapping[str, Mapping[str, str]], examples: Sequence[str]) -> str:
    """The options that most people need, in a line or two each.

    Args:
      program: for example "hindrl train".
      description: one sentence.
      groups: all options.
      chosen: titles, and below each the options, as "name" or "name VALUES", with what is said of them here.
      examples: commands.
    """
    flags = {flag.name: flag for group in groups for flag in group.flags}
    lines = [f"usage: {program} [OPTIONS]", "", *_wrapped(description, 0)]
    for title, texts in chosen.items():
        lines += ["", f"{title}:"]
        for head, text in texts.items():
            default = flags[head.partition(" ")[0]].default  # of this task and algorithm, where it is known
            lines += _beside(f"  --{head}", f"{text.partition(' (default')[0]} {default}" if default else text)
    task = next((group for group in groups if group.title == "environment"), None)
    if task is not None:
        lines += ["", "of this task:", *_wrapped(", ".join(f"--{flag.name}" for flag in task.flags), 2)]
    lines += [
        "",
        "examples:",
        *(f"  {example}" for example in examples),
        "",
        *_wrapped(f"{program} --help-all explains all {len(flags)} options.", 0),
    ]
    return "\n".join(lines)


def _width() -> int:
    return min(shutil.get_terminal_size().columns - 1, _WIDEST)


def _wrapped(text: str, indent: int) -> list[str]:
    margin = " " * indent
    return textwrap.wrap(" ".join(text.split()), _width(), initial_indent=margin, subsequent_indent=margin, break_on_hyphens=False)


def _head(flag: Flag) -> str:
    if flag.positional:
        return f"{flag.name.upper()}"
    return f"--{flag.name}" if not flag.values else f"--{flag.name} {flag.values}"


def _described(flag: Flag, text: str) -> list[str]:
    head = _head(flag) + (f", --no-{flag.name}" if flag.switch else "")
    return [*textwrap.wrap(head, _width(), initial_indent="  ", subsequent_indent="    "), *_wrapped(f"{text} {flag.default}", _INDENT)]


def _beside(head: str, text: str) -> list[str]:
    first, *rest = textwrap.wrap(text.strip(), _width() - _COLUMN, break_on_hyphens=False)
    lines = [head.ljust(_COLUMN) + first] if len(head) < _COLUMN else [head, " " * _COLUMN + first]
    return lines + [" " * _COLUMN + line for line in rest]


def missing(arguments: Sequence[str], groups: Sequence[Group]) -> list[str]:
    """The options that have to be given and are not, and what stands before them without a name."""
    given = {argument.partition("=")[0].replace("_", "-") for argument in arguments}
    return [_head(flag) for group in groups for flag in group.flags if flag.required and (flag.positional or f"--{flag.name}" not in given)]


def nearest(unknown: str, groups: Sequence[Group]) -> str | None:
    """The option that was probably meant, with its hyphens: of the same meaning elsewhere, of these initials, or of nearly the same letters."""
    names = [flag.name for group in groups for flag in group.flags if not flag.positional]
    wanted = unknown.strip("-,").partition("=")[0].replace("_", "-").lower()
    if wanted.startswith("n-"):
        wanted = f"num-{wanted[2:]}"
    if _SYNONYMS.get(wanted) in names:
        return f"--{_SYNONYMS[wanted]}"
    initials = [name for name in names if "".join(word[0] for word in name.split("-")) == wanted]
    nearly = difflib.get_close_matches(wanted, names, n=1, cutoff=0.85)  # a letter too few or too many
    words = [name for name in names if wanted in name.split("-")]
    close = initials or nearly or words or difflib.get_close_matches(wanted, names, n=1) or [name for name in names if name.startswith(wanted)]
    return f"--{close[0]}" if close else None
