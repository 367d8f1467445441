"""What the tests of several commands look at."""

import pytest
from commands import TINY

from hindrl_jax import cli


@pytest.fixture(scope="session")
def run(tmp_path_factory):
    """A finished run of two seeds, in a directory whose name is legal and odd."""
    path = tmp_path_factory.mktemp("runs") / "tiny [0] 100%s {a}"
    cli.main(["train", "--env", "FixedGridPickAndPlace", "--demos", "1", "--seeds", "2", "--seed", "5", "--out", str(path), *TINY])
    return path


@pytest.fixture
def demos_file(tmp_path):
    path = tmp_path / "demos.hdf5"
    cli.main(["demos", "record", "--env", "FixedGridPickAndPlace", "--demos", "2", "--out", str(path)])
    return path
