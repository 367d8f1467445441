"""Data that every part of the project shares: time steps, episodes and batches.

Shape letters, project-wide: B batch, T time (the horizon), C critics, Q quantiles, M atoms or goals of a table, G goal, D observation, A action,
E environments, N episodes, U gradient steps of an iteration, S seeds.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

Array = jax.Array


class TimeStep(struct.PyTreeNode, kw_only=True):
    """What one environment step returns.

    `observation` is always the true next observation, also when the episode has just ended: resetting is the caller's business.
    """

    observation: Array  # (D,) float32
    reward: Array  # () float32, 1 where the task is solved by this step, else 0
    terminated: Array  # () bool, the task is over (solved); there is no future value
    truncated: Array  # () bool, the horizon, or the training, cut the episode; the future value still exists


class Episodes(struct.PyTreeNode, kw_only=True):
    """A table of episodes, padded to the horizon. Used for demonstrations and, through `replay`, for rollouts.

    Row t of an episode is the transition (observations[t], actions[t], rewards[t], observations[t + 1]) for 0 <= t < length. Entries past the
    length are padding and are never read. Leading axes other than the first (episode) axis are named where the table is made.
    """

    observations: Array  # (N, T + 1, D) float32
    actions: Array  # (N, T, A) float32, in the policy's range [-1, 1]
    rewards: Array  # (N, T) float32
    lengths: Array  # (N,) int32, number of transitions, 1 <= length <= T
    terminated: Array  # (N,) bool, whether the last transition ended the task (rather than the horizon)
    desired_goals: Array  # (N, G) float32, the goal that the episode was acted under
    states: Array | None = None  # (N, T + 1, S) environment states as vectors; None where they are not kept


class Transition(struct.PyTreeNode, kw_only=True):
    """A batch of (n-step) transitions, ready for the losses."""

    observation: Array  # (B, D)
    achieved_goal: Array  # (B, G), where the observation is
    action: Array  # (B, A), in [-1, 1]
    reward: Array  # (B,), sum of the discounted rewards of the n steps
    discount: Array  # (B,), factor of the bootstrapped value: gamma**steps, or 0 where the return has ended
    next_observation: Array  # (B, D)
    next_achieved_goal: Array  # (B, G)
    desired_goal: Array  # (B, G)
    is_demonstration: Array  # (B,) bool
    is_relabelled: Array  # (B,) bool, whether the goal, or the observations, are those of hindsight


def tree_where(condition: Array, if_true: Any, if_false: Any) -> Any:
    """`jnp.where` over two pytrees of equal structure, random keys included; `condition` (B,) selects along the leading axis."""

    def select(a: Array, b: Array) -> Array:
        if jnp.issubdtype(a.dtype, jax.dtypes.prng_key):
            return jax.random.wrap_key_data(select(jax.random.key_data(a), jax.random.key_data(b)), impl=jax.random.key_impl(a))
        return jnp.where(condition.reshape(condition.shape + (1,) * (a.ndim - condition.ndim)), a, b)

    return jax.tree.map(select, if_true, if_false)
