"""Held actions: one decision of the policy is the command of several control steps.

What makes a sparse-reward task long is the number of decisions between start and reward, over which the value has to travel. With each action held
for k control steps there are k times fewer. The task stays what it is: its horizon and its demonstrations count control steps, and the
environment notices what it notices at each of them. Training, evaluation and saved policies see `hold(env, k)`, one step of which is one decision.
(Action repeat is as old as the Atari benchmark, Bellemare et al., 2013.)

In the general form a decision is a chunk: k actions, played one after the other whatever is seen meanwhile, and the critics value chunks (Q-chunking;
Li, Zhou and Levine, reinforcement learning with action chunking, 2025). Differences from the paper: the policy is the Gaussian of all algorithms
here, not one held to the demonstrations by flow matching; and gamma counts decisions, so that within a chunk nothing is discounted.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp

from hindrl_jax.base.environments import Environment, command_of
from hindrl_jax.base.errors import UserError
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
    """k, control steps for each decision."""
    chunks: bool = False
    """Whether a decision is k actions, rather than one."""

    @property
    def horizon(self) -> int:
        """In decisions, the last of which may be cut short."""
        return -(-self.env.horizon // self.num_held)

    @property
    def action_dim(self) -> int:
        """Numbers in a decision."""
        return self.env.action_dim * (self.num_held if self.chunks else 1)

    @property
    def action_low(self) -> Any:
        """Lower bound of each of them."""
        return self._of_each_action(self.env.action_low)

    @property
    def action_high(self) -> Any:
        """Upper bound, likewise."""
        return self._of_each_action(self.env.action_high)

    def _of_each_action(self, bound: Any) -> Any:
        return jnp.tile(bound, self.num_held) if self.chunks and jnp.ndim(bound) else bound


def hold(env: Environment, num_held: int, *, chunks: bool = False) -> Environment:
    """The environment with each action held for `num_held` control steps, or until the episode is over; itself for 1.

    With `chunks` its actions are `num_held` actions (k A,) of the environment in place of one, the first of them first.
    """
    return env if num_held == 1 else _held_class(type(env))(env, num_held, chunks)


_OWN = ("horizon", "action_dim", "action_low", "action_high", "env", "num_held", "chunks")
"""What `HeldActions` answers for itself."""


@functools.cache
def _held_class(kind: type[Any]) -> type[Any]:
    """`HeldActions` with all public attributes of a class of environments, so that abilities can be asked for as ever."""
    own = {"reset": _delegated("reset"), "step": _step, "stepper": _stepper}
    names = {name for name in (*dir(kind), *(field.name for field in dataclasses.fields(kind))) if not name.startswith("_")}
    members = {name: own.get(name) or _delegated(name) for name in names if name not in ("watched", *_OWN)}
    return type("HeldActions", (HeldActions,), members)


def _delegated(name: str) -> property:
    return property(lambda held: getattr(held.env, name))


def _step(held: HeldActions, state: Any, action: Array) -> tuple[Any, TimeStep]:
    """`num_held` control steps, as one; what comes after the end of the episode does not happen."""
    action_dim = held.env.action_dim

    def control_step(carry: tuple[Any, TimeStep], index: Array) -> tuple[tuple[Any, TimeStep], None]:
        state, before = carry
        over = before.terminated | before.truncated
        after, time_step = held.env.step(state, command_of(action, index, action_dim))
        time_step = time_step.replace(reward=before.reward + time_step.reward)
        return tree_where(over, carry, (after, time_step)), None

    nothing = TimeStep(
        observation=jnp.zeros(held.env.observation_dim),
        reward=jnp.zeros(()),
        terminated=jnp.asarray(False),
        truncated=jnp.asarray(False),
    )
    return jax.lax.scan(control_step, (state, nothing), jnp.arange(held.num_held))[0]


def _stepper(held: HeldActions, num_envs: int) -> Any:
    return held.env.stepper(num_envs, num_held=held.num_held)


def in_control_steps(evaluation: Evaluation, env: Environment, num_held: int) -> Evaluation:
    """What became of episodes of `hold(env, num_held)`, with lengths in control steps of `env`; the horizon may cut the last decision short."""
    return evaluation.replace(length=jnp.minimum(evaluation.length * num_held, env.horizon))


def longest_hold(lengths: Array) -> int:
    """For how many control steps actions can be held: the most with which the median demonstration takes `FEWEST_DECISIONS`, at least 1.

    Args:
      lengths: of the demonstrations, in control steps, any shape; where the goal is to be held, of their ways to it.
    """
    return max(1, int(jnp.median(lengths)) // FEWEST_DECISIONS)


def with_action_hold(config: TrainConfig, demonstrations: Episodes) -> TrainConfig:
    """The config with its `action_hold` chosen, if it is None: `longest_hold` of all demonstrations, whose lengths are control steps.

    Raises:
      UserError: if it is to hold chunks, and they would be single actions.
    """
    if config.action_hold is not None:
        return config
    num_held = longest_hold(demonstrations.lengths)
    if config.action_chunks and num_held == 1:
        raise UserError("the demonstrations are too short for chunks to be chosen by them, so action_chunks changes nothing: give action_hold, too")
    return dataclasses.replace(config, action_hold=num_held)


def hold_demonstrations(demonstrations: Episodes, num_held: int, *, chunks: bool = False, holds_goal: bool = False) -> Episodes:
    """Demonstrations as `hold` would have shown them: every k-th state and the last one, and between them the mean of the actions, or all of them.

    The mean of commands to move is the command that, held, moves as far. Where the motion is finer than k steps, the demonstrated
    actions are blurred. Chunks (k A,) are the actions themselves, where the demonstration ends early with its last action repeated.

    Args:
      demonstrations: N of T control steps, numpy or JAX, leaves (..., N, ...).
      num_held: k.
      chunks: whether decisions are chunks.
      holds_goal: whether the goal is to be held: a decision has the reward of its last control step, in place of the sum of all.

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

    rewards = sums(demonstrations.rewards[..., None])[..., 0]
    if holds_goal:
        at_last_steps = jnp.take_along_axis(jnp.asarray(demonstrations.rewards), jnp.maximum(starts[..., 1:] - 1, 0), axis=-1)
        rewards = jnp.where(jnp.diff(starts, axis=-1) > 0, at_last_steps, 0.0)
    mean_action = sums(demonstrations.actions) / jnp.maximum(jnp.diff(starts, axis=-1), 1)[..., None]
    held = demonstrations.replace(
        observations=at_decisions(demonstrations.observations),
        actions=_cut_into_chunks(jnp.asarray(demonstrations.actions), lengths, num_held) if chunks else mean_action,
        rewards=rewards,
        lengths=-(-lengths // num_held),
        states=None if demonstrations.states is None else at_decisions(demonstrations.states),
    )
    return jax.device_get(held)


def _cut_into_chunks(actions: Array, lengths: Array, num_held: int) -> Array:
    """Actions (..., N, T, A) of episodes of lengths (..., N) -> chunks (..., N, decisions, k A); past the end the last action is repeated."""
    decisions = -(-actions.shape[-2] // num_held)
    steps = jnp.expand_dims(jnp.arange(decisions * num_held), tuple(range(lengths.ndim)))
    steps = jnp.minimum(steps, jnp.maximum(lengths[..., None] - 1, 0))
    return jnp.take_along_axis(actions, steps[..., None], axis=-2).reshape(*lengths.shape, decisions, -1)
