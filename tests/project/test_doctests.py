"""The examples in the docstrings of the core are true."""

import doctest
import importlib
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hindrl_jax import core

CORE = sorted(Path(core.__path__[0]).glob("[a-z]*.py"))
NUM_EXAMPLES = {"goals": 3, "losses": 2}


@pytest.mark.parametrize("name", [path.stem for path in CORE])
def test_examples(name):
    module = importlib.import_module(f"hindrl_jax.core.{name}")
    result = doctest.testmod(module, extraglobs=dict(jax=jax, jnp=jnp, np=np))
    assert result.failed == 0
    assert result.attempted >= NUM_EXAMPLES.get(name, 0)  # found, not skipped
