"""The command line as a whole: interrupts, refusals, and what it lists."""

import shlex
import signal
import subprocess
import sys
import time

import pytest
from commands import refusal

from hindrl_jax import __version__, cli
from hindrl_jax.tasks.registry import TASKS


class Forgetful:
    """What it raises when it is deleted is not seen by anyone."""

    def __del__(self):
        raise KeyboardInterrupt


def test_an_interrupt_that_nobody_saw_comes_again(monkeypatch, capsys):
    def forget(arguments):
        Forgetful()
        time.sleep(20)

    monkeypatch.setitem(cli.COMMANDS, "envs", forget)
    started, before = time.monotonic(), signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs are begun without
    try:
        with pytest.raises(SystemExit) as stop:
            cli.main(["envs"])
    finally:
        signal.signal(signal.SIGINT, before)
    assert stop.value.code == 130
    assert time.monotonic() - started < 10  # it wakes what waits
    assert capsys.readouterr().err == "hindrl: interrupted\n"


def test_an_interrupt_does_not_outlive_its_command(monkeypatch):
    came, before = [], signal.getsignal(signal.SIGINT)
    monkeypatch.setitem(cli.COMMANDS, "envs", lambda arguments: Forgetful() and None)
    try:
        signal.signal(signal.SIGINT, lambda *given: came.append(given))
        cli.main(["envs"])
        time.sleep(0.3)
    finally:
        signal.signal(signal.SIGINT, before)
    assert not came


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["demos"], "'hindrl demos' needs a command"),
        (["trian"], "did you mean 'train'?"),
        (["train", "--env", "FixedGrid"], "unknown environment 'FixedGrid' (did you mean"),
        (["train", "--algo", "sac"], "unknown algorithm 'sac'"),
        (["train", "--preset", "paper"], "unknown preset 'paper'"),
        (["train", "--lerning-rate", "1"], "did you mean --learning-rate?"),
        (["train", "--lr", "1"], "did you mean --learning-rate?"),
        (["train", "--lr=1"], "did you mean --learning-rate?"),
        (["train", "--total_timesteps", "1"], "did you mean --steps?"),
        (["train", "--demo", "1"], "hindrl train has no option --demo (did you mean --demos?) (see hindrl train --help)"),
        (["train", "--demo=1"], "hindrl train has no option --demo (did you mean --demos?) (see"),
        (["train", "--step", "5"], "did you mean --steps?"),
        (["train", "--foo", "1", "--bar"], "hindrl train has no option --foo, --bar (see"),
        (["train", "--steps", "abc"], "hindrl: --steps abc is not usable: give a whole number (see"),
        (["train", "--steps=2.5"], "hindrl: --steps 2.5 is not usable: give a whole number (see"),
        (["train", "--stop-at", "x"], "hindrl: --stop-at x is not usable: give a number (see"),
        (["train", "--net-arch", "4", "x"], "hindrl: --net-arch 4 x is not usable: give whole numbers (see"),
        (["train", "--bc-loss", "squard"], "--bc-loss squard is not usable (did you mean 'squared'?): choose one of relative, squared, norm (see"),
        (["train", "--steps"], "hindrl: --steps needs a whole number after it (see"),
        (["train", "--demos"], "hindrl: --demos needs a value after it (see"),
        (["train", "--seeds", "2", "3"], "hindrl train does not know what '3' is for: values stand behind their options (see"),
        (["train", "--n-envs", "1"], "did you mean --num-envs?"),
        (["train", "--hold", "1"], "did you mean --action-hold?"),
        (["eval"], "hindrl eval needs DIRECTORY"),
        (["demos", "record", "--out", "x.hdf5"], "hindrl demos record needs --demos INT"),
        (["train", "--learning-rate", "fast"], "fast"),
        (["train", "--learning-rate", "nan"], "learning_rate = nan"),
        (["train", "--gamma", "1.5"], "gamma = 1.5"),
        (["train", "--demos", "0"], "num_demos = 0"),
        (["train", "--demos", "-3"], "num_demos = -3"),
        (["train", "--demos", "missing.hdf5"], "missing.hdf5"),
        (["train", "--seeds", "0"], "--seeds 0"),
        (["train", "--seed", "-1"], "--seed -1"),
        (["train", "--batch-size", "4", "--max-demo-ratio", "1.0"], "leaves no replay row"),
        (["train", "--num-objects", "2.5"], "2.5"),
        (["train", "--steps", "100"], "steps = 100"),
        (["train", "--buffer-size", "200"], "buffer_size = 200"),
        (["train", "--num-objects", "99"], "99"),
        (["train", "--algo", "tqcfd", "--relabelled-per-original", "3"], "relabelled_per_original = 3"),
        (["train", "--config", "missing.json"], "missing.json"),
        (["train", "--config", "x", "--algo", "bc"], "exclude each other"),
        (["eval", "missing"], "missing"),
        (["render", "missing"], "missing"),
        (["demos", "info", "missing.hdf5"], "missing.hdf5"),
        (["demos", "record", "--demos", "0", "--out", "x.hdf5"], "num_demos = 0"),
        (["demos", "forget"], "'forget' is not a command"),
    ],
)
def test_bad_input_is_one_line_and_writes_nothing(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert message in refusal(capsys, *arguments)
    assert list(tmp_path.iterdir()) == []


def test_envs_lists_every_environment(capsys):
    cli.main(["envs"])
    printed = capsys.readouterr().out
    assert all(name in printed for name in TASKS)
    assert "\ngymnasium:ID: " in printed  # rich would make a picture of :ID:


def test_without_arguments_it_says_what_there_is(capsys):
    pages = []
    for arguments in ([], ["--help"]):
        cli.main(arguments)
        pages.append(capsys.readouterr().out)
    assert pages[0] == pages[1]
    lines = pages[0].splitlines()
    assert len(lines) <= 25
    assert max(map(len, lines)) <= 100
    listed = [line.split()[1] for line in lines if line.startswith("  hindrl ")]
    assert set(listed) == set(cli.COMMANDS)
    starts = listed.index("policies")  # after the three commands to start with
    assert listed[starts:] == ["policies", "envs", "train", "eval", "render", "compare", "demos", "sweep", "reproduce"]
    assert "hindrl COMMAND --help" in pages[0]


@pytest.mark.parametrize("group", [name for name, command in cli.COMMANDS.items() if isinstance(command, dict)])
def test_a_group_of_commands_lists_its_own(group, capsys):
    cli.main([group, "--help"])
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[2] for line in lines if line.startswith(f"  hindrl {group} ")] == list(cli.COMMANDS[group])
    assert not any(line.startswith("  hindrl train") for line in lines)


def test_it_says_its_version(capsys):
    cli.main(["--version"])
    assert capsys.readouterr().out.startswith(f"hindrl_jax {__version__}, jax ")


def completions(script, line):
    """What bash offers at the end of a line."""
    words = line.split(" ")
    asked = f"COMP_WORDS=({' '.join(map(shlex.quote, words))}); COMP_CWORD={len(words) - 1}; _hindrl; printf '%s\\n' \"${{COMPREPLY[@]}}\""
    return subprocess.run(["bash", "-c", f"{script}\n{asked}"], capture_output=True, text=True, check=True).stdout.split()


def test_the_shell_completes(capsys):
    cli.main(["completion"])
    script = capsys.readouterr().out
    assert completions(script, "hindrl tr") == ["train"]
    assert completions(script, "hindrl demos re") == ["record", "render"]
    assert completions(script, "hindrl train --env Fixed") == ["FixedGridPickAndPlace", "FixedParameterizedReach"]
    assert completions(script, "hindrl train --learning-r") == ["--learning-rate"]
    assert completions(script, "hindrl train --seeds 3 --algo sm") == ["smooth-hindrl"]
    assert completions(script, "hindrl demos record --ou") == ["--out"]


def test_the_installed_command_starts():
    done = subprocess.run([sys.executable, "-c", "from hindrl_jax.cli import main; main()", "--help"], capture_output=True, text=True, check=True)
    assert "hindrl train" in done.stdout
