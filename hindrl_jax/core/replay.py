"""Replay of whole episodes, and the batches that are drawn from it.

A transition is never stored twice: an episode keeps its T + 1 observations once, next observations and achieved goals are read off the
following rows, and relabelled goals, rewards and n-step returns are computed when a batch is drawn (the thesis's "online relabelling"). So are
observations, where those hold what an episode is about and it is told anew (`Retelling`).

Every environment owns a ring of episode slots, so that writing needs no bookkeeping between environments. One slot per ring is being written;
only complete episodes are sampled, and an episode is overwritten as a whole.

Transitions are drawn uniformly by episode, then by step, with `sample_batch`, or by their priorities, with `sample_prioritised_batch`; both read what
they have drawn alike:

    told = read_steps(episodes, rows, steps, n_step)        # as it was lived
    told = retell(told, chosen, tell)                       # where hindsight changes what was seen
    told = judge_by_goals(told, others, goals, ...)         # where it changes the goal: no row takes part in both
    batch = transitions(told, goals, ...)                   # n-step returns, each up to where it ends by then
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from hindrl_jax.base.errors import UserError
from hindrl_jax.base.types import Array, Episodes, Transition, tree_where
from hindrl_jax.config import BatchConfig, Source
from hindrl_jax.core import priorities as prioritised
from hindrl_jax.core.goals import GoalTable, goal_reached, sample_goals
from hindrl_jax.core.hindsight import choose_sources, hindsight_steps, intersection_steps
from hindrl_jax.core.priorities import Drawn, Priorities
from hindrl_jax.core.randomness import uniform_in_groups, uniform_index


class Retelling(NamedTuple):
    """How an environment that puts into its observations what an episode is about tells in hindsight, see `types.RetellableEnvironment`."""

    retell: Callable[[Array, Array, Array], tuple[Array, Array]]
    num_subgoals: int  # J


class ReplayState(struct.PyTreeNode, kw_only=True):
    """Rings of episodes, one ring of R slots for each of the E environments; slot r of environment e is row e * R + r of `episodes`."""

    episodes: Episodes  # E * R episodes; what lies in a slot that is empty or being written is never sampled
    slot: Array  # (E,) int32, the slot that each environment is writing
    step: Array  # (E,) int32, transitions already written there
    num_complete: Array  # (E,) int32, complete episodes in each ring, at most R - 1
    judged_by_goal: Array  # (E * R,) bool, whether an episode is rewarded for reaching its behavioural goal rather than by the environment
    nearby_goals: Array | None  # (E * R, T + 1) int32, for each state but the first a row of the goal table near it, or -1; None if not kept
    priorities: Priorities | None = None  # of all transitions, those of the demonstrations included; None where they are drawn uniformly


def init(
    *, num_envs: int, capacity: int, horizon: int, observation_dim: int, action_dim: int, goal_dim: int, keep_nearby_goals: bool = False
) -> ReplayState:
    """An empty replay.

    Args:
      num_envs: E.
      capacity: transitions to hold; rounded down to whole episodes of `horizon` steps per environment.
      horizon: T, the longest episode.
      observation_dim, action_dim, goal_dim: D, A, G.
      keep_nearby_goals: whether `add` will be given nearby goals, which the source joint_intersection needs.

    Raises:
      UserError: if the capacity is below two episodes per environment (one being written, one to sample).
    """
    slots = capacity // (num_envs * horizon)
    if slots < 2:
        raise UserError(
            f"buffer_size = {capacity} is too small: {num_envs} environments with episodes of up to {horizon} steps "
            f"need at least {2 * num_envs * horizon}"
        )
    rows = num_envs * slots
    return ReplayState(
        episodes=Episodes(
            observations=jnp.zeros((rows, horizon + 1, observation_dim)),
            actions=jnp.zeros((rows, horizon, action_dim)),
            rewards=jnp.zeros((rows, horizon)),
            lengths=jnp.zeros(rows, jnp.int32),
            terminated=jnp.zeros(rows, bool),
            desired_goals=jnp.zeros((rows, goal_dim)),
        ),
        slot=jnp.zeros(num_envs, jnp.int32),
        step=jnp.zeros(num_envs, jnp.int32),
        num_complete=jnp.zeros(num_envs, jnp.int32),
        judged_by_goal=jnp.zeros(rows, bool),
        nearby_goals=jnp.full((rows, horizon + 1), -1) if keep_nearby_goals else None,
    )


def add(
    replay: ReplayState,
    *,
    observation: Array,
    desired_goal: Array,
    action: Array,
    reward: Array,
    next_observation: Array,
    terminated: Array,
    truncated: Array,
    judged_by_goal: Array,
    nearby_goal: Array | None = None,
) -> ReplayState:
    """Appends one transition per environment; an episode becomes available for sampling when it ends.

    Args:
      replay: the state to extend.
      observation, next_observation: (E, D); the true next observation, not that of the following episode.
      desired_goal: (E, G), the behavioural goal, constant within an episode.
      action: (E, A) in [-1, 1].
      reward: (E,).
      terminated, truncated: (E,) bool, not both.
      judged_by_goal: (E,) bool, constant within an episode, see `ReplayState`.
      nearby_goal: (E,) int32, see `goals.nearby_goal`, of the goal achieved by the next observation; where it is kept.

    Returns:
      The new state. The caller donates the old one.
    """
    num_envs = replay.slot.shape[0]
    episodes = replay.episodes
    slots = episodes.lengths.shape[0] // num_envs
    first, step, ended = jnp.arange(num_envs) * slots, replay.step, terminated | truncated
    row, next_slot = first + replay.slot, jnp.where(ended, (replay.slot + 1) % slots, replay.slot)
    episodes = episodes.replace(
        observations=episodes.observations.at[row, step].set(observation).at[row, step + 1].set(next_observation),
        actions=episodes.actions.at[row, step].set(action),
        rewards=episodes.rewards.at[row, step].set(reward),
        lengths=episodes.lengths.at[row].set(jnp.where(ended, step + 1, 0)),
        terminated=episodes.terminated.at[row].set(terminated),
        desired_goals=episodes.desired_goals.at[row].set(desired_goal),
    )
    priorities = replay.priorities
    if priorities is not None:
        priorities = prioritised.add(priorities, row, step + 1, first + next_slot)
    return ReplayState(
        episodes=episodes,
        slot=next_slot,
        step=jnp.where(ended, 0, step + 1),
        num_complete=jnp.minimum(replay.num_complete + ended, slots - 1),
        judged_by_goal=replay.judged_by_goal.at[row].set(judged_by_goal),
        nearby_goals=None if replay.nearby_goals is None else replay.nearby_goals.at[row, step + 1].set(nearby_goal),
        priorities=priorities,
    )


def sample_episodes(key: Array, replay: ReplayState, num_samples: int) -> Array:
    """Draws complete episodes uniformly, with replacement: (num_samples,) int32 rows of `replay.episodes`.

    At least one episode must be complete; else the rows are meaningless.
    """
    slots = replay.episodes.lengths.shape[0] // replay.slot.shape[0]
    env, age = uniform_in_groups(key, num_samples, replay.num_complete)  # age 1: the newest episode of that environment
    return env * slots + (replay.slot[env] - age) % slots


def sample_steps(key: Array, episodes: Episodes, rows: Array) -> Array:
    """Draws a transition uniformly from each of the given episodes: rows (B,) -> steps (B,) int32, 0 <= step < length."""
    return uniform_index(key, rows.shape, jnp.maximum(episodes.lengths[rows], 1))


class Steps(struct.PyTreeNode, kw_only=True):
    """The n steps from each of B drawn transitions on, over which its return is taken. Past the end of the episode its last step is repeated."""

    observation: Array  # (B, D), before the first step
    action: Array  # (B, A), at the first step
    next_observations: Array  # (B, n, D), after each step
    rewards: Array  # (B, n)
    inside: Array  # (B, n) bool, whether the episode was not over before
    is_last: Array  # (B, n) bool, whether it is over after
    terminated: Array  # (B,) bool, whether its end is a termination, rather than a truncation
    steps_left: Array  # (B,) int32, from the first of these steps to the last one of the episode
    last_reward: Array  # (B,), at the last step of the episode
    ends: Array  # (B, n) bool, whether hindsight has the task end there
    by_hindsight: Array  # (B,) bool, whether rewards are those of hindsight, of which the episode's own last reward says nothing


def read_steps(episodes: Episodes, rows: Array, steps: Array, n_step: int) -> Steps:
    """Reads steps as they were lived.

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
        observation=episodes.observations[rows, steps],
        action=episodes.actions[rows, steps],
        next_observations=episodes.observations[rows[:, None], window + 1],
        rewards=episodes.rewards[rows[:, None], window],
        inside=inside,
        is_last=window == lengths[:, None] - 1,
        terminated=episodes.terminated[rows],
        steps_left=lengths - 1 - steps,
        last_reward=episodes.rewards[rows, lengths - 1],
        ends=jnp.zeros_like(inside),
        by_hindsight=jnp.zeros(rows.shape, bool),
    )


def judge_by_goals(
    told: Steps, chosen: Array, goals: Array, *, achieved_goal: Callable[[Array], Array], epsilon: Array, config: BatchConfig
) -> Steps:
    """Rewards rows where they reach goals, by the box test on the goal achieved after each step (thesis eq. 2.29 and 4.8).

    With `terminate_on_relabel` they end there.

    Args:
      told: B rows of n steps.
      chosen: (B,) bool, the rows to judge; the others stay as they are.
      goals: (B, G).
      achieved_goal: projection of observations (..., D) to goals (..., G).
      epsilon: (G,) half-width of the goal box.
      config: the goal test, and whether a reached goal ends the row.
    """
    reached = goal_reached(achieved_goal(told.next_observations), goals[:, None], epsilon, inclusive=config.inclusive_goal_test) & chosen[:, None]
    return told.replace(
        rewards=jnp.where(chosen[:, None], reached.astype(jnp.float32), told.rewards),
        ends=told.ends | reached if config.terminate_on_relabel else told.ends,
        by_hindsight=told.by_hindsight | chosen,
    )


def retell(told: Steps, chosen: Array, tell: Callable[[Array], tuple[Array, Array]]) -> Steps:
    """Tells rows anew: rewarded, and over, where the task is then solved.

    They end there whatever `terminate_on_relabel` says: no row begins in a solved state, so the value of one is never learnt.

    Args:
      told: B rows of n steps, as they were lived.
      chosen: (B,) bool, the rows to tell anew; the others stay as they are.
      tell: observations (B, n + 1, D) -> what is seen in their place, and (B, n) bool, whether the task is solved after each step.
    """
    seen, solved = tell(jnp.concatenate([told.observation[:, None], told.next_observations], axis=1))
    solved &= chosen[:, None]
    return told.replace(
        observation=jnp.where(chosen[:, None], seen[:, 0], told.observation),
        next_observations=jnp.where(chosen[:, None, None], seen[:, 1:], told.next_observations),
        rewards=jnp.where(chosen[:, None], solved.astype(jnp.float32), told.rewards),
        terminated=told.terminated & ~chosen,  # where the task was solved in truth, the story may go on
        ends=told.ends | solved,
        by_hindsight=told.by_hindsight | chosen,
    )


def transitions(told: Steps, desired_goals: Array, *, is_relabelled: Array | bool, is_demonstration: bool, config: BatchConfig) -> Transition:
    """The n-step transitions of steps as they are told.

    A return ends after n steps, at the end of the episode, or where hindsight has the task end, whichever comes first.

    Args:
      told: B rows of n steps.
      desired_goals: (B, G).
      is_relabelled: (B,) bool, or one for all, notes which rows have a goal or a story of hindsight in place of their own.
      is_demonstration: marks the rows for the behaviour cloning loss.
      config: gamma, `timeouts_are_terminal` and `bound_by_obtained_return`.

    Returns:
      The batch. Where the return ended by termination the discount is 0, else gamma to the number of steps taken.
    """
    ends = told.ends | (told.is_last if config.timeouts_are_terminal else told.is_last & told.terminated[:, None])
    ended_before = jnp.cumsum(ends, axis=1) - ends > 0
    counted = told.inside & ~ended_before
    num_steps = jnp.sum(counted, axis=1)  # (B,), at least 1
    discounts = config.gamma ** jnp.arange(ends.shape[1], dtype=jnp.float32)
    last, size = (num_steps - 1)[:, None], num_steps.shape
    obtained = jnp.where(told.by_hindsight, 0.0, told.last_reward * config.gamma ** told.steps_left.astype(jnp.float32))
    return Transition(
        observation=told.observation,
        action=told.action,
        reward=jnp.sum(jnp.where(counted, told.rewards * discounts[None], 0.0), axis=1),
        discount=jnp.where(jnp.take_along_axis(ends, last, axis=1)[:, 0], 0.0, config.gamma**num_steps),
        next_observation=jnp.take_along_axis(told.next_observations, last[..., None], axis=1)[:, 0],
        desired_goal=desired_goals,
        is_demonstration=jnp.full(size, is_demonstration),
        is_relabelled=jnp.broadcast_to(is_relabelled, size),
        obtained_return=obtained if config.bound_by_obtained_return else None,
    )


def num_demo_rows(env_steps: Array, config: BatchConfig) -> Array:
    """Demonstration rows of a batch after `env_steps` environment steps: floor(max(r (1 - steps / reach_zero), 0) B) (thesis eq. 4.9)."""
    if config.reach_zero is None:
        return jnp.asarray(config.max_demo_rows)
    remaining = jnp.maximum(1.0 - env_steps / config.reach_zero, 0.0)
    return jnp.minimum(jnp.floor(config.max_demo_ratio * config.batch_size * remaining).astype(jnp.int32), config.max_demo_rows)


def _by_source(key: Array, num_rows: int, config: BatchConfig, draw: Callable[[Array, Source], Any]) -> Any:
    """For each row what draw(key, source), leaves (B, ...), has for it from the source that falls to it."""
    sources, weights = zip(*config.sources, strict=True)
    key_choice, *keys = jax.random.split(key, len(sources) + 1)
    choice = choose_sources(key_choice, num_rows, weights)
    drawn = draw(keys[0], sources[0])
    for index in range(1, len(sources)):
        drawn = tree_where(choice == index, draw(keys[index], sources[index]), drawn)
    return drawn


def _new_goals(
    key: Array, replay: ReplayState, rows: Array, steps: Array, table: GoalTable, *, achieved_goal: Callable[[Array], Array], config: BatchConfig
) -> tuple[Array, Array]:
    """(B, G) goals from the sources of the config, and (B,) whether there was one: only an intersection can be empty."""
    lengths, size = replay.episodes.lengths, rows.shape[0]

    def reached(rows: Array, steps: Array) -> Array:
        return achieved_goal(replay.episodes.observations[rows, steps])

    def goals_from(key: Array, source: Source) -> tuple[Array, Array]:
        always = jnp.ones(size, bool)
        key_row, key_step = jax.random.split(key)
        if source == "task_conditioned":
            return sample_goals(key_row, table, size), always
        if source == "random":
            others = sample_episodes(key_row, replay, size)
            return reached(others, hindsight_steps(key_step, jnp.zeros_like(others), lengths[others], source="episode")), always
        if source == "joint_intersection":
            nearby = replay.nearby_goals[rows]
            chosen, found = intersection_steps(key_step, steps, lengths[rows], nearby >= 0)
            if config.intersection_goals == "rollout":
                return reached(rows, chosen), found
            return table.goals[jnp.take_along_axis(nearby, chosen[:, None], axis=1)[:, 0]], found
        return reached(rows, hindsight_steps(key_step, steps, lengths[rows], source=source)), always

    return _by_source(key, size, config, goals_from)


def _new_subgoals(key: Array, replay: ReplayState, rows: Array, steps: Array, table: GoalTable, *, num_subgoals: int, config: BatchConfig) -> Array:
    """(B, J, D) observations of states from the sources of the config; those of the row's own episode come in the order in which it visited them.

    A story that needs fewer than J takes the first, so where few subgoals remain, those of "future" tend to be soon.
    """
    lengths, shape = replay.episodes.lengths, (rows.shape[0], num_subgoals)

    def states_from(key: Array, source: Source) -> Array:
        if source == "joint_intersection":
            raise ValueError("joint_intersection compares goals, and a retelling changes none")
        key_row, key_step = jax.random.split(key)
        if source == "task_conditioned":
            return table.observations[uniform_index(key_row, shape, table.count)]
        if source == "random":
            others = sample_episodes(key_row, replay, rows.shape[0] * num_subgoals).reshape(shape)
            chosen = hindsight_steps(key_step, jnp.zeros_like(others), lengths[others], source="episode")
            return replay.episodes.observations[others, chosen]
        own = jnp.broadcast_to(rows[:, None], shape)
        chosen = hindsight_steps(key_step, jnp.broadcast_to(steps[:, None], shape), lengths[own], source=source)
        return replay.episodes.observations[own, jnp.sort(chosen, axis=1)]

    return _by_source(key, rows.shape[0], config, states_from)


def _num_relabelled(num_replay_rows: Array, config: BatchConfig) -> Array:
    """Of the rows that come from the replay n / (n + 1), rounded down."""
    share = config.num_sampled_goals / (config.num_sampled_goals + 1)
    return jnp.floor(num_replay_rows * share + 1e-3).astype(jnp.int32)  # the margin is for float32's rounding


def _replay_rows(
    key: Array,
    replay: ReplayState,
    rows: Array,
    steps: Array,
    relabelled: Array,
    table: GoalTable,
    *,
    achieved_goal: Callable[[Array], Array],
    epsilon: Array,
    config: BatchConfig,
    retelling: Retelling | None,
) -> Transition:
    """Reads rows of the replay, those that are to be `relabelled` (B,) with goals of the config's sources as far as there are any, or retold."""
    told = read_steps(replay.episodes, rows, steps, config.n_step)
    goals, judged_by_goal = replay.episodes.desired_goals[rows], replay.judged_by_goal[rows]
    if config.sources and retelling is not None:
        key, key_telling = jax.random.split(key)
        keys = jax.random.split(key_telling, rows.shape[0])
        subgoals = _new_subgoals(key, replay, rows, steps, table, num_subgoals=retelling.num_subgoals, config=config)
        told = retell(told, relabelled, lambda observations: jax.vmap(retelling.retell)(keys, observations, subgoals))
        judged_by_goal &= ~relabelled
    elif config.sources:
        new_goals, found = _new_goals(key, replay, rows, steps, table, achieved_goal=achieved_goal, config=config)
        relabelled &= found
        goals = jnp.where(relabelled[:, None], new_goals, goals)
        judged_by_goal |= relabelled
    # A row of an episode that is judged by its behavioural goal is read as if that were a goal chosen in hindsight.
    told = judge_by_goals(told, judged_by_goal, goals, achieved_goal=achieved_goal, epsilon=epsilon, config=config)
    return transitions(told, goals, is_relabelled=relabelled, is_demonstration=False, config=config)


def demonstration_rows(demonstrations: Episodes, rows: Array, steps: Array, config: BatchConfig) -> Transition:
    """Reads rows of the demonstrations, which are never relabelled: rows and steps (B,) int32 -> the batch."""
    n_step = demonstrations.rewards.shape[1] if config.demo_returns == "monte_carlo" else config.n_step
    lived = read_steps(demonstrations, rows, steps, n_step)
    return transitions(lived, demonstrations.desired_goals[rows], is_relabelled=False, is_demonstration=True, config=config)


def sample_batch(
    key: Array,
    replay: ReplayState,
    demonstrations: Episodes,
    table: GoalTable,
    *,
    achieved_goal: Callable[[Array], Array],
    epsilon: Array,
    demo_rows: Array,
    config: BatchConfig,
    retelling: Retelling | None = None,
) -> Transition:
    """Draws the batch of one gradient step: demonstrations, then relabelled replay rows, then replay rows as they were lived.

    Of B rows, `demo_rows` come from the demonstrations; of the rest, n / (n + 1) (rounded down) are relabelled, or fewer where intersections are
    empty.

    Args:
      key: random key.
      replay: at least one complete episode.
      demonstrations: N episodes; drawn uniformly by episode, then by step, and never relabelled.
      table: demonstration goals, for the sources that need them.
      achieved_goal: projection of observations (..., D) to goals (..., G).
      epsilon: (G,) half-width of the goal box.
      demo_rows: () int32, see `num_demo_rows`.
      config: batch size, relabelled share, strategy, n-step.
      retelling: how hindsight is told where it changes observations in place of goals; the table then holds observations, too.

    Returns:
      A batch of `config.batch_size` rows in that order.
    """
    key_demo, key_demo_step, key_episode, key_step, key_goal = jax.random.split(key, 5)
    size, num_demos = config.batch_size, demonstrations.lengths.shape[0]
    rows = sample_episodes(key_episode, replay, size)
    steps = sample_steps(key_step, replay.episodes, rows)
    index = jnp.arange(size)
    relabelled = (index >= demo_rows) & (index < demo_rows + _num_relabelled(size - demo_rows, config))
    batch = _replay_rows(
        key_goal, replay, rows, steps, relabelled, table, achieved_goal=achieved_goal, epsilon=epsilon, config=config, retelling=retelling
    )
    if config.max_demo_rows == 0:
        return batch

    demo = uniform_index(key_demo, (config.max_demo_rows,), num_demos)
    demo_batch = demonstration_rows(demonstrations, demo, sample_steps(key_demo_step, demonstrations, demo), config)
    head = jax.tree.map(lambda leaf: leaf[: config.max_demo_rows], batch)
    head = tree_where(index[: config.max_demo_rows] < demo_rows, demo_batch, head)
    return jax.tree.map(lambda leaf, first: leaf.at[: config.max_demo_rows].set(first), batch, head)


def sample_prioritised_batch(
    key: Array,
    replay: ReplayState,
    demonstrations: Episodes,
    table: GoalTable,
    *,
    achieved_goal: Callable[[Array], Array],
    epsilon: Array,
    config: BatchConfig,
    retelling: Retelling | None = None,
) -> tuple[Transition, Drawn]:
    """Draws the batch of one gradient step by the priorities of the transitions, see `priorities`.

    Of the rows that happen to come from the replay, n / (n + 1) (rounded down) are relabelled, or fewer where intersections are empty.

    Args: as for `sample_batch`, the replay with its priorities.

    Returns:
      A batch of `config.batch_size` rows in no particular order, with weights, and where its rows come from.
    """
    key_draw, key_goal = jax.random.split(key)
    drawn = prioritised.draw(key_draw, replay.priorities, config.batch_size)
    # How many rows come from where is not known when this is compiled, so each is read from both tables, and one reading thrown away.
    replayed = ~drawn.is_demonstration
    relabelled = replayed & (jnp.cumsum(replayed) <= _num_relabelled(jnp.sum(replayed), config))  # the first of them: all are drawn alike
    from_replay = _replay_rows(
        key_goal, replay, drawn.rows, drawn.steps, relabelled, table, achieved_goal=achieved_goal, epsilon=epsilon, config=config, retelling=retelling
    )
    from_demonstrations = demonstration_rows(demonstrations, drawn.rows, drawn.steps, config)
    batch = tree_where(replayed, from_replay, from_demonstrations)
    return batch.replace(weight=prioritised.importance_weights(drawn, config)), drawn
