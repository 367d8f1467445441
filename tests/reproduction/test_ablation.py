"""The ablation: what is trained and what is kept, and the command that does it."""

import csv
import dataclasses
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from commands import refusal
from tiny import CONFIG

from hindrl_jax import cli
from hindrl_jax.reproduction import ablation, cells
from hindrl_jax.reproduction.ablation import TASKS, cells_of
from hindrl_jax.reproduction.cells import Task
from hindrl_jax.reproduction.options import OPTIONS
from hindrl_jax.runs.spec import read_spec

TINY = dataclasses.replace(CONFIG, steps=80, eval_episodes=100)
SMALL = Task("FixedGridPickAndPlace", (("num_objects", 1), ("size", 4), ("random_box_size", 1), ("horizon", 20)), 1)

OPTION = next(option for option in OPTIONS if option.name == "n-step-1")


@pytest.fixture(scope="module", autouse=True)
def tiny():
    """One small task and a small recipe in place of the real ones."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ablation, "TASKS", {"small": SMALL})
        patch.setattr(ablation, "RECIPE", TINY)
        yield


def command(out, *arguments):
    return ["reproduce", "ablation", "--out", str(out), "--seeds", "2", "--seed", "7", *arguments]


def run(out, *arguments):
    cli.main(command(out, *arguments))


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A finished ablation of one option, which was interrupted in between."""
    out = tmp_path_factory.mktemp("ablation") / "out"
    _, interrupted = cells_of(out, tasks=["small"], options=[OPTION], seeds=(7, 8))
    interrupted.path.mkdir(parents=True)
    (interrupted.path / "config.json").write_text(json.dumps(interrupted.spec.to_json()))
    (interrupted.path / "metrics.csv").write_text("half a line")
    run(out, "--options", OPTION.name)
    return out


def contents(out: Path) -> dict[str, tuple[int, bytes]]:
    return {str(file.relative_to(out)): (file.stat().st_mtime_ns, file.read_bytes()) for file in out.glob("*/*/*")}


def test_the_tasks_are_those_of_the_grid():
    assert [(name, task.title()) for name, task in TASKS.items()] == [
        ("fixed-1", "FixedGridPickAndPlace, num_objects 2, 1 demonstration"),
        ("fixed-5", "FixedGridPickAndPlace, num_objects 2, 5 demonstrations"),
        ("random-50", "GridPickAndPlace, num_objects 2, 50 demonstrations"),
    ]


def test_an_ablation_leaves_runs_and_tables(finished):
    assert sorted(str(file.relative_to(finished)) for file in finished.glob("*")) == ["ablation.csv", "ablation.md", "ablation.png", "small"]
    assert sorted(file.name for file in finished.glob("small/*")) == ["default", "n-step-1"]
    baseline, option = (read_spec(finished / "small" / name) for name in ("default", "n-step-1"))
    held = dataclasses.replace(TINY, action_hold=1)  # which was chosen
    assert (baseline.config, option.config) == (held, dataclasses.replace(held, batch=dataclasses.replace(TINY.batch, n_step=1)))
    assert (baseline.seeds, baseline.demos, baseline.env.horizon) == ((7, 8), "1", 20)
    for name in ("default", "n-step-1"):
        evaluations = list(csv.DictReader((finished / "small" / name / "metrics.csv").read_text().splitlines()))
        assert [(row["seed"], row["env_steps"]) for row in evaluations] == [("7", "60"), ("8", "60"), ("7", "80"), ("8", "80")]
    rows = list(csv.DictReader((finished / "ablation.csv").read_text().splitlines()))
    assert [row["option"] for row in rows] == ["default", "n-step-1"]
    assert all(np.isfinite(float(row[name])) for row in rows for name in ("difference_low", "seconds_per_seed", "relative_cost"))
    text = (finished / "ablation.md").read_text()
    assert "2 seeds from 7, 80 environment steps each" in text
    assert f"## small: {SMALL.title()}\n" in text
    assert text.index("| default |") < text.index(f"| *{OPTION.group}* |") < text.index(f"| {OPTION.name} |")
    assert text.endswith(f"| default | the recipe as it is |\n| {OPTION.name} | {OPTION.summary} |\n")


def test_what_is_finished_is_not_trained_again(finished, capsys):
    before = contents(finished)
    text = (finished / "ablation.md").read_text()
    (finished / "ablation.md").unlink()
    capsys.readouterr()
    run(finished, "--options", "n-step-1")
    assert "0 settings to train, 2 seeds from 7, 2 finished before" in capsys.readouterr().out
    assert contents(finished) == before
    assert (finished / "ablation.md").read_text() == text


def test_what_is_interrupted_is_trained_again_and_said_in_a_line(finished, tmp_path, capsys, monkeypatch):
    """Training is replaced by a copy of what was trained."""
    shutil.copytree(finished / "small" / "default", tmp_path / "small" / "default")
    shutil.copytree(finished / "small" / "n-step-1", tmp_path / "small" / "n-step-1")
    summary = (tmp_path / "small" / "n-step-1" / "summary.json").rename(tmp_path / "kept.json")
    monkeypatch.setattr(cells, "train", lambda cell, *, report: summary.rename(cell.path / "summary.json"))
    capsys.readouterr()
    run(tmp_path, "--options", "n-step-1")
    printed = capsys.readouterr().out
    assert "1 setting to train, 2 seeds from 7, 1 finished before" in printed
    assert len(re.findall(r"^small +n-step-1 +\d of 2 reach 95%, median .* returned +\d+% +[\d.]+ s +\d+ s of CPU$", printed, re.MULTILINE)) == 1


def test_runs_of_other_options_are_refused_and_replaced_only_on_request(finished, capsys):
    before = contents(finished)
    assert "default holds a run of other options (config.steps)" in refusal(capsys, *command(finished, "--options", "n-step-3", "--steps", "100"))
    assert "default holds a run of other options (seeds)" in refusal(capsys, *command(finished, "--options", "n-step-3", "--seed", "9"))
    assert contents(finished) == before
    others = cells_of(finished, tasks=["small"], options=[], seeds=(7, 9))
    cells.check_can_train(others, overwrite=True)
    assert not cells.is_finished(others[0])


def test_files_that_are_not_ours_are_not_replaced(tmp_path, capsys):
    (tmp_path / "small" / "default").mkdir(parents=True)
    (tmp_path / "small" / "default" / "summary.json").write_text("mine")
    assert "summary.json" in refusal(capsys, *command(tmp_path))
    assert (tmp_path / "small" / "default" / "summary.json").read_text() == "mine"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--options", "n-stp-1"], "--options n-stp-1 is not known (did you mean 'n-step-1'?)"),
        (["--tasks", "smal"], "--tasks smal is not known (did you mean 'small'?)"),
        (["--seeds", "1"], "an interval needs at least 2"),
        (["--seed", "-1"], "--seed -1 is not usable"),
        (["--steps", "0"], "steps = 0"),
        (["--steps", "10"], "steps = 10 ends within"),
        (["--step", "100"], "did you mean --steps?"),
    ],
)
def test_bad_input_is_one_line_and_writes_nothing(arguments, message, tmp_path, capsys):
    assert message in refusal(capsys, *command(tmp_path / "out", *arguments))
    assert not (tmp_path / "out").exists()


def test_the_list_shows_every_option_and_trains_nothing(tmp_path, capsys):
    run(tmp_path / "out", "--list")
    printed = capsys.readouterr().out
    assert all(re.search(rf"^ *{re.escape(option.name)} +{option.group} ", printed, re.MULTILINE) for option in OPTIONS)
    assert not (tmp_path / "out").exists()


def test_the_group_of_commands_has_a_usage(capsys):
    cli.main(["reproduce", "--help"])
    assert "hindrl reproduce ablation" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        cli.main(["reproduce"])
    assert "'hindrl reproduce' needs a command: choose one of ablation" in capsys.readouterr().err
