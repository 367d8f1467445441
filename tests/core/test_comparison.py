"""Comparisons of actions by their values, worked by hand."""

import jax
import jax.numpy as jnp
import numpy as np

from hindrl_jax.core.comparison import better, probability_of_being_better


def test_the_better_action_by_hand():
    # Column 0: 3 > 2, the first; column 1: 1 < 4, the second; column 2: equal, the first. Both dimensions of an action go together.
    first, second = jnp.array([[0.1, 0.2, 0.3], [-0.1, -0.2, -0.3]]), jnp.array([[0.7, 0.8, 0.9], [-0.7, -0.8, -0.9]])
    action, is_first = better((first, second), (jnp.array([3.0, 1.0, 2.0]), jnp.array([2.0, 4.0, 2.0])))
    np.testing.assert_allclose(action, [[0.1, 0.8, 0.3], [-0.1, -0.8, -0.3]])
    assert is_first.tolist() == [True, False, True]


def test_probability_of_being_better_by_hand():
    # Column 0: means 2 and 0.5, variances 1 and 0.25: Phi(1.5 / sqrt(1.25) = 1.3416) = 0.91014. Column 1: the other way round. Column 2: equal means.
    # Column 3: certain, and worse by 1.
    values = jnp.array([[1.0, 0.0, 2.0, 3.0], [3.0, 1.0, 4.0, 3.0]])
    others = jnp.array([[0.0, 1.0, 3.0, 4.0], [1.0, 3.0, 3.0, 4.0]])
    np.testing.assert_allclose(probability_of_being_better(values, others), [0.91014, 0.08986, 0.5, 0.0], atol=1e-4)
    # Three critics, of whom one disagrees: means 1 and 0, variances 2 and 0: Phi(1 / sqrt(2) = 0.7071) = 0.76025.
    np.testing.assert_allclose(probability_of_being_better(jnp.array([[0.0], [0.0], [3.0]]), jnp.zeros((3, 1))), [0.76025], atol=1e-4)
    for gradient in jax.grad(lambda *given: probability_of_being_better(*given).sum(), argnums=(0, 1))(values, others):
        assert not gradient.any()
