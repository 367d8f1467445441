"""Which of two actions is better, by what the critics say of both: surely (IBRL) or with a probability (SPReD)."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from hindrl_jax.base.types import Array

_LEAST_VARIANCE = 1e-12  # critics that agree to the last digit do not divide by 0


def better(actions: tuple[Array, Array], values: tuple[Array, Array]) -> tuple[Array, Array]:
    """Of two actions the one that is valued more, column by column; the first where both are equal.

    Imitation bootstrapped RL (IBRL; Hu et al., 2024) takes the actor's and an imitating policy's, in episodes and in targets.

    Args:
      actions: (A, B) each.
      values: (B,) each.

    Returns:
      Actions (A, B), and (B,) bool, which of them are the first ones.

    Example:
      >>> better((jnp.zeros((1, 3)), jnp.ones((1, 3))), (jnp.array([2.0, 2.0, 2.0]), jnp.array([1.0, 2.0, 3.0])))[0].tolist()
      [[0.0, 0.0, 1.0]]
    """
    is_first = values[0] >= values[1]
    return jnp.where(is_first[None], *actions), is_first


def probability_of_being_better(values: Array, other_values: Array) -> Array:
    """How sure an ensemble of critics is that one action is better than another (SPReD-P; Zhu et al., smooth policy regularisation, 2025).

    Each action's value is taken for a Gaussian with the mean m and the variance v of the critics' values, and the two for independent:
    Phi((m - m') / sqrt(v + v')).

    Args:
      values, other_values: (C, B), of C >= 2 critics.

    Returns:
      (B,) in [0, 1], without gradient.

    Example:
      >>> probability_of_being_better(jnp.array([[1.0], [3.0]]), jnp.array([[2.0], [2.0]])).tolist()
      [0.5]
    """
    difference = jnp.mean(values, axis=0) - jnp.mean(other_values, axis=0)
    variance = jnp.var(values, axis=0) + jnp.var(other_values, axis=0)
    return jax.lax.stop_gradient(jax.scipy.stats.norm.cdf(difference / jnp.sqrt(variance + _LEAST_VARIANCE)))
