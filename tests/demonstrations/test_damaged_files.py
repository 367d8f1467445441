"""Every kind of damage to a file of demonstrations is named in one clear line."""

import h5py
import numpy as np
import pytest
from line_world import LineWorld, assert_refused, edit

from hindrl_jax.demonstrations.hdf5 import describe_demonstrations, load_demonstrations, read_recording, read_states


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


def test_what_stands_beside_the_demonstrations_does_no_harm(path):
    """It is kept for the tool that wrote it."""
    with h5py.File(path, "r+") as file:
        file["mask/train"], file["note"] = [b"demo_0"], 1.0
    recording = read_recording(path)
    assert {name: array.tolist() for name, array in recording.extras.items()} == {"mask/train": [b"demo_0"], "note": 1.0}
