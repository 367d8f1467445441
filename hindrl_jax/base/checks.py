"""Checking the fields of the project's frozen dataclasses: configs, environments, experts."""

from __future__ import annotations

import copy
import sys
from collections.abc import Callable
from types import UnionType
from typing import Any, ClassVar, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

T = TypeVar("T")
LARGEST = 2**31 - 1
"""The largest whole number that is counted to: counters are int32."""


def unchecked(instance: T, **values: object) -> T:
    """A copy of a frozen dataclass with other values, as `dataclasses.replace` makes one, but without its checks: a value may be traced."""
    changed = copy.copy(instance)
    for name, value in values.items():
        object.__setattr__(changed, name, value)
    return changed


def check_types(instance: object) -> None:
    """Raises ValueError naming the first field whose value is not of the type that its annotation asks for."""
    for name, hint in get_type_hints(type(instance)).items():
        if get_origin(hint) is not ClassVar and not _matches(getattr(instance, name), hint):
            raise ValueError(f"{name} = {getattr(instance, name)!r} is not usable: it must be {_in_words(hint)}")


def check(instance: object, **conditions: tuple[bool, str]) -> None:
    """Raises ValueError naming the first field whose condition does not hold, its value and what is asked of it."""
    for name, (holds, requirement) in conditions.items():
        if not holds:
            raise ValueError(f"{name} = {getattr(instance, name)!r} is not usable: it must be {requirement}")


def _matches(value: object, hint: Any) -> bool:
    """Whether a value is of the (simple) type that a field asks for; an int serves as a float, a bool as neither, NaN and infinity as nothing."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Literal:
        return value in arguments
    if origin in (Union, UnionType):
        return any(_matches(value, argument) for argument in arguments)
    if origin is tuple:
        hints = arguments[:1] * len(value) if isinstance(value, tuple) and arguments[-1] is Ellipsis else arguments
        return isinstance(value, tuple) and len(value) == len(hints) and all(map(_matches, value, hints))
    if origin is Callable:
        return callable(value)
    if hint is float:
        return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= sys.float_info.max
    if hint is int:
        return isinstance(value, int) and not isinstance(value, bool) and abs(value) <= LARGEST
    return isinstance(value, hint) and (hint is bool or not isinstance(value, bool))


def _in_words(hint: Any) -> str:
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Literal:
        return f"one of {', '.join(map(str, arguments))}"
    if origin in (Union, UnionType):
        return " or ".join(_in_words(argument) for argument in arguments)
    if origin is tuple:
        return f"a list, each item {_in_words(arguments[0])}" if arguments[-1] is Ellipsis else f"({', '.join(map(_in_words, arguments))})"
    if origin is Callable:
        return "a function"
    return {int: f"a whole number of at most {LARGEST}", float: "a finite number", bool: "true or false", type(None): "none"}.get(
        hint, f"a {hint.__name__}"
    )
