"""`hindrl demos ...`, and how training takes files of demonstrations."""

import dataclasses
import re

import h5py
import jax
import numpy as np
import pytest
from commands import refusal
from PIL import Image

from hindrl_jax import cli
from hindrl_jax.cli.dimension_names import dimension_names
from hindrl_jax.cli.running import demonstrations_of
from hindrl_jax.cli.train_options import parse_train
from hindrl_jax.tasks.registry import TASKS, make


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
    cli.main(["demos", "plot", str(demos_file), "--epsilon-steps", "0", "--demo", "1"])
    with Image.open(demos_file.with_suffix(".png")) as picture:
        assert picture.size[0] > picture.size[1] > 300
    kept, total = map(int, re.search(r"keeps (\d+) of (\d+) goals", capsys.readouterr().out).groups())
    with h5py.File(demos_file) as file:
        observations = file["data/demo_1/obs/observation"][:]
        final = file["data/demo_1/next_obs/observation"][-1:]
    goals = np.concatenate([observations, final])
    assert total == len(goals)
    assert kept == 1 + (goals[1:] != goals[:-1]).any(axis=1).sum()  # epsilon is 0: only repeated states are dropped
    for arguments in (["--demo", "2"], ["--epsilon-steps", "-1"], ["--dims", "0", "0"], ["--dims", "0", "99"], ["--to", "picture.gif"]):
        assert arguments[-1] in refusal(capsys, "demos", "plot", demos_file, *arguments)


def test_demos_info_and_render(demos_file, tmp_path, capsys):
    capsys.readouterr()
    cli.main(["demos", "info", str(demos_file), "--epsilon-steps", "5"])
    printed = capsys.readouterr().out
    assert "2 demonstrations, 2 solved" in printed
    cli.main(["demos", "render", str(demos_file), "--demo", "1", "--to", str(tmp_path / "demo.png")])
    assert (tmp_path / "demo.png").read_bytes().startswith(b"\x89PNG")
    assert "no demonstration 2" in refusal(capsys, "demos", "render", demos_file, "--demo", 2)


@pytest.mark.parametrize("name", TASKS)
def test_dimensions_have_names(name):
    env = make(name)
    names = dimension_names(env)
    assert list(map(len, dataclasses.astuple(names))) == [env.observation_dim, env.goal_dim, env.action_dim]
    assert all(len(set(one)) == len(one) for one in dataclasses.astuple(names))


def test_names_follow_the_options_of_the_task():
    assert dimension_names(make("FixedParameterizedReach", num_waypoints=3, orientation="axis_angle")).goal[-4:] == (
        "hand's orientation 3",
        "waypoint 1 reached",
        "waypoint 2 reached",
        "waypoint 3 reached",
    )
    env = make("GridPickAndPlace", num_objects=3)
    observation = env.observe(env.reset(jax.random.key(0))[0].replace(num_delivered=2))
    named = dict(zip(dimension_names(env).observation, observation.tolist(), strict=True))
    assert [named[f"object {number} delivered"] for number in range(3)] == [1, 1, 0]
    assert len(dimension_names(make("CableInsertion", observation="thesis")).observation) == 31


def test_demos_info_names_dimensions(demos_file, capsys):
    cli.main(["demos", "info", str(demos_file)])
    printed = capsys.readouterr().out
    assert "object 1 from agent, x" in printed
    assert "move +x" in printed
