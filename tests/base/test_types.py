"""What the core shares: units of actions, and what it may ask of an environment."""

from types import SimpleNamespace

import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import strategies as st
from toy_env import Corridor

from hindrl_jax.base.environments import Environment, RestorableEnvironment, action_from_env, action_to_env, compiler_options
from hindrl_jax.envs.grid import GridPickAndPlace
from hindrl_jax.envs.reach import FixedParameterizedReach, ParameterizedReach


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    # Policy actions -1, 0, 0.5 and 1 of three dimensions.
    [
        (0.0, 2.0, [[0.0] * 3, [1.0] * 3, [1.5] * 3, [2.0] * 3]),
        (np.array([-0.02, 0.0, 1.0]), np.array([0.02, 4.0, 3.0]), [[-0.02, 0.0, 1.0], [0.0, 2.0, 2.0], [0.01, 3.0, 2.5], [0.02, 4.0, 3.0]]),
        (np.array([-0.02, 0.0, 1.0]), 3.0, [[-0.02, 0.0, 1.0], [1.49, 1.5, 2.0], [2.245, 2.25, 2.5], [3.0, 3.0, 3.0]]),
    ],
)
def test_units_of_actions_by_hand(low, high, expected):
    env = SimpleNamespace(action_low=low, action_high=high)
    actions = jnp.array([-1.0, 0.0, 0.5, 1.0])[:, None] * jnp.ones((1, 3))
    np.testing.assert_allclose(action_to_env(actions, env), expected, atol=1e-6)
    np.testing.assert_allclose(action_from_env(jnp.array(expected), env), actions, atol=1e-6)
    for leading in ((), (2, 2)):  # unbatched, and with several axes
        given = actions[2] if leading == () else actions.reshape(2, 2, 3)
        wanted = expected[2] if leading == () else np.reshape(expected, (2, 2, 3))
        np.testing.assert_allclose(action_to_env(given, env), wanted, atol=1e-6)


@hypothesis.given(st.lists(st.floats(-1, 1, width=32), min_size=6, max_size=6))
@hypothesis.settings(deadline=None, max_examples=30)
def test_units_of_actions_and_back(values):
    env, action = FixedParameterizedReach(), jnp.array(values)
    np.testing.assert_allclose(action_from_env(action_to_env(action, env), env), action, atol=1e-6)


@pytest.mark.parametrize("env", [Corridor(), GridPickAndPlace(), FixedParameterizedReach(), ParameterizedReach()], ids=lambda env: env.name)
def test_protocols(env):
    assert isinstance(env, Environment)
    assert isinstance(env, RestorableEnvironment)
    assert not isinstance(SimpleNamespace(name="bare"), Environment)


def test_options_of_the_compiler(monkeypatch):
    """On CPUs all but gradient steps compile without the fusion emitters, where they can be turned off and nobody has chosen; MJX always does."""
    monkeypatch.setenv("XLA_FLAGS", "--xla_backend_optimization_level=0")
    plain = [Corridor(), GridPickAndPlace(), FixedParameterizedReach(), FixedParameterizedReach(backend="robosuite")]
    on_mjx = ParameterizedReach(backend="mjx")
    scheduler, emitters = {"xla_cpu_enable_concurrency_optimized_scheduler": False}, {"xla_cpu_use_fusion_emitters": False}
    for version, backend, of_plain, of_mjx in (
        ((0, 11, 0), "cpu", emitters, scheduler | emitters),
        ((0, 11, 1), "cpu", {}, scheduler),
        ((0, 11, 0), "gpu", {}, {}),
    ):
        monkeypatch.setattr(jax, "__version_info__", version)
        monkeypatch.setattr(jax, "default_backend", lambda backend=backend: backend)
        assert [compiler_options(env) for env in plain] == [of_plain] * 4
        assert [compiler_options(env, learns=True) for env in plain] == [{}] * 4
        assert compiler_options(on_mjx) == compiler_options(on_mjx, learns=True) == of_mjx
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_use_fusion_emitters=true")
    monkeypatch.setattr(jax, "default_backend", lambda: "cpu")
    assert [compiler_options(env) for env in plain] == [{}] * 4
