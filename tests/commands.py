"""Commands: of a training that takes seconds, and such that must be refused."""

import pytest

from hindrl_jax import cli

SIZES = dict(num_envs=2, learning_starts=200, steps=260, eval_every=40, eval_episodes=3, updates_per_iteration=1, buffer_size=2000, imitation_steps=0)
BATCH_SIZE, WIDTH = 16, 8
TINY = [text for name, value in SIZES.items() for text in (f"--{name.replace('_', '-')}", str(value))]
TINY += ["--batch-size", str(BATCH_SIZE), "--net-arch", str(WIDTH)]


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
