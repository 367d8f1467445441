"""Where in a demonstration training episodes begin: near its end at first, and further back where they succeed.

The reverse curriculum of RFCL (Tao et al., reverse forward curriculum learning, 2024), one for each demonstration, with the numbers of its code. Its
differences from here: all of its episodes begin in demonstrated states, until they succeed from the first of them, and then a forward curriculum over
the environment's own starts follows; its episodes are also cut off sooner, the nearer to the end they begin.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from hindrl_jax.base.types import Array

STEPS_BACK = 4
"""By how many steps (decisions) a beginning moves; RFCL's code: "values from 4 to 8 work fine"."""
SUCCESSES_IN_A_ROW = 3
"""Episodes from there that have to succeed, one after the other, before it does."""
_OFFSETS = (0.5, 0.25, 0.125, 0.0625, 0.0625)
"""With which probability an episode begins so many steps after that: 0, 1, 2, 3 or 4."""


class Curriculum(struct.PyTreeNode, kw_only=True):
    """How far N demonstrations have been worked backwards."""

    first_step: Array  # (N,) int32, the earliest step at which episodes begin
    successes: Array  # (N,) int32, of the latest episodes from that very step, up to the last one that failed


class Origin(struct.PyTreeNode, kw_only=True):
    """Where E episodes began."""

    demo: Array  # (E,) int32, -1 for the environment's own starts
    step: Array  # (E,) int32


def init(lengths: Array) -> Curriculum:
    """Before the last step of each demonstration of lengths (N,)."""
    return Curriculum(first_step=lengths - 1, successes=jnp.zeros_like(lengths))


def sample(key: Array, curriculum: Curriculum, lengths: Array, num_episodes: int) -> Origin:
    """Draws where episodes begin: demonstrations in proportion to the share of them that is still ahead of the curriculum, if any is.

    Args:
      key: random key.
      curriculum: of N demonstrations.
      lengths: (N,) of them.
      num_episodes: how many to draw.
    """
    key_demo, key_offset = jax.random.split(key)
    ahead = curriculum.first_step / lengths + 1e-6
    demo = jax.random.categorical(key_demo, jnp.log(ahead), shape=(num_episodes,))
    offset = jax.random.categorical(key_offset, jnp.log(jnp.array(_OFFSETS)), shape=(num_episodes,))
    return Origin(demo=demo, step=jnp.minimum(curriculum.first_step[demo] + offset, lengths[demo] - 1))


def record(curriculum: Curriculum, origin: Origin, ended: Array, success: Array) -> Curriculum:
    """Counts episodes that have ended, and moves back where enough of them succeeded in a row; those that began elsewhere do not count.

    Args:
      curriculum: of N demonstrations.
      origin: where E episodes began.
      ended: (E,) bool, which of them are over now; in order, should several be.
      success: (E,) bool, which of these succeeded.
    """
    demos = jnp.arange(curriculum.first_step.shape[0])[:, None]
    counted = ended[None] & (origin.demo[None] == demos) & (origin.step[None] == curriculum.first_step[:, None])  # (N, E)
    failed = counted & ~success[None]
    failures_from_here = jnp.cumsum(failed[:, ::-1], axis=1)[:, ::-1]
    latest = jnp.sum(counted & (failures_from_here == 0), axis=1)
    successes = jnp.where(jnp.any(failed, axis=1), 0, curriculum.successes) + latest
    moves = successes >= SUCCESSES_IN_A_ROW
    return Curriculum(
        first_step=jnp.where(moves, jnp.maximum(curriculum.first_step - STEPS_BACK, 0), curriculum.first_step),
        successes=jnp.where(moves, 0, successes),
    )
