"""Our files in robomimic's own tools, and files that robomimic writes here and now in ours. `make test-interop` installs robomimic.

robomimic needs PyTorch, whose build for CPUs is not on PyPI, so these tests are skipped where it is missing; tests/test_conversion.py reads a file
that robomimic wrote.
"""

import argparse
import json
import runpy
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

from hindrl_jax import cli
from hindrl_jax.demonstrations.hdf5 import load_demonstrations, read_recording
from hindrl_jax.tasks.registry import make

pytest.importorskip("robomimic", reason="robomimic is not installed: make test-interop")
pytestmark = pytest.mark.filterwarnings("ignore")  # robomimic and what it imports are of another time
with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import robomimic_grid
    from robomimic.scripts import get_dataset_info, playback_dataset
    from robomimic.utils import obs_utils
    from robomimic.utils.dataset import SequenceDataset

ROBOMIMIC_FILE = Path(__file__).parent.parent / "data" / "robomimic_low_dim.hdf5"
GOAL_KEYS = ["observation", "achieved_goal", "desired_goal"]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    path = tmp_path_factory.mktemp("recorded") / "demos.hdf5"
    cli.main(["demos", "record", "--env", "FixedGridPickAndPlace", "--demos", "2", "--out", str(path)])
    return path


@pytest.fixture(scope="module")
def low_dim(recorded, tmp_path_factory):
    """What robomimic makes of the states and actions of a file of ours."""
    raw = tmp_path_factory.mktemp("robomimic") / "raw.hdf5"
    robomimic_grid.write_raw(recorded, raw)
    return robomimic_grid.write_low_dim(raw, "low_dim.hdf5")


@pytest.fixture(scope="module")
def converted(low_dim):
    path = low_dim.with_name("converted.hdf5")
    cli.main(["demos", "convert", str(low_dim), str(path), "--observation-keys", *robomimic_grid.KEYS])
    return path


def sequences(path, keys, **options):
    obs_utils.initialize_obs_utils_with_obs_specs([{"obs": {"low_dim": keys}}])
    return SequenceDataset(str(path), obs_keys=keys, dataset_keys=["actions", "rewards", "dones"], **options)


def test_dataset_info(recorded, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["get_dataset_info", "--dataset", str(recorded)])
    runpy.run_path(get_dataset_info.__file__, run_name="__main__")
    printed = capsys.readouterr().out
    lengths = [len(demo) for demo in read_recording(recorded).demonstrations]
    assert f"total transitions: {sum(lengths)}" in printed
    assert f"traj length max: {max(lengths)}" in printed


def test_sequences_of_a_recorded_file(recorded):
    demos = read_recording(recorded).demonstrations
    dataset = sequences(recorded, GOAL_KEYS, seq_length=2, goal_mode="last", hdf5_cache_mode="low_dim")
    assert len(dataset) == sum(map(len, demos))
    row = dataset[len(demos[0]) + 3]  # step 3 of the second demonstration
    np.testing.assert_array_equal(row["actions"], demos[1].actions[3:5])
    np.testing.assert_array_equal(row["obs"]["observation"], demos[1].observations[3:5])
    np.testing.assert_array_equal(row["next_obs"]["observation"], demos[1].observations[4:6])
    np.testing.assert_array_equal(np.ravel(row["goal_obs"]["achieved_goal"]), demos[1].achieved_goals[-1])


@pytest.mark.parametrize("use_actions", [False, True])
def test_playback(recorded, capsys, use_actions):
    robomimic_grid.tell_robomimic()
    options = dict(use_obs=False, use_actions=use_actions, filter_key=None, n=None, render=False, video_path=None, video_skip=5, first=False)
    playback_dataset.playback_dataset(argparse.Namespace(dataset=str(recorded), render_image_names=["none"], **options))
    printed = capsys.readouterr().out
    assert "Playing back episode: demo_1" in printed
    assert ("diverged" in printed) is False


def test_its_file_becomes_what_was_recorded(low_dim, converted, recorded):
    env = make("FixedGridPickAndPlace")
    first, second = load_demonstrations(converted, env), load_demonstrations(recorded, env)
    for name in ("observations", "actions", "rewards", "lengths", "terminated", "desired_goals", "states"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name), err_msg=name)


def test_its_file_comes_back(low_dim, converted, tmp_path):
    from test_conversion import assert_same_file

    cli.main(["demos", "convert", str(converted), str(tmp_path / "back.hdf5"), "--restore"])
    assert_same_file(low_dim, tmp_path / "back.hdf5")
    assert_same_file(low_dim, ROBOMIMIC_FILE)  # the copy that the other tests read is what robomimic writes


def test_converted_file_is_still_one_of_robomimic(converted):
    keys = [*GOAL_KEYS, *robomimic_grid.KEYS]
    for filter_key in ("train", "valid"):
        dataset = sequences(converted, keys, filter_by_attribute=filter_key, hdf5_cache_mode="all")
        row = dataset[5]
        np.testing.assert_array_equal(row["obs"]["observation"], np.concatenate([row["obs"][key] for key in robomimic_grid.KEYS], axis=-1))


def test_env_args_are_what_robomimic_looks_for(recorded):
    from robomimic.utils.file_utils import get_env_metadata_from_dataset

    metadata = get_env_metadata_from_dataset(str(recorded))
    assert (metadata["env_name"], metadata["type"]) == ("FixedGridPickAndPlace", 2)
    assert json.dumps(metadata["env_kwargs"])
