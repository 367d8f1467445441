"""What the tests of pictures share."""

import pytest

from hindrl_jax.base.errors import UserError
from hindrl_jax.envs.reach import viewer


@pytest.fixture
def opengl_here():
    """The pictures need an OpenGL library on the machine."""
    try:
        viewer._renderer()
    except UserError as error:
        pytest.skip(str(error))
