"""The agent: truncated quantile critics, a tanh-Gaussian actor with a behaviour cloning loss, an automatic entropy coefficient.

One `update` serves TQCfD, HinDRL and Smooth HinDRL, which differ only in the batch they are given; `update_bc` is the BC baseline, on the
same actor. Differences from the TQC paper (Kuznetsov et al., 2020): the loss is averaged, not summed, over quantiles (as in sb3-contrib,
which the thesis used), and the discount comes with each transition, so that n-step returns and termination need no special case. By default
also: inputs encoded at two scales, a target entropy that falls along the run, and a running average of the actor for evaluation.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct

from hindrl_jax.config import AgentConfig
from hindrl_jax.losses import behaviour_cloning, entropy_coefficient, quantile_huber, target_atoms
from hindrl_jax.networks import Params, apply_actor, apply_critics, init_actor, init_critics, mean_return
from hindrl_jax.types import Array, Transition

Metrics = dict[str, Array]


@struct.dataclass(kw_only=True)
class AgentState:
    """Everything the agent learns."""

    actor: Params
    average_actor: Params  # running average of the actor, which acts more steadily
    critics: Params  # leaves (N, ...)
    target_critics: Params  # leaves (N, ...)
    log_alpha: Array  # ()
    actor_optimiser: optax.OptState
    critic_optimiser: optax.OptState
    alpha_optimiser: optax.OptState


_ADAM = optax.scale_by_adam()  # the step size is applied apart, since it may change along a run


_LEAST_EXTENT = 1e-6


@struct.dataclass(kw_only=True)
class InputScale:
    """Where each input dimension lies in the demonstrations and how large it is; the encodings other than raw see (x - centre) / scale."""

    observation: Array  # (D,) scale, > 0
    goal: Array  # (G,)
    observation_centre: Array  # (D,)
    goal_centre: Array  # (G,)


def input_scale(observations: Array, achieved_goals: Array, is_visited: Array, config: AgentConfig) -> InputScale:
    """The scale of each dimension over demonstration states.

    Standardised inputs have their mean as centre and their standard deviation as scale; others have centre 0 and the root mean square. A dimension
    without extent has scale 1.

    Args:
      observations, achieved_goals: (..., D) and (..., G).
      is_visited: (...) bool, false for padding.
      config: its `input_encoding` decides.
    """

    def moments(values: Array) -> tuple[Array, Array]:
        axes, visited = tuple(range(values.ndim - 1)), is_visited[..., None]
        count = jnp.sum(is_visited)
        centre = jnp.zeros(values.shape[-1])
        if config.input_encoding == "standardised":
            centre = jnp.sum(jnp.where(visited, values, 0.0), axis=axes) / count
        offset = values - centre.reshape((1,) * len(axes) + centre.shape)
        mean_square = jnp.sum(jnp.where(visited, jnp.square(offset), 0.0), axis=axes) / count
        return centre, jnp.where(mean_square > _LEAST_EXTENT**2, jnp.sqrt(mean_square), 1.0)

    observation_centre, observation = moments(observations)
    goal_centre, goal = moments(achieved_goals)
    return InputScale(observation=observation, goal=goal, observation_centre=observation_centre, goal_centre=goal_centre)


def _encode(values: Array, centre: Array, scale: Array, config: AgentConfig) -> Array:
    if config.input_encoding == "raw":
        return values
    leading = (1,) * (values.ndim - 1)
    scaled = (values - centre.reshape(leading + centre.shape)) / scale.reshape(leading + scale.shape)
    return jnp.concatenate([scaled, jnp.tanh(4.0 * scaled)], axis=-1) if config.input_encoding == "multiscale" else scaled


def network_inputs(observation: Array, achieved_goal: Array, desired_goal: Array, scale: InputScale, config: AgentConfig) -> Array:
    """Joins what the networks see, along the last axis: (..., D), (..., G), (..., G) -> (..., input_dim).

    The multiscale encoding gives each dimension twice: once linear, for distances, once saturating, so that "exactly there" and "one
    step off" are far apart. With inputs as they are, small networks blur the two.
    """
    observation, achieved_goal, desired_goal = (
        _encode(observation, scale.observation_centre, scale.observation, config),
        _encode(achieved_goal, scale.goal_centre, scale.goal, config),
        _encode(desired_goal, scale.goal_centre, scale.goal, config),
    )
    if config.policy_input == "observation_goal":
        return jnp.concatenate([observation, desired_goal], axis=-1)
    return jnp.concatenate([achieved_goal, desired_goal, observation], axis=-1)


def init(key: Array, config: AgentConfig, *, observation_dim: int, goal_dim: int, action_dim: int) -> AgentState:
    """A fresh agent; the target critics start as a copy of the critics."""
    key_actor, key_critics = jax.random.split(key)
    observation, goal = jnp.ones(observation_dim), jnp.ones(goal_dim)
    unit = InputScale(observation=observation, goal=goal, observation_centre=observation, goal_centre=goal)
    input_dim = network_inputs(unit.observation, unit.goal, unit.goal, unit, config).shape[-1]
    actor = init_actor(key_actor, config, input_dim=input_dim, action_dim=action_dim)
    critics = init_critics(key_critics, config, input_dim=input_dim, action_dim=action_dim)
    log_alpha = jnp.log(jnp.asarray(config.initial_alpha, jnp.float32))
    return AgentState(
        actor=actor,
        average_actor=jax.tree.map(jnp.copy, actor),
        critics=critics,
        target_critics=jax.tree.map(jnp.copy, critics),
        log_alpha=log_alpha,
        actor_optimiser=_ADAM.init(actor),
        critic_optimiser=_ADAM.init(critics),
        alpha_optimiser=_ADAM.init(log_alpha),
    )


def select_action(key: Array, actor: Params, inputs: Array, config: AgentConfig, *, action_dim: int, stochastic: bool) -> Array:
    """Actions (B, A) in [-1, 1] at inputs (B, input_dim), see `network_inputs`: sampled from the policy, or its mode."""
    distribution = apply_actor(actor, inputs.T, config, action_dim=action_dim)
    return (distribution.sample(key)[0] if stochastic else distribution.mode).T


@struct.dataclass(kw_only=True)
class Schedule:
    """What changes along a run."""

    learning_rate: Array | float  # () step size of Adam
    target_entropy: Array | float  # () in nats
    actor_average_rate: Array | float  # () share of the actor that moves into its running average


def schedule(progress: Array | float, updates: Array | int, config: AgentConfig, *, action_dim: int) -> Schedule:
    """What holds at one moment of a run.

    Learning rate and target entropy move linearly. With a span s, the rate of the actor's average falls like 1 / (1 + s updates), the
    polynomial-decay averaging of Shamir and Zhang (stochastic gradient descent for non-smooth optimization, 2013).

    Args:
      progress: share of the run that is over, in [0, 1].
      updates: gradient steps so far.
      config, action_dim: of the agent.
    """

    def between(start: float, end: float | None) -> Array | float:
        return start if end is None else start + (end - start) * progress

    entropy = -float(action_dim) if config.target_entropy is None else config.target_entropy
    return Schedule(
        learning_rate=between(config.learning_rate, config.final_learning_rate),
        target_entropy=between(entropy, config.final_target_entropy),
        actor_average_rate=jnp.minimum(config.actor_average_rate, 1.0 / (1.0 + config.actor_average_span * updates)),
    )


def _descend(gradient: Any, optimiser_state: optax.OptState, params: Any, learning_rate: Array | float) -> tuple[Any, optax.OptState]:
    updates, optimiser_state = _ADAM.update(gradient, optimiser_state, params)
    return jax.tree.map(lambda param, update: param - learning_rate * update, params, updates), optimiser_state


@struct.dataclass(kw_only=True)
class _Columns:
    """A batch as networks and losses take it: one column per transition."""

    inputs: Array  # (input_dim, B)
    next_inputs: Array  # (input_dim, B)
    action: Array  # (A, B)
    reward: Array  # (B,)
    discount: Array  # (B,)
    is_demonstration: Array  # (B,) bool
    obtained_return: Array | None  # (B,)
    noise: Array  # (A, B) standard normal, for the sampled action
    next_noise: Array  # (A, B) the same for the next action


_BLOCK_BYTES = 2**19


def _num_blocks(batch_size: int, config: AgentConfig) -> int:
    """Into how many equal blocks a batch is cut on a CPU, so that the activations of one layer stay in a core's cache; elsewhere 1.

    Also 1 for a batch size that has no divisor near the number needed.
    """
    if jax.default_backend() != "cpu":
        return 1
    needed = -(-4 * max(config.net_arch) * batch_size // _BLOCK_BYTES)
    return next((blocks for blocks in range(needed, 2 * needed) if batch_size % blocks == 0), 1)


def _mean_over_blocks(function: Callable[[_Columns], Any], columns: _Columns, num_blocks: int) -> Any:
    """The mean of function(block) over equal blocks of columns; for means over columns, that is function(columns) itself."""
    if num_blocks == 1:
        return function(columns)

    def cut(array: Array) -> Array:  # (..., B) -> (blocks, ..., B / blocks)
        return jnp.moveaxis(array.reshape((*array.shape[:-1], num_blocks, -1)), -2, 0)

    return jax.tree.map(lambda value: jnp.mean(value, axis=0), jax.lax.map(function, jax.tree.map(cut, columns)))


def update(
    key: Array, state: AgentState, batch: Transition, *, inputs: Array, next_inputs: Array, schedule: Schedule, config: AgentConfig
) -> tuple[AgentState, Metrics]:
    """One gradient step of critics, actor and entropy coefficient, then one move of the target critics and of the averaged actor.

    Critic: quantile Huber loss towards the truncated atoms of r + discount (Z' - alpha log pi(a' | s')).
    Actor: mean(alpha log pi - mean over critics and quantiles of Z(s, a_pi)) + bc_weight * behaviour cloning loss.

    Args:
      key: random key.
      state: the agent.
      batch: B transitions.
      inputs, next_inputs: (B, input_dim) network inputs at the two ends of the transitions, see `network_inputs`.
      schedule: see `schedule`.
      config: static.

    Returns:
      The new agent and scalar metrics.
    """
    key_actor, key_next = jax.random.split(key)
    action_dim = batch.action.shape[-1]
    num_blocks = _num_blocks(batch.action.shape[0], config)
    alpha = jnp.exp(state.log_alpha)
    # The barrier makes the transposition one copy, not a strided read in every product.
    inputs, next_inputs, action = jax.lax.optimization_barrier((inputs.T, next_inputs.T, batch.action.T))
    columns = _Columns(
        inputs=inputs,
        next_inputs=next_inputs,
        action=action,
        reward=batch.reward,
        discount=batch.discount,
        is_demonstration=batch.is_demonstration,
        obtained_return=batch.obtained_return,
        noise=jax.random.normal(key_actor, action.shape),
        next_noise=jax.random.normal(key_next, action.shape),
    )

    def critic_gradient(block: _Columns) -> tuple[Params, Metrics]:
        next_action, next_log_prob = apply_actor(state.actor, block.next_inputs, config, action_dim=action_dim).at(block.next_noise)
        next_atoms = apply_critics(state.target_critics, block.next_inputs, next_action, config)
        targets = target_atoms(
            next_atoms.reshape(-1, next_atoms.shape[-1]),
            reward=block.reward,
            discount=block.discount,
            entropy_bonus=-alpha * next_log_prob,
            num_dropped=config.num_critics * config.top_quantiles_to_drop_per_net,
        )
        if config.clip_targets:
            targets = jnp.clip(targets, 0.0, 1.0)
        if block.obtained_return is not None:
            targets = jnp.maximum(targets, block.obtained_return[None])

        def loss(critics: Params) -> tuple[Array, Metrics]:
            quantiles = apply_critics(critics, block.inputs, block.action, config)
            value = jnp.mean(quantile_huber(quantiles, targets))
            return value, {"critic/loss": value, "critic/value": jnp.mean(quantiles), "critic/target": jnp.mean(targets)}

        return jax.grad(loss, has_aux=True)(state.critics)

    gradient, critic_metrics = _mean_over_blocks(critic_gradient, columns, num_blocks)
    critics, critic_optimiser = _descend(gradient, state.critic_optimiser, state.critics, schedule.learning_rate)

    def actor_gradient(block: _Columns) -> tuple[Params, Metrics]:
        def loss(actor: Params) -> tuple[Array, Metrics]:
            distribution = apply_actor(actor, block.inputs, config, action_dim=action_dim)
            action, log_prob = distribution.at(block.noise)
            value = jnp.mean(mean_return(critics, block.inputs, action, config))
            cloned = distribution.mode if config.bc_action == "mean" else action
            bc = behaviour_cloning(cloned, block.action, block.is_demonstration, form=config.bc_loss)
            entropy = -jnp.mean(log_prob)
            total = -alpha * entropy - value + config.bc_weight * bc
            return total, {"actor/loss": total, "actor/bc_loss": bc, "actor/value": value, "actor/entropy": entropy}

        return jax.grad(loss, has_aux=True)(state.actor)

    gradient, actor_metrics = _mean_over_blocks(actor_gradient, columns, num_blocks)
    actor, actor_optimiser = _descend(gradient, state.actor_optimiser, state.actor, schedule.learning_rate)

    loss_alpha, gradient = jax.value_and_grad(entropy_coefficient)(
        state.log_alpha, -actor_metrics["actor/entropy"], target_entropy=schedule.target_entropy
    )
    log_alpha, alpha_optimiser = _descend(gradient, state.alpha_optimiser, state.log_alpha, schedule.learning_rate)

    new_state = AgentState(
        actor=actor,
        average_actor=optax.incremental_update(actor, state.average_actor, schedule.actor_average_rate),
        critics=critics,
        target_critics=optax.incremental_update(critics, state.target_critics, config.target_update_rate),
        log_alpha=log_alpha,
        actor_optimiser=actor_optimiser,
        critic_optimiser=critic_optimiser,
        alpha_optimiser=alpha_optimiser,
    )
    metrics = {
        **critic_metrics,
        **actor_metrics,
        "alpha/loss": loss_alpha,
        "alpha/value": alpha,
        "batch/reward": jnp.sum(batch.reward),
    }
    return new_state, metrics


def update_bc(state: AgentState, batch: Transition, *, inputs: Array, schedule: Schedule, config: AgentConfig) -> tuple[AgentState, Metrics]:
    """One gradient step of behaviour cloning alone: mean squared error of tanh(mean) to the demonstrated action (thesis eq. 4.1).

    Args:
      state: the agent; only the actor and its optimiser change.
      batch: B demonstration transitions.
      inputs: (B, input_dim) network inputs.
      schedule: its learning rate and averaging rate are used.
      config: static.

    Returns:
      The new agent and scalar metrics.
    """

    def loss(actor: Params) -> Array:
        action = apply_actor(actor, inputs.T, config, action_dim=batch.action.shape[-1]).mode
        return jnp.mean(jnp.square(action.T - batch.action))

    value, gradient = jax.value_and_grad(loss)(state.actor)
    actor, actor_optimiser = _descend(gradient, state.actor_optimiser, state.actor, schedule.learning_rate)
    average_actor = optax.incremental_update(actor, state.average_actor, schedule.actor_average_rate)
    return state.replace(actor=actor, average_actor=average_actor, actor_optimiser=actor_optimiser), {"actor/bc_loss": value}
