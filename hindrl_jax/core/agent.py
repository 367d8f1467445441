"""The agent: truncated quantile critics (or those of SAC, TD3 or DDPG), an actor with a behaviour cloning loss, an automatic entropy coefficient.

One `update` serves TQCfD, HinDRL and Smooth HinDRL, which differ only in the batch they are given; `update_bc` is the BC baseline, on the
same actor. Differences from the TQC paper (Kuznetsov et al., 2020): the loss is averaged, not summed, over quantiles (as in sb3-contrib,
which the thesis used), and the discount comes with each transition, so that n-step returns and termination need no special case. By default
also: inputs encoded at two scales, a target entropy that falls along the run, and a running average of the actor for evaluation. With td3, the
target critics move at every gradient step, also where the actor is delayed (in the paper both wait); a delayed actor saves no time, since its
gradient is computed at every step.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct

from hindrl_jax.base.types import Array, Transition, tree_where
from hindrl_jax.config import AgentConfig, linear_schedule
from hindrl_jax.core.losses import behaviour_cloning, entropy_coefficient, quantile_huber, squared_error, target_atoms, target_value
from hindrl_jax.core.networks import Params, apply_actor, apply_critics, init_actor, init_critics, mean_return

Metrics = dict[str, Array]


class AgentState(struct.PyTreeNode, kw_only=True):
    """Everything the agent learns."""

    actor: Params
    average_actor: Params  # running average of the actor, which acts more steadily
    target_actor: Params | None  # follows the actor as the target critics follow the critics; None for algorithms without one
    critics: Params  # leaves (N, ...)
    target_critics: Params  # leaves (N, ...)
    log_alpha: Array  # ()
    actor_optimiser: optax.OptState
    critic_optimiser: optax.OptState
    alpha_optimiser: optax.OptState


_ADAM = optax.scale_by_adam()  # the step size is applied apart, since it may change along a run


_LEAST_EXTENT = 1e-6
_LEAST_VALUE = 0.01  # below it, a value is mostly the critics' error


class InputScale(struct.PyTreeNode, kw_only=True):
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
        target_actor=None if config.has_entropy else jax.tree.map(jnp.copy, actor),
        critics=critics,
        target_critics=jax.tree.map(jnp.copy, critics),
        log_alpha=log_alpha,
        actor_optimiser=_ADAM.init(actor),
        critic_optimiser=_ADAM.init(critics),
        alpha_optimiser=_ADAM.init(log_alpha),
    )


def select_action(key: Array, actor: Params, inputs: Array, config: AgentConfig, *, action_dim: int, stochastic: bool) -> Array:
    """Actions (B, A) in [-1, 1] at inputs (B, input_dim), see `network_inputs`: sampled from the policy, or its mode.

    The samples of a deterministic policy (td3, ddpg) are its mode with noise.
    """
    distribution = apply_actor(actor, inputs.T, config, action_dim=action_dim)
    if not stochastic:
        return distribution.mode.T
    if config.has_entropy:
        return distribution.sample(key)[0].T
    return jnp.clip(distribution.mode.T + config.exploration_noise * jax.random.normal(key, (inputs.shape[0], action_dim)), -1.0, 1.0)


class Schedule(struct.PyTreeNode, kw_only=True):
    """What changes along a run."""

    learning_rate: Array | float  # () step size of Adam
    target_entropy: Array | float  # () in nats
    actor_average_rate: Array | float  # () share of the actor that moves into its running average
    bc_weight: Array | float  # () weight of the behaviour cloning loss


def schedule(progress: Array | float, updates: Array | int, config: AgentConfig, *, action_dim: int) -> Schedule:
    """What holds at one moment of a run.

    Learning rate, target entropy and the weight of cloning move linearly. With a span s, the rate of the actor's average falls like
    1 / (1 + s updates), the polynomial-decay averaging of Shamir and Zhang (stochastic gradient descent for non-smooth optimization, 2013).

    Args:
      progress: share of the run that is over, in [0, 1].
      updates: gradient steps so far.
      config, action_dim: of the agent.
    """
    entropy = -float(action_dim) if config.target_entropy is None else config.target_entropy
    return Schedule(
        learning_rate=linear_schedule(config.learning_rate, config.final_learning_rate, progress),
        target_entropy=linear_schedule(entropy, config.final_target_entropy, progress),
        actor_average_rate=jnp.minimum(config.actor_average_rate, 1.0 / (1.0 + config.actor_average_span * updates)),
        bc_weight=linear_schedule(config.bc_weight, config.final_bc_weight, progress),
    )


def _descend(
    gradient: Any, optimiser_state: optax.OptState, params: Any, learning_rate: Array | float, *, max_norm: float | None = None
) -> tuple[Any, optax.OptState]:
    if max_norm is not None:
        gradient, _ = optax.clip_by_global_norm(max_norm).update(gradient, optax.EmptyState())
    updates, optimiser_state = _ADAM.update(gradient, optimiser_state, params)
    return jax.tree.map(lambda param, update: param - learning_rate * update, params, updates), optimiser_state


class _Columns(struct.PyTreeNode, kw_only=True):
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
    weight: Array | None = None  # (B,)


_BLOCK_BYTES = 2**19


def _num_blocks(batch_size: int, config: AgentConfig) -> int:
    """Into how many equal blocks a batch is cut on a CPU, so that the activations of one layer stay in a core's cache; elsewhere 1.

    Also 1 for a batch size that has no divisor near the number needed.
    """
    if jax.default_backend() != "cpu" or config.normalise_value:  # which takes the mean size of the value over the whole batch
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
    """One gradient step of critics, actor and entropy coefficient, then one move of the target networks and of the averaged actor.

    Critic: quantile Huber loss towards the truncated atoms of r + discount (Z' - alpha log pi(a' | s')); for algorithms without quantiles the
      squared error to r + discount (min Q' - alpha log pi(a' | s')).
    Actor: mean(alpha log pi - value(s, a_pi)) + bc_weight * behaviour cloning loss + preactivation_weight * squared length of the mode before
      tanh; the value is the mean over critics and quantiles (tqc), the least critic's (sac; with REDQ's subsets the mean over critics) or the
      first one's (td3, ddpg). With `normalise_value` or `relative_value` it is divided by its size, and there is no alpha in the critics'
      targets, whose units are others.

    Args:
      key: random key.
      state: the agent.
      batch: B transitions; their weights, if they have any, are those of the critics' losses.
      inputs, next_inputs: (B, input_dim) network inputs at the two ends of the transitions, see `network_inputs`.
      schedule: see `schedule`.
      config: static.

    Returns:
      The new agent and scalar metrics.
    """
    num_blocks = _num_blocks(batch.action.shape[0], config)
    columns, target_critics = _prepare(key, state, batch, inputs, next_inputs, config)
    gradient, critic_metrics = _mean_over_blocks(functools.partial(_critic_gradient, state, target_critics, config), columns, num_blocks)
    critics, critic_optimiser = _descend(gradient, state.critic_optimiser, state.critics, schedule.learning_rate, max_norm=config.max_gradient_norm)
    state = state.replace(
        critics=critics,
        critic_optimiser=critic_optimiser,
        target_critics=optax.incremental_update(critics, state.target_critics, config.target_update_rate),
    )

    gradient, actor_metrics = _mean_over_blocks(functools.partial(_actor_gradient, state, schedule, config), columns, num_blocks)
    moved, alpha_metrics = _move_actor(state, gradient, actor_metrics["actor/entropy"], schedule, config)
    if config.actor_delay > 1:
        moved = tree_where(critic_optimiser.count % config.actor_delay == 0, moved, state)
    return moved, {**critic_metrics, **actor_metrics, **alpha_metrics, "batch/reward": jnp.sum(batch.reward)}


def td_error(key: Array, state: AgentState, batch: Transition, *, inputs: Array, next_inputs: Array, config: AgentConfig) -> Array:
    """How far the critics are from their targets: |mean of all critics' atoms - mean of the targets|, for each row of a batch.

    Args: as for `update`.

    Returns:
      (B,), not weighted.
    """
    columns, target_critics = _prepare(key, state, batch, inputs, next_inputs, config)
    values = mean_return(state.critics, columns.inputs, columns.action, config)
    return jnp.abs(values - jnp.mean(_targets(state, target_critics, config, columns), axis=0))


def _prepare(key: Array, state: AgentState, batch: Transition, inputs: Array, next_inputs: Array, config: AgentConfig) -> tuple[_Columns, Params]:
    """The batch in columns, with the noise of its actions, and the target critics that are asked."""
    key_actor, key_next, key_critics = jax.random.split(key, 3)
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
        weight=batch.weight,
    )
    target_critics = state.target_critics
    if config.num_target_critics is not None:
        chosen = jax.random.permutation(key_critics, config.num_critics)[: config.num_target_critics]
        target_critics = jax.tree.map(lambda leaf: leaf[chosen], target_critics)
    return columns, target_critics


def _targets(state: AgentState, target_critics: Params, config: AgentConfig, block: _Columns) -> Array:
    """What the critics of each column are moved towards: (M, B) target atoms, or (1, B) without quantiles."""
    next_action, entropy_bonus = _next_action(state, config, block)
    next_atoms = apply_critics(target_critics, block.next_inputs, next_action, config)  # (N, Q, B)
    bellman = dict(reward=block.reward, discount=block.discount, entropy_bonus=entropy_bonus)
    if config.base == "tqc":
        num_dropped = next_atoms.shape[0] * config.top_quantiles_to_drop_per_net
        targets = target_atoms(next_atoms.reshape(-1, next_atoms.shape[-1]), **bellman, num_dropped=num_dropped)
    else:
        targets = target_value(next_atoms[:, 0], **bellman)
    if config.clip_targets:
        targets = jnp.clip(targets, 0.0, 1.0)
    if block.obtained_return is not None:
        targets = jnp.maximum(targets, block.obtained_return[None])
    return targets


def _critic_gradient(state: AgentState, target_critics: Params, config: AgentConfig, block: _Columns) -> tuple[Params, Metrics]:
    """The gradient of the critics' loss over a block, and metrics."""
    targets = _targets(state, target_critics, config, block)

    def loss(critics: Params) -> tuple[Array, Metrics]:
        quantiles = apply_critics(critics, block.inputs, block.action, config)
        errors = quantile_huber(quantiles, targets) if config.base == "tqc" else squared_error(quantiles[:, 0], targets[0])
        value = jnp.mean(errors if block.weight is None else errors * block.weight[None])
        return value, {"critic/loss": value, "critic/value": jnp.mean(quantiles), "critic/target": jnp.mean(targets)}

    return jax.grad(loss, has_aux=True)(state.critics)


def _next_action(state: AgentState, config: AgentConfig, block: _Columns) -> tuple[Array, Array]:
    """The actions (A, B) that the targets assume at the ends of the transitions, and the bonus (B,) for their entropy."""
    action_dim = block.action.shape[0]
    if config.has_entropy:
        action, log_prob = apply_actor(state.actor, block.next_inputs, config, action_dim=action_dim).at(block.next_noise)
        weight = 0.0 if config.divides_value else jnp.exp(state.log_alpha)
        return action, -weight * log_prob
    action = apply_actor(state.target_actor, block.next_inputs, config, action_dim=action_dim).mode
    if config.base == "td3":
        noise = jnp.clip(config.target_noise * block.next_noise, -config.target_noise_clip, config.target_noise_clip)
        action = jnp.clip(action + noise, -1.0, 1.0)
    return action, jnp.zeros(action.shape[1])


def _value(critics: Params, inputs: Array, action: Array, config: AgentConfig) -> Array:
    """What the actor climbs: (B,)."""
    if config.base == "tqc":
        return mean_return(critics, inputs, action, config)
    if config.base == "sac":
        values = apply_critics(critics, inputs, action, config)[:, 0]
        return jnp.min(values, axis=0) if config.num_target_critics is None else jnp.mean(values, axis=0)
    return apply_critics(jax.tree.map(lambda leaf: leaf[:1], critics), inputs, action, config)[0, 0]


def _actor_gradient(state: AgentState, schedule: Schedule, config: AgentConfig, block: _Columns) -> tuple[Params, Metrics]:
    """The gradient of the actor's loss over a block, and metrics."""

    def loss(actor: Params) -> tuple[Array, Metrics]:
        distribution = apply_actor(actor, block.inputs, config, action_dim=block.action.shape[0])
        action, log_prob = distribution.at(block.noise)
        if not config.has_entropy:
            action, log_prob = distribution.mode, jnp.zeros(block.reward.shape)
        values = _value(state.critics, block.inputs, action, config)
        value, entropy = jnp.mean(values), -jnp.mean(log_prob)
        cloned = distribution.mode if config.bc_action == "mean" else action
        clonable = block.is_demonstration
        if config.q_filter:
            own = _value(state.critics, block.inputs, jax.lax.stop_gradient(distribution.mode), config)
            clonable &= _value(state.critics, block.inputs, block.action, config) > own
        bc = behaviour_cloning(cloned, block.action, clonable, form=config.bc_loss)
        total = -jnp.exp(state.log_alpha) * entropy - _climbed(values, config) + schedule.bc_weight * bc
        if config.preactivation_weight > 0.0:
            total += config.preactivation_weight * jnp.mean(jnp.sum(jnp.square(distribution.mean), axis=0))
        return total, {"actor/loss": total, "actor/bc_loss": bc, "actor/value": value, "actor/entropy": entropy}

    return jax.grad(loss, has_aux=True)(state.actor)


def _climbed(values: Array, config: AgentConfig) -> Array:
    """() what the actor climbs, of the values (B,) of its actions."""
    size: Array | float = 1.0
    if config.normalise_value:
        size = jnp.maximum(jnp.mean(jnp.abs(values)), _LEAST_EXTENT)
    if config.relative_value:
        size = jnp.maximum(values, _LEAST_VALUE)
    return jnp.mean(values / jax.lax.stop_gradient(size))


def _move_actor(state: AgentState, gradient: Params, entropy: Array, schedule: Schedule, config: AgentConfig) -> tuple[AgentState, Metrics]:
    """The actor's step, and that of what depends on it: what follows it, and the entropy coefficient."""
    state = _step_actor(state, gradient, schedule, config)
    if not config.has_entropy:
        return state, {}
    loss, gradient = jax.value_and_grad(entropy_coefficient)(state.log_alpha, -entropy, target_entropy=schedule.target_entropy)
    log_alpha, alpha_optimiser = _descend(gradient, state.alpha_optimiser, state.log_alpha, schedule.learning_rate)
    metrics = {"alpha/loss": loss, "alpha/value": jnp.exp(state.log_alpha)}
    return state.replace(log_alpha=log_alpha, alpha_optimiser=alpha_optimiser), metrics


def _step_actor(state: AgentState, gradient: Params, schedule: Schedule, config: AgentConfig) -> AgentState:
    """The actor's step, and one move of what follows it: its average and, where there is one, its target."""
    actor, actor_optimiser = _descend(gradient, state.actor_optimiser, state.actor, schedule.learning_rate, max_norm=config.max_gradient_norm)
    target_actor = state.target_actor
    if target_actor is not None:
        target_actor = optax.incremental_update(actor, target_actor, config.target_update_rate)
    return state.replace(
        actor=actor,
        actor_optimiser=actor_optimiser,
        average_actor=optax.incremental_update(actor, state.average_actor, schedule.actor_average_rate),
        target_actor=target_actor,
    )


def update_bc(state: AgentState, batch: Transition, *, inputs: Array, schedule: Schedule, config: AgentConfig) -> tuple[AgentState, Metrics]:
    """One gradient step of behaviour cloning alone: mean squared error of tanh(mean) to the demonstrated action (thesis eq. 4.1).

    Args:
      state: the agent; only the actor, what follows it, and its optimiser change.
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
    return _step_actor(state, gradient, schedule, config), {"actor/bc_loss": value}
