"""The agent: truncated quantile critics (or those of SAC), an actor with a behaviour cloning loss, an automatic entropy coefficient.

One `update` serves TQCfD, HinDRL and Smooth HinDRL, which differ only in the batch they are given; `update_bc` is the BC baseline, on the
same actor. Differences from the TQC paper (Kuznetsov et al., 2020): the loss is averaged, not summed, over quantiles (as in sb3-contrib,
which the thesis used), and the discount comes with each transition, so that n-step returns and termination need no special case. By default
also: inputs encoded at two scales, targets clipped to what returns can be, an actor that climbs the value relative to its size, and a running
average of the actor for evaluation.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct

from hindrl_jax.base.errors import UserError
from hindrl_jax.base.types import Array, Transition
from hindrl_jax.config import TrainConfig
from hindrl_jax.core.comparison import better, probability_of_being_better
from hindrl_jax.core.inputs import InputScale, network_inputs
from hindrl_jax.core.kernels import mean_over_blocks, num_blocks
from hindrl_jax.core.losses import (
    ActorTerms,
    CriticTerms,
    actor_loss,
    behaviour_cloning,
    critic_loss,
    entropy_coefficient,
    target_atoms,
    target_value,
)
from hindrl_jax.core.networks import Params, apply_actor, apply_critics, init_actor, init_critics, mean_return, mean_returns
from hindrl_jax.core.schedules import Schedule

Metrics = dict[str, Array]

_ADAM = optax.scale_by_adam()  # the step size is applied apart, since it may be an array, in sweeps


class AgentState(struct.PyTreeNode, kw_only=True):
    """Everything the agent learns, and the scale of its inputs. C critics."""

    actor: Params
    average_actor: Params  # running average of the actor, which acts more steadily
    critics: Params  # leaves (C, ...)
    target_critics: Params  # leaves (C, ...)
    imitation: Params | None  # of a policy cloned at the start, then frozen, see `TrainConfig.imitation_steps`; None where there is none
    log_alpha: Array  # ()
    actor_optimiser: optax.OptState
    critic_optimiser: optax.OptState
    alpha_optimiser: optax.OptState
    scale: InputScale  # of the networks' inputs, constant


class Policy(struct.PyTreeNode, kw_only=True):
    """What acting needs."""

    actor: Params  # with `imitation_steps` what `policy` makes of two networks
    scale: InputScale
    noise: Array  # () of its actions, before tanh, over the standard deviation that the actor gives them: 0 for the mean action, 1 for sampled ones


def init(key: Array, scale: InputScale, config: TrainConfig, *, action_dim: int) -> AgentState:
    """A fresh agent; the target critics start as a copy of the critics."""
    key_actor, key_critics = jax.random.split(key)
    input_dim = network_inputs(scale.observation, scale.goal, scale.goal, scale, config).shape[-1]
    actor = init_actor(key_actor, config.agent, input_dim=input_dim, action_dim=action_dim)
    critics = init_critics(key_critics, config.agent, input_dim=input_dim, action_dim=action_dim)
    imitation = None
    if config.imitation_steps > 0:
        imitation = init_actor(jax.random.fold_in(key, 2), config.agent.for_imitation, input_dim=input_dim, action_dim=action_dim)
    log_alpha = jnp.log(jnp.asarray(config.agent.initial_alpha, jnp.float32))
    return AgentState(
        actor=actor,
        average_actor=jax.tree.map(jnp.copy, actor),
        critics=critics,
        target_critics=jax.tree.map(jnp.copy, critics),
        imitation=imitation,
        log_alpha=log_alpha,
        actor_optimiser=_ADAM.init(actor),
        critic_optimiser=_ADAM.init(critics),
        alpha_optimiser=_ADAM.init(log_alpha),
        scale=scale,
    )


def policy(state: AgentState, config: TrainConfig, *, average: bool, imitates: bool = False) -> Policy:
    """The policy that explores, or with `average` the mean actions of the steadier one that is evaluated and saved. Leaves (..., ) as the state's.

    With `imitation_steps` the latter is a dict of the actor, the imitation, and whether it is the imitation that acts, as it does with `imitates`;
    so these policies have equal structures, and are kept, chosen from and saved alike. With `imitation_proposal` both are, and the dict has the
    critics, too, which choose between the two.
    """
    actor = state.average_actor if average else state.actor
    noise = jnp.zeros_like(state.log_alpha) if average else jnp.ones_like(state.log_alpha)
    if state.imitation is not None and (average or config.imitation_proposal):
        actor = {"actor": actor, "imitation": state.imitation, "imitates": jnp.full_like(noise, imitates, jnp.int32)}
        if config.imitation_proposal:
            actor["critics"] = state.target_critics
    return Policy(actor=actor, scale=state.scale, noise=noise)


def select_action(key: Array, policy: Policy, inputs: Array, config: TrainConfig, *, action_dim: int) -> Array:
    """Actions (B, A) in [-1, 1] at inputs (B, input_dim), see `inputs.network_inputs`, with the policy's noise; an imitation's are mean actions."""
    imitation = policy.actor.get("imitation")
    distribution = apply_actor(policy.actor if imitation is None else policy.actor["actor"], inputs.T, config.agent, action_dim=action_dim)
    action, _ = distribution.at(policy.noise * jax.random.normal(key, distribution.mean.shape))
    if imitation is not None:
        imitated = apply_actor(imitation, inputs.T, config.agent.for_imitation, action_dim=action_dim).mode
        if config.imitation_proposal:
            action, _ = _better((action, imitated), policy.actor["critics"], inputs.T, config)
        action = jnp.where(policy.actor["imitates"], imitated, action)
    return action.T


class _Columns(struct.PyTreeNode, kw_only=True):
    """A batch as networks and losses take it: one column per transition."""

    inputs: Array  # (input_dim, B)
    next_inputs: Array  # (input_dim, B)
    action: Array  # (A, B)
    reward: Array  # (B,)
    discount: Array  # (B,)
    is_demonstration: Array  # (B,) bool
    noise: Array  # (A, B) standard normal, for the sampled action
    next_noise: Array  # (A, B) the same for the next action


def update(key: Array, state: AgentState, batch: Transition, schedule: Schedule, config: TrainConfig) -> tuple[AgentState, Metrics]:
    """One gradient step of critics, actor and entropy coefficient, then one move of the target networks and of the averaged actor.

    Critic (`losses.critic_loss`): quantile Huber loss towards the truncated atoms of r + discount (Z' - alpha log pi(a' | s')); for algorithms
      without quantiles the squared error to r + discount (min Q' - alpha log pi(a' | s')). With `relative_value` targets have no entropy term.
    Actor (`losses.actor_loss`): mean(alpha log pi - value(s, a_pi)) + bc_weight * behaviour cloning loss; the value is the mean over critics and
      quantiles (tqc), or the least critic's (sac; with REDQ's subsets the mean over critics). With `relative_value` each row's is
      divided by max(itself, 0.01), through which no gradient flows: its share of the metric `actor/loss` is then 1, so read `actor/value`.

    Args:
      key: random key.
      state: the agent.
      batch: B transitions.
      schedule: see `schedules.schedule`.
      config: static.

    Returns:
      The new agent and scalar metrics.
    """
    blocks = num_blocks(batch.action.shape[0], config.agent.widest_layer)
    columns, target_critics = _prepare(key, state, batch, config)
    gradient, critic_metrics = mean_over_blocks(functools.partial(_critic_gradient, state, target_critics, config), columns, blocks)
    critics, critic_optimiser = _descend(gradient, state.critic_optimiser, state.critics, config.agent.learning_rate)
    state = state.replace(
        critics=critics,
        critic_optimiser=critic_optimiser,
        target_critics=optax.incremental_update(critics, state.target_critics, config.agent.target_update_rate),
    )

    gradient, actor_metrics = mean_over_blocks(functools.partial(_actor_gradient, state, schedule, config), columns, blocks)
    state, alpha_metrics = _move_actor(state, gradient, actor_metrics["actor/entropy"], schedule, config)
    return state, {**critic_metrics, **actor_metrics, **alpha_metrics, "batch/reward": jnp.sum(batch.reward)}


def _prepare(key: Array, state: AgentState, batch: Transition, config: TrainConfig) -> tuple[_Columns, Params]:
    """The batch in columns, with the noise of its actions, and the target critics that are asked."""
    key_actor, key_next, key_critics = jax.random.split(key, 3)
    inputs = network_inputs(batch.observation, batch.achieved_goal, batch.desired_goal, state.scale, config)
    next_inputs = network_inputs(batch.next_observation, batch.next_achieved_goal, batch.desired_goal, state.scale, config)
    # The barrier makes the transposition one copy, not a strided read in every product.
    inputs, next_inputs, action = jax.lax.optimization_barrier((inputs.T, next_inputs.T, batch.action.T))
    columns = _Columns(
        inputs=inputs,
        next_inputs=next_inputs,
        action=action,
        reward=batch.reward,
        discount=batch.discount,
        is_demonstration=batch.is_demonstration,
        noise=jax.random.normal(key_actor, action.shape),
        next_noise=jax.random.normal(key_next, action.shape),
    )
    target_critics = state.target_critics
    if config.agent.num_target_critics is not None:
        chosen = jax.random.permutation(key_critics, config.agent.num_critics)[: config.agent.num_target_critics]
        target_critics = jax.tree.map(lambda leaf: leaf[chosen], target_critics)
    return columns, target_critics


def _targets(state: AgentState, target_critics: Params, config: TrainConfig, block: _Columns) -> Array:
    """What the critics of each column are moved towards: (M, B) target atoms, or (1, B) without quantiles."""
    next_action, log_prob = apply_actor(state.actor, block.next_inputs, config.agent, action_dim=block.action.shape[0]).at(block.next_noise)
    entropy_bonus = jnp.zeros_like(log_prob) if config.agent.relative_value else -jnp.exp(state.log_alpha) * log_prob
    if config.imitation_proposal:
        imitated = apply_actor(state.imitation, block.next_inputs, config.agent.for_imitation, action_dim=next_action.shape[0]).mode
        next_action, is_own = _better((next_action, imitated), target_critics, block.next_inputs, config)
        entropy_bonus = jnp.where(is_own, entropy_bonus, 0.0)  # the imitating policy is not random
    next_atoms = apply_critics(target_critics, block.next_inputs, next_action, config.agent)  # (C, Q, B)
    bellman = dict(reward=block.reward, discount=block.discount, entropy_bonus=entropy_bonus)
    if config.agent.base == "tqc":
        num_dropped = next_atoms.shape[0] * config.agent.top_quantiles_to_drop_per_net
        targets = target_atoms(next_atoms.reshape(-1, next_atoms.shape[-1]), **bellman, num_dropped=num_dropped)
    else:
        targets = target_value(next_atoms[:, 0], **bellman)
    return jnp.clip(targets, 0.0, 1.0) if config.agent.clip_targets else targets


def _better(actions: tuple[Array, Array], critics: Params, inputs: Array, config: TrainConfig) -> tuple[Array, Array]:
    """Of two actions (A, B) those that the critics value more, see `comparison.better`."""
    return better(actions, (_value(critics, inputs, actions[0], config), _value(critics, inputs, actions[1], config)))


def _critic_gradient(state: AgentState, target_critics: Params, config: TrainConfig, block: _Columns) -> tuple[Params, Metrics]:
    """The gradient of the critics' loss over a block, and metrics."""
    targets = _targets(state, target_critics, config, block)

    def loss(critics: Params) -> tuple[Array, Metrics]:
        quantiles = apply_critics(critics, block.inputs, block.action, config.agent)
        terms = CriticTerms(
            quantiles=quantiles,
            targets=targets,
            taken_action=block.action,
            is_demonstration=block.is_demonstration,
            critics=lambda action: apply_critics(critics, block.inputs, action, config.agent),
        )
        value = _scalar((config.agent.critic_loss or critic_loss)(terms, config.agent), "critic_loss")
        return value, {"critic/loss": value, "critic/value": jnp.mean(quantiles), "critic/target": jnp.mean(targets)}

    return jax.grad(loss, has_aux=True)(state.critics)


def action_value(critics: Params, inputs: Array, action: Array, config: TrainConfig) -> Array:
    """The value (B,) of actions (B, A) in [-1, 1] at inputs (B, input_dim): what the actor climbs, the mean over critics and quantiles.

    Without quantiles it is the least critic's, or with REDQ's subsets the mean over critics.
    """
    return _value(critics, inputs.T, action.T, config)


def _scalar(loss: Array, name: str) -> Array:
    if jnp.shape(loss) != ():
        raise UserError(f"{name} gives an array of shape {jnp.shape(loss)}: let it give one number, as jnp.mean does")
    return loss


def _value(critics: Params, inputs: Array, action: Array, config: TrainConfig) -> Array:
    """The value of actions, of which the actor climbs the mean, absolute or relative to itself: (B,)."""
    if config.agent.base == "tqc":
        return mean_return(critics, inputs, action, config.agent)
    values = apply_critics(critics, inputs, action, config.agent)[:, 0]
    return jnp.min(values, axis=0) if config.agent.num_target_critics is None else jnp.mean(values, axis=0)


def _cloning_weight(critics: Params, block: _Columns, own_action: Array, config: TrainConfig) -> Array:
    """How much of each column is cloned, (B,) in [0, 1]: of demonstrations, what the Q-filter passes."""
    own_action = jax.lax.stop_gradient(own_action)
    if config.agent.q_filter == "hard":
        valued = _value(critics, block.inputs, block.action, config) > _value(critics, block.inputs, own_action, config)
        return block.is_demonstration & valued
    if config.agent.q_filter == "smooth":
        values, own_values = (mean_returns(critics, block.inputs, action, config.agent) for action in (block.action, own_action))
        return block.is_demonstration * probability_of_being_better(values, own_values)
    return block.is_demonstration


def _actor_gradient(state: AgentState, schedule: Schedule, config: TrainConfig, block: _Columns) -> tuple[Params, Metrics]:
    """The gradient of the actor's loss over a block, and metrics."""
    agent, quirks = config.agent, config.quirks

    def loss(actor: Params) -> tuple[Array, Metrics]:
        distribution = apply_actor(actor, block.inputs, agent, action_dim=block.action.shape[0])
        action, log_prob = distribution.at(block.noise)
        values, entropy = _value(state.critics, block.inputs, action, config), -jnp.mean(log_prob)
        weight = _cloning_weight(state.critics, block, distribution.mode, config)
        bc = behaviour_cloning(distribution.mode if quirks.bc_action == "mean" else action, block.action, weight, form=quirks.bc_loss)
        terms = ActorTerms(
            value=values,
            action=action,
            log_prob=log_prob,
            mode=distribution.mode,
            alpha=jnp.exp(state.log_alpha),
            cloning=bc,
            taken_action=block.action,
            is_demonstration=block.is_demonstration,
            critics=lambda action: apply_critics(state.critics, block.inputs, action, agent),
        )
        total = _scalar((agent.actor_loss or actor_loss)(terms, agent), "actor_loss")
        return total, {"actor/loss": total, "actor/bc_loss": bc, "actor/value": jnp.mean(values), "actor/entropy": entropy}

    return jax.grad(loss, has_aux=True)(state.actor)


def _descend(gradient: Any, optimiser_state: optax.OptState, params: Any, learning_rate: Array | float) -> tuple[Any, optax.OptState]:
    updates, optimiser_state = _ADAM.update(gradient, optimiser_state, params)
    return jax.tree.map(lambda param, update: param - learning_rate * update, params, updates), optimiser_state


def _move_actor(state: AgentState, gradient: Params, entropy: Array, schedule: Schedule, config: TrainConfig) -> tuple[AgentState, Metrics]:
    """The step of the actor, of its average, and of the entropy coefficient."""
    state = _step_actor(state, gradient, schedule, config)
    loss, gradient = jax.value_and_grad(entropy_coefficient)(state.log_alpha, -entropy, target_entropy=schedule.target_entropy)
    log_alpha, alpha_optimiser = _descend(gradient, state.alpha_optimiser, state.log_alpha, config.agent.learning_rate)
    metrics = {"alpha/loss": loss, "alpha/value": jnp.exp(state.log_alpha)}
    return state.replace(log_alpha=log_alpha, alpha_optimiser=alpha_optimiser), metrics


def _step_actor(state: AgentState, gradient: Params, schedule: Schedule, config: TrainConfig) -> AgentState:
    """The actor's step, and one move of its average."""
    actor, actor_optimiser = _descend(gradient, state.actor_optimiser, state.actor, config.agent.learning_rate)
    return state.replace(
        actor=actor,
        actor_optimiser=actor_optimiser,
        average_actor=optax.incremental_update(actor, state.average_actor, schedule.actor_average_rate),
    )


def with_actor(state: AgentState, actor: Params) -> AgentState:
    """The agent with another actor, whose optimiser begins anew."""
    return state.replace(actor=actor, average_actor=actor, actor_optimiser=_ADAM.init(actor))


def update_bc(key: Array, state: AgentState, batch: Transition, schedule: Schedule, config: TrainConfig) -> tuple[AgentState, Metrics]:
    """One gradient step of behaviour cloning alone: by default the mean squared error of tanh(mean) to the demonstrated action (thesis eq. 4.1).

    Args:
      key: random key, for the quirk `bc_action = sample`.
      state: the agent; only the actor, its average, and its optimiser change.
      batch: B demonstration transitions.
      schedule: its averaging rate is used.
      config: static; the quirks `bc_loss` and `bc_action` have their say.

    Returns:
      The new agent and scalar metrics.
    """
    inputs = network_inputs(batch.observation, batch.achieved_goal, batch.desired_goal, state.scale, config)
    action_dim = batch.action.shape[-1]

    def loss(actor: Params) -> Array:
        distribution = apply_actor(actor, inputs.T, config.agent, action_dim=action_dim)
        action = distribution.mode if config.quirks.bc_action == "mean" else distribution.sample(key)[0]
        return behaviour_cloning(action, batch.action.T, batch.is_demonstration, form=config.quirks.bc_loss) / action_dim

    value, gradient = jax.value_and_grad(loss)(state.actor)
    return _step_actor(state, gradient, schedule, config), {"actor/bc_loss": value}
