"""Demonstrations in the files of other programs, for a task of one's own: converted, looked at, drawn, filmed and declared to be of it."""

import dataclasses
import json
from typing import ClassVar

import h5py
import jax.numpy as jnp
import numpy as np
import pytest
from commands import refusal
from PIL import Image
from toy_env import Corridor, corridor_demonstrations

import hindrl_jax as hindrl
from hindrl_jax import cli
from hindrl_jax.demonstrations.hdf5 import read_recording
from hindrl_jax.tasks.registry import TASKS

KEYS = ("--observation-keys", "start", "step", "position")


@dataclasses.dataclass(frozen=True)
class Hall(Corridor):
    """The corridor, whose goals are step and position."""

    name: ClassVar[str] = "Hall"

    @property
    def goal_dim(self):
        return 2

    def achieved_goal(self, observation):
        return observation[..., 1:]

    def task_goal(self):
        return jnp.array([3.0, self.width])


@dataclasses.dataclass(frozen=True)
class Passage(Hall):
    """The same by another name."""

    name: ClassVar[str] = "Passage"


class Viewer:
    """A picture of one colour for each state, as bright as the position is far."""

    def animation(self, env, states, captions=None):
        return [np.full((16, 16, 3), min(255, 40 * int(state.position)), np.uint8) for state in states], [0.1] * len(states)


HALL, PASSAGE = f"{__name__}:Hall", f"{__name__}:Passage"


@pytest.fixture(autouse=True)
def registered(monkeypatch):
    """Both tasks, for one test; the commands import this module, which has registered them."""
    for task in (Hall, Passage):
        monkeypatch.setitem(TASKS, task.name, None)
        hindrl.register(task, viewer=Viewer())


@pytest.fixture
def written(tmp_path):
    """Writes robomimic's kind of file, of a task that it calls what it is told."""

    def write(env_name):
        path, demos = tmp_path / "theirs.hdf5", corridor_demonstrations()
        with h5py.File(path, "w") as file:
            file.create_group("data").attrs["env_args"] = json.dumps({"env_name": env_name, "type": 1, "env_kwargs": {}})
            for i, length in enumerate(np.asarray(demos.lengths)):
                group, rows = file["data"].create_group(f"demo_{i}"), np.asarray(demos.observations[i])
                for dim, key in enumerate(KEYS[1:]):
                    group[f"obs/{key}"], group[f"next_obs/{key}"] = rows[:length, dim], rows[1 : length + 1, dim]
                group["actions"], group["rewards"] = np.asarray(demos.actions[i, :length]), np.asarray(demos.rewards[i, :length])
                group["dones"], group["states"] = np.arange(length) == length - 1, np.asarray(demos.states[i, :length])
                group.attrs["num_samples"] = length
        return path

    return write


@pytest.mark.parametrize("env_name", ["Lift", "Hall"])
def test_a_file_of_robomimic_is_converted_said_drawn_and_filmed(written, env_name, tmp_path, capsys):
    """Whether it calls the task something else, or by its name without the module."""
    theirs, ours = str(written(env_name)), tmp_path / "ours.hdf5"
    cli.main(["demos", "convert", theirs, str(ours), "--env", HALL, "--width", "2.5", *KEYS])
    recording, demos = read_recording(ours), corridor_demonstrations()
    assert (recording.env_name, recording.env_kwargs) == (HALL, {"horizon": 5, "width": 2.5})
    for i, demo in enumerate(recording.demonstrations):
        length = int(demos.lengths[i])
        np.testing.assert_array_equal(demo.observations, demos.observations[i, : length + 1])
        np.testing.assert_array_equal(demo.achieved_goals, demos.observations[i, : length + 1, 1:])
        np.testing.assert_allclose(demo.states, demos.states[i, : length + 1], atol=1e-6)  # the last of them by playing the last action again
    assert hindrl.load_demonstrations(ours, Hall(width=2.5)).lengths.tolist() == demos.lengths.tolist()
    for source, meaning in ((theirs, ["--env", HALL, *KEYS]), (str(ours), [])):
        capsys.readouterr()
        cli.main(["demos", "info", source, *meaning])
        assert "3 demonstrations, 3 solved" in capsys.readouterr().out
        cli.main(["demos", "plot", source, "--to", str(tmp_path / "plot.png"), *meaning])
        cli.main(["demos", "render", source, "--demo", "1", "--to", str(tmp_path / "film.gif"), *meaning])
        with Image.open(tmp_path / "film.gif") as film:
            assert film.n_frames >= 3


def test_what_says_that_it_is_of_another_task_can_be_declared_to_be_of_this_one(written, tmp_path, capsys):
    theirs, hall, passage = written("FixedGridPickAndPlace"), tmp_path / "hall.hdf5", tmp_path / "passage.hdf5"
    line = refusal(capsys, "demos", "convert", theirs, hall, "--env", HALL, *KEYS)
    assert "says itself that it is of FixedGridPickAndPlace; leave out --env, or declare it to be of another task with --as-env" in line
    cli.main(["demos", "convert", str(theirs), str(hall), "--as-env", HALL, *KEYS])
    assert read_recording(hall).env_name == HALL
    assert "says itself that it is of" in refusal(capsys, "demos", "convert", hall, passage, "--env", PASSAGE)  # one of ours, too
    cli.main(["demos", "convert", str(hall), str(passage), "--as-env", PASSAGE, "--horizon", "7"])
    before, after = read_recording(hall), read_recording(passage)
    assert (after.env_name, after.env_kwargs["horizon"]) == (PASSAGE, 7)
    for one, other in zip(before.demonstrations, after.demonstrations, strict=True):
        np.testing.assert_array_equal(other.observations, one.observations)
        np.testing.assert_array_equal(other.states, one.states)
    assert hindrl.load_demonstrations(passage, Passage(horizon=7)).lengths.shape == (3,)
    cli.main(["demos", "info", str(hall), "--as-env", PASSAGE])
    assert f"{PASSAGE}(" in capsys.readouterr().out


def test_refusals_are_one_line(written, tmp_path, capsys):
    theirs, ours = written("Lift"), tmp_path / "ours.hdf5"
    convert = ("demos", "convert", theirs, ours)
    assert "exclude each other: drop one of them" in refusal(capsys, *convert, "--env", HALL, "--as-env", HALL, *KEYS)
    assert "there is no module 'nowhere'" in refusal(capsys, *convert, "--as-env", "nowhere:Hall", *KEYS)
    assert "unknown environment 'Hal'" in refusal(capsys, *convert, "--as-env", f"{__name__}:Hal", *KEYS)
    assert "have 3 numbers, but FixedGridPickAndPlace has" in refusal(capsys, *convert, "--as-env", "FixedGridPickAndPlace", *KEYS)
    cli.main(["demos", "convert", str(theirs), str(ours), "--env", HALL, *KEYS])
    line = refusal(capsys, "demos", "info", ours, "--as-env", "FixedGridPickAndPlace")
    assert "observations have 3 numbers, but 10 in FixedGridPickAndPlace" in line
