"""The progress bar as a person sees it: in a terminal, in a log file, in a notebook. No training: the results are made up."""

import dataclasses
import io
import re
from types import SimpleNamespace

import numpy as np
import pytest
import tiny
from rich.console import Console

import hindrl_jax as hindrl
from hindrl_jax.cli import training
from hindrl_jax.config import TrainConfig
from hindrl_jax.training.progress import bar, evaluation_line
from hindrl_jax.training.result import Row

CONFIG = TrainConfig(steps=4_000)
WIPE = "\r\x1b[2K"


def result(done, *, every=100, seeds=(0, 1), algo="hindrl", finished=False, cloned=None):
    """A training of 4,000 steps, of which so many are done, at 100 steps per second; success is the share of steps done, the second seed's half."""
    env_steps = (lambda step: 0) if algo == "bc" else (lambda step: step)
    rows = [
        Row(seed=seed, env_steps=env_steps(at), updates=at, seconds=at / 100, success=at / 4_000 / (1 + i), episode_length=50.0, metrics={})
        for at in range(every, done + 1, every)
        for i, seed in enumerate(seeds)
    ]
    return SimpleNamespace(
        config=dataclasses.replace(CONFIG, algo=algo),
        seeds=seeds,
        rows=rows,
        steps_done=done,
        steps_unit="updates" if algo == "bc" else "steps",
        train_seconds=done / 100,
        final_success=np.zeros(len(seeds)) if finished else None,
        cloned_success=cloned,
        practised_success=None,
        practice_steps=np.zeros(len(seeds), int),
        are_stuck=np.zeros(len(seeds), bool),
        latest_success=lambda: float(np.mean([row.success for row in rows[-len(seeds) :]])) if rows else None,
    )


def console(**options):
    return Console(file=io.StringIO(), highlight=False, soft_wrap=True, width=80, **options)


def play(screen, **options):
    with hindrl.ProgressBar(console=screen) as progress:
        progress.wait("compiling")
        for done in range(0, 4_001, 50):
            progress(result(done, **options))
        progress(result(4_000, finished=True, **options))
    return screen.file.getvalue()


def test_a_log_file_gets_ten_plain_lines():
    written = play(console())
    assert not re.search(r"[^\x20-\x7e\n]", written)
    first, *lines = written.splitlines()
    assert first == "compiling ..."
    assert [line.split()[0] for line in lines] == [f"{steps:,}" for steps in range(400, 4_001, 400)]
    assert lines[4] == "    2,000 steps    2,000 updates    20.0 s   success  38% (worst  25%)   length  50.0"


def test_what_sampled_actions_solve_stands_beside():
    rows = [dataclasses.replace(row, metrics={"evaluation/sampled_success": share}) for row, share in zip(result(100).rows, (1.0, 0.5), strict=True)]
    assert evaluation_line(rows) == "      100 steps      100 updates     1.0 s   success   2% (worst   1%)   sampled  75%   length  50.0"


def test_the_steps_of_an_evaluation_are_the_most_that_a_seed_took():
    rows = [dataclasses.replace(row, env_steps=steps) for row, steps in zip(result(100).rows, (0, 1_700), strict=True)]
    assert evaluation_line(rows).split(" steps ")[0].strip() == "1,700"


def test_each_round_of_practice_has_a_line():
    screen, rounds = console(), [(0, None), (0, None), (1_000, [0.5, 0.75]), (1_000, [0.5, 0.75]), (2_500, [1.0, 0.75]), (4_000, [1.0, 0.75])]
    progress = hindrl.ProgressBar(console=screen)
    for index, (steps, success) in enumerate(rounds):
        present = result(0 if index < 5 else 50, cloned=np.array([0.5, 0.5]))  # the last round was no use, so learning begins
        present.practice_steps, present.practised_success = np.full(2, steps), None if success is None else np.array(success)
        progress(present)
    assert screen.file.getvalue().splitlines()[1:] == [
        "after 1,000 steps of practice 62% (worst 50%)",
        "after 2,500 steps of practice 88% (worst 75%)",
    ]


@pytest.mark.parametrize(
    ("success", "line"),
    [([0.5, 0.75], "a clone of the demonstrations solves 62% (worst 50%);"), ([1.0], "a clone of the demonstrations solves 100%;")],
)
def test_what_a_clone_solves_is_said_once_and_first(success, line):
    screen = console()
    progress = hindrl.ProgressBar(console=screen)
    for done in range(0, 4_001, 400):
        progress(result(done, cloned=np.array(success)))
    said = screen.file.getvalue().splitlines()
    assert [index for index, each in enumerate(said) if each.startswith(line)] == [0]
    assert len(said) == 11


def test_a_terminal_shows_the_lines_above_a_bar_that_goes_in_the_end():
    written = play(console(force_terminal=True, color_system=None, _environ={"TERM": "xterm"}))
    drawn = written.split(WIPE)
    assert drawn[0] == "compiling ..."
    assert max(len(part.split("\n")[-1]) for part in drawn) <= 79  # a bar that reaches the edge would wrap
    assert drawn[-1] == ""
    seen = [line.split(WIPE)[-1] for line in written.split("\n")]
    assert seen[-1] == ""
    assert seen[:-1] == play(console()).splitlines()[1:]


def test_the_bar_says_how_far_how_good_how_fast_and_how_long():
    # Learning began after 1,000 steps and 2 s; the next 1,000 took 8 s, so the last 2,000 will take 16 s. Both seeds together make 250 per second.
    half = result(2_000)
    half.train_seconds = 10.0
    text = bar(half, (1_000, 2.0), width=79).plain
    assert text.lstrip("━─") == " 2,000/4,000 steps, success 38%, 250 steps/s, 0:16 left"
    assert (text.count("━"), text.count("─")) == (12, 12)
    assert bar(half, None, width=200, unicode=False).plain == "#" * 15 + "." * 15 + " 2,000/4,000 steps, success 38%"
    assert "updates/s" in bar(result(2_000, algo="bc"), (100, 1.0), width=79).plain


def test_bc_counts_updates():
    assert play(console(), algo="bc").splitlines()[1] == "     400 updates     4.0 s   success   8% (worst   5%)   length  50.0"
    seed = dict(seed=0, final_success=1.0, episode_length=50.0, env_steps_to_95=0, updates_to_95=1_500, seconds_to_95=2.0)
    seed |= dict(returned_success=1.0, returned_length=49.0, returned_noise=0.0, returned_env_steps=0, returned_updates=1_000)
    screen = console()
    screen.print(training._summary_table({"seeds": [seed]}, dataclasses.replace(CONFIG, algo="bc")))
    assert re.search(r"1,500 +2\.0", screen.file.getvalue())
    screen.print(training._summary_table({"seeds": [seed | {"env_steps_to_95": 300}]}, CONFIG))
    assert re.search(r"300 +1,500 +2\.0", screen.file.getvalue())


def test_a_second_training_starts_again():
    screen = console()
    progress = hindrl.ProgressBar(console=screen, lines=2)
    for _ in range(2):
        for done in range(0, 4_001, 500):
            progress(result(done))
    assert [line.split()[0] for line in screen.file.getvalue().splitlines()] == ["2,000", "4,000"] * 2


def test_a_notebook_gets_one_display_that_changes(monkeypatch, capsys):
    import IPython.display

    shown = []
    handle = SimpleNamespace(update=lambda picture: shown.append(picture.data))
    monkeypatch.setattr(IPython.display, "display", lambda picture, display_id: shown.append(picture.data) or handle)
    play(Console(force_jupyter=True))
    assert "compiling" in shown[0]
    assert "2,000/4,000 steps, success 38%" in shown[41]  # compiling, then a picture every 50 steps from 0
    assert shown[-1] == ""
    assert len(capsys.readouterr().out.splitlines()) == 10


def test_the_evaluation_that_ends_a_run_before_its_time_has_a_line():
    """At 2,100 of 4,000 steps: the last line was that of the fifth tenth."""
    screen = console()
    progress = hindrl.ProgressBar(console=screen)
    for done in range(0, 2_101, 50):
        progress(result(done))
    for _ in range(2):
        progress(result(2_100, finished=True))
    assert [line.split()[0] for line in screen.file.getvalue().splitlines()] == ["400", "800", "1,200", "1,600", "2,000", "2,100"]
    screen.file.truncate(0)
    progress(result(500))  # another training, whose last evaluation has no line of its own here
    progress(result(500, finished=True))
    assert screen.file.getvalue().strip("\0") == ""


def test_what_shows_a_training_is_told_that_it_is_being_compiled(monkeypatch):
    class Compiling(Exception):
        pass

    def compile_(*given):
        raise Compiling

    monkeypatch.setattr("hindrl_jax.training.experiment.programs_of", compile_)
    screen, demonstrations = console(), hindrl.record_demonstrations(tiny.ENV, 1)
    with pytest.raises(Compiling):
        hindrl.fit(tiny.ENV, demonstrations, tiny.CONFIG, report=hindrl.ProgressBar(console=screen))
    assert screen.file.getvalue() == "compiling ...\n"
    with pytest.raises(Compiling):
        hindrl.fit(tiny.ENV, demonstrations, tiny.CONFIG, report=print)


@pytest.mark.parametrize(
    ("options", "written"),
    [
        ({"force_terminal": True, "_environ": {"TERM": "xterm"}}, f"compiling ...{WIPE}"),
        ({"force_terminal": True, "_environ": {"TERM": "dumb"}}, ""),
        ({}, ""),
    ],
)
def test_a_person_who_watches_sees_the_progress_unasked(monkeypatch, options, written):
    def compile_(*given):
        raise KeyboardInterrupt

    screen = console(**options)
    monkeypatch.setattr("hindrl_jax.training.progress.Console", lambda **_: screen)
    monkeypatch.setattr("hindrl_jax.training.experiment.programs_of", compile_)
    with pytest.raises(KeyboardInterrupt):
        hindrl.fit(tiny.ENV, hindrl.record_demonstrations(tiny.ENV, 1), tiny.CONFIG)
    assert screen.file.getvalue() == written


def test_an_interrupted_training_leaves_the_line_clean():
    screen = console(force_terminal=True, _environ={"TERM": "xterm"})

    def train():
        with hindrl.ProgressBar(console=screen) as progress:
            progress(result(500))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train()
    assert screen.file.getvalue().endswith(WIPE)


def test_a_resumed_training_says_only_what_is_new():
    screen = console()
    progress = hindrl.ProgressBar(console=screen, lines=4)
    for done in range(2_100, 4_001, 100):
        progress(result(done))
    assert [line.split()[0] for line in screen.file.getvalue().splitlines()] == ["3,000", "4,000"]
