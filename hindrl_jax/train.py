"""Training as pure functions over one state: collect, learn (or clone), evaluate. The Python loop over jitted chunks is the caller's.

The chain relabel -> batch -> update is one program. The batches of an iteration are drawn together, in one read of the replay, before the scan
over its gradient steps.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from hindrl_jax import agent as agents
from hindrl_jax import goals, replay, rollout
from hindrl_jax.agent import AgentState, InputScale, Metrics
from hindrl_jax.config import TrainConfig
from hindrl_jax.errors import UserError
from hindrl_jax.goals import GoalTable
from hindrl_jax.randomness import uniform_index
from hindrl_jax.replay import ReplayState
from hindrl_jax.rollout import Act, Evaluation, RolloutState, StartTable
from hindrl_jax.types import Array, Environment, Episodes, Transition, action_to_env


@struct.dataclass(kw_only=True)
class Guidance:
    """What training takes from the demonstrations; constant during a run."""

    demonstrations: Episodes  # N episodes
    goals: GoalTable  # goals for task-conditioned relabelling, filtered or not
    behavioural_goals: GoalTable  # goals for rollouts
    epsilon: Array  # (G,) half-width of the goal box
    scale: InputScale  # typical size of the networks' inputs
    starts: StartTable | None  # demonstrated states in which training episodes may begin; None if none do


@struct.dataclass(kw_only=True)
class TrainState:
    """All that a run needs to go on."""

    agent: AgentState
    replay: ReplayState
    rollout: RolloutState
    key: Array
    env_steps: Array  # () int32
    updates: Array  # () int32


def guidance(demonstrations: Episodes, env: Environment, config: TrainConfig) -> Guidance:
    """Epsilon (thesis eq. 4.7), goal database, filter (algorithm 6) and behavioural goals (algorithm 5) from demonstrations (N, ...).

    Raises:
      UserError: if training episodes are to begin in demonstrated states, and the demonstrations come without their states.
    """
    starts = None
    if config.demo_reset_ratio > 0.0:
        if demonstrations.states is None:
            raise UserError(f"demo_reset_ratio = {config.demo_reset_ratio} needs the states of the demonstrations: give them, or set it to 0")
        starts = rollout.start_table(demonstrations.states, demonstrations.lengths)
    demonstrations = demonstrations.replace(states=None)
    goal_config, inclusive = config.goal, config.batch.inclusive_goal_test
    if goal_config.misalign_demo_actions:
        demonstrations = demonstrations.replace(
            observations=demonstrations.observations[:, 1:],
            actions=demonstrations.actions[:, :-1],
            rewards=demonstrations.rewards[:, 1:],
            lengths=demonstrations.lengths - 1,
        )
    if not goal_config.rescale_demo_actions:
        demonstrations = demonstrations.replace(actions=action_to_env(demonstrations.actions, env))
    achieved, lengths = env.achieved_goal(demonstrations.observations), demonstrations.lengths
    epsilon = goals.epsilon_from_demonstrations(achieved, lengths, m=goal_config.m, k=goal_config.k)
    if goal_config.behavioural_goals == "task":
        behavioural_goals = goals.constant_goal(env.task_goal())
        desired_goals = jnp.broadcast_to(behavioural_goals.goals, (lengths.shape[0], env.goal_dim))
    else:
        behavioural_goals = goals.final_goals(achieved, lengths)
        desired_goals = behavioural_goals.goals
    return Guidance(
        demonstrations=demonstrations.replace(desired_goals=desired_goals),
        goals=goals.goal_table(
            achieved,
            lengths,
            epsilon,
            filtered=goal_config.epsilon_filtering,
            exclude_last=goal_config.exclude_last_goal,
            inclusive=inclusive,
        ),
        behavioural_goals=behavioural_goals,
        epsilon=epsilon,
        scale=agents.input_scale(demonstrations.observations, achieved, goals.is_visited(lengths, achieved.shape[1]), config.agent),
        starts=starts,
    )


def init(key: Array, data: Guidance, env: Environment, config: TrainConfig) -> TrainState:
    """A fresh agent, an empty replay and `num_envs` episodes about to begin.

    Raises:
      UserError: if the replay is too small.
    """
    key_agent, key_rollout, key_train = jax.random.split(key, 3)
    dims = dict(observation_dim=env.observation_dim, goal_dim=env.goal_dim, action_dim=env.action_dim)
    smallest = 2 * config.num_envs * env.horizon
    return TrainState(
        agent=agents.init(key_agent, config.agent, **dims),
        replay=replay.init(num_envs=config.num_envs, capacity=smallest if config.algo == "bc" else config.buffer_size, horizon=env.horizon, **dims),
        rollout=_new_episodes(key_rollout, data, env, config),
        key=key_train,
        env_steps=jnp.asarray(0),
        updates=jnp.asarray(0),
    )


def _new_episodes(key: Array, data: Guidance, env: Environment, config: TrainConfig) -> RolloutState:
    goals, ratio = data.behavioural_goals, config.demo_reset_ratio
    return rollout.reset(key, env, goals, config.num_envs, starts=data.starts, demo_reset_ratio=ratio)


def warm_up_iterations(env: Environment, config: TrainConfig) -> int:
    """Steps of every environment before learning: `learning_starts` in all, and enough for a complete episode in each."""
    return max(-(-config.learning_starts // config.num_envs), env.horizon)


def make_policy(actor: Any, scale: InputScale, env: Environment, config: TrainConfig, *, stochastic: bool) -> Act:
    """The actor as a function of observations and goals: sampled actions, or the mean ones."""

    def act(key: Array, observation: Array, desired_goal: Array) -> Array:
        inputs = agents.network_inputs(observation, env.achieved_goal(observation), desired_goal, scale, config.agent)
        return agents.select_action(key, actor, inputs, config.agent, action_dim=env.action_dim, stochastic=stochastic)

    return act


def _interact(key: Array, state: TrainState, data: Guidance, env: Environment, config: TrainConfig, act: Act) -> TrainState:
    """One step of every environment, stored in the replay."""
    key_act, key_reset = jax.random.split(key)
    before = state.rollout
    action = act(key_act, before.observation, before.desired_goal)
    after, time_step = rollout.step(before, _new_episodes(key_reset, data, env, config), action, env)
    stored = replay.add(
        state.replay,
        observation=before.observation,
        desired_goal=before.desired_goal,
        action=action,
        reward=time_step.reward,
        next_observation=time_step.observation,
        terminated=time_step.terminated,
        truncated=time_step.truncated,
    )
    return state.replace(replay=stored, rollout=after, env_steps=state.env_steps + action.shape[0])


def collect(state: TrainState, data: Guidance, *, env: Environment, config: TrainConfig, num_iterations: int) -> TrainState:
    """Fills the replay by uniformly random actions: `num_iterations` steps of every environment."""

    def uniform(key: Array, observation: Array, desired_goal: Array) -> Array:
        return jax.random.uniform(key, (observation.shape[0], env.action_dim), minval=-1.0, maxval=1.0)

    def iteration(state: TrainState, _: None) -> tuple[TrainState, None]:
        key, key_interact = jax.random.split(state.key)
        return _interact(key_interact, state.replace(key=key), data, env, config, uniform), None

    return jax.lax.scan(iteration, state, length=num_iterations)[0]


def _network_inputs(batch: Transition, scale: InputScale, env: Environment, config: TrainConfig) -> dict[str, Array]:
    return {
        name: agents.network_inputs(observation, env.achieved_goal(observation), batch.desired_goal, scale, config.agent)
        for name, observation in (("inputs", batch.observation), ("next_inputs", batch.next_observation))
    }


def learn(state: TrainState, data: Guidance, *, env: Environment, config: TrainConfig, num_iterations: int) -> tuple[TrainState, Metrics]:
    """`num_iterations` times: one step of every environment, then `updates_per_iteration` gradient steps.

    Returns:
      The new state, and metrics averaged over the gradient steps.
    """

    def iteration(state: TrainState, _: None) -> tuple[TrainState, Metrics]:
        key, key_interact, key_batch, key_updates = jax.random.split(state.key, 4)
        act = make_policy(state.agent.actor, data.scale, env, config, stochastic=True)
        state = _interact(key_interact, state.replace(key=key), data, env, config, act)
        draw = functools.partial(
            replay.sample_batch,
            replay=state.replay,
            demonstrations=data.demonstrations,
            table=data.goals,
            achieved_goal=env.achieved_goal,
            epsilon=data.epsilon,
            demo_rows=replay.num_demo_rows(state.env_steps, config.batch),
            config=config.batch,
        )
        num_updates = config.updates_per_iteration
        batches = jax.vmap(draw)(jax.random.split(key_batch, num_updates))
        progress = jnp.minimum(state.env_steps / config.steps, 1.0)

        def gradient_step(carry: tuple[Array, AgentState], update: tuple[Array, Transition]) -> tuple[tuple[Array, AgentState], Metrics]:
            (key, agent), (index, batch) = carry, update
            key, key_update = jax.random.split(key)
            schedule = agents.schedule(progress, state.updates + index, config.agent, action_dim=env.action_dim)
            inputs = _network_inputs(batch, data.scale, env, config)
            agent, metrics = agents.update(key_update, agent, batch, **inputs, schedule=schedule, config=config.agent)
            return (key, agent), metrics

        (_, agent), metrics = jax.lax.scan(gradient_step, (key_updates, state.agent), (jnp.arange(num_updates), batches))
        return state.replace(agent=agent, updates=state.updates + num_updates), jax.tree.map(jnp.mean, metrics)

    state, metrics = jax.lax.scan(iteration, state, length=num_iterations)
    return state, jax.tree.map(jnp.mean, metrics)


def clone(state: TrainState, data: Guidance, *, env: Environment, config: TrainConfig, num_iterations: int) -> tuple[TrainState, Metrics]:
    """`num_iterations` gradient steps of behaviour cloning on demonstration batches; no environment is stepped."""
    size, num_demos = config.batch.batch_size, data.demonstrations.lengths.shape[0]

    def gradient_step(state: TrainState, _: None) -> tuple[TrainState, Metrics]:
        key, key_demo, key_step = jax.random.split(state.key, 3)
        rows = uniform_index(key_demo, (size,), num_demos)
        batch = replay.transitions(
            data.demonstrations,
            rows,
            replay.sample_steps(key_step, data.demonstrations, rows),
            achieved_goal=env.achieved_goal,
            new_goals=data.demonstrations.desired_goals[rows],
            relabelled=jnp.zeros(size, bool),
            epsilon=data.epsilon,
            is_demonstration=True,
            config=config.batch,
        )
        inputs = _network_inputs(batch, data.scale, env, config)["inputs"]
        schedule = agents.schedule(jnp.minimum(state.updates / config.steps, 1.0), state.updates, config.agent, action_dim=env.action_dim)
        agent, metrics = agents.update_bc(state.agent, batch, inputs=inputs, schedule=schedule, config=config.agent)
        return state.replace(agent=agent, key=key, updates=state.updates + 1), metrics

    state, metrics = jax.lax.scan(gradient_step, state, length=num_iterations)
    return state, jax.tree.map(jnp.mean, metrics)


def evaluate(
    key: Array, actor: Any, data: Guidance, *, env: Environment, config: TrainConfig, num_episodes: int, stochastic: bool = False
) -> Evaluation:
    """Plays fresh episodes with the actor, see `rollout.evaluate`."""
    act = make_policy(actor, data.scale, env, config, stochastic=stochastic)
    return rollout.evaluate(key, env, data.behavioural_goals, act, num_episodes)
