"""Losses, worked by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hindrl_jax.config import AgentConfig
from hindrl_jax.core.losses import (
    ActorTerms,
    actor_loss,
    behaviour_cloning,
    entropy_coefficient,
    quantile_huber,
    squared_error,
    target_atoms,
    target_value,
)


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


def test_target_value_by_hand():
    # Row 0: the least of 4 and 2 is 2; 1 + 0.5 * (2 - 0.4) = 1.8. Row 1: the least of 3 and 5 is 3, but it has ended: only the reward is left.
    given = dict(reward=jnp.array([1.0, 0.3]), discount=jnp.array([0.5, 0.0]), entropy_bonus=jnp.array([-0.4, 7.0]))
    value, gradient = jax.value_and_grad(lambda values: target_value(values, **given).sum())(jnp.array([[4.0, 3.0], [2.0, 5.0]]))
    np.testing.assert_allclose(value, 1.8 + 0.3, rtol=1e-6)
    np.testing.assert_allclose(target_value(jnp.array([[4.0, 3.0], [2.0, 5.0]]), **given), [[1.8, 0.3]], rtol=1e-6)
    assert not gradient.any()


def test_squared_error_by_hand():
    # Halves of 2^2 and 1^2 for the first critic, of 0 and 3^2 for the second; the derivative is the difference.
    values, target = jnp.array([[3.0, 1.0], [1.0, 5.0]]), jnp.array([1.0, 2.0])
    np.testing.assert_allclose(squared_error(values, target), [[2.0, 0.5], [0.0, 4.5]], rtol=1e-6)
    by_values, by_target = jax.grad(lambda *given: squared_error(*given).sum(), argnums=(0, 1))(values, target)
    np.testing.assert_allclose(by_values, [[2.0, -1.0], [0.0, 3.0]], rtol=1e-6)
    assert not by_target.any()


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
    ("form", "expected"),
    # Squared distances 25, 1 and 9 with weights 0.5, 1 and 0, divided by three rows; demonstrated lengths 4, 1 and 100: (0.5 * 4 + 1) / 1.5 = 2.
    [("squared", 13.5 / 3), ("norm", (0.5 * 5.0 + 1.0) / 3), ("relative", 13.5 / 3 / 2.0)],
)
def test_weighted_behaviour_cloning_by_hand(form, expected):
    demonstrated = jnp.array([[2.0, 1.0, 10.0]])
    value = behaviour_cloning(demonstrated + jnp.array([[5.0, -1.0, 3.0]]), demonstrated, jnp.array([0.5, 1.0, 0.0]), form=form)
    np.testing.assert_allclose(value, expected, rtol=1e-5)


def test_small_weights_stay_small():
    """Their sum is far below 1, and the mean length of what they weigh is still that of the actions: 0.001 * 1 / (2 rows * 4)."""
    value = behaviour_cloning(jnp.array([[3.0, 3.0]]), jnp.array([[2.0, 9.0]]), jnp.array([1e-3, 0.0]), form="relative")
    np.testing.assert_allclose(value, 1e-3 / 8, rtol=1e-5)
    assert not behaviour_cloning(jnp.ones((1, 2)), jnp.zeros((1, 2)), jnp.zeros(2, bool), form="relative")


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


@pytest.mark.parametrize(
    ("relative", "expected"),
    [
        (False, 0.2 - 0.2505 + 0.1),  # alpha times the mean of 1 and 3, less the mean of 0.5 and 0.001, and 0.05 * 2
        (True, 0.2 - 0.55 + 0.1),  # 0.5 / 0.5 = 1, and 0.001 / 0.01 = 0.1
    ],
)
def test_loss_of_the_actor(relative, expected):
    action = jnp.zeros((1, 2))
    terms = ActorTerms(
        value=jnp.array([0.5, 0.001]),
        log_prob=jnp.array([1.0, 3.0]),
        alpha=jnp.asarray(0.1),
        cloning=jnp.asarray(2.0),
        **dict(action=action, mode=action, taken_action=action, is_demonstration=jnp.ones(2, bool), critics=None),
    )
    assert float(actor_loss(terms, AgentConfig(bc_weight=0.05, relative_value=relative))) == pytest.approx(expected, abs=1e-6)
