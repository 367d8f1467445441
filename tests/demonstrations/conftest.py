"""Files that many tests begin with."""

import shutil
from pathlib import Path

import pytest
from foreign_files import ROBOMIMIC_FILE
from line_world import save

from hindrl_jax import cli
from hindrl_jax.tasks.registry import make


@pytest.fixture
def path(tmp_path):
    return save(tmp_path / "demos.hdf5")


@pytest.fixture(scope="session")
def env():
    return make("FixedGridPickAndPlace")


@pytest.fixture(scope="session")
def recorded(tmp_path_factory):
    """A file of ours with two demonstrations."""
    path = tmp_path_factory.mktemp("recorded") / "demos.hdf5"
    cli.main(["demos", "record", "--env", "FixedGridPickAndPlace", "--demos", "2", "--seed", "7", "--out", str(path)])
    return path


@pytest.fixture(autouse=True)
def minari_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    return tmp_path / "minari"


@pytest.fixture
def low_dim(tmp_path):
    """A copy of robomimic's file, to be changed."""
    return Path(shutil.copy(ROBOMIMIC_FILE, tmp_path / "low_dim.hdf5"))
