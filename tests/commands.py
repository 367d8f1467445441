"""Commands: of a training that takes seconds, and such that must be refused."""

import shlex

import pytest

from hindrl_jax import cli

TINY = shlex.split(
    "--num-envs 2 --learning-starts 200 --steps 260 --eval-every 40 --eval-episodes 3 --updates-per-iteration 1 "
    "--batch-size 16 --net-arch 8 --buffer-size 2000"
)


def refusal(capsys, *arguments) -> str:
    """Runs a command that must be refused; returns its one line."""
    capsys.readouterr()
    with pytest.raises(SystemExit) as stop:
        cli.main([str(argument) for argument in arguments])
    assert stop.value.code == 2
    printed = capsys.readouterr()
    assert printed.err.startswith("hindrl: ")
    assert printed.err.count("\n") == 1, printed.err
    assert "Traceback" not in printed.err
    return printed.err
