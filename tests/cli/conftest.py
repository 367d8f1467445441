"""What the tests of several commands look at."""

import shutil
from pathlib import Path

import pytest
from commands import TINY

from hindrl_jax import cli


@pytest.fixture(scope="session")
def run(tmp_path_factory):
    """A finished run of two seeds, in a directory whose name is legal and odd."""
    path = tmp_path_factory.mktemp("runs") / "tiny [0] 100%s {a}"
    cli.main(["train", "--env", "FixedGridPickAndPlace", "--demos", "1", "--seeds", "2", "--seed", "5", "--out", str(path), *TINY])
    return path


@pytest.fixture(scope="session")
def recorded_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("recorded") / "demos.hdf5"
    cli.main(["demos", "record", "--env", "FixedGridPickAndPlace", "--demos", "2", "--out", str(path)])
    return path


@pytest.fixture
def demos_file(recorded_file, tmp_path):
    """A copy, to be changed."""
    return Path(shutil.copy(recorded_file, tmp_path / "demos.hdf5"))
