"""Cells of a grid: moves, comparisons, and drawing a free one at random. A cell is (2,) int32 (x, y); its rank is its number, counted row by row."""

from __future__ import annotations

import jax.numpy as jnp

from hindrl_jax.base.types import Array
from hindrl_jax.envs.grid.types import Box


def direction(scores: Array) -> Array:
    """(2,) int32 unit step for movement scores (4,): 0 is +x, 1 is +y, 2 is -x, 3 is -y; the first of equal scores wins."""
    move = jnp.argmax(scores)
    return jnp.stack([move == 0, move == 1]).astype(jnp.int32) - jnp.stack([move == 2, move == 3]).astype(jnp.int32)


def same_cell(a: Array, b: Array) -> Array:
    """Whether cells (..., 2) are equal -> (...) bool."""
    return (a[..., 0] == b[..., 0]) & (a[..., 1] == b[..., 1])


def rank_to_cell(rank: Array, width: int) -> Array:
    """(2,) int32 cell number `rank` of a block `width` cells wide, counted row by row."""
    return jnp.stack([rank % width, rank // width])


def free_rank(bits: Array, occupied: list[Array], num_ranks: int) -> Array:
    """Draws uniformly from the ranks 0 .. num_ranks - 1 that are not occupied, without rejection or sorting.

    Draws r0 among the free ranks, counted without the occupied ones, and then shifts it past those: the answer is the least r with
    r = r0 + (number of distinct occupied ranks <= r). Iterating that equation from r0 climbs to it in at most len(occupied) rounds,
    because every round but the last passes at least one more occupied rank.

    Args:
      bits: () uint32 random bits.
      occupied: () int32 ranks; duplicates count once and entries >= num_ranks are ignored.
      num_ranks: how many ranks there are; at least one must be free.

    Returns:
      () int32 rank. Uniform up to the 2**-32 granularity of `bits`.
    """
    # A repeated rank is moved out of range, so that it is ignored from here on.
    distinct: list[Array] = []
    for rank in occupied:
        repeated = jnp.zeros((), bool)
        for earlier in distinct:
            repeated = repeated | (rank == earlier)
        distinct.append(jnp.where(repeated, num_ranks, rank))
    num_free = num_ranks - sum(((rank < num_ranks).astype(jnp.int32) for rank in distinct), jnp.zeros((), jnp.int32))
    start = (bits % num_free.astype(jnp.uint32)).astype(jnp.int32)
    rank = start
    for _ in distinct:
        rank = start + sum((other <= rank).astype(jnp.int32) for other in distinct)
    return rank


def overlap(a: Box, b: Box) -> bool:
    """Whether two boxes share a cell."""
    (a_low, a_high), (b_low, b_high) = a, b
    return all(a_low[i] <= b_high[i] and b_low[i] <= a_high[i] for i in range(2))
