"""`hindrl completion`: a script for the shell, after which Tab completes commands, options and the names of tasks."""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Callable, Mapping
from typing import Any, get_args

from hindrl_jax.config import Algorithm
from hindrl_jax.tasks.presets import Preset
from hindrl_jax.tasks.registry import TASKS

_SCRIPT = """\
_hindrl() {{
  local word=${{COMP_WORDS[COMP_CWORD]}} before=${{COMP_WORDS[COMP_CWORD-1]}} words=""
  case "$before" in
    --env) words="{tasks}" ;;
    --algo) words="{algorithms}" ;;
    --preset) words="{presets}" ;;
    *) if [[ $COMP_CWORD == 1 ]]; then words="{commands}"
       else case "${{COMP_WORDS[*]:1:2}}" in
{cases}
       esac; fi ;;
  esac
  COMPREPLY=($(compgen -W "$words" -- "$word"))
}}
complete -o default -F _hindrl hindrl"""


def script(commands: Mapping[str, Any]) -> str:
    """The script, for bash; zsh reads it after `autoload -U +X bashcompinit && bashcompinit`.

    Args:
      commands: functions of the arguments by their names, those of a group in a mapping of their own.
    """
    cases = []
    for name, command in commands.items():
        if callable(command):
            cases.append((f'"{name} "*', _flags(command)))
        else:
            cases += [(f'"{name} {sub}"', _flags(function)) for sub, function in command.items()]
            cases.append((f'"{name} "*', " ".join(command)))
    return _SCRIPT.format(
        tasks=" ".join(TASKS),
        algorithms=" ".join(get_args(Algorithm)),
        presets=" ".join(get_args(Preset)),
        commands=" ".join(commands),
        cases="\n".join(f'         {pattern}) words="{words}" ;;' for pattern, words in cases),
    )


def _flags(command: Callable[[list[str]], None]) -> str:
    """The options of a command, read off its help."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
        command(["--help-all"])
    return " ".join(dict.fromkeys(re.findall(r"^  (--[a-z0-9-]+)", printed.getvalue(), re.MULTILINE)))
