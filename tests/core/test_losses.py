"""Losses: worked by hand, and against plain loops and plain formulas."""

import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import strategies as st

from hindrl_jax.core import losses
from hindrl_jax.core.losses import behaviour_cloning, drop_largest, entropy_coefficient, quantile_huber, quantile_midpoints, target_atoms


def test_quantile_midpoints():
    np.testing.assert_allclose(quantile_midpoints(2), [0.25, 0.75])
    np.testing.assert_allclose(quantile_midpoints(5), [0.1, 0.3, 0.5, 0.7, 0.9], rtol=1e-6)


@pytest.mark.parametrize(
    ("target", "expected"),
    [
        # One quantile at 0 has midpoint 1/2, so that the loss is half the Huber loss of the target.
        (0.0, 0.0),
        (0.5, 0.5 * 0.125),  # inside: 0.5^2 / 2
        (-0.5, 0.5 * 0.125),
        (1.0, 0.5 * 0.5),  # on the edge both branches give 1/2
        (3.0, 0.5 * 2.5),  # outside: 3 - 1/2
        (-3.0, 0.5 * 2.5),
    ],
)
def test_quantile_huber_of_one_quantile(target, expected):
    np.testing.assert_allclose(quantile_huber(jnp.zeros((1, 1)), jnp.array([[target]])), [expected], rtol=1e-6)


def test_quantile_huber_by_hand():
    # Quantiles 0 (midpoint 1/4) and 1 (midpoint 3/4); targets 0.5 and 3.
    # u = 0.5 - 0 =  0.5: 1/4 * 0.125 = 0.03125      u = 3 - 0 = 3: 1/4 * 2.5 = 0.625
    # u = 0.5 - 1 = -0.5: 1/4 * 0.125 = 0.03125      u = 3 - 1 = 2: 3/4 * 1.5 = 1.125
    # Their mean is 1.8125 / 4. A second column, moved by 10, must give the same, and so must targets in another order.
    quantiles = jnp.array([[0.0, 10.0], [1.0, 11.0]])
    targets = jnp.array([[0.5, 13.0], [3.0, 10.5]])
    np.testing.assert_allclose(quantile_huber(quantiles, targets), [1.8125 / 4] * 2, rtol=1e-6)


def test_gradient_by_hand():
    # As above; the derivative with respect to a quantile is -|midpoint - 1{u < 0}| * clip(u, -1, 1), averaged over 4 pairs:
    # quantile 0: -(1/4 * 0.5 + 1/4 * 1) / 4;  quantile 1: -(1/4 * -0.5 + 3/4 * 1) / 4.
    gradient = jax.grad(lambda quantiles: quantile_huber(quantiles, jnp.array([[0.5], [3.0]])).sum())(jnp.array([[0.0], [1.0]]))
    np.testing.assert_allclose(gradient[:, 0], [-0.375 / 4, -0.625 / 4], rtol=1e-6)


def test_quantile_huber_averages_over_quantiles():
    # All midpoints average to 1/2, and the Huber loss of 1 is 1/2.
    np.testing.assert_allclose(quantile_huber(jnp.zeros((3, 25, 2)), jnp.ones((46, 2))), np.full((3, 2), 0.25), rtol=1e-6)


def plain_quantile_huber(quantiles, targets):
    """The formula of Dabney et al. (2018) with every pair written out: (N, Q, B), (M, B) -> (N, B)."""
    num_quantiles = quantiles.shape[1]
    midpoints = ((jnp.arange(num_quantiles) + 0.5) / num_quantiles).reshape(1, 1, -1, 1)
    error = targets[None, :, None, :] - quantiles[:, None]  # (N, M, Q, B)
    huber = jnp.where(jnp.abs(error) <= 1.0, 0.5 * error**2, jnp.abs(error) - 0.5)
    return jnp.mean(jnp.abs(midpoints - (error < 0.0)) * huber, axis=(1, 2))


@pytest.mark.parametrize("form", [losses._quantile_huber_in_one_pass, losses._quantile_huber_of_all_pairs])
def test_loss_and_gradient_are_those_of_the_plain_formula(form, monkeypatch):
    """Both forms, though only one of them runs on this machine's kind of device."""
    monkeypatch.setattr(losses, "_quantile_huber_and_gradient", form)
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


@pytest.mark.parametrize("form", [losses._drop_by_registers, losses._drop_by_sorting])
@pytest.mark.parametrize("num_dropped", [1, 2, 5])
def test_both_forms_of_truncation_keep_the_same_atoms(form, num_dropped):
    atoms = np.random.default_rng(0).integers(-3, 3, size=(6, 11)).astype(np.float32)
    expected = np.sort(atoms, axis=0)[: 6 - num_dropped]
    np.testing.assert_array_equal(np.sort(form(jnp.asarray(atoms), num_dropped=num_dropped), axis=0), expected)


def test_drop_largest_by_hand():
    # Column 0 has a tie for the largest, of which one copy goes; column 1 is negative throughout.
    atoms = jnp.array([[2.0, -1.0], [5.0, -4.0], [5.0, -2.0], [1.0, -3.0]])
    np.testing.assert_array_equal(np.sort(drop_largest(atoms, 1), axis=0), [[1.0, -4.0], [2.0, -3.0], [5.0, -2.0]])
    np.testing.assert_array_equal(drop_largest(atoms, 0), atoms)


def test_target_atoms_by_hand():
    # Row 0: of 1, 4, 2 the 4 goes; 0.5 + 0.9 * (1 - 0.1) = 1.31 and 0.5 + 0.9 * (2 - 0.1) = 2.21. Row 1 has ended: only the reward is left.
    atoms = target_atoms(
        jnp.array([[1.0, 7.0], [4.0, 8.0], [2.0, 9.0]]),
        reward=jnp.array([0.5, 1.0]),
        discount=jnp.array([0.9, 0.0]),
        entropy_bonus=jnp.array([-0.1, 5.0]),
        num_dropped=1,
    )
    np.testing.assert_allclose(np.sort(atoms, axis=0), [[1.31, 1.0], [2.21, 1.0]], rtol=1e-6)


def test_target_atoms_pass_no_gradient():
    def total(atoms, bonus):
        return target_atoms(atoms, reward=jnp.ones(1), discount=jnp.ones(1), entropy_bonus=bonus, num_dropped=1).sum()

    for gradient in jax.grad(total, argnums=(0, 1))(jnp.ones((3, 1)), jnp.ones(1)):
        assert np.all(np.asarray(gradient) == 0.0)


@pytest.mark.parametrize(("form", "expected"), [("squared", (25.0 + 1.0) / 4), ("norm", (5.0 + 1.0) / 4)])
def test_behaviour_cloning_by_hand(form, expected):
    # Differences (3, 4), (0, 1), (0, 0) and, not a demonstration, (9, 9): distances 5, 1 and 0, divided by all four rows.
    policy = jnp.array([[3.0, 4.0], [1.0, 2.0], [1.0, 1.0], [9.0, 9.0]])
    demonstrated = jnp.array([[0.0, 0.0], [1.0, 1.0], [1.0, 1.0], [0.0, 0.0]])
    mask = jnp.array([True, True, True, False])
    value, gradient = jax.value_and_grad(behaviour_cloning)(policy.T, demonstrated.T, mask, form=form)
    np.testing.assert_allclose(value, expected, rtol=1e-5)
    # d|x|^2 = 2x and d|x| = x / |x|, divided by four; finite at distance 0.
    first = [6.0 / 4, 8.0 / 4] if form == "squared" else [0.6 / 4, 0.8 / 4]
    np.testing.assert_allclose(gradient.T, [first, [0.0, 0.5 if form == "squared" else 0.25], [0.0, 0.0], [0.0, 0.0]], rtol=1e-5)


@pytest.mark.parametrize(
    ("log_prob", "expected"),
    [
        # Target entropy -2. Entropies -mean(log_prob): -3 is below the target, so descent must raise log alpha; 0 is above it, so it must fall.
        ([2.0, 4.0], -1.0),  # -(mean(2, 4) - 2)
        ([1.0, -1.0], 2.0),  # -(mean(1, -1) - 2)
        ([2.0, 2.0], 0.0),
    ],
)
def test_gradient_of_the_entropy_coefficient(log_prob, expected):
    value, gradient = jax.value_and_grad(entropy_coefficient)(jnp.asarray(3.0), jnp.array(log_prob), target_entropy=-2.0)
    np.testing.assert_allclose(gradient, expected, rtol=1e-6)
    np.testing.assert_allclose(value, 3.0 * expected, rtol=1e-6)
    policy_gradient = jax.grad(lambda x: entropy_coefficient(jnp.asarray(3.0), x, target_entropy=-2.0))(jnp.array(log_prob))
    assert np.all(np.asarray(policy_gradient) == 0.0)
