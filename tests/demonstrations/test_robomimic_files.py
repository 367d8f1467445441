"""Files of robomimic: read as what they mean, trained on, and given back as they were."""

import dataclasses
import json

import h5py
import jax
import numpy as np
from foreign_files import KEYS, MEANING, ROBOMIMIC_FILE, TINY, assert_same_file, refusal

from hindrl_jax import cli
from hindrl_jax.demonstrations.convert import load, read, restore, write
from hindrl_jax.demonstrations.foreign import Interpretation
from hindrl_jax.demonstrations.hdf5 import load_demonstrations, read_recording


def test_robomimic_file_means_what_it_says(env, tmp_path):
    recording = read(str(ROBOMIMIC_FILE), MEANING)
    assert (recording.env_name, recording.env_kwargs) == ("FixedGridPickAndPlace", dataclasses.asdict(env))
    assert [(demo.name, len(demo), demo.terminated) for demo in recording.demonstrations] == [("demo_1", 58, True), ("demo_2", 54, True)]
    with h5py.File(ROBOMIMIC_FILE) as file:
        for demo in recording.demonstrations:
            group = file[f"data/{demo.name}"]
            parts = [np.concatenate([group[f"obs/{key}"], group[f"next_obs/{key}"][-1:]]) for key in KEYS]
            np.testing.assert_array_equal(demo.observations, np.concatenate(parts, axis=1))
            np.testing.assert_array_equal(demo.achieved_goals, demo.observations)  # what the grid tasks derive
            np.testing.assert_array_equal(demo.desired_goal, demo.observations[-1])
            np.testing.assert_array_equal(demo.actions, group["actions"])
            assert demo.rewards.tolist() == [0.0] * (len(demo) - 1) + [1.0]
            # robomimic has no last state; it is found by the last action, and looks as the last observation
            np.testing.assert_array_equal(demo.states[:-1], group["states"])
            np.testing.assert_array_equal(env.observe(env.vector_to_state(jax.random.key(0), demo.states[-1])), demo.observations[-1])
    write(str(tmp_path / "ours.hdf5"), recording)
    loaded = load_demonstrations(tmp_path / "ours.hdf5", env)
    assert loaded.observations.shape == (2, 101, 10)
    assert loaded.states is not None


def test_converted_robomimic_file_trains_and_comes_back(tmp_path, capsys):
    ours, back, archive = tmp_path / "ours.hdf5", tmp_path / "back.hdf5", tmp_path / "ours.npz"
    cli.main(["demos", "convert", str(ROBOMIMIC_FILE), str(ours), "--observation-keys", *KEYS])
    assert "2 demonstrations of FixedGridPickAndPlace, 2 solved, 112 transitions" in capsys.readouterr().out
    # the source's own modalities and filter keys are still there for robomimic
    with h5py.File(ours) as file:
        assert file["data/demo_1/next_obs/objects"].shape == (58, 4)
        assert file["mask/train"][()].tolist() == [b"demo_1"]
    cli.main(["train", "--demos", str(ours), "--out", str(tmp_path / "run"), *TINY])
    assert (tmp_path / "run" / "summary.json").exists()
    cli.main(["demos", "convert", str(ours), str(back), "--restore"])
    assert_same_file(ROBOMIMIC_FILE, back)
    cli.main(["demos", "convert", str(ours), str(archive)])
    cli.main(["demos", "convert", str(archive), str(back), "--restore", "--overwrite"])
    assert_same_file(ROBOMIMIC_FILE, back)


def test_task_that_is_not_ours(low_dim, tmp_path):
    """Goals are then taken from modalities, whole or some of their columns; the file keeps the name of the task and has no states for us."""
    with h5py.File(low_dim, "r+") as file:
        file["data"].attrs["env_args"] = json.dumps({"env_name": "Lift", "type": 1, "env_kwargs": {"robots": ["Panda"]}})
    meaning = Interpretation(observation_keys=("goal", "objects"), achieved_goal_keys=("objects[2:4]", "goal[1]"))
    write(str(tmp_path / "ours.hdf5"), read(str(low_dim), meaning))
    recording = read_recording(tmp_path / "ours.hdf5")
    assert (recording.env_name, recording.env_kwargs) == ("Lift", {"robots": ["Panda"]})
    first = recording.demonstrations[0]
    with h5py.File(low_dim) as file:
        np.testing.assert_array_equal(first.observations[:-1, 2:], file["data/demo_1/obs/objects"])
        np.testing.assert_array_equal(first.achieved_goals[:-1, :2], file["data/demo_1/obs/objects"][:, 2:4])
        np.testing.assert_array_equal(first.achieved_goals[:-1, 2], file["data/demo_1/obs/goal"][:, 1])
    np.testing.assert_array_equal(first.desired_goal, first.achieved_goals[-1])
    assert first.states is None
    with h5py.File(tmp_path / "ours.hdf5") as file:  # robomimic can still play the states back in its own environment
        assert json.loads(file["data"].attrs["env_args"])["type"] == 1
        assert file["data/demo_1/states"].shape == (58, 11)
    restore(tmp_path / "back.hdf5", recording, source="ours.hdf5")
    assert_same_file(low_dim, tmp_path / "back.hdf5")


def test_file_without_observations(low_dim):
    """As robosuite's own collecting script leaves it."""
    with h5py.File(low_dim, "r+") as file:
        del file["data"].attrs["env_args"]
        file["data"].attrs["env"] = "Lift"
        for demo in file["data"].values():
            for name in ("obs", "next_obs", "rewards", "dones"):
                del demo[name]
            del demo.attrs["num_samples"]
    message = refusal(lambda: read(str(low_dim), MEANING))
    assert "holds no observations" in message
    assert "dataset_states_to_obs" in message


def test_foreign_file_given_to_train_points_to_convert(env):
    message = refusal(lambda: load(str(ROBOMIMIC_FILE), env))
    assert "--observation-keys" in message
    assert "hindrl demos convert" in message
