"""Products and inverses of small matrices, and lengths, written so that thousands of them side by side are fast on a CPU. Matrices are unbatched."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np

from hindrl_jax.base.types import Array


def product(a: Array, b: Array | np.ndarray) -> Array:
    """a b of small matrices (m, k) and (k, n): a sum of outer products, because a batch of tiny `dot`s is slow on a CPU."""
    return functools.reduce(jnp.add, [a[:, i, None] * b[None, i, :] for i in range(a.shape[1])])


def times(a: Array, x: Array) -> Array:
    """a x of a small matrix (m, k) and a vector (k,)."""
    return functools.reduce(jnp.add, [a[:, i] * x[i] for i in range(a.shape[1])])


def length(vectors: Array) -> Array:
    """(...) of vectors (..., n), never quite 0, so that one can divide by it."""
    return jnp.sqrt(jnp.sum(jnp.square(vectors), axis=-1) + 1e-20)


def inverse(matrix: Array) -> Array:
    """Inverse of a symmetric positive definite matrix (n, n), by Gauss-Jordan elimination without pivots.

    `jnp.linalg.inv` would call LAPACK once per environment on a CPU.
    """
    size = matrix.shape[0]

    def eliminate(k: Array, a: Array) -> Array:
        here = jnp.arange(size) == k
        row, column, pivot = a[k], a[:, k], a[k, k]
        row = jnp.where(here, 1.0, row) / pivot
        rest = jnp.where(here[None, :], 0.0, a) - column[:, None] * row[None, :]
        return jnp.where(here[:, None], row[None, :], rest)

    return jax.lax.fori_loop(0, size, eliminate, matrix)
