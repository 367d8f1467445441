"""Prioritised replay, as a `core.train.Sampler`: transitions that the critics are wrong about are drawn more often, and demonstrations with a bonus.

A transition of priority p is drawn with a probability in proportion to p^a, a being `priority_exponent`; p is its temporal-difference error when it
was last drawn, plus a constant (Schaul et al., prioritised experience replay, 2016, eq. 1, proportional), plus the bonus if it is demonstrated, for
demonstrations and replay are one table (DDPGfD, Vecerik et al., 2017). Differences from the papers:
  * The error is that of the mean, |mean of the critics' atoms - mean of the targets|. DDPGfD squares it and adds the actor's gradient.
  * New transitions are given the largest priority so far without the bonus, which is to set demonstrations apart from them.
  * Rows that are relabelled keep the priority of their transition, whichever goal its error was measured under.
  * No tree of sums: an episode is drawn by the sum of its priorities, then a step of it. One pass over all priorities serves all batches of an
    iteration, there is nothing to be kept in step with them, and in float32 no sum runs over more than the episodes.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from hindrl_jax.base.environments import Environment
from hindrl_jax.base.types import Array, Episodes, Transition, tree_where
from hindrl_jax.config import PriorityConfig, TrainConfig
from hindrl_jax.core import agent as agents
from hindrl_jax.core.batch import Rows, rows_of_demonstrations, rows_of_replay
from hindrl_jax.core.guidance import Guidance
from hindrl_jax.core.relabel import num_relabelled
from hindrl_jax.core.replay import ReplayState, written_rows
from hindrl_jax.core.train import Sampler, TrainState, uniform_sampler

_LEAST_ERROR = 1e-3  # added to every error, so that no transition is lost for ever; that of DQfD (Hester et al., 2018)


class Priorities(struct.PyTreeNode, kw_only=True):
    """Priorities to the power of `priority_exponent`: positive for what can be drawn, 0 for padding and for what is being written."""

    demonstrations: Array  # (N, T)
    replay: Array  # (E * R, T), as the episodes of the replay
    largest: Array  # () the largest so far, bonuses left out; at least 1


class Drawn(struct.PyTreeNode, kw_only=True):
    """Where the rows of a batch come from."""

    is_demonstration: Array  # (B,) bool
    rows: Array  # (B,) int32 episode, of the demonstrations or of the replay
    steps: Array  # (B,) int32
    priority: Array  # (B,) > 0, to the power of `priority_exponent`, when drawn


def init(demonstrations: Episodes, empty: Episodes, config: PriorityConfig) -> Priorities:
    """For N demonstrations, priority 1 and the bonus for each of their transitions, and for the episodes of an empty replay."""
    num_steps = demonstrations.rewards.shape[1]
    is_step = jnp.arange(num_steps)[None] < demonstrations.lengths[:, None]
    return Priorities(
        demonstrations=jnp.where(is_step, (1.0 + config.demo_priority_bonus) ** config.priority_exponent, 0.0),
        replay=jnp.zeros_like(empty.rewards),
        largest=jnp.ones(()),
    )


def add(priorities: Priorities, before: ReplayState, after: ReplayState) -> Priorities:
    """Lets in what has been written to the replay by a step of all environments.

    Returns:
      The new state: transitions of ended episodes have the largest priority so far; those of episodes that are being written are left out.
    """
    is_step = jnp.arange(priorities.replay.shape[1])[None] < before.step[:, None] + 1
    written = priorities.replay.at[written_rows(before)].set(jnp.where(is_step, priorities.largest, 0.0))
    return priorities.replace(replay=written.at[written_rows(after)].set(0.0))


def draw(key: Array, priorities: Priorities, num_samples: int) -> Drawn:
    """Draws transitions by their priorities, with replacement. What cannot be drawn, see `Priorities`, never is.

    Args:
      key: random key.
      priorities: of which one at least is positive.
      num_samples: B.
    """
    key_row, key_step = jax.random.split(key)
    demonstrations, replay = priorities.demonstrations, priorities.replay
    num_demos = demonstrations.shape[0]
    row = _draw_row(key_row, jnp.concatenate([jnp.sum(demonstrations, axis=1), jnp.sum(replay, axis=1)]), num_samples)
    is_demonstration = row < num_demos
    rows = jnp.where(is_demonstration, row, row - num_demos)
    width = max(demonstrations.shape[1], replay.shape[1])

    def steps_of(table: Array) -> Array:
        """(B, T) of the longer table; for rows of the other table without meaning."""
        return jnp.pad(table[jnp.minimum(rows, table.shape[0] - 1)], ((0, 0), (0, width - table.shape[1])))

    weights = jnp.where(is_demonstration[:, None], steps_of(demonstrations), steps_of(replay))
    sums = _running_sums(weights)
    target = jax.random.uniform(key_step, (num_samples, 1)) * jnp.max(sums, axis=1, keepdims=True)
    steps = jnp.argmax(sums > target, axis=1).astype(jnp.int32)
    priority = jnp.take_along_axis(weights, steps[:, None], axis=1)[:, 0]
    return Drawn(is_demonstration=is_demonstration, rows=rows, steps=steps, priority=priority)


def _running_sums(weights: Array) -> Array:
    """Sums of the weights (..., M) up to each of them, that one included; 0 where a weight is 0, so that no sum to be passed is passed there."""
    return jnp.where(weights > 0.0, jnp.cumsum(weights, axis=-1), 0.0)


def _draw_row(key: Array, weights: Array, num_samples: int) -> Array:
    """Draws from (M,) weights, never one that is 0: (num_samples,) int32."""
    # For the search no sum may fall, and none rise where the weight is 0. Sums of a parallel scan, each rounded in its own way, may do both.
    sums = jax.lax.cummax(_running_sums(weights))
    # Uniform numbers lie below 1 by more than what a product is rounded by, so that it lies below the last sum.
    return jnp.searchsorted(sums, jax.random.uniform(key, (num_samples,)) * sums[-1], side="right")


def importance_weights(drawn: Drawn, config: PriorityConfig) -> Array:
    """What corrects the loss for rows that are drawn more often than others (Schaul et al., 2016, section 3.4): (B,) in (0, 1].

    The weights (1 / (M P))^b over the largest of the batch, P being the probability of the row, b `importance_exponent` and M the number of
    transitions. M, and the sum of all priorities in P, cancel.
    """
    return (jnp.min(drawn.priority) / drawn.priority) ** config.importance_exponent


def assign(priorities: Priorities, drawn: Drawn, errors: Array, config: PriorityConfig) -> Priorities:
    """Gives the drawn transitions the priorities of their errors; of one that was drawn twice the larger error counts.

    Args:
      priorities: the state from which they were drawn.
      drawn: leaves (B,), or of any other shape.
      errors: (B,) >= 0, likewise.
      config: exponent and bonus.
    """
    least = errors + _LEAST_ERROR
    powers = least**config.priority_exponent

    def write(table: Array, chosen: Array, values: Array) -> Array:
        place = (jnp.where(chosen, drawn.rows, table.shape[0]), drawn.steps)  # rows past the end are dropped
        # The least of the old and all new values, then the largest of all new ones. To set the place to 0 first would do as well, but not wait for
        # the values, and so for all that reads the table before it is written: that would take a copy.
        return table.at[place].min(values, mode="drop").at[place].max(values, mode="drop")

    return Priorities(
        demonstrations=write(priorities.demonstrations, drawn.is_demonstration, (least + config.demo_priority_bonus) ** config.priority_exponent),
        replay=write(priorities.replay, ~drawn.is_demonstration, powers),
        largest=jnp.maximum(priorities.largest, jnp.max(powers)),
    )


def sample_batch(key: Array, state: TrainState, guidance: Guidance, env: Environment, config: TrainConfig) -> tuple[Transition, Drawn]:
    """Draws the batch of one gradient step by the priorities of the transitions.

    Of the rows that happen to come from the replay, n / (n + 1) (rounded down) are relabelled, or fewer where intersections are empty.

    Args:
      key: random key.
      state: its replay, and priorities as its `sampler`.
      guidance, env, config: as for `core.batch.sample_batch`.

    Returns:
      A batch of `batch_size` rows in no particular order, with weights, and where its rows come from.
    """
    key_draw, key_goal = jax.random.split(key)
    drawn = draw(key_draw, state.sampler, config.batch.batch_size)
    # How many rows come from where is not known when this is compiled, so each is read from both tables, and one reading thrown away.
    replayed = ~drawn.is_demonstration
    share = num_relabelled(jnp.sum(replayed), config.batch.relabelled_per_original)
    relabelled = replayed & (jnp.cumsum(replayed) <= share)  # the first of them: all are drawn alike
    from_replay = rows_of_replay(key_goal, state.replay, Rows(row=drawn.rows, step=drawn.steps, relabelled=relabelled), guidance, env, config)
    from_demonstrations = rows_of_demonstrations(guidance.demonstrations, drawn.rows, drawn.steps, env, config)
    batch = tree_where(replayed, from_replay, from_demonstrations)
    return batch.replace(weight=importance_weights(drawn, config.priority)), drawn


def prioritised_sampler(env: Environment, config: TrainConfig) -> Sampler:
    """Draws transitions by their priorities, which are renewed after the gradient steps of an iteration."""

    def draw_batches(key: Array, state: TrainState, guidance: Guidance) -> tuple[Transition, tuple[Drawn, Array]]:
        key_batch, key_errors = jax.random.split(key)
        keys = jax.random.split(key_batch, config.num_updates)
        batches, drawn = jax.vmap(lambda key: sample_batch(key, state, guidance, env, config))(keys)
        return batches, (drawn, key_errors)

    def renew(state: TrainState, batches: Transition, said: tuple[Drawn, Array]) -> Priorities:
        def errors_of(key: Array, batch: Transition) -> tuple[Array, Array]:
            key, key_error = jax.random.split(key)
            return key, agents.td_error(key_error, state.agent, batch, config)

        drawn, key_errors = said
        _, errors = jax.lax.scan(errors_of, key_errors, batches)
        return assign(state.sampler, drawn, errors, config.priority)

    return Sampler(
        init=lambda guidance, replay: init(guidance.demonstrations, replay.episodes, config.priority), record=add, draw=draw_batches, learned=renew
    )


def sampler_for(env: Environment, config: TrainConfig) -> Sampler:
    """The sampler that a config asks for."""
    return prioritised_sampler(env, config) if config.priority.is_used else uniform_sampler(env, config)
