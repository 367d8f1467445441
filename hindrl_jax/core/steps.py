"""From recorded episodes to transitions: the n steps from each drawn transition on, and their n-step returns."""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
from flax import struct

from hindrl_jax.base.types import Array, Episodes, Transition
from hindrl_jax.config import TrainConfig


class Steps(struct.PyTreeNode, kw_only=True):
    """The n steps from each of B drawn transitions on, over which its return is taken, recorded or relabelled.

    Past the end of the episode its last step is repeated.
    """

    row: Array  # (B,) int32, episode
    step: Array  # (B,) int32, the first of these steps in the episode
    observation: Array  # (B, D), before the first step
    action: Array  # (B, A), at the first step
    next_observations: Array  # (B, n, D), after each step
    desired_goal: Array  # (B, G)
    rewards: Array  # (B, n)
    inside: Array  # (B, n) bool, whether the episode was not over before
    is_last: Array  # (B, n) bool, whether it is over after
    terminated: Array  # (B,) bool, whether its end is a termination, rather than a truncation
    ends: Array  # (B, n) bool, whether the return ends there because a goal is reached
    is_relabelled: Array  # (B,) bool, whether the goal, or the observations, are those of hindsight


def read_steps(episodes: Episodes, rows: Array, steps: Array, n_step: int) -> Steps:
    """Reads steps as they were recorded.

    Args:
      episodes: N of them.
      rows: (B,) int32, episodes.
      steps: (B,) int32, the first step to read of each; 0 <= step < length.
      n_step: n.
    """
    lengths = episodes.lengths[rows]
    window = steps[:, None] + jnp.arange(n_step)[None]
    inside = window < lengths[:, None]
    window = jnp.minimum(window, lengths[:, None] - 1)
    return Steps(
        row=rows,
        step=steps,
        observation=episodes.observations[rows, steps],
        action=episodes.actions[rows, steps],
        next_observations=episodes.observations[rows[:, None], window + 1],
        desired_goal=episodes.desired_goals[rows],
        rewards=episodes.rewards[rows[:, None], window],
        inside=inside,
        is_last=window == lengths[:, None] - 1,
        terminated=episodes.terminated[rows],
        ends=jnp.zeros_like(inside),
        is_relabelled=jnp.zeros(rows.shape, bool),
    )


def as_occupancy(steps: Steps, gamma: Array | float) -> Steps:
    """Rewards for being at the goal, where episodes go on there: (1 - gamma) at each step.

    So returns stay in [0, 1]: who is at the goal after step t, counted from 1, and stays there, has gamma^(t - 1), as where the episode ends at the
    goal with a reward of 1. An episode that the environment itself ends at the goal counts as one that stays there.

    Args:
      steps: B rows of n steps, rewards 1 at each step at the goal, else 0.
      gamma: discount factor.

    Returns:
      The same, rewards (B, n) scaled.
    """
    stays = steps.is_last & steps.terminated[:, None]
    return steps.replace(rewards=jnp.where(stays, 1.0, 1.0 - gamma) * steps.rewards)


def transitions(steps: Steps, achieved_goal: Callable[[Array], Array], config: TrainConfig, *, is_demonstration: bool) -> Transition:
    """The n-step transitions of recorded or relabelled steps.

    A return ends after n steps, at the end of the episode, or where hindsight has it end, whichever comes first.

    Args:
      steps: B rows of n steps.
      achieved_goal: projection of observations (..., D) to goals (..., G).
      config: gamma and `timeouts_are_terminal`.
      is_demonstration: marks the rows for the behaviour cloning loss.

    Returns:
      The batch. The discount is 0 where the return ended by termination, by hindsight, or at a time-out under `timeouts_are_terminal`; else gamma to
      the number of steps taken.
    """
    gamma = config.batch.gamma
    ends = steps.ends | (steps.is_last if config.quirks.timeouts_are_terminal else steps.is_last & steps.terminated[:, None])
    ended_before = jnp.cumsum(ends, axis=1) - ends > 0
    counted = steps.inside & ~ended_before
    num_steps = jnp.sum(counted, axis=1)  # (B,), at least 1
    discounts = gamma ** jnp.arange(ends.shape[1], dtype=jnp.float32)
    last = (num_steps - 1)[:, None]
    next_observation = jnp.take_along_axis(steps.next_observations, last[..., None], axis=1)[:, 0]
    return Transition(
        observation=steps.observation,
        achieved_goal=achieved_goal(steps.observation),
        action=steps.action,
        reward=jnp.sum(jnp.where(counted, steps.rewards * discounts[None], 0.0), axis=1),
        discount=jnp.where(jnp.take_along_axis(ends, last, axis=1)[:, 0], 0.0, gamma**num_steps),
        next_observation=next_observation,
        next_achieved_goal=achieved_goal(next_observation),
        desired_goal=steps.desired_goal,
        is_demonstration=jnp.full(num_steps.shape, is_demonstration),
        is_relabelled=steps.is_relabelled,
    )
