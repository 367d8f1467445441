"""A second policy, which imitates: the demonstrations first, then the best of its own episodes.

To `practise` is to play from the same starts several times, with noise on the actions, and to remember of each start the fastest episode that solved
the task. Cloned together with the demonstrations, these make a policy that solves more and sooner, which practises in its turn. That is expert
iteration (Anthony, Tian and Barber, thinking fast and slow with deep learning and tree search, 2017), with the best of several attempts in the place
of the search: no value has to be learnt, and what is imitated was seen to work.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct

from hindrl_jax.base.environments import Environment, Steppable
from hindrl_jax.base.types import Array, Episodes, Transition, tree_where
from hindrl_jax.config import TrainConfig
from hindrl_jax.core import agent as agents
from hindrl_jax.core import rollout
from hindrl_jax.core.agent import AgentState, Params
from hindrl_jax.core.batch import rows_of_demonstrations
from hindrl_jax.core.guidance import Guidance
from hindrl_jax.core.inputs import network_inputs
from hindrl_jax.core.networks import apply_actor
from hindrl_jax.core.randomness import uniform_index
from hindrl_jax.core.replay import empty_table, sample_steps
from hindrl_jax.core.rollout import Act
from hindrl_jax.core.train import TrainState, clone_from

NUM_PARTS = 3
"""Times at which the first clone is looked at: which is best differs by seed and task."""
NUM_STARTS = 32
"""Starts of a round of practice."""
NOISES = (0.0, 0.05, 0.05, 0.1, 0.1, 0.1, 0.1, 0.1)
"""Standard deviation of the noise on the actions, in [-1, 1], of each attempt at a start."""
_CLONING, _PRACTICE = 2**16, 2**17  # the random numbers here are none of those that a state's key gives when it is split


class Practice(struct.PyTreeNode, kw_only=True):
    """The best that the imitating policy has done in the latest round: of M starts, the fastest episode that solved the task."""

    episodes: Episodes  # M
    solved: Array  # (M,) bool, whether there is one
    num_rounds: Array  # () int32, rounds so far


class Attempts(struct.PyTreeNode, kw_only=True):
    """What became of the attempts of a round, K at each of M starts."""

    solved: Array  # (K, M) bool
    length: Array  # (K, M) int32, decisions taken
    delay: Array  # (K, M) int32, those of them that were not rewarded: how long the goal was not reached, or not held


def no_practice(env: Environment) -> Practice:
    """Before the first round."""
    episodes = empty_table(env, NUM_STARTS)
    episodes = episodes.replace(lengths=jnp.ones_like(episodes.lengths))  # steps can be drawn from them, and are not used
    return Practice(episodes=episodes, solved=jnp.zeros(NUM_STARTS, bool), num_rounds=jnp.zeros((), jnp.int32))


def imitate(state: TrainState, guidance: Guidance, practice: Practice, *, env: Environment, config: TrainConfig) -> tuple[TrainState, list[Params]]:
    """`imitation_steps` gradient steps of cloning, of the imitating policy; all else stays as it is.

    So does what follows, unless that policy proposes actions in it (`imitation_proposal`).

    Args:
      state: a run that has not begun to learn.
      guidance: of it; its demonstrations are cloned.
      practice: and so are the episodes that solved the task here.
      env, config: static.

    Returns:
      The new state, and the policy's parameters after each of `NUM_PARTS` equal parts of the steps, the last of which are the state's, too.
    """
    cloning = dataclasses.replace(config, agent=config.agent.for_imitation)
    demonstrations = _as_long_as(guidance.demonstrations, practice.episodes)
    examples = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), demonstrations, practice.episodes)
    start = state.replace(
        agent=agents.with_actor(state.agent, state.agent.imitation),
        key=jax.random.fold_in(state.key, _CLONING + practice.num_rounds),
        updates=jnp.zeros_like(state.updates),
    )

    def draw(key: Array) -> Transition:
        return _sample_examples(key, examples, practice.solved, env, cloning)

    def part(state: TrainState, _: None) -> tuple[TrainState, Params]:
        state, _metrics = clone_from(state, draw, env, cloning, -(-config.imitation_steps // NUM_PARTS))
        return state, state.agent.average_actor

    cloned, clones = jax.lax.scan(part, start, length=NUM_PARTS)
    parts = [jax.tree.map(lambda leaf, part=part: leaf[part], clones) for part in range(NUM_PARTS)]
    return state.replace(agent=state.agent.replace(imitation=cloned.agent.average_actor)), parts


def _as_long_as(demonstrations: Episodes, others: Episodes) -> Episodes:
    """Demonstrations that were cut by `misaligned_demo_actions`, padded again."""

    def padded(leaf: Array, other: Array) -> Array:
        return jnp.pad(leaf, [(0, 0), *((0, max(0, there - here)) for here, there in zip(leaf.shape[1:], other.shape[1:], strict=True))])

    return jax.tree.map(padded, demonstrations, others)


def _sample_examples(key: Array, examples: Episodes, solved: Array, env: Environment, config: TrainConfig) -> Transition:
    """A batch of rows of N + M episodes, the last M of which count only where `solved` (M,) says so: elsewhere a demonstration takes their place."""
    key_demo, key_step = jax.random.split(key)
    shape, num_examples = (config.batch.batch_size,), examples.lengths.shape[0]
    num_demos = num_examples - solved.shape[0]
    demo = uniform_index(key_demo, shape, num_demos)
    drawn = uniform_index(jax.random.fold_in(key, 2), shape, num_examples)  # 2: split has used what 0 and 1 give
    rows = jnp.where((drawn >= num_demos) & solved[drawn - num_demos], drawn, demo)
    return rows_of_demonstrations(examples, rows, sample_steps(key_step, examples, rows), env, config)


def practise(state: TrainState, guidance: Guidance, practice: Practice, *, env: Steppable, config: TrainConfig) -> tuple[Practice, Attempts]:
    """One round of practice: each of `NUM_STARTS` new starts is played from `len(NOISES)` times.

    Args:
      state: its imitating policy plays.
      guidance: says what goals the episodes have.
      practice: of the rounds before, which are forgotten.
      env, config: static.
    """
    key = jax.random.fold_in(jax.random.fold_in(state.key, _PRACTICE), practice.num_rounds)
    key_start, key_attempts = (jax.random.fold_in(key, index) for index in (0, 1))

    def attempt(best: Practice, given: tuple[Array, Array]) -> tuple[Practice, Attempts]:
        index, noise = given
        begun = rollout.reset(jax.random.clone(key_start), env, guidance.behavioural_goals, NUM_STARTS)  # the same for all
        episodes = rollout.play(jax.random.fold_in(key_attempts, index), env, begun, _noisy(state.agent, noise, env, config))
        return with_attempt(best, episodes)

    given = (jnp.arange(len(NOISES)), jnp.asarray(NOISES))
    return jax.lax.scan(attempt, no_practice(env).replace(num_rounds=practice.num_rounds + 1), given)


def _noisy(agent: AgentState, noise: Array, env: Environment, config: TrainConfig) -> Act:
    """The imitating policy with Gaussian noise on its actions."""

    def act(key: Array, observation: Array, desired_goal: Array) -> Array:
        inputs = network_inputs(observation, env.achieved_goal(observation), desired_goal, agent.scale, config)
        action = apply_actor(agent.imitation, inputs.T, config.agent.for_imitation, action_dim=env.action_dim).mode.T
        return jnp.clip(action + noise * jax.random.normal(key, action.shape), -1.0, 1.0)

    return act


def with_attempt(best: Practice, episodes: Episodes) -> tuple[Practice, Attempts]:
    """What is best after one more attempt at each start, and how that went; of equals the earlier one stays.

    Args:
      best: of the attempts before.
      episodes: M, from the same starts.
    """
    attempts = Attempts(solved=_is_solved(episodes), length=episodes.lengths, delay=_delay(episodes))
    better = attempts.solved & (~best.solved | (attempts.delay < _delay(best.episodes)))
    return best.replace(episodes=tree_where(better, episodes, best.episodes), solved=best.solved | attempts.solved), attempts


def _taken(episodes: Episodes) -> Array:
    """(M, T) bool, which steps are no padding."""
    return jnp.arange(episodes.rewards.shape[1])[None] < episodes.lengths[:, None]


def _is_solved(episodes: Episodes) -> Array:
    """(M,) bool, whether the last step was rewarded: the goal was reached, or where it is to be held, is held in the end."""
    return jnp.take_along_axis(episodes.rewards, episodes.lengths[:, None] - 1, axis=1)[:, 0] > 0.0


def _delay(episodes: Episodes) -> Array:
    """(M,) int32, steps without reward."""
    return jnp.sum(_taken(episodes) & (episodes.rewards <= 0.0), axis=1, dtype=jnp.int32)
