"""The network passes of a TQC gradient step and nothing else: the floor beneath which no gradient step with these networks can come.

Actor and target critics forward at the next states; critics forward and backward; actor forward and backward through the updated critics; one
move of the target critics. In place of losses, optimisers, sampling and random numbers there is a squared error and a trivial step.

The same passes in two forms: `plain`, the way one writes a network in JAX (a batch is (B, features), x @ kernel + bias, the two critics by vmap),
and `own`, by the project's networks (a batch is (features, B), cut into blocks on a CPU, the critics one after the other).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct

from benchmarks import timing
from hindrl_jax.base.types import Array
from hindrl_jax.config import AgentConfig
from hindrl_jax.core import kernels, networks
from hindrl_jax.core.networks import Params

_STEP_SIZE = 1e-9  # so small that the parameters stay what they are however long the benchmark runs


@struct.dataclass(kw_only=True)
class Batch:
    """Random numbers, in the layout of the form; here that of `own`."""

    inputs: Array  # (input_dim, B)
    next_inputs: Array  # (input_dim, B)
    action: Array  # (A, B)


@dataclasses.dataclass(frozen=True)
class Form:
    """How the networks are computed."""

    action: Callable[[Params, Array], Array]
    """(actor, inputs) -> mean actions."""
    quantiles: Callable[[Params, Array, Array], Array]
    """(critics, inputs, action) -> quantiles of all critics."""
    value: Callable[[Params, Array, Array], Array]
    """(critics, inputs, action) -> something whose mean is the mean of the quantiles."""
    mean_gradient: Callable[[Callable[[Batch], Params], Batch], Params]
    """Applies a gradient of a mean over the batch."""
    transposed: bool
    """Whether batches are (features, B)."""


def plain(action_dim: int) -> Form:
    """Networks as one usually writes them; the parameters are those of hindrl_jax."""

    def mlp(params: Params, features: Array) -> Array:
        *hidden, last = [params["params"][f"Dense_{index}"] for index in range(len(params["params"]))]
        for layer in hidden:
            features = jax.nn.relu(features @ layer["kernel"] + layer["bias"])
        return features @ last["kernel"] + last["bias"]

    def action(actor: Params, inputs: Array) -> Array:
        return jnp.tanh(mlp(actor, inputs)[:, :action_dim])

    def quantiles(critics: Params, inputs: Array, action: Array) -> Array:
        return jax.vmap(mlp, (0, None))(critics, jnp.concatenate([inputs, action], axis=-1))

    return Form(action=action, quantiles=quantiles, value=quantiles, mean_gradient=lambda gradient, batch: gradient(batch), transposed=False)


def own(config: AgentConfig, action_dim: int, batch_size: int) -> Form:
    """The networks of hindrl_jax, over the blocks that `agent.update` cuts."""
    num_blocks = kernels.num_blocks(batch_size, config.widest_layer)

    def mean_gradient(gradient: Callable[[Batch], Params], batch: Batch) -> Params:
        return kernels.mean_over_blocks(gradient, batch, num_blocks)

    return Form(
        action=lambda actor, inputs: networks.apply_actor(actor, inputs, config, action_dim=action_dim).mode,
        quantiles=lambda critics, inputs, action: networks.apply_critics(critics, inputs, action, config),
        value=lambda critics, inputs, action: networks.mean_return(critics, inputs, action, config),
        mean_gradient=mean_gradient,
        transposed=True,
    )


@struct.dataclass(kw_only=True)
class State:
    """The parameters that a step changes."""

    actor: Params
    critics: Params
    target_critics: Params


def step(form: Form, state: State, batch: Batch) -> State:
    """All network passes of one gradient step."""

    def critic_gradient(block: Batch) -> Params:
        next_action = form.action(state.actor, block.next_inputs)
        target = form.quantiles(state.target_critics, block.next_inputs, next_action)
        return jax.grad(lambda critics: jnp.mean(jnp.square(form.quantiles(critics, block.inputs, block.action) - target)))(state.critics)

    critics = _descend(state.critics, form.mean_gradient(critic_gradient, batch))

    def actor_gradient(block: Batch) -> Params:
        return jax.grad(lambda actor: -jnp.mean(form.value(critics, block.inputs, form.action(actor, block.inputs))))(state.actor)

    actor = _descend(state.actor, form.mean_gradient(actor_gradient, batch))
    target_critics = jax.tree.map(lambda target, online: target + 0.005 * (online - target), state.target_critics, critics)
    return State(actor=actor, critics=critics, target_critics=target_critics)


def _descend(params: Params, gradient: Params) -> Params:
    return jax.tree.map(lambda param, slope: param - _STEP_SIZE * slope, params, gradient)


def stepper(form: Form, config: AgentConfig, *, input_dim: int, action_dim: int, batch_size: int, num_steps: int) -> Callable[[], None]:
    """Compiles `num_steps` steps on one random batch; each call of the result goes on from the last."""
    key_actor, key_critics, key_inputs, key_next, key_action = jax.random.split(jax.random.key(0), 5)
    dims = dict(input_dim=input_dim, action_dim=action_dim)
    critics = networks.init_critics(key_critics, config, **dims)
    state = State(actor=networks.init_actor(key_actor, config, **dims), critics=critics, target_critics=jax.tree.map(jnp.copy, critics))
    batch = Batch(
        inputs=jax.random.normal(key_inputs, (batch_size, input_dim)),
        next_inputs=jax.random.normal(key_next, (batch_size, input_dim)),
        action=jax.random.uniform(key_action, (batch_size, action_dim), minval=-1.0, maxval=1.0),
    )
    if form.transposed:
        batch = jax.tree.map(jnp.transpose, batch)

    def steps(state: State, batch: Batch) -> State:
        return jax.lax.scan(lambda state, _: (step(form, state, batch), None), state, length=num_steps)[0]

    return timing.advancing(jax.jit(steps, donate_argnums=0).lower(state, batch).compile(), state, batch)
