"""Losses of TQC (Kuznetsov et al., 2020), of SAC, and of learning from demonstrations, as functions of arrays.

Atoms (quantiles) lie on the leading axes and the batch on the last. How truncation and the quantile loss are computed fast is in `kernels`.

`actor_loss` and `critic_loss` are where the losses are put together. One of your own, `actor_loss` or `critic_loss` of the config, is a function of
the same terms and takes its place:

    def calm(terms, config):
        return losses.actor_loss(terms, config) + 0.1 * jnp.mean(jnp.square(terms.mode))

    agent = dataclasses.replace(config.agent, actor_loss=calm)

On a CPU, batches with wide layers are cut into blocks, whose losses are averaged: let yours be a mean over rows.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import jax
import jax.numpy as jnp
from flax import struct

from hindrl_jax.base.types import Array
from hindrl_jax.config import AgentConfig
from hindrl_jax.core import kernels

_LEAST_SQUARED_LENGTH = 1e-3  # of actions; demonstrations that hardly do anything are not blown up
_LEAST_WEIGHT = 1e-6  # of a batch, whose weights may all be 0
_LEAST_VALUE = 0.01  # values below it count as this much where the actor climbs them relative to their size


class ActorTerms(struct.PyTreeNode, kw_only=True):
    """What a loss of the actor may be made of. Gradients flow through what the actor does: `value`, `action`, `log_prob`, `mode`, `cloning`."""

    value: Array  # (B,) of the sampled action, by the critics
    action: Array  # (A, B) sampled, in (-1, 1)
    log_prob: Array  # (B,) of the sampled action
    mode: Array  # (A, B) the mean action, tanh(mean)
    alpha: Array  # () entropy coefficient
    cloning: Array  # () behaviour cloning loss, see `behaviour_cloning`
    taken_action: Array  # (A, B) of the batch: what was done
    is_demonstration: Array  # (B,) bool
    critics: Callable[[Array], Array] = struct.field(pytree_node=False)  # actions (A, B) -> quantiles (C, Q, B); Q is 1 where there are none


class CriticTerms(struct.PyTreeNode, kw_only=True):
    """What a loss of the critics may be made of. Gradients flow through `quantiles` and `critics`."""

    quantiles: Array  # (C, Q, B) of the actions that were taken; Q is 1 where there are no quantiles
    targets: Array  # (M, B) atoms of the Bellman target, no gradient
    taken_action: Array  # (A, B) of the batch
    is_demonstration: Array  # (B,) bool
    critics: Callable[[Array], Array] = struct.field(pytree_node=False)  # other actions (A, B) -> (C, Q, B), for penalties on them


def actor_loss(terms: ActorTerms, config: AgentConfig) -> Array:
    """mean(alpha log pi - value) + bc_weight * cloning: ().

    With `relative_value` each row's value is divided by max(itself, 0.01), through which no gradient flows.
    """
    entropy = -jnp.mean(terms.log_prob)
    climbed = terms.value / jax.lax.stop_gradient(jnp.maximum(terms.value, _LEAST_VALUE)) if config.relative_value else terms.value
    return -terms.alpha * entropy - jnp.mean(climbed) + config.bc_weight * terms.cloning


def critic_loss(terms: CriticTerms, config: AgentConfig) -> Array:
    """The mean quantile Huber loss, or the mean squared error where there are no quantiles: ()."""
    if config.base == "tqc":
        return jnp.mean(quantile_huber(terms.quantiles, terms.targets))
    return jnp.mean(squared_error(terms.quantiles[:, 0], terms.targets[0]))


def quantile_huber(quantiles: Array, targets: Array) -> Array:
    """Quantile Huber loss with kappa = 1, averaged over quantiles and target atoms (Dabney et al., 2018, eq. 10).

    With u = target - quantile and midpoint tau: |tau - 1{u < 0}| * (u^2 / 2 if |u| <= 1 else |u| - 1/2). The targets are constants and get no
    gradient.

    Args:
      quantiles: (..., Q, B) predicted quantiles in ascending order of their midpoints.
      targets: (M, B) target atoms, in any order, the same for all leading axes.

    Returns:
      (..., B) loss per leading index and batch row.

    Example:
      >>> quantile_huber(jnp.zeros((25, 1)), jnp.ones((46, 1))).tolist()
      [0.25]
    """
    return kernels.quantile_huber(quantiles, targets)


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
    kept = kernels.drop_largest(next_atoms, num_dropped)
    return jax.lax.stop_gradient(reward[None] + discount[None] * (kept + entropy_bonus[None]))


def target_value(next_values: Array, *, reward: Array, discount: Array, entropy_bonus: Array | float) -> Array:
    """The target of algorithms without quantiles: r + discount * (min over critics of the next value + bonus).

    Clipped double Q-learning (Fujimoto et al., TD3, 2018, eq. 10), with the bonus of SAC.

    Args:
      next_values: (C, B) values of the target critics at the next state and action.
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


def behaviour_cloning(policy_action: Array, demonstrated_action: Array, weight: Array, *, form: Literal["relative", "squared", "norm"]) -> Array:
    """Behaviour cloning loss: masked by "is a demonstration row", divided by the whole batch (thesis eq. 2.32).

    Args:
      policy_action, demonstrated_action: (A, B) in [-1, 1].
      weight: (B,) in [0, 1], how much of each row is cloned: the mask delta^e; with a Q-filter, those that pass it, or as far as they do.
      form: "squared" for the squared distance (thesis text), "norm" for the distance itself (original code), "relative" for the squared distance
        over the mean squared length of the demonstrated actions, weighted alike: 1 for a policy that does nothing.

    Returns:
      () loss.
    """
    squared = jnp.sum(jnp.square(policy_action - demonstrated_action), axis=0)
    weight = weight.astype(squared.dtype)
    loss = jnp.mean(weight * (jnp.sqrt(squared + 1e-12) if form == "norm" else squared))
    if form != "relative":
        return loss
    length = jnp.sum(weight * jnp.sum(jnp.square(demonstrated_action), axis=0)) / jnp.maximum(jnp.sum(weight), _LEAST_WEIGHT)
    return loss / jnp.maximum(length, _LEAST_SQUARED_LENGTH)


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
