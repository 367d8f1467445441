"""The fast forms of truncation and quantile loss against plain ones, and batches in blocks."""

import chex
import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import strategies as st

from hindrl_jax.core import kernels
from hindrl_jax.core.kernels import drop_largest, mean_over_blocks, num_blocks, quantile_huber, quantile_midpoints


def test_drop_largest_by_hand():
    # Column 0 has a tie for the largest, of which one copy goes; column 1 is negative throughout.
    atoms = jnp.array([[2.0, -1.0], [5.0, -4.0], [5.0, -2.0], [1.0, -3.0]])
    np.testing.assert_array_equal(np.sort(drop_largest(atoms, 1), axis=0), [[1.0, -4.0], [2.0, -3.0], [5.0, -2.0]])
    np.testing.assert_array_equal(drop_largest(atoms, 0), atoms)


def test_quantile_midpoints():
    np.testing.assert_allclose(quantile_midpoints(2), [0.25, 0.75])
    np.testing.assert_allclose(quantile_midpoints(5), [0.1, 0.3, 0.5, 0.7, 0.9], rtol=1e-6)


def plain_quantile_huber(quantiles, targets):
    """The formula of Dabney et al. (2018) with every pair written out: (C, Q, B), (M, B) -> (C, B)."""
    num_quantiles = quantiles.shape[1]
    midpoints = ((jnp.arange(num_quantiles) + 0.5) / num_quantiles).reshape(1, 1, -1, 1)
    error = targets[None, :, None, :] - quantiles[:, None]  # (C, M, Q, B)
    huber = jnp.where(jnp.abs(error) <= 1.0, 0.5 * error**2, jnp.abs(error) - 0.5)
    return jnp.mean(jnp.abs(midpoints - (error < 0.0)) * huber, axis=(1, 2))


@pytest.mark.parametrize("form", [kernels._quantile_huber_in_one_pass, kernels._quantile_huber_of_all_pairs])
def test_loss_and_gradient_are_those_of_the_plain_formula(form, monkeypatch):
    """Both forms, though only one of them runs on this machine's kind of device."""
    monkeypatch.setattr(kernels, "_quantile_huber_and_gradient", form)
    jax.clear_caches()
    rng = np.random.default_rng(0)
    with jax.enable_x64(True):
        # Errors of either sign on both sides of 1, and weights that differ between critics and rows.
        quantiles, targets = jnp.asarray(2.0 * rng.normal(size=(2, 5, 7))), jnp.asarray(2.0 * rng.normal(size=(8, 7)))
        weights = jnp.asarray(rng.normal(size=(2, 7)))
        value, gradient = jax.jit(jax.value_and_grad(lambda q, z: jnp.sum(weights * quantile_huber(q, z)), argnums=(0, 1)))(quantiles, targets)
        expected, plain = jax.jit(jax.value_and_grad(lambda q, z: jnp.sum(weights * plain_quantile_huber(q, z))))(quantiles, targets)
        assert value.dtype == jnp.float64
        # The midpoints are float32 numbers: 1/10 and so on are off by up to 3e-8.
        np.testing.assert_allclose(value, expected, rtol=1e-6)
        np.testing.assert_allclose(gradient[0], plain, rtol=1e-6, atol=1e-9)
        assert np.all(np.asarray(gradient[1]) == 0.0)  # targets are constants


jitted_drop = jax.jit(drop_largest, static_argnums=1)


@hypothesis.settings(deadline=None, max_examples=40)
@hypothesis.given(
    atoms=st.lists(st.lists(st.integers(-3, 3), min_size=6, max_size=6), min_size=3, max_size=3),
    num_dropped=st.sampled_from([0, 1, 3, 5]),
)
def test_drop_largest_is_that_of_a_sort(atoms, num_dropped):
    atoms = np.array(atoms, np.float32).T  # integers from a small range: ties and negative numbers abound
    expected = np.sort(atoms, axis=0)[: 6 - num_dropped]
    np.testing.assert_array_equal(np.sort(jitted_drop(jnp.asarray(atoms), num_dropped), axis=0), expected)


@pytest.mark.parametrize("form", [kernels._drop_by_registers, kernels._drop_by_sorting])
@pytest.mark.parametrize("num_dropped", [1, 2, 5])
def test_both_forms_of_truncation_keep_the_same_atoms(form, num_dropped):
    atoms = np.random.default_rng(0).integers(-3, 3, size=(6, 11)).astype(np.float32)
    expected = np.sort(atoms, axis=0)[: 6 - num_dropped]
    np.testing.assert_array_equal(np.sort(form(jnp.asarray(atoms), num_dropped=num_dropped), axis=0), expected)


def test_blocks_are_as_few_as_the_cache_allows_and_equal(monkeypatch):
    monkeypatch.setattr(kernels, "_BLOCK_BYTES", 1000)
    # 10 float32 numbers are 40 bytes per row: at most 25 rows per block.
    assert [num_blocks(batch_size, 10) for batch_size in (1, 25, 26, 100, 120, 103)] == [1, 1, 2, 4, 5, 1]  # 103 is a prime
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert num_blocks(100, 10) == 1


def test_mean_over_blocks_is_the_mean_over_the_batch():
    rng = np.random.default_rng(0)
    columns = dict(
        inputs=jnp.asarray(rng.normal(size=(3, 12)), jnp.float32),
        next_inputs=jnp.zeros((3, 12)),
        action=jnp.asarray(rng.normal(size=(2, 12)), jnp.float32),
        reward=jnp.arange(12.0),
        discount=jnp.ones(12),
        is_demonstration=jnp.arange(12) < 5,
        nothing=None,
    )

    def function(block):
        # Columns stay together: a product of different fields would show a mixture.
        product = block["inputs"][0] * block["action"][1] * block["reward"] * block["is_demonstration"]
        return {"mean": jnp.mean(product), "matrix": block["inputs"] @ block["action"].T / block["reward"].shape[0]}

    expected = function(columns)
    for count in (1, 2, 3, 12):
        given = mean_over_blocks(function, columns, count)
        chex.assert_trees_all_close(given, expected, rtol=1e-5, atol=1e-6)
