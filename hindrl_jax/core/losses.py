"""Losses of TQC (Kuznetsov et al., 2020) and of learning from demonstrations, as functions of arrays.

Atoms (quantiles) lie on the leading axes and the batch on the last: on a CPU that layout, not the arithmetic, decides the speed. Truncation and
the quantile Huber loss come in two forms with equal results, chosen where the program is compiled: loops over the atoms, which keep a CPU's cache
and vector units busy, and whole-array operations, which are few launches on a GPU.
"""

from __future__ import annotations

import functools
from typing import Literal

import jax
import jax.numpy as jnp

from hindrl_jax.base.types import Array


def quantile_midpoints(num_quantiles: int) -> Array:
    """Midpoints (2 i + 1) / (2 Q) of the Q quantile intervals, i = 0 .. Q - 1 (Dabney et al., QR-DQN, 2018, lemma 2): (Q,)."""
    return (jnp.arange(num_quantiles, dtype=jnp.float32) + 0.5) / num_quantiles


def drop_largest(atoms: Array, num_dropped: int) -> Array:
    """Removes the `num_dropped` largest atoms of each column: the truncation of TQC (2020, eq. 9).

    Nothing needs to be sorted, since the loss is symmetric in the target atoms.

    Args:
      atoms: (M, B).
      num_dropped: 0 <= num_dropped < M.

    Returns:
      (M - num_dropped, B), in no particular order.

    Example:
      >>> sorted(drop_largest(jnp.array([[3.0], [1.0], [4.0], [2.0]]), 2)[:, 0].tolist())
      [1.0, 2.0]
    """
    if num_dropped == 0:
        return atoms
    loop, sort = (functools.partial(form, num_dropped=num_dropped) for form in (_drop_by_registers, _drop_by_sorting))
    return jax.lax.platform_dependent(atoms, cpu=loop, default=sort)


def _drop_by_sorting(atoms: Array, *, num_dropped: int) -> Array:
    return jnp.sort(atoms, axis=0)[: atoms.shape[0] - num_dropped]


def _drop_by_registers(atoms: Array, *, num_dropped: int) -> Array:
    """Carries every atom past `num_dropped` registers that keep the largest values seen; what falls out at the end is kept."""

    def carry_past(largest: tuple[Array, ...], atom: Array) -> tuple[tuple[Array, ...], Array]:
        registers = []
        for register in largest:
            registers.append(jnp.maximum(register, atom))
            atom = jnp.minimum(register, atom)
        return tuple(registers), atom

    empty = tuple(jnp.full(atoms.shape[1:], -jnp.inf, atoms.dtype) for _ in range(num_dropped))
    _, fallen_out = jax.lax.scan(carry_past, empty, atoms)
    return fallen_out[num_dropped:]


def _quantile_huber_and_gradient(quantiles: Array, targets: Array) -> tuple[Array, Array]:
    """The loss (..., B) and its gradient (..., Q, B), both averaged over atoms."""
    return jax.lax.platform_dependent(quantiles, targets, cpu=_quantile_huber_in_one_pass, default=_quantile_huber_of_all_pairs)


def _quantile_huber_of_all_pairs(quantiles: Array, targets: Array) -> tuple[Array, Array]:
    error = targets.reshape((targets.shape[0],) + (1,) * (quantiles.ndim - 1) + (-1,)) - quantiles[None]  # (M, ..., Q, B)
    loss, gradient = _pairwise_quantile_huber(error)
    return _average_over_pairs(jnp.sum(loss, axis=0), jnp.sum(gradient, axis=0), targets.shape[0])


def _quantile_huber_in_one_pass(quantiles: Array, targets: Array) -> tuple[Array, Array]:
    """A scan over the target atoms that sums up loss and gradient together."""

    def add_target(sums: tuple[Array, Array], target: Array) -> tuple[tuple[Array, Array], None]:
        terms = _pairwise_quantile_huber(target.reshape((1,) * (quantiles.ndim - 1) + target.shape) - quantiles)
        return (sums[0] + terms[0], sums[1] + terms[1]), None

    zeros = jnp.zeros_like(quantiles)
    (loss, gradient), _ = jax.lax.scan(add_target, (zeros, zeros), targets)
    return _average_over_pairs(loss, gradient, targets.shape[0])


def _pairwise_quantile_huber(error: Array) -> tuple[Array, Array]:
    """Loss of each pair of a quantile and a target, and its derivative by the quantile, for errors target - quantile (..., Q, B)."""
    num_quantiles = error.shape[-2]
    midpoints = quantile_midpoints(num_quantiles).reshape((1,) * (error.ndim - 2) + (num_quantiles, 1)).astype(error.dtype)
    clipped = jnp.clip(error, -1.0, 1.0)
    weighted = jnp.where(error < 0.0, 1.0 - midpoints, midpoints) * clipped
    return weighted * (error - 0.5 * clipped), -weighted


def _average_over_pairs(loss: Array, gradient: Array, num_targets: int) -> tuple[Array, Array]:
    """From sums over targets (..., Q, B) to the loss (..., B) and its gradient (..., Q, B)."""
    scale = 1.0 / (loss.shape[-2] * num_targets)
    return scale * jnp.sum(loss, axis=-2), scale * gradient


@jax.custom_vjp
def quantile_huber(quantiles: Array, targets: Array) -> Array:
    """Quantile Huber loss with kappa = 1, averaged over quantiles and target atoms (Dabney et al., 2018, eq. 10).

    With u = target - quantile and midpoint tau: |tau - 1{u < 0}| * (u^2 / 2 if |u| <= 1 else |u| - 1/2). The gradient with respect to
    the quantiles is computed in the same pass; the targets are constants and get none.

    Args:
      quantiles: (..., Q, B) predicted quantiles in ascending order of their midpoints.
      targets: (M, B) target atoms, in any order, the same for all leading axes.

    Returns:
      (..., B) loss per leading index and batch row.

    Example:
      >>> quantile_huber(jnp.zeros((25, 1)), jnp.ones((46, 1))).tolist()
      [0.25]
    """
    return _quantile_huber_and_gradient(quantiles, targets)[0]


def _quantile_huber_forward(quantiles: Array, targets: Array) -> tuple[Array, tuple[Array, Array]]:
    loss, gradient = _quantile_huber_and_gradient(quantiles, targets)
    return loss, (gradient, targets)


def _quantile_huber_backward(residuals: tuple[Array, Array], cotangent: Array) -> tuple[Array, Array]:
    gradient, targets = residuals
    return gradient * cotangent[..., None, :], jnp.zeros_like(targets)


quantile_huber.defvjp(_quantile_huber_forward, _quantile_huber_backward)


def target_atoms(next_atoms: Array, *, reward: Array, discount: Array, entropy_bonus: Array, num_dropped: int) -> Array:
    """Atoms of the distributional Bellman target (Kuznetsov et al., 2020, eq. 10): r + discount * (z + bonus) for each kept atom z.

    Args:
      next_atoms: (M, B) atoms of all target critics at the next state and action.
      reward, discount: (B,); the discount is 0 after termination.
      entropy_bonus: (B,) minus alpha times the log-probability of the next action.
      num_dropped: how many of the largest atoms are dropped.

    Returns:
      (M - num_dropped, B), without gradient.
    """
    kept = drop_largest(next_atoms, num_dropped)
    return jax.lax.stop_gradient(reward[None] + discount[None] * (kept + entropy_bonus[None]))


def target_value(next_values: Array, *, reward: Array, discount: Array, entropy_bonus: Array | float) -> Array:
    """The target of algorithms without quantiles: r + discount * (min over critics of the next value + bonus).

    Clipped double Q-learning (Fujimoto et al., TD3, 2018, eq. 10), with the bonus of SAC; with one critic the target of DDPG.

    Args:
      next_values: (N, B) values of the target critics at the next state and action.
      reward, discount: (B,); the discount is 0 after termination.
      entropy_bonus: (B,) minus alpha times the log-probability of the next action; 0 for deterministic policies.

    Returns:
      (1, B), without gradient.

    Example:
      >>> target_value(jnp.array([[4.0], [2.0]]), reward=jnp.ones(1), discount=jnp.full(1, 0.5), entropy_bonus=0.0).tolist()
      [[2.0]]
    """
    target = reward + discount * (jnp.min(next_values, axis=0) + entropy_bonus)
    return jax.lax.stop_gradient(target[None])


def squared_error(values: Array, target: Array) -> Array:
    """Half the squared distance of values (..., B) to a target (B,), which gets no gradient: (..., B)."""
    return 0.5 * jnp.square(values - jax.lax.stop_gradient(target).reshape((1,) * (values.ndim - 1) + target.shape))


def behaviour_cloning(policy_action: Array, demonstrated_action: Array, is_demonstration: Array, *, form: Literal["squared", "norm"]) -> Array:
    """Behaviour cloning loss: masked by "is a demonstration row", divided by the whole batch (thesis eq. 2.32).

    Args:
      policy_action, demonstrated_action: (A, B) in [-1, 1].
      is_demonstration: (B,) bool, the mask delta^e; of these, with a Q-filter, those that pass it.
      form: "squared" for the squared distance (thesis text), "norm" for the distance itself (original code).

    Returns:
      () loss.
    """
    squared = jnp.sum(jnp.square(policy_action - demonstrated_action), axis=0)
    loss = {"squared": squared, "norm": jnp.sqrt(squared + 1e-12)}[form]
    return jnp.mean(jnp.where(is_demonstration, loss, 0.0))


def entropy_coefficient(log_alpha: Array, log_prob: Array, *, target_entropy: Array | float) -> Array:
    """Loss whose gradient raises alpha while the policy's entropy is below the target: -mean(log_alpha (log_prob + target)).

    As in Stable-Baselines3, it is linear in log alpha (Haarnoja et al., SAC applications, 2018, eq. 18, use alpha itself).

    Args:
      log_alpha: () logarithm of the entropy coefficient.
      log_prob: (B,) log-probabilities of sampled actions, or () their mean; treated as constants.
      target_entropy: the entropy aimed at, in nats.

    Returns:
      () loss.
    """
    return -jnp.mean(log_alpha * jax.lax.stop_gradient(log_prob + target_entropy))
