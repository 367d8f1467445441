"""The examples in the docstrings of the core are true."""

import doctest
import importlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

CORE = ("types", "config", "goals", "relabel", "replay", "networks", "losses", "agent", "rollout", "train")
NUM_EXAMPLES = {"goals": 3, "losses": 2}


@pytest.mark.parametrize("name", CORE)
def test_examples(name):
    module = importlib.import_module(f"hindrl_jax.{name}")
    result = doctest.testmod(module, extraglobs=dict(jax=jax, jnp=jnp, np=np))
    assert result.failed == 0
    assert result.attempted >= NUM_EXAMPLES.get(name, 0)  # found, not skipped
