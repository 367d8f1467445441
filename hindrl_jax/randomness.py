"""Random indices, cheaply: a batch needs several draws, and each `jax.random.randint` costs three passes of the generator."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from hindrl_jax.types import Array


def uniform_index(key: Array, shape: tuple[int, ...], bound: Array | int) -> Array:
    """Uniform integers 0 <= i < bound.

    The remainder of 32 random bits: small values are favoured by at most bound / 2**32, which no sample of this project can show.

    Args:
      key: random key.
      shape: shape of the result.
      bound: positive, broadcast against `shape`.

    Returns:
      int32 array.
    """
    return (jax.random.bits(key, shape, jnp.uint32) % jnp.asarray(bound, jnp.uint32)).astype(jnp.int32)
