"""Actor and critic networks. The one module that knows flax.linen; everybody else sees parameters and functions of arrays."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn
from flax import struct

from hindrl_jax.config import AgentConfig
from hindrl_jax.types import Array

LOG_STD_MIN, LOG_STD_MAX = -20.0, 2.0
_KERNEL_INIT = nn.initializers.variance_scaling(1.0 / 3.0, "fan_in", "uniform")  # U(-b, b), b = 1 / sqrt(fan_in), as in the thesis's framework

Params = Any


class MLP(nn.Module):
    """Fully connected ReLU network: (..., in) -> (..., out_dim)."""

    net_arch: tuple[int, ...]
    out_dim: int
    layer_norm: bool = False

    @nn.compact
    def __call__(self, inputs: Array) -> Array:
        hidden = inputs
        for width in self.net_arch:
            hidden = nn.Dense(width, kernel_init=_KERNEL_INIT)(hidden)
            if self.layer_norm:
                hidden = nn.LayerNorm()(hidden)
            hidden = nn.relu(hidden)
        return nn.Dense(self.out_dim, kernel_init=_KERNEL_INIT)(hidden)


@struct.dataclass(kw_only=True)
class ActionDistribution:
    """A Gaussian squashed by tanh, one per batch row."""

    mean: Array  # (B, A), before tanh
    log_std: Array  # (B, A)

    @property
    def mode(self) -> Array:
        """The deterministic action tanh(mean): (B, A)."""
        return jnp.tanh(self.mean)

    def sample(self, key: Array) -> tuple[Array, Array]:
        """A reparameterised action (B, A) in (-1, 1) and its log-probability (B,)."""
        noise = jax.random.normal(key, self.mean.shape)
        pre_tanh = self.mean + jnp.exp(self.log_std) * noise
        log_prob = -0.5 * jnp.square(noise) - self.log_std - 0.5 * jnp.log(2.0 * jnp.pi)
        # log(1 - tanh(x)^2), in the form that does not cancel for large |x|
        log_slope = 2.0 * (jnp.log(2.0) - pre_tanh - jax.nn.softplus(-2.0 * pre_tanh))
        return jnp.tanh(pre_tanh), jnp.sum(log_prob - log_slope, axis=-1)


def _actor(config: AgentConfig, action_dim: int) -> MLP:
    return MLP(net_arch=config.net_arch, out_dim=2 * action_dim)


def _critic(config: AgentConfig) -> MLP:
    return MLP(net_arch=config.net_arch, out_dim=config.num_quantiles, layer_norm=config.layer_norm)


def init_actor(key: Array, config: AgentConfig, *, input_dim: int, action_dim: int) -> Params:
    """Parameters of the actor for inputs (B, input_dim)."""
    return _actor(config, action_dim).init(key, jnp.zeros((1, input_dim)))


def init_critics(key: Array, config: AgentConfig, *, input_dim: int, action_dim: int) -> Params:
    """Parameters of the N critics, stacked along the leading axis of every leaf."""
    keys = jax.random.split(key, config.num_critics)
    return jax.vmap(lambda key: _critic(config).init(key, jnp.zeros((1, input_dim + action_dim))))(keys)


def apply_actor(params: Params, inputs: Array, config: AgentConfig, *, action_dim: int) -> ActionDistribution:
    """The policy at inputs (B, input_dim); the logarithm of the deviation is clamped to [-20, 2]."""
    mean, log_std = jnp.split(_actor(config, action_dim).apply(params, inputs), 2, axis=-1)
    return ActionDistribution(mean=mean, log_std=jnp.clip(log_std, LOG_STD_MIN, LOG_STD_MAX))


def apply_critics(params: Params, inputs: Array, action: Array, config: AgentConfig) -> Array:
    """Quantiles of the return at inputs (B, input_dim) and actions (B, A): (N, Q, B)."""
    joint = jnp.concatenate([inputs, action], axis=-1)
    quantiles = jax.vmap(_critic(config).apply, in_axes=(0, None))(params, joint)  # (N, B, Q)
    return jnp.swapaxes(quantiles, 1, 2)
