"""What training takes from the demonstrations: epsilon, goals to relabel with, goals for rollouts, states to begin in."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from hindrl_jax.base.environments import Environment, action_to_env
from hindrl_jax.base.errors import UserError
from hindrl_jax.base.types import Array, Episodes
from hindrl_jax.config import TrainConfig
from hindrl_jax.core import goals
from hindrl_jax.core.goals import GoalTable
from hindrl_jax.core.inputs import InputScale, input_scale, seen_goal
from hindrl_jax.core.rollout import StartTable


class Guidance(struct.PyTreeNode, kw_only=True):
    """What training takes from the demonstrations; constant during a run."""

    demonstrations: Episodes  # N episodes
    goals: GoalTable  # goals for task-conditioned relabelling, filtered or not
    behavioural_goals: GoalTable  # goals for rollouts
    epsilon: Array  # (G,) half-width of the goal box
    scale: InputScale  # typical size of the networks' inputs
    starts: StartTable | None  # demonstrated states in which training episodes may begin; None if none do


def guidance(demonstrations: Episodes, env: Environment, config: TrainConfig) -> Guidance:
    """Epsilon (thesis eq. 4.7), goal database, filter (algorithm 6) and behavioural goals (algorithm 5) from demonstrations (N, ...).

    Raises:
      UserError: if training episodes are to begin in demonstrated states, and the demonstrations come without their states.
    """
    starts = None
    if config.demo_reset_ratio > 0.0:
        if demonstrations.states is None:
            raise UserError(f"demo_reset_ratio = {config.demo_reset_ratio} needs the states of the demonstrations: give them, or set it to 0")
        starts = StartTable(states=demonstrations.states, lengths=demonstrations.lengths)
    demonstrations = _with_quirks(demonstrations.replace(states=None), env, config)
    observations, lengths = demonstrations.observations, demonstrations.lengths
    achieved = env.achieved_goal(observations)
    if config.goal.epsilon is None:
        epsilon = goals.epsilon_from_demonstrations(achieved, lengths, steps=config.goal.epsilon_steps, deviations=config.goal.epsilon_deviations)
    else:
        epsilon = jnp.full(env.goal_dim, config.goal.epsilon)
    behavioural_goals, desired_goals = _behavioural_goals(demonstrations, achieved, env, config)
    seen = seen_goal(achieved, desired_goals[:, None], config) if config.relative_goals else achieved
    keep = goals.is_visited(lengths, achieved.shape[1])
    if config.goal.epsilon_filtering:
        keep &= jax.vmap(lambda path: goals.epsilon_filter(path, epsilon))(achieved)
    if config.quirks.exclude_last_goal:
        keep = jax.vmap(goals.without_last)(keep)
    return Guidance(
        demonstrations=demonstrations.replace(desired_goals=desired_goals),
        goals=goals.goal_table(observations, achieved, keep),
        behavioural_goals=behavioural_goals,
        epsilon=epsilon,
        scale=input_scale(observations, seen, goals.is_visited(lengths, achieved.shape[1]), config.agent),
        starts=starts,
    )


def _behavioural_goals(demonstrations: Episodes, achieved: Array, env: Environment, config: TrainConfig) -> tuple[GoalTable, Array]:
    """The goals of rollouts, and (N, G) the goals that rows of the demonstrations are given in place of the recorded ones."""
    if config.own_goals:
        desired_goals = demonstrations.desired_goals
        return GoalTable(goals=desired_goals, count=jnp.asarray(desired_goals.shape[0])), desired_goals
    table = goals.final_goals(achieved, demonstrations.lengths)
    if config.goal.behavioural_goals == "task":
        known = env.task_goal()
        table = goals.constant_goal(jnp.mean(table.goals, axis=0) if known is None else known)
    return table, jnp.broadcast_to(table.goals, (demonstrations.lengths.shape[0], env.goal_dim))


def _with_quirks(demonstrations: Episodes, env: Environment, config: TrainConfig) -> Episodes:
    """The demonstrations as the original code pairs and scales them, if it is to be followed in that."""
    if config.quirks.misaligned_demo_actions:
        demonstrations = demonstrations.replace(
            observations=demonstrations.observations[:, 1:],
            actions=demonstrations.actions[:, :-1],
            rewards=demonstrations.rewards[:, 1:],
            lengths=demonstrations.lengths - 1,
        )
    if config.quirks.unscaled_demo_actions:
        demonstrations = demonstrations.replace(actions=action_to_env(demonstrations.actions, env))
    return demonstrations
