"""The command line: what it writes, and how it refuses. Runs in process; the one training run is tiny and shared by the tests that read it."""

from __future__ import annotations

import csv
import dataclasses
import json
import re
import shlex
import signal
import subprocess
import sys
import time
import warnings
from pathlib import Path

import h5py
import jax
import numpy as np
import pytest
from commands import refusal
from PIL import Image

from hindrl_jax import cli
from hindrl_jax.cli.running import demonstrations_of
from hindrl_jax.cli.train_options import parse_train
from hindrl_jax.runs.reader import load_run
from hindrl_jax.runs.spec import read_spec
from hindrl_jax.tasks.presets import preset
from hindrl_jax.tasks.registry import TASKS, make

TINY = shlex.split(
    "--num-envs 2 --learning-starts 200 --steps 260 --eval-every 40 --eval-episodes 3 --updates-per-iteration 1 "
    "--batch-size 16 --net-arch 8 --buffer-size 2000"
)
SEED_FIELDS = {"seed", "final_success", "best_success", "env_steps_to_95", "updates_to_95", "seconds_to_95", "episode_length"}
TOTALS = {"updates_per_second", "env_steps_per_second", "compile_seconds", "train_seconds", "peak_memory_bytes"}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A finished run of two seeds."""
    path = tmp_path_factory.mktemp("runs") / "tiny"
    cli.main(["train", "--env", "FixedGridPickAndPlace", "--demos", "1", "--seeds", "2", "--seed", "5", "--out", str(path), *TINY])
    return path


@pytest.fixture
def demos_file(tmp_path):
    path = tmp_path / "demos.hdf5"
    cli.main(["demos", "record", "--env", "FixedGridPickAndPlace", "--demos", "2", "--out", str(path)])
    return path


class Forgetful:
    """What it raises when it is deleted is not seen by anyone."""

    def __del__(self):
        raise KeyboardInterrupt


def test_an_interrupt_that_nobody_saw_comes_again(monkeypatch, capsys):
    def forget(arguments):
        Forgetful()
        time.sleep(20)

    monkeypatch.setitem(cli.COMMANDS, "envs", forget)
    started = time.monotonic()
    with pytest.raises(SystemExit) as stop:
        cli.main(["envs"])
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


def test_options_that_change_nothing_are_warned_about():
    with pytest.warns(UserWarning, match="num_quantiles = 50 changes nothing: sac has no quantiles"):
        parse_train(["--base", "sac", "--num-quantiles", "50"])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        parse_train(["--base", "sac", "--num-critics", "3"])


def test_run_directory_holds_what_it_promises(run):
    assert {file.name for file in run.iterdir()} == {
        "config.json",
        "metrics.csv",
        "summary.json",
        "parameters.npz",
        "curve.png",
        "episode.gif",
    }
    summary = json.loads((run / "summary.json").read_text())
    assert set(summary) == TOTALS | {"seeds"}
    assert [set(seed) for seed in summary["seeds"]] == [SEED_FIELDS] * 2
    assert [seed["seed"] for seed in summary["seeds"]] == [5, 6]
    assert all(seed["env_steps_to_95"] is None for seed in summary["seeds"])
    rows = list(csv.DictReader((run / "metrics.csv").read_text().splitlines()))
    # 200 random steps, then chunks of 4 steps (a tenth of eval_every, in steps of 2 environments): evaluations at 240 and 260 for 2 seeds
    assert [(row["seed"], row["env_steps"], row["updates"]) for row in rows] == [
        ("5", "240", "20"),
        ("6", "240", "20"),
        ("5", "260", "30"),
        ("6", "260", "30"),
    ]
    assert all(np.isfinite(float(value)) for row in rows for value in row.values())
    with np.load(run / "parameters.npz", allow_pickle=False) as archive:
        assert archive["policy/params/Dense_0/kernel"].shape == (2, 40, 8)


def test_config_runs_again_and_other_flags_change_it(run, tmp_path):
    again = tmp_path / "again"
    cli.main(["train", "--config", str(run), "--out", str(again)])
    assert (again / "config.json").read_text() == (run / "config.json").read_text()
    with np.load(run / "parameters.npz") as first, np.load(again / "parameters.npz") as second:
        for name in first.files:
            np.testing.assert_array_equal(first[name], second[name])
    spec, _ = parse_train(["--config", str(run / "config.json"), "--learning-rate", "0.5", "--seeds", "1"])
    assert (spec.config.agent.learning_rate, spec.seeds, spec.config.batch.batch_size) == (0.5, (5,), 16)


def test_sweep_leaves_a_run_for_each_setting(tmp_path, capsys):
    out = tmp_path / "sweep"
    cli.main(
        [
            "sweep",
            "--over",
            "learning-rate=1e-3,2e-3",
            "--over",
            "bc_weight=0.1",
            "--seeds",
            "2",
            "--seed",
            "5",
            "--tensorboard",
            "--out",
            str(out),
            *TINY,
        ]
    )
    printed = capsys.readouterr().out
    assert "2 seeds from 5, 2 settings" in printed
    folders = ["learning_rate=0.001,bc_weight=0.1", "learning_rate=0.002,bc_weight=0.1"]
    assert sorted(file.name for file in out.iterdir()) == [*folders, "sweep.csv", "sweep.json", "sweep.png"]
    rows = list(csv.DictReader((out / "sweep.csv").read_text().splitlines()))
    assert [[row[name] for name in ("learning_rate", "bc_weight", "seeds", "seeds_reaching_95", "median_steps_to_95")] for row in rows] == [
        ["0.001", "0.1", "2", "0", ""],
        ["0.002", "0.1", "2", "0", ""],
    ]
    for folder, rate in zip(folders, (1e-3, 2e-3), strict=True):
        run = load_run(out / folder)
        assert (run.spec.seeds, run.spec.config.agent.learning_rate, run.spec.config.agent.bc_weight) == ((5, 6), rate, 0.1)
        assert jax.tree.leaves(run.policies)[0].shape[0] == 2
        metrics = list(csv.DictReader((out / folder / "metrics.csv").read_text().splitlines()))
        assert [(row["seed"], row["env_steps"]) for row in metrics] == [("5", "240"), ("6", "240"), ("5", "260"), ("6", "260")]
        for name in ("seed_5", "seed_6", "mean"):
            (events,) = (out / folder / "tensorboard" / name).iterdir()
            assert b"evaluation/success" in events.read_bytes()
            assert b"final/success" in events.read_bytes()
    first, second = (np.load(out / folder / "parameters.npz")["policy/params/Dense_0/kernel"] for folder in folders)
    assert np.abs(first - second).max() > 0.0
    assert "already holds sweep.json, sweep.csv" in refusal(capsys, "sweep", "--over", "gamma=0.9,0.8", "--out", out, *TINY)
    assert "already holds config.json" in refusal(capsys, "sweep", "--over", "gamma=0.9,0.8", "--overwrite", "--out", out / folders[0], *TINY)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["sweep"], "--over is missing"),
        (["sweep", "--over", "batch_size=1,2"], "'batch_size' cannot be swept"),
        (["sweep", "--over", "gama=0.9"], "did you mean 'gamma'?"),
        (["sweep", "--over", "gamma"], "write for example --over gamma=0.1,0.2"),
        (["sweep", "--over", "gamma=0.9,x"], "write for example --over gamma=0.1,0.2"),
        (["sweep", "--over", "gamma=0.9,0.9"], "a value is listed twice"),
        (["sweep", "--over", "gamma=0.9,0.9000000001"], "a value is listed twice"),
        (["sweep", "--over", "k=1,2"], "would change nothing: epsilon depends on it only for m > 0"),
        (["sweep", "--over", "union_sampling_ratio=0.1,0.2"], "would change nothing: only relabelling by joint_union"),
        (["sweep", "--algo", "bc", "--over", "gamma=0.1,0.2"], "would change nothing: behaviour cloning does not use it"),
        (["sweep", "--over", "gamma=0.9", "--over", "gamma=0.8"], "gamma is given twice"),
        (["sweep", "--over", "gamma=0.9,1.5"], "gamma = 1.5 is not usable"),
        (["train", "--host", "0"], "add --distributed"),
        (["train", "--distributed", "--host", "0"], "belong together"),
        (["train", "--distributed", "--coordinator", "first", "--num-hosts", "2", "--host", "0"], "write HOST:PORT"),
        (["train", "--distributed", "--coordinator", "first:1", "--num-hosts", "2", "--host", "2"], "--host 2 is not one of --num-hosts 2"),
    ],
)
def test_sweeps_and_hosts_that_make_no_sense_are_refused(arguments, message, tmp_path, capsys):
    out = tmp_path / "run"
    tiny = [] if "bc" in arguments else TINY
    assert message in refusal(capsys, *arguments, "--out", out, *tiny)
    assert not out.exists()


def test_a_place_inside_a_file_is_refused(tmp_path, capsys):
    file = tmp_path / "file"
    file.write_text("mine")
    assert "is a file" in refusal(capsys, "train", "--out", file / "run", *TINY)
    assert file.read_text() == "mine"


def test_eval_and_render_read_the_run_back(run, tmp_path, capsys):
    cli.main(["eval", str(run), "--episodes", "4", "--stochastic"])
    assert "4 episodes per seed" in capsys.readouterr().out
    film = tmp_path / "film.gif"
    cli.main(["render", str(run), "--to", str(film), "--seed", "6"])
    assert film.read_bytes().startswith(b"GIF89a")
    capsys.readouterr()
    cli.main(["render", str(run), "--to", str(tmp_path / "film.mp4"), "--episodes", "2"])
    assert "0 of 2 episodes are solved" in capsys.readouterr().out
    assert (tmp_path / "film.mp4").read_bytes()[4:8] == b"ftyp"
    assert "too few" in refusal(capsys, "render", run, "--episodes", 0)
    assert "no seed 7" in refusal(capsys, "render", run, "--seed", 7, "--to", tmp_path / "other.gif")
    assert not (tmp_path / "other.gif").exists()
    assert "must end in .gif, .mp4 or .png" in refusal(capsys, "render", run, "--to", tmp_path / "film.avi")


def test_the_configuration_keeps_its_number_of_seeds(run):
    spec, _ = parse_train(["--config", str(run), "--seed", "100"])
    assert spec.seeds == (100, 101)


def test_files_that_are_not_ours_are_not_replaced(tmp_path, capsys):
    (tmp_path / "summary.json").write_text("mine")
    assert "summary.json" in refusal(capsys, "train", "--out", tmp_path, *TINY)
    assert (tmp_path / "summary.json").read_text() == "mine"


def test_drawing_into_nowhere_is_refused(run, demos_file, tmp_path, capsys):
    nowhere = tmp_path / "nowhere" / "film.gif"
    assert "no folder" in refusal(capsys, "render", run, "--to", nowhere)
    assert "no folder" in refusal(capsys, "demos", "render", demos_file, "--to", nowhere)


def test_unsolved_demonstrations_are_dropped_with_a_warning(demos_file, capsys):
    with h5py.File(demos_file, "r+") as file:
        file["data/demo_0/dones"][-1] = 0
    spec, _ = parse_train(["--demos", str(demos_file)])
    with pytest.warns(UserWarning, match="1 of 2"):
        (demonstrations,) = demonstrations_of(spec)
    assert demonstrations.lengths.shape == (1,)
    with h5py.File(demos_file, "r+") as file:
        file["data/demo_1/dones"][-1] = 0
    assert "none of its demonstrations solves" in refusal(capsys, "train", "--demos", demos_file)


def test_the_original_preset_plays_by_the_original_rules():
    assert parse_train(["--preset", "original"])[0].env.strict_order is False
    assert parse_train(["--preset", "thesis"])[0].env.strict_order is True


README_COMMANDS = re.findall(r"^hindrl train ([^#\n]*)", (Path(__file__).parent.parent.parent / "README.md").read_text(), re.MULTILINE)


@pytest.mark.parametrize("command", README_COMMANDS)
def test_commands_of_the_readme_parse(command, run):
    arguments = [str(run) if word == "runs/eight" and "--config" in command else word for word in shlex.split(command)]
    parse_train(arguments)


def test_existing_run_is_refused_and_kept(run, capsys):
    before = {file.name: file.read_bytes() for file in run.iterdir()}
    assert "already holds a run" in refusal(capsys, "train", "--out", run, *TINY)
    # even with --overwrite, nothing is lost when the rest of the command is not usable
    refusal(capsys, "train", "--out", run, "--overwrite", "--demos", "missing.hdf5", *TINY)
    refusal(capsys, "train", "--out", run, "--overwrite", "--buffer-size", "100")
    assert {file.name: file.read_bytes() for file in run.iterdir()} == before


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "needs a command"),
        (["trian"], "did you mean 'train'?"),
        (["train", "--env", "FixedGrid"], "unknown environment 'FixedGrid' (did you mean"),
        (["train", "--algo", "sac"], "unknown algorithm 'sac'"),
        (["train", "--preset", "paper"], "unknown preset 'paper'"),
        (["train", "--lerning-rate", "1"], "did you mean --learning-rate?"),
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


def test_bad_demonstration_files_are_refused(demos_file, tmp_path, capsys):
    other = tmp_path / "other.hdf5"
    cli.main(["demos", "record", "--env", "GridPickAndPlace", "--demos", "1", "--out", str(other)])
    assert "GridPickAndPlace" in refusal(capsys, "train", "--env", "FixedGridPickAndPlace", "--demos", other)
    assert "num_objects" in refusal(capsys, "train", "--env", "GridPickAndPlace", "--num-objects", 3, "--demos", other)
    assert "exists already" in refusal(capsys, "demos", "record", "--demos", 1, "--out", other)
    text = tmp_path / "text.hdf5"
    text.write_text("not a file of numbers")
    refusal(capsys, "train", "--demos", text)
    cut = tmp_path / "cut.hdf5"
    cut.write_bytes(demos_file.read_bytes()[: demos_file.stat().st_size // 2])
    refusal(capsys, "train", "--demos", cut)
    with h5py.File(demos_file, "r+") as file:
        file["data/demo_1/actions"][3] = np.nan
    assert "demo_1" in refusal(capsys, "train", "--demos", demos_file)
    assert not (tmp_path / "runs").exists()


def test_demonstrations_longer_than_the_horizon_are_dropped_with_a_warning(demos_file, capsys):
    with h5py.File(demos_file) as file:
        lengths = sorted(file[f"data/demo_{i}"].attrs["num_samples"] for i in range(2))
    assert lengths[0] < lengths[1]
    spec, _ = parse_train(["--demos", str(demos_file), "--horizon", str(lengths[0])])
    with pytest.warns(UserWarning, match="1 of 2"):
        (demonstrations,) = demonstrations_of(spec)
    assert demonstrations.lengths.tolist() == [lengths[0]]
    assert "horizon" in refusal(capsys, "train", "--demos", demos_file, "--horizon", lengths[0] - 1)


def test_demos_plot_draws_what_the_filter_keeps(demos_file, capsys):
    cli.main(["demos", "plot", str(demos_file), "--m", "0", "--demo", "1"])
    with Image.open(demos_file.with_suffix(".png")) as picture:
        assert picture.size[0] > picture.size[1] > 300
    kept, total = map(int, re.search(r"keeps (\d+) of (\d+) goals", capsys.readouterr().out).groups())
    with h5py.File(demos_file) as file:
        observations = file["data/demo_1/obs/observation"][:]
        final = file["data/demo_1/next_obs/observation"][-1:]
    goals = np.concatenate([observations, final])
    assert total == len(goals)
    assert kept == 1 + (goals[1:] != goals[:-1]).any(axis=1).sum()  # epsilon is 0: only repeated states are dropped
    for arguments in (["--demo", "2"], ["--m", "-1"], ["--dims", "0", "0"], ["--dims", "0", "99"], ["--to", "picture.gif"]):
        assert arguments[-1] in refusal(capsys, "demos", "plot", demos_file, *arguments)


def test_demos_info_and_render(demos_file, tmp_path, capsys):
    capsys.readouterr()
    cli.main(["demos", "info", str(demos_file), "--m", "5"])
    printed = capsys.readouterr().out
    assert "2 demonstrations, 2 solved" in printed
    cli.main(["demos", "render", str(demos_file), "--demo", "1", "--to", str(tmp_path / "demo.png")])
    assert (tmp_path / "demo.png").read_bytes().startswith(b"\x89PNG")
    assert "no demonstration 2" in refusal(capsys, "demos", "render", demos_file, "--demo", 2)


def test_envs_lists_every_environment(capsys):
    cli.main(["envs"])
    printed = capsys.readouterr().out
    assert all(name in printed for name in TASKS)
    assert "\ngymnasium:ID: " in printed  # rich would make a picture of :ID:


def test_every_config_field_is_a_flag(capsys):
    with pytest.raises(SystemExit):
        cli.main(["train", "--help"])
    printed = capsys.readouterr().out
    config = preset()
    for part in (config, config.batch, config.goal, config.agent, make("FixedGridPickAndPlace")):
        for field in dataclasses.fields(part):
            assert dataclasses.is_dataclass(getattr(part, field.name)) or f"--{field.name.replace('_', '-')}" in printed, field.name


def test_flags_of_each_type():
    arguments = ["--batch-size", "64", "--strict-goal-test", "--target-entropy", "-2.5", "--reach-zero", "None", "--num-objects", "3"]
    spec, _ = parse_train(arguments)
    assert (spec.config.batch.batch_size, spec.config.batch.inclusive_goal_test) == (64, False)
    assert (spec.config.agent.target_entropy, spec.config.batch.reach_zero, spec.env.num_objects) == (-2.5, None, 3)


@pytest.mark.parametrize("algo", ["bc", "tqcfd", "hindrl", "smooth-hindrl"])
@pytest.mark.parametrize("preset", ["default", "thesis", "original"])
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
    assert "did you mean 'num_objects'" in says(good | {"env_args": {"num_object": 3}})
    assert "lacks 'seeds'" in says({name: value for name, value in good.items() if name != "seeds"})
    assert "seeds = [-1]" in says(good | {"seeds": [-1]})
    assert "does not hold" in says([1, 2])
    path.write_text("{")
    assert "cannot be read as JSON" in refusal(capsys, "train", "--config", path)


def test_the_installed_command_starts():
    done = subprocess.run([sys.executable, "-c", "from hindrl_jax.cli import main; main()", "--help"], capture_output=True, text=True, check=True)
    assert "hindrl train" in done.stdout
