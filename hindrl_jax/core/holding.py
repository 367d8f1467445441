"""Held actions: one decision of the policy is the command of several control steps.

What makes a sparse-reward task long is the number of decisions between start and reward, over which the value has to travel. With each action held
for k control steps there are k times fewer. The task stays what it is: its horizon and its demonstrations count control steps, and the
environment notices what it notices at each of them. Training, evaluation and saved policies see `hold(env, k)`, one step of which is one decision.
(Action repeat is as old as the Atari benchmark, Bellemare et al., 2013; chunks of actions, Li et al., 2025, are its general form.)
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp

from hindrl_jax.base.environments import Environment
from hindrl_jax.base.types import Array, Episodes, TimeStep, tree_where
from hindrl_jax.config import TrainConfig
from hindrl_jax.core.rollout import Evaluation

FEWEST_DECISIONS = 60
"""Decisions that the median demonstration still takes when its actions are held for as long as can be."""


@dataclasses.dataclass(frozen=True)
class HeldActions:
    """An environment whose actions are held, made by `hold`. It is able to do whatever the environment is, which answers for all else."""

    env: Any
    num_held: int
    """k, control steps for each action."""

    @property
    def horizon(self) -> int:
        """In decisions, the last of which may be cut short."""
        return -(-self.env.horizon // self.num_held)


def hold(env: Environment, num_held: int) -> Environment:
    """The environment with each action held for `num_held` control steps, or until the episode is over; itself for 1."""
    return env if num_held == 1 else _held_class(type(env))(env, num_held)


@functools.cache
def _held_class(kind: type[Any]) -> type[Any]:
    """`HeldActions` with all public attributes of a class of environments, so that abilities can be asked for as ever."""
    own = {"reset": _delegated("reset"), "step": _step, "stepper": _stepper}
    names = {name for name in (*dir(kind), *(field.name for field in dataclasses.fields(kind))) if not name.startswith("_")}
    members = {name: own.get(name) or _delegated(name) for name in names if name not in ("horizon", "watched", "env", "num_held")}
    return type("HeldActions", (HeldActions,), members)


def _delegated(name: str) -> property:
    return property(lambda held: getattr(held.env, name))


def _step(held: HeldActions, state: Any, action: Array) -> tuple[Any, TimeStep]:
    """`num_held` control steps with the same action, as one; what comes after the end of the episode does not happen."""

    def control_step(carry: tuple[Any, TimeStep], _: None) -> tuple[tuple[Any, TimeStep], None]:
        state, before = carry
        over = before.terminated | before.truncated
        after, time_step = held.env.step(state, action)
        time_step = time_step.replace(reward=before.reward + time_step.reward)
        return tree_where(over, carry, (after, time_step)), None

    nothing = TimeStep(
        observation=jnp.zeros(held.env.observation_dim),
        reward=jnp.zeros(()),
        terminated=jnp.asarray(False),
        truncated=jnp.asarray(False),
    )
    return jax.lax.scan(control_step, (state, nothing), length=held.num_held)[0]


def _stepper(held: HeldActions, num_envs: int) -> Any:
    return held.env.stepper(num_envs, num_held=held.num_held)


def in_control_steps(evaluation: Evaluation, env: Environment, num_held: int) -> Evaluation:
    """What became of episodes of `hold(env, num_held)`, with lengths in control steps of `env`; the horizon may cut the last decision short."""
    return evaluation.replace(length=jnp.minimum(evaluation.length * num_held, env.horizon))


def longest_hold(lengths: Array) -> int:
    """For how many control steps actions can be held: the most with which the median demonstration takes `FEWEST_DECISIONS`, at least 1.

    Args:
      lengths: of the demonstrations, in control steps, any shape.
    """
    return max(1, int(jnp.median(lengths)) // FEWEST_DECISIONS)


def with_action_hold(config: TrainConfig, demonstrations: Episodes) -> TrainConfig:
    """The config with its `action_hold` chosen, if it is None: `longest_hold` of all demonstrations, whose lengths are control steps."""
    if config.action_hold is not None:
        return config
    return dataclasses.replace(config, action_hold=longest_hold(demonstrations.lengths))


def hold_demonstrations(demonstrations: Episodes, num_held: int) -> Episodes:
    """Demonstrations as `hold` would have shown them: every k-th state and the last one, and between them the mean of the actions.

    The mean of commands to move is the command that, held, moves as far. Where the motion is finer than k steps, the demonstrated
    actions are blurred.

    Args:
      demonstrations: N of T control steps, numpy or JAX, leaves (..., N, ...).
      num_held: k.

    Returns:
      Numpy leaves, the same but for T, which counts decisions.
    """
    if num_held == 1:
        return demonstrations
    lengths = jnp.asarray(demonstrations.lengths)
    steps = demonstrations.actions.shape[-2]
    horizon = -(-steps // num_held)
    leading = tuple(range(lengths.ndim))
    starts = jnp.minimum(jnp.expand_dims(jnp.arange(horizon + 1) * num_held, leading), lengths[..., None])  # (..., N, decisions + 1), control steps
    taken = jnp.expand_dims(jnp.arange(steps), leading) < lengths[..., None]  # (..., N, T), past the end there is padding

    def at_decisions(values: Array) -> Array:
        return jnp.take_along_axis(jnp.asarray(values), starts[..., None], axis=-2)

    def sums(values: Array) -> Array:
        """(..., N, T, X) -> (..., N, decisions, X), over the control steps of each decision."""
        values = jnp.where(taken[..., None], jnp.asarray(values), 0.0)
        nothing = [(0, 0)] * (values.ndim - 2)
        values = jnp.pad(values, [*nothing, (0, horizon * num_held - steps), (0, 0)])
        return values.reshape(*values.shape[:-2], horizon, num_held, values.shape[-1]).sum(axis=-2)

    held = demonstrations.replace(
        observations=at_decisions(demonstrations.observations),
        actions=sums(demonstrations.actions) / jnp.maximum(jnp.diff(starts, axis=-1), 1)[..., None],
        rewards=sums(demonstrations.rewards[..., None])[..., 0],
        lengths=-(-lengths // num_held),
        states=None if demonstrations.states is None else at_decisions(demonstrations.states),
    )
    return jax.device_get(held)
