"""Files of demonstrations: what goes in comes out, and afterwards the file holds either all of it or what it held before."""

import dataclasses
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import h5py
import hypothesis
import numpy as np
import pytest
from hypothesis import strategies as st
from line_world import LineWorld, assert_refused, encoded_episodes, save

from hindrl_jax.base.errors import UserError
from hindrl_jax.base.types import Episodes
from hindrl_jax.demonstrations.hdf5 import describe_demonstrations, load_demonstrations, read_recording, read_states, save_demonstrations


@hypothesis.given(lengths=st.lists(st.integers(1, 6), min_size=1, max_size=13), data=st.data())
@hypothesis.settings(max_examples=15, deadline=None)
def test_what_is_saved_is_loaded(lengths, data):
    terminated = data.draw(st.lists(st.booleans(), min_size=len(lengths), max_size=len(lengths)))
    table = encoded_episodes(lengths, terminated=terminated)
    env = LineWorld()
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "demos.hdf5"
        save_demonstrations(file, table, env=env, env_args=dataclasses.asdict(env))
        loaded, loaded_states = load_demonstrations(file, env), read_states(file)
    # Padding is NaN in what was saved and zero in what is loaded, and the numbers are exact.
    for field in dataclasses.fields(Episodes):
        value = getattr(loaded, field.name)
        np.testing.assert_array_equal(value, np.nan_to_num(getattr(table, field.name)), err_msg=field.name)
        assert type(value) is np.ndarray
        assert value.dtype == {"lengths": np.int32, "terminated": bool}.get(field.name, np.float32)
    assert len(loaded_states) == len(lengths)
    for i, length in enumerate(lengths):
        np.testing.assert_array_equal(loaded_states[i], table.states[i, : length + 1])


def test_layout_is_that_of_robomimic(path):
    with h5py.File(path) as file:
        assert dict(file.attrs) == {}
        data = file["data"]
        assert data.attrs["total"] == 3 + 6 + 1
        assert {data.attrs.get_id(name).dtype.kind for name in ("env", "env_args", "expert")} == {"S"}  # fixed length
        assert sorted(data) == ["demo_0", "demo_1", "demo_2"]
        env_args = json.loads(data.attrs["env_args"])
        assert sorted(env_args) == ["env_kwargs", "env_name", "type"]
        assert (env_args["env_name"], env_args["type"]) == ("LineWorld", 2)
        assert env_args["env_kwargs"]["size"] == 10.0
        for i, length in enumerate((3, 6, 1)):
            demo = data[f"demo_{i}"]
            assert demo.attrs["num_samples"] == length
            # Row t is one transition: the observation's last entry is the time, the action's last entry is time / 100.
            np.testing.assert_array_equal(demo["obs/observation"][:, 2], np.arange(length))
            np.testing.assert_array_equal(demo["next_obs/observation"][:, 2], np.arange(1, length + 1))
            np.testing.assert_allclose(demo["actions"][:, 1], np.arange(length) / 100, rtol=1e-6)
            np.testing.assert_array_equal(demo["obs/achieved_goal"][:, 0], 100 * i + np.arange(length))
            np.testing.assert_array_equal(demo["next_obs/achieved_goal"][:, 0], 100 * i + np.arange(1, length + 1))
            np.testing.assert_array_equal(demo["next_obs/desired_goal"], np.full((length, 1), i + 0.5))
            np.testing.assert_array_equal(demo["states"][:, 1], np.arange(length))
            np.testing.assert_array_equal(demo["final_state"], [i, length])
            assert demo["actions"].dtype == np.float32
            # Episodes 0 and 2 are terminated, episode 1 ran out of time.
            assert demo["dones"][:].tolist() == [0] * (length - 1) + [int(i != 1)]


def test_demonstrations_stand_in_numeric_order(tmp_path):
    file = save(tmp_path / "demos.hdf5", lengths=[1] * 12)
    loaded = load_demonstrations(file, LineWorld())
    assert loaded.observations[:, 0, 1].tolist() == list(range(12))
    assert load_demonstrations(file, LineWorld(), num_demos=3).observations[:, 0, 1].tolist() == [0, 1, 2]
    assert [states[0, 0] for states in read_states(file, num_demos=11)] == list(range(11))


def test_summary(path):
    summary = describe_demonstrations(path)
    assert (summary.env_name, summary.env_kwargs["start"], summary.expert) == ("LineWorld", [0, 1], {"name": "scripted"})
    assert (summary.num_demonstrations, summary.num_transitions, summary.num_solved) == (3, 10, 2)
    assert (summary.length_min, summary.length_median, summary.length_max) == (1, 3.0, 6)
    # Episodes 0, 1, 2 end at times 3, 6, 1: the first entry, 100 * episode + time, is largest at 201, the time at 6.
    assert summary.observation_low.tolist() == [0, 0, 0]
    assert summary.observation_high.tolist() == [201, 2, 6]
    np.testing.assert_allclose(summary.action_low, [0, 0])
    np.testing.assert_allclose(summary.action_high, [0.02, 0.05])


def test_what_was_observed_stands_in_rows_of_states(path):
    demo = read_recording(path).demonstrations[0]  # of 3 transitions: 4 states, the first entry the achieved goal, 0.5 the desired one
    assert {key: rows[:, 0].tolist() for key, rows in demo.observed.items()} == {
        "observation": [0, 1, 2, 3],
        "achieved_goal": [0, 1, 2, 3],
        "desired_goal": [0.5] * 4,
    }


def test_existing_file_is_refused_unless_overwritten(path):
    before = path.read_bytes()
    assert_refused(lambda: save(path, lengths=[2]), "exists already")
    assert path.read_bytes() == before
    save(path, lengths=[2], overwrite=True)
    assert load_demonstrations(path, LineWorld()).lengths.tolist() == [2]


def failing(*_args, **_kwargs):
    raise OSError(28, "No space left on device")


@pytest.mark.parametrize(("owner", "function"), [(os, "replace"), (os, "fsync"), (Path, "mkdir")])
def test_failing_write_leaves_nothing(tmp_path, monkeypatch, owner, function):
    monkeypatch.setattr(owner, function, failing)
    assert_refused(lambda: save(tmp_path / "demos.hdf5"), "cannot be written", "No space left")
    assert list(tmp_path.iterdir()) == []


def test_full_disk_is_reported(tmp_path):
    """A limit on the size of files stands for a full disk; a child process sets it, since it cannot be undone."""
    code = f"""
import resource, sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
from line_world import save
resource.setrlimit(resource.RLIMIT_FSIZE, (4000, 4000))
save({str(tmp_path / "demos.hdf5")!r})
"""
    child = subprocess.run([sys.executable, "-B", "-c", code], capture_output=True, text=True, check=False)
    assert child.returncode == 1
    assert "UserError" in child.stderr.splitlines()[-1]
    assert "cannot be written" in child.stderr.splitlines()[-1]
    assert list(tmp_path.iterdir()) == []


def test_failing_write_leaves_the_old_file(path, monkeypatch):
    before = path.read_bytes()
    monkeypatch.setattr(os, "replace", failing)
    assert_refused(lambda: save(path, overwrite=True), "cannot be written")
    assert list(path.parent.iterdir()) == [path]
    assert path.read_bytes() == before


def test_interrupted_write_leaves_nothing(tmp_path, monkeypatch):
    def interrupt(*_args):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", interrupt)
    with pytest.raises(KeyboardInterrupt):
        save(tmp_path / "demos.hdf5")
    assert list(tmp_path.iterdir()) == []


def test_file_appears_only_when_complete(tmp_path, monkeypatch):
    """At the moment of the renaming the file has no name yet, and the temporary file beside it is whole and on disk."""
    seen, replace, fsync = [], os.replace, os.fsync
    monkeypatch.setattr(os, "fsync", lambda descriptor: (seen.append("fsync"), fsync(descriptor)))

    def check(source, target):
        seen.append("replace")
        assert not Path(target).exists()
        assert Path(source).parent == Path(target).parent
        assert describe_demonstrations(source).num_demonstrations == 3
        replace(source, target)

    monkeypatch.setattr(os, "replace", check)
    file = save(tmp_path / "new" / "demos.hdf5")
    assert seen == ["fsync", "replace"]
    assert list(file.parent.iterdir()) == [file]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"actions": np.full((3, 6, 2), 2.0)}, ["demo_0", "[-1, 1]"]),
        ({"observations": np.full((3, 7, 3), np.nan)}, ["demo_0", "not finite"]),
        ({"lengths": np.array([3, 0, 1])}, ["demo_1", "0 transitions"]),
    ],
)
def test_what_could_not_be_loaded_is_not_saved(tmp_path, changes, words):
    assert_refused(lambda: save(tmp_path / "demos.hdf5", **changes), *words)
    assert list(tmp_path.iterdir()) == []


def test_arguments_of_another_environment_are_not_saved(tmp_path):
    table = encoded_episodes([2])
    env_args = dataclasses.asdict(LineWorld(size=1.0))
    with pytest.raises(UserError, match=r"size = 1\.0"):
        save_demonstrations(tmp_path / "demos.hdf5", table, env=LineWorld(), env_args=env_args)
    assert list(tmp_path.iterdir()) == []


def test_states_must_go_with_the_episodes(tmp_path):
    table = encoded_episodes([2, 3])
    for states in (None, table.states[:, :-1], table.states[..., :-1]):
        with pytest.raises(ValueError, match=r"states must have shape \(2, 7, 2\)"):
            save_demonstrations(tmp_path / "demos.hdf5", table.replace(states=states), env=LineWorld(), env_args={})
