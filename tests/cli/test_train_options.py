"""The options of `hindrl train`: flags, presets and configuration files. Nothing is trained."""

import dataclasses
import json
import re
import shlex
import warnings
from pathlib import Path
from typing import get_args

import pytest
from commands import refusal

from hindrl_jax import cli
from hindrl_jax.cli.train_options import parse_train
from hindrl_jax.config import Algorithm
from hindrl_jax.runs.spec import read_spec
from hindrl_jax.tasks.presets import Preset, preset
from hindrl_jax.tasks.registry import make


def test_options_that_change_nothing_are_warned_about():
    with pytest.warns(UserWarning, match="--num-quantiles 50 changes nothing: sac has no quantiles"):
        parse_train(["--base", "sac", "--num-quantiles", "50"])
    with pytest.warns(UserWarning, match="--bc-loss norm changes nothing: nothing is cloned"):
        parse_train(["--bc-weight", "0", "--imitation-steps", "0", "--bc-loss", "norm"])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        parse_train(["--base", "sac", "--num-critics", "3"])


def test_the_configuration_keeps_its_number_of_seeds(run):
    spec, _ = parse_train(["--config", str(run), "--seed", "100"])
    assert spec.seeds == (100, 101)


def test_the_original_preset_plays_by_the_original_rules():
    assert parse_train(["--preset", "original"])[0].env.strict_order is False
    assert parse_train(["--preset", "thesis"])[0].env.strict_order is True


README_COMMANDS = re.findall(r"^hindrl train ([^#\n]*)", (Path(__file__).parent.parent.parent / "README.md").read_text(), re.MULTILINE)


@pytest.mark.parametrize("command", README_COMMANDS)
def test_commands_of_the_readme_parse(command, run):
    arguments = [str(run) if word == "runs/eight" and "--config" in command else word for word in shlex.split(command)]
    parse_train(arguments)


def test_every_config_field_is_a_flag(capsys):
    with pytest.raises(SystemExit):
        cli.main(["train", "--help-all"])
    printed = capsys.readouterr().out
    config = preset()
    sections = [section for section in vars(config).values() if dataclasses.is_dataclass(section)]
    assert len(sections) == 4
    for part in (config, *sections, make("FixedGridPickAndPlace")):
        for field in dataclasses.fields(part):
            assert dataclasses.is_dataclass(getattr(part, field.name)) or f"--{field.name.replace('_', '-')}" in printed, field.name


def test_quirks_come_last_in_the_help(capsys):
    with pytest.raises(SystemExit):
        cli.main(["train", "--help-all"])
    titles = re.findall(r"^(\S.*):$", capsys.readouterr().out, re.MULTILINE)
    assert titles == [
        "options",
        "the task",
        "training",
        "training: the batch",
        "training: goals",
        "training: networks and losses",
        "training: peculiarities of the thesis and its code",
    ]


def test_the_short_help_is_short_and_names_no_flag_that_is_not_there(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    pages = []
    for flag in ("--help", "--help-all"):
        with pytest.raises(SystemExit) as stop:
            cli.main(["train", flag, "--env", "FixedParameterizedReach", "--algo", "bc"])
        assert stop.value.code == 0
        pages.append(capsys.readouterr().out)
    short, full = pages
    assert len(short.splitlines()) < 60
    assert max(map(len, short.splitlines())) < 80
    assert set(re.findall(r"--[a-z-]+", short)) - {"--help-all"} <= set(re.findall(r"--[a-z-]+", full))
    assert "--num-waypoints" in short  # of the task that is named
    assert "(default: FixedParameterizedReach)" in " ".join(short.split())


def test_each_default_is_said_once(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    with pytest.raises(SystemExit):
        cli.main(["train", "--help-all"])
    printed = capsys.readouterr().out
    assert "(default: None)" not in printed
    assert "{None}" not in printed
    assert all(line.count("(default: ") <= 1 for line in printed.splitlines())
    assert "Learning rate" not in printed
    assert "      Discount factor. (default: 0.98)" in printed.splitlines()


def test_a_file_of_demonstrations_says_which_task(tmp_path):
    file = tmp_path / "demos.hdf5"
    cli.main(["demos", "record", "--env", "GridPickAndPlace", "--num-objects", "1", "--demos", "1", "--out", str(file)])
    spec, _ = parse_train(["--demos", str(file)])
    assert spec.env == make("GridPickAndPlace", num_objects=1)
    assert spec.config == preset(env="GridPickAndPlace")
    spec, _ = parse_train(["--demos", str(file), "--horizon", "50"])  # other flags change it
    assert spec.env == make("GridPickAndPlace", num_objects=1, horizon=50)
    spec, _ = parse_train(["--demos", str(file), "--env", "FixedGridPickAndPlace"])  # and the flag wins
    assert spec.env == make("FixedGridPickAndPlace")
    assert parse_train(["--demos", "3"])[0].env.name == "FixedGridPickAndPlace"


def test_flags_of_each_type():
    arguments = ["--batch-size", "64", "--strict-goal-test", "--target-entropy", "-2.5", "--reach-zero", "None", "--num-objects", "3"]
    spec, _ = parse_train(arguments)
    assert (spec.config.batch.batch_size, spec.config.quirks.strict_goal_test) == (64, True)
    assert (spec.config.agent.target_entropy, spec.config.batch.reach_zero, spec.env.num_objects) == (-2.5, None, 3)


PRESETS = [(algo, preset) for algo in get_args(Algorithm) for preset in get_args(Preset) if (algo, preset) != ("bc", "rlpd")]


@pytest.mark.parametrize(("algo", "preset"), PRESETS)
def test_presets_parse_and_survive_the_configuration_file(algo, preset, tmp_path):
    spec, _ = parse_train(["--algo", algo, "--preset", preset])
    path = tmp_path / "config.json"
    path.write_text(json.dumps(spec.to_json()))
    assert read_spec(path) == spec


def test_configuration_files_are_checked_field_by_field(tmp_path, capsys):
    spec, _ = parse_train([])
    good = spec.to_json()
    path = tmp_path / "config.json"

    def says(data) -> str:
        path.write_text(json.dumps(data))
        return refusal(capsys, "train", "--config", path)

    assert "did you mean 'num_envs'" in says(good | {"config": good["config"] | {"num_envz": 3}})
    assert "steps = 'many'" in says(good | {"config": good["config"] | {"steps": "many"}})
    assert "batch = 3 is not usable" in says(good | {"config": good["config"] | {"batch": 3}})
    assert "gamma = True" in says(good | {"config": good["config"] | {"batch": good["config"]["batch"] | {"gamma": True}}})
    assert "gamma = nan" in says(good | {"config": good["config"] | {"batch": good["config"]["batch"] | {"gamma": float("nan")}}})
    assert "did you mean 'num_objects'" in says(good | {"env_args": {"num_object": 3}})
    assert "lacks 'seeds'" in says({name: value for name, value in good.items() if name != "seeds"})
    assert "seeds = [-1]" in says(good | {"seeds": [-1]})
    assert "does not hold" in says([1, 2])
    path.write_text("{")
    assert "cannot be read as JSON" in refusal(capsys, "train", "--config", path)
