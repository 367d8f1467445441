"""Replay of whole episodes.

A transition is never stored twice: an episode keeps its T + 1 observations once, and next observations are the following rows. Achieved goals,
relabelled goals, rewards and n-step returns are computed when a batch is drawn (the thesis's "online relabelling").

Every environment owns a ring of episode slots, so that writing needs no bookkeeping between environments. One slot per ring is being written;
only complete episodes are sampled, and an episode is overwritten as a whole.
"""

from __future__ import annotations

from collections.abc import Mapping

import jax.numpy as jnp
from flax import struct

from hindrl_jax.base.environments import Environment
from hindrl_jax.base.errors import UserError
from hindrl_jax.base.types import Array, Episodes
from hindrl_jax.core.randomness import uniform_in_groups, uniform_index


class ReplayState(struct.PyTreeNode, kw_only=True):
    """Rings of episodes, one ring of R slots for each of the E environments; slot r of environment e is row e * R + r of `episodes`."""

    episodes: Episodes  # E * R episodes; what lies in a slot that is empty or being written is never sampled
    slot: Array  # (E,) int32, the slot that each environment is writing
    step: Array  # (E,) int32, transitions already written there
    num_complete: Array  # (E,) int32, complete episodes in each ring, at most R - 1
    notes: dict[str, Array]  # leaves (E * R, T), what else is noted of each transition, by name; most runs note nothing


class RecordedStep(struct.PyTreeNode, kw_only=True):
    """One transition of each of E environments, as it was recorded."""

    observation: Array  # (E, D)
    desired_goal: Array  # (E, G), the behavioural goal, constant within an episode
    action: Array  # (E, A) in [-1, 1]
    reward: Array  # (E,)
    next_observation: Array  # (E, D), the true next one, not that of the following episode
    terminated: Array  # (E,) bool
    truncated: Array  # (E,) bool, not both
    notes: dict[str, Array]  # leaves (E,), of the names that the replay was made for


def init(env: Environment, *, num_envs: int, capacity: int, notes: Mapping[str, int] | None = None) -> ReplayState:
    """An empty replay.

    Args:
      env: its horizon T, the longest episode, and its dimensions are used.
      num_envs: E.
      capacity: transitions to hold; rounded down to whole episodes of `horizon` steps per environment.
      notes: what is noted of each transition beyond itself, by name, and the value of what has not been written.

    Raises:
      UserError: if the capacity is below two episodes per environment (one being written, one to sample).
    """
    slots = capacity // (num_envs * env.horizon)
    if slots < 2:
        raise UserError(
            f"buffer_size = {capacity} is too small: {num_envs} environments with episodes of up to {env.horizon} steps "
            f"need at least {2 * num_envs * env.horizon}"
        )
    rows = num_envs * slots
    return ReplayState(
        episodes=empty_table(env, rows),
        slot=jnp.zeros(num_envs, jnp.int32),
        step=jnp.zeros(num_envs, jnp.int32),
        num_complete=jnp.zeros(num_envs, jnp.int32),
        notes={name: jnp.full((rows, env.horizon), value) for name, value in (notes or {}).items()},
    )


def empty_table(env: Environment, num_episodes: int) -> Episodes:
    """A table with room for so many episodes, none of which has been played: of length 0."""
    return Episodes(
        observations=jnp.zeros((num_episodes, env.horizon + 1, env.observation_dim)),
        actions=jnp.zeros((num_episodes, env.horizon, env.action_dim)),
        rewards=jnp.zeros((num_episodes, env.horizon)),
        lengths=jnp.zeros(num_episodes, jnp.int32),
        terminated=jnp.zeros(num_episodes, bool),
        desired_goals=jnp.zeros((num_episodes, env.goal_dim)),
    )


def add(replay: ReplayState, recorded: RecordedStep) -> ReplayState:
    """Appends one transition per environment; an episode becomes available for sampling when it ends. The caller donates the old state."""
    slots = slots_per_env(replay)
    step, ended = replay.step, recorded.terminated | recorded.truncated
    row = jnp.arange(step.shape[0]) * slots + replay.slot
    episodes = replay.episodes
    return ReplayState(
        episodes=episodes.replace(
            observations=episodes.observations.at[row, step].set(recorded.observation).at[row, step + 1].set(recorded.next_observation),
            actions=episodes.actions.at[row, step].set(recorded.action),
            rewards=episodes.rewards.at[row, step].set(recorded.reward),
            lengths=episodes.lengths.at[row].set(jnp.where(ended, step + 1, 0)),
            terminated=episodes.terminated.at[row].set(recorded.terminated),
            desired_goals=episodes.desired_goals.at[row].set(recorded.desired_goal),
        ),
        slot=jnp.where(ended, (replay.slot + 1) % slots, replay.slot),
        step=jnp.where(ended, 0, step + 1),
        num_complete=jnp.minimum(replay.num_complete + ended, slots - 1),
        notes={name: values.at[row, step].set(recorded.notes[name]) for name, values in replay.notes.items()},
    )


def slots_per_env(replay: ReplayState) -> int:
    """R, the slots in the ring of each environment."""
    return replay.episodes.lengths.shape[0] // replay.slot.shape[0]


def sample_episodes(key: Array, replay: ReplayState, num_samples: int) -> Array:
    """Draws complete episodes uniformly, with replacement: (num_samples,) int32 rows of `replay.episodes`.

    At least one episode must be complete; else the rows are meaningless.
    """
    slots = slots_per_env(replay)
    env, age = uniform_in_groups(key, num_samples, replay.num_complete)  # age 1: the newest episode of that environment
    return env * slots + (replay.slot[env] - age) % slots


def sample_steps(key: Array, episodes: Episodes, rows: Array) -> Array:
    """Draws a transition uniformly from each of the given episodes: rows (B,) -> steps (B,) int32, 0 <= step < length."""
    return uniform_index(key, rows.shape, jnp.maximum(episodes.lengths[rows], 1))
