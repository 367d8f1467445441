"""What the tests of checkpoints and those of killed runs have in common."""

import gc

import pytest


@pytest.fixture
def unfinished_tasks_end_with_their_test():
    yield
    gc.collect()
