"""Commands that must be refused."""

import pytest

from hindrl_jax import cli


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
