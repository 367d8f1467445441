"""Actor and critic networks. The one module that knows flax.linen; everybody else sees parameters and functions of arrays.

Features lie on the leading axis and the batch on the last, here as in `losses`: kernels are small, batches long, and on a CPU the products and
the gradients of kernels and biases are fastest along contiguous batches.

A network of your own, `actor_network` or `critic_network` of the config, is an ordinary flax module with the batch first. It is called with the
number of its outputs, and made in one place, `_network`:

    class Tanh(nn.Module):
        out_dim: int

        @nn.compact
        def __call__(self, features):  # (B, inputs) -> (B, out_dim)
            return nn.Dense(self.out_dim)(nn.tanh(nn.Dense(64)(features)))

    agent = dataclasses.replace(config.agent, actor_network=Tanh)

Its parameters are dictionaries of arrays, and it keeps no other variables: no batch normalisation, no dropout.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn
from flax import struct

from hindrl_jax.base.errors import UserError
from hindrl_jax.base.types import Array
from hindrl_jax.config import RESIDUAL_EXPANSION, AgentConfig

LOG_STD_MIN, LOG_STD_MAX = -20.0, 2.0
_KERNEL_INIT = nn.initializers.variance_scaling(1.0 / 3.0, "fan_in", "uniform")  # U(-b, b), b = 1 / sqrt(fan_in), as in the thesis's framework

Params = Any


class Dense(nn.Module):
    """Affine layer along the leading axis: (in, B) -> (width, B)."""

    width: int

    @nn.compact
    def __call__(self, features: Array) -> Array:
        kernel = self.param("kernel", _KERNEL_INIT, (features.shape[0], self.width))
        bias = self.param("bias", nn.initializers.zeros, (self.width,))
        return kernel.T @ features + bias[:, None]


class MLP(nn.Module):
    """Fully connected ReLU network: (in, B) -> (out_dim, B)."""

    net_arch: tuple[int, ...]
    out_dim: int
    layer_norm: bool = False

    @nn.compact
    def __call__(self, features: Array) -> Array:
        for width in self.net_arch:
            features = Dense(width)(features)
            if self.layer_norm:
                features = _layer_norm()(features)
            features = nn.relu(features)
        return Dense(self.out_dim)(features)


class ResidualMLP(nn.Module):
    """Residual network of SimBa (Lee et al., 2024): (in, B) -> (out_dim, B).

    An embedding, then a block x + W2 relu(W1 LN(x)) for each entry of `net_arch`, four times as wide inside, then layer normalisation. Difference
    from the paper: inputs are scaled by the demonstrations (`inputs`), not by running statistics.
    """

    net_arch: tuple[int, ...]
    out_dim: int

    @nn.compact
    def __call__(self, features: Array) -> Array:
        features = Dense(self.net_arch[0])(features)
        for width in self.net_arch:
            inner = nn.relu(Dense(RESIDUAL_EXPANSION * width)(_layer_norm()(features)))
            features = features + Dense(width)(inner)
        return Dense(self.out_dim)(_layer_norm()(features))


def _layer_norm() -> nn.LayerNorm:
    return nn.LayerNorm(reduction_axes=0, feature_axes=0)


class ActionDistribution(struct.PyTreeNode, kw_only=True):
    """A Gaussian squashed by tanh, one per batch column."""

    mean: Array  # (A, B), before tanh
    log_std: Array  # (A, B)

    @property
    def mode(self) -> Array:
        """The deterministic action tanh(mean): (A, B)."""
        return jnp.tanh(self.mean)

    def sample(self, key: Array) -> tuple[Array, Array]:
        """A reparameterised action (A, B) in (-1, 1) and its log-probability (B,)."""
        return self.at(jax.random.normal(key, self.mean.shape))

    def at(self, noise: Array) -> tuple[Array, Array]:
        """The action (A, B) that standard normal noise (A, B) leads to, and its log-probability (B,)."""
        pre_tanh = self.mean + jnp.exp(self.log_std) * noise
        log_prob = -0.5 * jnp.square(noise) - self.log_std - 0.5 * jnp.log(2.0 * jnp.pi)
        # log(1 - tanh(x)^2), in the form that does not cancel for large |x|
        log_slope = 2.0 * (jnp.log(2.0) - pre_tanh - jax.nn.softplus(-2.0 * pre_tanh))
        return jnp.tanh(pre_tanh), jnp.sum(log_prob - log_slope, axis=0)


class _BatchFirst:
    """A module (B, in) -> (B, out) as one (in, B) -> (out, B)."""

    def __init__(self, module: Any, out_dim: int):
        self._module, self._out_dim = module, out_dim

    def init(self, key: Array, features: Array) -> Params:
        return self._module.init(key, features.T)

    def apply(self, params: Params, features: Array) -> Array:
        output = self._module.apply(params, features.T)
        wanted = (features.shape[1], self._out_dim)
        if jnp.shape(output) != wanted:
            name = type(self._module).__name__
            raise UserError(f"{name} gives {jnp.shape(output)} for inputs of shape {features.T.shape}: let it give (B, out_dim) = {wanted}")
        return output.T


def _actor(config: AgentConfig, action_dim: int) -> Any:
    return _network(config, config.actor_network, 2 * action_dim, layer_norm=False)


def _critic(config: AgentConfig, out_dim: int) -> Any:
    return _network(config, config.critic_network, out_dim, layer_norm=config.layer_norm)


def _network(config: AgentConfig, own: Callable[[int], Any] | None, out_dim: int, *, layer_norm: bool) -> Any:
    """The one place in which networks are made: what has `init` and `apply`, with features first."""
    if own is not None:
        return _BatchFirst(own(out_dim), out_dim)
    if config.residual:
        return ResidualMLP(net_arch=config.net_arch, out_dim=out_dim)
    return MLP(net_arch=config.net_arch, out_dim=out_dim, layer_norm=layer_norm)


def init_actor(key: Array, config: AgentConfig, *, input_dim: int, action_dim: int) -> Params:
    """Parameters of the actor for inputs (input_dim, B)."""
    return _actor(config, action_dim).init(key, jnp.zeros((input_dim, 1)))


def init_critics(key: Array, config: AgentConfig, *, input_dim: int, action_dim: int) -> Params:
    """Parameters of the C critics, stacked along the leading axis of every leaf."""
    keys = jax.random.split(key, config.num_critics)
    return jax.vmap(lambda key: _critic(config, config.critic_outputs).init(key, jnp.zeros((input_dim + action_dim, 1))))(keys)


def apply_actor(params: Params, inputs: Array, config: AgentConfig, *, action_dim: int) -> ActionDistribution:
    """The policy at inputs (input_dim, B); the logarithm of the deviation is clamped to [-20, 2]."""
    output = _actor(config, action_dim).apply(params, inputs)
    mean, log_std = jnp.split(output, 2, axis=0)
    return ActionDistribution(mean=mean, log_std=jnp.clip(log_std, LOG_STD_MIN, LOG_STD_MAX))


def _apply_each(params: Params, inputs: Array, action: Array, config: AgentConfig, out_dim: int) -> Array:
    # One critic after the other: as one batched product they are slower on a CPU.
    joint = jnp.concatenate([inputs, action], axis=0)
    critic = _critic(config, out_dim)
    num_critics = jax.tree.leaves(params)[0].shape[0]
    members = [jax.tree.map(lambda leaf, n=n: leaf[n], params) for n in range(num_critics)]
    return jnp.stack([critic.apply(member, joint) for member in members])


def apply_critics(params: Params, inputs: Array, action: Array, config: AgentConfig) -> Array:
    """Quantiles of the return at inputs (input_dim, B) and actions (A, B): (C, Q, B); for algorithms without quantiles Q is 1.

    C is that of the parameters, which may be a subset of the critics.
    """
    return _apply_each(params, inputs, action, config, config.critic_outputs)


def mean_return(params: Params, inputs: Array, action: Array, config: AgentConfig) -> Array:
    """Mean over critics and quantiles of `apply_critics`: (B,)."""
    return jnp.mean(mean_returns(params, inputs, action, config), axis=0)


def mean_returns(params: Params, inputs: Array, action: Array, config: AgentConfig) -> Array:
    """Mean over the quantiles of `apply_critics`, (C, B), in less work: the last layer is linear, so its kernel is averaged instead."""
    if config.critic_network is not None:  # whose last layer nobody knows
        return jnp.mean(apply_critics(params, inputs, action, config), axis=1)
    num_hidden = 2 * len(config.net_arch) + 1 if config.residual else len(config.net_arch)
    last = f"Dense_{num_hidden}"
    output = jax.tree.map(lambda leaf: jnp.mean(leaf, axis=-1, keepdims=True), params["params"][last])
    averaged = {"params": {**params["params"], last: output}}
    return _apply_each(averaged, inputs, action, config, 1)[:, 0]
