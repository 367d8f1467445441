"""Files of demonstrations: what goes in comes out, and every kind of damage is named in one clear line."""

import dataclasses
import json
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import h5py
import hypothesis
import numpy as np
import pytest
from hypothesis import strategies as st

from hindrl_jax.base.errors import UserError
from hindrl_jax.base.types import Episodes
from hindrl_jax.demonstrations.hdf5 import describe_demonstrations, load_demonstrations, read_states, save_demonstrations


@dataclasses.dataclass(frozen=True)
class LineWorld:
    """The least that the dataset functions ask of an environment; the achieved goal is the first entry of the observation."""

    name: str = "LineWorld"
    horizon: int = 6
    size: float = 10.0
    start: tuple[int, int] = (0, 1)
    observation_dim: int = 3
    goal_dim: int = 1
    action_dim: int = 2
    state_dim: int = 2

    def achieved_goal(self, observation):
        return observation[..., :1]


def encoded_episodes(lengths, horizon=6, terminated=None):
    """Every number says where it belongs: observation (episode, t, .), action (episode + t / 100), and padding is NaN, so reading it shows."""
    num, time = len(lengths), np.arange(horizon + 1)
    episode = np.arange(num, dtype=np.float32)[:, None] * np.ones(horizon + 1, np.float32)
    observations = np.stack([100 * episode + time, episode, time * np.ones_like(episode)], axis=-1).astype(np.float32)
    actions = np.stack([episode[:, :-1] / 100, time[:-1] / 100 * np.ones_like(episode[:, :-1])], axis=-1).astype(np.float32)
    rewards = (episode[:, :-1] + time[:-1] / 10).astype(np.float32)
    states = np.stack([episode, time * np.ones_like(episode)], axis=-1).astype(np.float32)
    for i, length in enumerate(lengths):
        observations[i, length + 1 :] = np.nan
        actions[i, length:] = np.nan
        rewards[i, length:] = np.nan
    if terminated is None:
        terminated = np.arange(num) % 2 == 0
    desired_goals = np.arange(num, dtype=np.float32)[:, None] + 0.5
    table = Episodes(
        observations=observations,
        actions=actions,
        rewards=rewards,
        lengths=np.array(lengths, np.int32),
        terminated=np.array(terminated),
        desired_goals=desired_goals,
        states=np.where(time[None, :, None] <= np.array(lengths)[:, None, None], states, np.float32(np.nan)),
    )
    return table


def save(path, lengths=(3, 6, 1), env=None, horizon=6, overwrite=False, **changes):
    """Saves the encoded episodes, with fields replaced by `changes`."""
    env = env or LineWorld()
    table = encoded_episodes(lengths, horizon)
    save_demonstrations(
        path,
        table.replace(**changes),
        env=env,
        env_args=dataclasses.asdict(env),
        expert={"name": "scripted"},
        overwrite=overwrite,
    )
    return path


@pytest.fixture
def path(tmp_path):
    return save(tmp_path / "demos.hdf5")


def assert_refused(call, *words):
    """One line that starts with the file, holds all `words`, and says what to do after a semicolon."""
    with pytest.raises(UserError) as error:
        call()
    message = str(error.value)
    assert "\n" not in message
    assert re.match(r"\S+\.hdf5: ", message), message
    assert "; " in message, message
    for word in words:
        assert word in message, message


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


# Horizon and number


def test_too_long_demonstrations_are_dropped_with_a_warning(path):
    env = LineWorld(horizon=3)
    with pytest.warns(UserWarning, match="dropped 1 of 3 demonstrations, longer than the horizon of 3 steps") as record:
        loaded = load_demonstrations(path, env)
    assert record[0].filename == __file__  # it points at the caller
    assert loaded.observations.shape == (2, 4, 3)
    assert loaded.observations[:, 0, 1].tolist() == [0, 2]
    # num_demos counts those that fit.
    with pytest.warns(UserWarning, match="dropped 1 of 3"):
        assert load_demonstrations(path, env, num_demos=2).lengths.tolist() == [3, 1]
    assert_refused(lambda: load_demonstrations(path, env, num_demos=3), "3 demonstrations asked for", "holds 2", "horizon of 3")


def test_longer_horizon_pads_further(path):
    loaded = load_demonstrations(path, LineWorld(horizon=9))
    assert loaded.observations.shape == (3, 10, 3)
    assert loaded.actions.shape == (3, 9, 2)
    assert loaded.lengths.tolist() == [3, 6, 1]


def test_no_demonstration_fits_the_horizon(tmp_path):
    file = save(tmp_path / "demos.hdf5", lengths=[4, 5])
    assert_refused(lambda: load_demonstrations(file, LineWorld(horizon=3)), "all 2", "horizon of 3")


@pytest.mark.parametrize("num_demos", [4, 0, -1])
def test_impossible_number_of_demonstrations(path, num_demos):
    assert_refused(lambda: load_demonstrations(path, LineWorld(), num_demos=num_demos), f"{num_demos} demonstrations asked for")


# Another environment


@pytest.mark.parametrize(
    ("env", "words"),
    [
        (LineWorld(name="PlaneWorld"), ["recorded in LineWorld", "not in PlaneWorld"]),
        (LineWorld(size=5.0), ["size = 10.0", "size = 5.0"]),
        (LineWorld(start=(0, 2)), ["start = [0, 1]", "start = [0, 2]"]),
    ],
)
def test_file_of_another_environment(path, env, words):
    assert_refused(lambda: load_demonstrations(path, env), *words)


@pytest.mark.parametrize(("field", "what"), [("observation_dim", "observations"), ("action_dim", "actions"), ("goal_dim", "achieved goals")])
def test_dimensions_other_than_the_environments(path, field, what):
    env = LineWorld(**{field: 4})
    edit(path, lambda data: data.attrs.modify("env_args", json.dumps({"env_name": env.name, "env_kwargs": dataclasses.asdict(env)})))
    assert_refused(lambda: load_demonstrations(path, env), "demo_0", what, "but 4 in LineWorld")


def test_achieved_goals_by_another_definition(path):
    def shift(data):
        data["demo_1/obs/achieved_goal"][...] += 1
        data["demo_1/next_obs/achieved_goal"][...] += 1

    edit(path, shift)
    assert_refused(lambda: load_demonstrations(path, LineWorld()), "demo_1", "achieved_goal is not what LineWorld derives")


def test_what_the_environment_calls_interchangeable_may_differ(path):
    class Flexible(LineWorld):
        interchangeable = ("size",)

    assert load_demonstrations(path, Flexible(size=5.0)).lengths.tolist() == [3, 6, 1]
    assert_refused(lambda: load_demonstrations(path, Flexible(size=5.0, start=(0, 2))), "start = [0, 1]", "start = [0, 2]")


# Damaged files


def edit(path, change):
    with h5py.File(path, "r+") as file:
        change(file["data"])


def put(data, name, value):
    del data[name]
    data[name] = value


def set_entry(name, index, value):
    def change(data):
        array = data[name][...]
        array[index] = value
        put(data, name, array)

    return change


def set_aligned(value):
    """Sets observation 1 of demo_0 in both places, so that nothing is misaligned."""

    def change(data):
        data["demo_0/obs/observation"][1, 0] = value
        data["demo_0/next_obs/observation"][0, 0] = value

    return change


def delete_all(data):
    for name in list(data):
        del data[name]


DATASETS = ["actions", "rewards", "dones", "states", "final_state"]
DATASETS += [f"{group}/{key}" for group in ("obs", "next_obs") for key in ("observation", "achieved_goal", "desired_goal")]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        *[(lambda data, name=name: data.__delitem__(f"demo_1/{name}"), ["demo_1", f"{name} is missing"]) for name in DATASETS],
        *[(lambda data, name=name: data.attrs.__delitem__(name), [f"{name} is missing"]) for name in ("env_args", "format_version")],
        (lambda data: data["demo_2"].attrs.__delitem__("num_samples"), ["demo_2", "num_samples is missing"]),
        (lambda data: data["demo_2"].attrs.modify("num_samples", 2), ["demo_2", "shape (1, 3), expected (2, any)"]),
        (lambda data: data["demo_2"].attrs.modify("num_samples", 0), ["demo_2", "0 transitions"]),
        (lambda data: data.attrs.modify("env_args", "{not json"), ["env_args", "JSON"]),
        (lambda data: data.attrs.modify("env_args", "[]"), ["env_args", "JSON"]),
        (lambda data: data.attrs.modify("format_version", 99), ["format version 99"]),
        (lambda data: put(data, "demo_1", np.zeros(3)), ["demo_1", "not a group"]),
        (delete_all, ["holds no demonstrations"]),
        (lambda data: data.file.__delitem__("data"), ["no group 'data'"]),
        (lambda data: put(data, "demo_1/actions", np.zeros((6, 3))), ["demo_1", "actions have shape (3,) per step but (2,) in demo_0"]),
        (lambda data: put(data, "demo_1/actions", np.zeros(6)), ["demo_1", "actions has shape (6,)"]),
        (lambda data: put(data, "demo_1/actions", np.full((6, 2), b"left")), ["demo_1", "actions", "not numbers"]),
        (lambda data: put(data, "demo_0/next_obs/observation", np.zeros((3, 2))), ["demo_0", "next_obs/observation has shape (3, 2)"]),
        (set_entry("demo_0/actions", (2, 1), np.nan), ["demo_0", "actions is not finite in row 2"]),
        (set_entry("demo_0/rewards", 1, np.inf), ["demo_0", "rewards is not finite in row 1"]),
        (set_aligned(np.nan), ["demo_0", "obs/observation is not finite in row 1"]),
        (set_entry("demo_1/actions", (3, 0), 1.001), ["demo_1", "1.001", "[-1, 1]"]),
        (set_entry("demo_1/actions", (3, 0), -1.5), ["demo_1", "1.5", "[-1, 1]"]),
        (set_entry("demo_1/next_obs/observation", (2, 1), 7.0), ["demo_1", "row 2 of next_obs/observation is not row 3 of obs/observation"]),
        (set_entry("demo_1/next_obs/observation", (0, 2), 0.999), ["demo_1", "row 0 of next_obs/observation is not row 1"]),
        (set_entry("demo_1/obs/desired_goal", 0, 9.0), ["demo_1", "desired_goal changes"]),
        (set_entry("demo_0/dones", 1, 1), ["demo_0", "dones"]),
        (set_entry("demo_0/dones", 2, 2), ["demo_0", "dones"]),
    ],
)
def test_damage_is_named(path, change, words):
    load_demonstrations(path, LineWorld())
    edit(path, change)
    assert_refused(lambda: load_demonstrations(path, LineWorld()), *words)
    assert_refused(lambda: describe_demonstrations(path), *words)


def test_rounding_at_the_edge_of_the_action_range_is_tolerated(path):
    edit(path, set_entry("demo_1/actions", (3, 0), 1.000001))
    assert load_demonstrations(path, LineWorld()).actions[1, 3, 0] > 1


@pytest.mark.parametrize("read", [lambda path: load_demonstrations(path, LineWorld()), describe_demonstrations, read_states])
def test_what_is_no_readable_file(tmp_path, read):
    missing, folder, text, empty = (tmp_path / f"{name}.hdf5" for name in ("missing", "folder", "text", "empty"))
    folder.mkdir()
    text.write_text("episode,step\n0,0\n")
    empty.touch()
    assert_refused(lambda: read(missing), "no such file")
    assert_refused(lambda: read(folder), "is not a file")
    assert_refused(lambda: read(text), "not an HDF5 file")
    assert_refused(lambda: read(empty), "not an HDF5 file")


@pytest.mark.parametrize("fraction", [0.02, 0.3, 0.6, 0.95])
def test_file_cut_off(path, fraction):
    content = path.read_bytes()
    path.write_bytes(content[: int(fraction * len(content))])
    assert_refused(lambda: load_demonstrations(path, LineWorld()), "cut off")


@pytest.mark.parametrize("error", [OSError("Can't read data\n(filter failed)"), RuntimeError("bad heap"), KeyError("bad header")])
def test_whatever_h5py_raises_while_reading_is_reported(path, monkeypatch, error):
    """Which exception h5py raises depends on the damaged place. Real damage is not tried at random here: some of it crashes the HDF5 library."""

    def fail(*_args):
        raise error

    monkeypatch.setattr(h5py.Dataset, "__getitem__", fail)
    assert_refused(lambda: load_demonstrations(path, LineWorld()), "demo_0", "cannot be read", str(error.args[0]).split()[-1])


# Writing


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
sys.path.insert(0, {str(Path(__file__).parent.parent)!r})
from test_datasets import save
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
