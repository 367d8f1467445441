"""Files of other tools, changed for a purpose, and how they are compared.

tests/data/robomimic_low_dim.hdf5 was written by robomimic 0.3.0 (see tests/interop/robomimic_grid.py): its dataset_states_to_obs, with --done_mode 0,
and its split_train_val, on two demonstrations of FixedGridPickAndPlace.
"""

import dataclasses
import shlex
from pathlib import Path

import h5py
import numpy as np
import pytest

from hindrl_jax.base.errors import UserError
from hindrl_jax.base.types import Episodes
from hindrl_jax.demonstrations.foreign import Interpretation

ROBOMIMIC_FILE = Path(__file__).parent.parent / "data" / "robomimic_low_dim.hdf5"
KEYS = ("objects", "goal", "delivered", "held")  # in this order they are the observation of the grid tasks
MEANING = Interpretation(observation_keys=KEYS)
TINY = shlex.split(
    "--num-envs 2 --learning-starts 200 --steps 240 --eval-every 40 --eval-episodes 1 --updates-per-iteration 1 "
    "--batch-size 16 --net-arch 8 --buffer-size 2000"
)


def content(path):
    """All datasets and attributes of an HDF5 file."""
    found = {}
    with h5py.File(path) as file:
        file.visititems(lambda name, item: found.update({name: (item[()] if isinstance(item, h5py.Dataset) else None, dict(item.attrs))}))
    return found


def assert_same_file(first, second):
    first, second = content(first), content(second)
    assert first.keys() == second.keys()
    for name, (array, attributes) in first.items():
        if array is not None:
            np.testing.assert_array_equal(second[name][0], array, err_msg=name)
            assert second[name][0].dtype == array.dtype, name
        assert {key: str(value) for key, value in second[name][1].items()} == {key: str(value) for key, value in attributes.items()}, name


def assert_same_episodes(first, second):
    for field in dataclasses.fields(Episodes):
        np.testing.assert_array_equal(getattr(first, field.name), getattr(second, field.name), err_msg=field.name)


def refusal(call) -> str:
    with pytest.raises(UserError) as error:
        call()
    message = str(error.value)
    assert "\n" not in message
    return message


def change(path, name, function):
    """Replaces a dataset of both demonstrations."""
    with h5py.File(path, "r+") as file:
        for demo in file["data"].values():
            array = function(demo[name][()])
            del demo[name]
            if array is not None:
                demo[name] = array


def remove_next_obs(path):
    with h5py.File(path, "r+") as file:
        for demo in file["data"].values():
            del demo["next_obs"]


def with_entry(index, value):
    def changed(array):
        array[index] = value
        return array

    return changed


def archive(path, **changes):
    """An archive as somebody else would write it: two demonstrations, of 1 and 2 transitions."""
    arrays = {
        "lengths": [1, 2],
        "observations": np.arange(10.0).reshape(5, 2),
        "actions": np.zeros((3, 1)),
        "achieved_goals": np.arange(5.0)[:, None],
    }
    np.savez(path, **{name: np.asarray(value) for name, value in (arrays | changes).items() if value is not None})
    return str(path)
