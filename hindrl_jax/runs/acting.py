"""Policies and critics of a run as functions of observations and goals, in the task's own units: in JAX, and the policy in NumPy alone."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax.traverse_util import flatten_dict

from hindrl_jax.base.compilation import in_float32
from hindrl_jax.base.environments import Environment, action_from_env, action_to_env
from hindrl_jax.base.errors import UserError
from hindrl_jax.base.types import Array
from hindrl_jax.config import TrainConfig
from hindrl_jax.core.agent import Params, Policy, action_value
from hindrl_jax.core.holding import hold
from hindrl_jax.core.inputs import network_inputs
from hindrl_jax.core.train import make_policy
from hindrl_jax.runs.numpy_policy import FORMAT


@dataclasses.dataclass(frozen=True, eq=False)
class TrainedPolicy:
    """One seed's policy as a function, observation and goal -> action; compiled, and to be called within `jax.jit` and `jax.vmap`, too."""

    env: Environment
    config: TrainConfig
    policy: Policy
    """Of one seed."""
    goal: Array | None
    """(G,) the goal that is meant where none is given; None where each episode has one of its own."""

    @property
    def action_hold(self) -> int:
        """Control steps for which each action is held: ask, do the same that many times, ask again."""
        return self.config.num_held

    @property
    def chunks(self) -> bool:
        """Whether a decision is `action_hold` different actions in place of one."""
        return self.config.action_chunks and self.action_hold > 1

    @property
    def noise(self) -> float:
        """Of the actions that are drawn with a key: what the run has found to be best, 0 for the mean action, 1 for sampled ones."""
        return float(self.policy.noise)

    @in_float32
    def __call__(self, observation: Any, goal: Any = None, key: Array | None = None) -> Array:
        """The action, within the bounds. The key comes last, unlike elsewhere, since most calls need none.

        Args:
          observation: (..., D) in the task's units.
          goal: (..., G) likewise; None for `self.goal`.
          key: draws actions with `self.noise`; None for the mean action.

        Returns:
          (..., A), or with `chunks` (..., action_hold, A).

        Raises:
          UserError: if a shape is not that of the task, or a goal is missing.
        """
        observation, goal, leading = _inputs(observation, goal, self)
        policy = self.policy.replace(noise=jnp.zeros_like(self.policy.noise)) if key is None else self.policy
        action = _act(jax.random.key(0) if key is None else key, policy, observation, goal, self.env, self.config)
        if self.chunks:
            return action.reshape(*leading, self.action_hold, self.env.action_dim)
        return action.reshape(*leading, self.env.action_dim)


@dataclasses.dataclass(frozen=True, eq=False)
class TrainedValue:
    """One seed's critics as a function, observation and goal -> expected return; compiled, and to be called within `jax.jit` and `jax.vmap`, too."""

    policy: TrainedPolicy
    critics: Params
    """Leaves (C, ...)."""

    @in_float32
    def __call__(self, observation: Any, goal: Any = None, action: Any = None) -> Array:
        """The mean over critics (and quantiles) of the return: gamma^(n - 1) where the goal is reached by the n-th decision.

        Args:
          observation: (..., D) in the task's units.
          goal: (..., G) likewise; None for `self.policy.goal`.
          action: (..., A) in the task's units, or with chunks (..., action_hold, A), as the policy gives it; None for its mean action.

        Returns:
          (...,) values.

        Raises:
          UserError: if a shape is not that of the task, or a goal is missing.
        """
        policy = self.policy
        action = policy(observation, goal) if action is None else jnp.asarray(action, jnp.float32)
        observation, goal, leading = _inputs(observation, goal, policy)
        shape = (policy.action_hold, policy.env.action_dim) if policy.chunks else (policy.env.action_dim,)
        fits = action.shape[action.ndim - len(shape) :] == shape
        if not fits or action.shape[: action.ndim - len(shape)] not in ((), leading):
            raise UserError(f"an action of shape {action.shape} does not go with {policy.env.name} here: give one of {(*leading, *shape)}")
        action = jnp.broadcast_to(action, (*leading, *shape)).reshape(len(observation), -1)
        return _value(self.critics, policy.policy, observation, goal, action, policy.env, policy.config).reshape(leading)


def takes_whole_actions(env: Environment) -> bool:
    """Whether the environment, one of Gymnasium's then, takes whole numbers; the bounds that the policy knows are half a number wider."""
    return bool(getattr(env, "whole_actions", False))


def _decisions(env: Environment, config: TrainConfig) -> Environment:
    """The environment as the policies see it, one step of which is one decision."""
    return hold(env, config.num_held, chunks=config.action_chunks)


@functools.partial(jax.jit, static_argnums=(4, 5))
def _act(key: Array, policy: Policy, observation: Array, goal: Array, env: Environment, config: TrainConfig) -> Array:
    """(B, D), (B, G) -> (B, A) in the environment's units, whole numbers where it takes such."""
    whole, env = takes_whole_actions(env), _decisions(env, config)
    action = action_to_env(make_policy(policy, env, config)(key, observation, goal), env)
    if not whole:
        return action
    low, high = (jnp.broadcast_to(bound, action.shape) for bound in (jnp.ceil(env.action_low), jnp.floor(env.action_high)))
    return jnp.clip(jnp.rint(action), low, high)


@functools.partial(jax.jit, static_argnums=(5, 6))
def _value(critics: Params, policy: Policy, observation: Array, goal: Array, action: Array, env: Environment, config: TrainConfig) -> Array:
    """(B, D), (B, G), (B, A) -> (B,)"""
    env = _decisions(env, config)
    inputs = network_inputs(observation, env.achieved_goal(observation), goal, policy.scale, config)
    return action_value(critics, inputs, action_from_env(action, env), config)


def _inputs(observation: Any, goal: Any, of: TrainedPolicy) -> tuple[Array, Array, tuple[int, ...]]:
    """Observations (B, D) and goals (B, G), and the leading axes that B stands for."""
    name = of.env.name
    if goal is None and of.goal is None:
        raise UserError(f"{name} has a goal of its own in each episode: give it, as policy(observation, goal)")
    observation = _checked(observation, of.env.observation_dim, "an observation", name)
    goal = _checked(of.goal if goal is None else goal, of.env.goal_dim, "a goal", name)
    leading = jnp.broadcast_shapes(observation.shape[:-1], goal.shape[:-1])
    rows = [jnp.broadcast_to(values, (*leading, values.shape[-1])).reshape(-1, values.shape[-1]) for values in (observation, goal)]
    return rows[0], rows[1], leading


def _checked(values: Any, dim: int, what: str, task: str) -> Array:
    values = jnp.asarray(values, jnp.float32)
    if values.ndim == 0 or values.shape[-1] != dim:
        raise UserError(f"{what} of shape {values.shape} is none of {task}: give (..., {dim})")
    return values


def _entries_of_achieved_goal(env: Environment) -> list[int]:
    """Which entries of an observation make up the achieved goal, (G,).

    Raises:
      UserError: if it is none of them, but computed.
    """
    rows = np.arange(2.0 * env.observation_dim, dtype=np.float32).reshape(2, -1)
    first, second = np.asarray(env.achieved_goal(jnp.asarray(rows)))
    if not (np.isin(first, rows[0]).all() and np.array_equal(first + env.observation_dim, second)):
        raise UserError(f"the achieved goals of {env.name} are computed, which has no form in NumPy: play it by run.policy(seed)")
    return first.astype(int).tolist()


def numpy_form(trained: TrainedPolicy) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """What `NumpyPolicy` is made of.

    Raises:
      UserError: if the policy is made of what NumPy has no form of here.
    """
    env, config = trained.env, trained.config
    actor, agent, noise = trained.policy.actor, config.agent, trained.noise
    if "imitates" in actor:  # one of two networks
        imitates = bool(actor["imitates"])
        actor, agent, noise = (actor["imitation"], config.agent.for_imitation, 0.0) if imitates else (actor["actor"], agent, noise)
    unusual = {
        "imitation_proposal": config.imitation_proposal,
        "achieved_goal_input": config.quirks.achieved_goal_input,
        "actor_network": config.agent.actor_network is not None,
    }
    for name, is_on in unusual.items():
        if is_on:
            raise UserError(f"this policy was trained with {name}, which has no form in NumPy: play it by run.policy(seed)")
    facts = {
        "format": FORMAT,
        "task": env.name,
        "encoding": config.agent.input_encoding,
        "depth": len(agent.net_arch),
        "residual": agent.residual,
        "achieved": _entries_of_achieved_goal(env) if config.relative_goals else None,
        "action_hold": trained.action_hold,
        "chunks": trained.chunks,
        "noise": noise,
        "whole_actions": takes_whole_actions(env),
    }
    scale = trained.policy.scale
    low, high = (np.broadcast_to(bound, (env.action_dim,)) for bound in (env.action_low, env.action_high))
    arrays = {
        **flatten_dict(actor["params"], sep="/"),
        "observation_scale": scale.observation,
        "observation_centre": scale.observation_centre,
        "goal_scale": scale.goal,
        "goal_centre": scale.goal_centre,
        "action_low": low,
        "action_high": high,
    }
    if trained.goal is not None:
        arrays["goal"] = trained.goal
    return {name: np.asarray(array, np.float32) for name, array in arrays.items()}, facts
