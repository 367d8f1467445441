"""Performance-critical forms: truncation and the quantile Huber loss in two forms each, and batches cut into blocks.

Atoms (quantiles) lie on the leading axes and the batch on the last: on a CPU that layout, not the arithmetic, decides the speed. The two forms have
equal results and are chosen where the program is compiled: loops over the atoms, which keep a CPU's cache and vector units busy, and whole-array
operations, which are few launches on a GPU.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

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
    """`losses.quantile_huber`, whose gradient with respect to the quantiles is computed in the same pass."""
    return _quantile_huber_and_gradient(quantiles, targets)[0]


def _quantile_huber_forward(quantiles: Array, targets: Array) -> tuple[Array, tuple[Array, Array]]:
    loss, gradient = _quantile_huber_and_gradient(quantiles, targets)
    return loss, (gradient, targets)


def _quantile_huber_backward(residuals: tuple[Array, Array], cotangent: Array) -> tuple[Array, Array]:
    gradient, targets = residuals
    return gradient * cotangent[..., None, :], jnp.zeros_like(targets)


quantile_huber.defvjp(_quantile_huber_forward, _quantile_huber_backward)


_BLOCK_BYTES = 2**19


def num_blocks(batch_size: int, width: int) -> int:
    """Into how many equal blocks a batch is cut on a CPU, so that the activations (width, B) of one layer stay in a core's cache; elsewhere 1.

    Also 1 for a batch size that has no divisor near the number needed.
    """
    if jax.default_backend() != "cpu":
        return 1
    needed = -(-4 * width * batch_size // _BLOCK_BYTES)
    return next((blocks for blocks in range(needed, 2 * needed) if batch_size % blocks == 0), 1)


def mean_over_blocks(function: Callable[[Any], Any], columns: Any, num_blocks: int) -> Any:
    """The mean of function(block) over equal blocks of a tree with leaves (..., B); for means over columns, that is function(columns) itself."""
    if num_blocks == 1:
        return function(columns)

    def cut(array: Array) -> Array:  # (..., B) -> (blocks, ..., B / blocks)
        return jnp.moveaxis(array.reshape((*array.shape[:-1], num_blocks, -1)), -2, 0)

    return jax.tree.map(lambda value: jnp.mean(value, axis=0), jax.lax.map(function, jax.tree.map(cut, columns)))
