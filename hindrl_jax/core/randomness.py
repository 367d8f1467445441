"""Random indices, cheaply: a batch needs several draws, and each `jax.random.randint` costs three passes of the generator."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from hindrl_jax.base.types import Array


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


def uniform_in_groups(key: Array, num_samples: int, sizes: Array) -> tuple[Array, Array]:
    """Draws uniformly, with replacement, from the members of K groups taken together.

    Args:
      key: random key.
      num_samples: how many to draw.
      sizes: (K,) int32, numbers of members, one of which at least is positive; else the result means nothing.

    Returns:
      (num_samples,) int32 group, and (num_samples,) int32 member, counted from the group's end: 1 .. its size.
    """
    cumulative = jnp.cumsum(sizes)
    drawn = uniform_index(key, (num_samples,), jnp.maximum(cumulative[-1], 1))
    group = jnp.searchsorted(cumulative, drawn, side="right", method="compare_all")
    return group, cumulative[group] - drawn
