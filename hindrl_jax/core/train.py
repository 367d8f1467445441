"""Training as pure functions over one state: collect, learn (or clone), evaluate. The Python loop over jitted chunks is the caller's.

The chain relabel -> batch -> update is one program. The batches of an iteration are drawn together, in one read of the replay, before the scan
over its gradient steps.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from hindrl_jax.base.environments import Environment, RetellableEnvironment, action_to_env
from hindrl_jax.base.errors import UserError
from hindrl_jax.base.types import Array, Episodes, TimeStep, Transition, tree_where
from hindrl_jax.config import TrainConfig, linear_schedule
from hindrl_jax.core import agent as agents
from hindrl_jax.core import goals, priorities, replay, rollout
from hindrl_jax.core.agent import AgentState, InputScale, Metrics
from hindrl_jax.core.goals import GoalTable
from hindrl_jax.core.hindsight import hindsight_steps
from hindrl_jax.core.priorities import Drawn
from hindrl_jax.core.randomness import uniform_index
from hindrl_jax.core.replay import ReplayState
from hindrl_jax.core.rollout import Act, Evaluation, RolloutState, StartTable


class Guidance(struct.PyTreeNode, kw_only=True):
    """What training takes from the demonstrations; constant during a run."""

    demonstrations: Episodes  # N episodes
    goals: GoalTable  # goals for task-conditioned relabelling, filtered or not
    behavioural_goals: GoalTable  # goals for rollouts
    epsilon: Array  # (G,) half-width of the goal box
    scale: InputScale  # typical size of the networks' inputs
    starts: StartTable | None  # demonstrated states in which training episodes may begin; None if none do


class TrainState(struct.PyTreeNode, kw_only=True):
    """All that a run needs to go on."""

    agent: AgentState
    replay: ReplayState
    rollout: RolloutState
    key: Array
    env_steps: Array  # () int32
    updates: Array  # () int32
    resets: Array  # () int32 times that the agent began anew
    updates_at_reset: Array  # () int32 updates when it last did, or 0


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
    if goal_config.epsilon is None:
        epsilon = goals.epsilon_from_demonstrations(achieved, lengths, m=goal_config.m, k=goal_config.k)
    else:
        epsilon = jnp.full(env.goal_dim, goal_config.epsilon)
    if goal_config.behavioural_goals == "environment":
        desired_goals = demonstrations.desired_goals
        behavioural_goals = GoalTable(goals=desired_goals, count=jnp.asarray(desired_goals.shape[0]))
    elif goal_config.behavioural_goals == "task":
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
            observations=demonstrations.observations if isinstance(env, RetellableEnvironment) else None,
        ),
        behavioural_goals=behavioural_goals,
        epsilon=epsilon,
        scale=agents.input_scale(demonstrations.observations, achieved, goals.is_visited(lengths, achieved.shape[1]), config.agent),
        starts=starts,
    )


def init(key: Array, data: Guidance, env: Environment, config: TrainConfig, *, begun: RolloutState | None = None) -> TrainState:
    """A fresh agent, an empty replay and `num_envs` episodes about to begin.

    Args:
      key, data, env, config: see the module's other functions.
      begun: the episodes, where they have begun outside JAX.

    Raises:
      UserError: if the replay is too small.
    """
    key_agent, key_rollout, key_train = jax.random.split(key, 3)
    dims = _dims(env)
    smallest = 2 * config.num_envs * env.horizon
    empty = replay.init(
        num_envs=config.num_envs,
        capacity=smallest if config.algo == "bc" else config.buffer_size,
        horizon=env.horizon,
        keep_nearby_goals=config.batch.uses_intersections,
        **dims,
    )
    if config.batch.has_priorities:
        empty = empty.replace(priorities=priorities.init(data.demonstrations, empty.episodes, config.batch))
    return TrainState(
        agent=agents.init(key_agent, config.agent, **dims),
        replay=empty,
        rollout=_new_episodes(key_rollout, data, env, config, 0.0) if begun is None else begun,
        key=key_train,
        env_steps=jnp.asarray(0),
        updates=jnp.asarray(0),
        resets=jnp.asarray(0),
        updates_at_reset=jnp.asarray(0),
    )


def _dims(env: Environment) -> dict[str, int]:
    return dict(observation_dim=env.observation_dim, goal_dim=env.goal_dim, action_dim=env.action_dim)


def _new_episodes(key: Array, data: Guidance, env: Environment, config: TrainConfig, progress: Array | float) -> RolloutState:
    share = jnp.minimum(progress / config.demo_reset_curriculum, 1.0) if config.demo_reset_curriculum > 0.0 else 1.0
    starts: dict[str, Any] = dict(starts=data.starts, demo_reset_ratio=config.demo_reset_ratio, demo_reset_share=share)
    return rollout.reset(key, env, data.behavioural_goals, config.num_envs, **starts)


def _with_achieved_goals(
    key: Array, episodes: RolloutState, past: ReplayState, env: Environment, config: TrainConfig, progress: Array
) -> RolloutState:
    """New episodes, a share of which are given a goal from the replay and are judged by it; none before the replay holds an episode."""
    key_choice, key_row, key_step = jax.random.split(key, 3)
    num_envs = config.num_envs
    share = linear_schedule(config.goal.achieved_goal_ratio, config.goal.final_achieved_goal_ratio, progress)
    rows = replay.sample_episodes(key_row, past, num_envs)
    steps = hindsight_steps(key_step, jnp.zeros_like(rows), past.episodes.lengths[rows], source="episode")
    chosen = jax.random.bernoulli(key_choice, share, (num_envs,)) & (jnp.sum(past.num_complete) > 0)
    achieved = env.achieved_goal(past.episodes.observations[rows, steps])
    return episodes.replace(desired_goal=jnp.where(chosen[:, None], achieved, episodes.desired_goal), judged_by_goal=chosen)


def _progress(state: TrainState, config: TrainConfig) -> Array:
    """() share of the run that is over."""
    return jnp.minimum(state.env_steps / config.steps, 1.0)


def _agent_schedule(state: TrainState, config: TrainConfig, updates: Array, env: Environment) -> agents.Schedule:
    """What holds for the agent at that number of updates: its schedules span the time between two resets."""
    progress = _progress(state, config)
    if config.agent_resets:
        begins, ends = (jnp.asarray(shares)[state.resets] for shares in ((0.0, *config.agent_resets), (*config.agent_resets, 1.0)))
        progress = jnp.clip((progress - begins) / (ends - begins), 0.0, 1.0)
    return agents.schedule(progress, updates - state.updates_at_reset, config.agent, action_dim=env.action_dim)


def _reset_agent_if_due(state: TrainState, env: Environment, config: TrainConfig) -> TrainState:
    """The agent begins anew, and all else stays, at the first call after each share of the run in `agent_resets`."""
    if not config.agent_resets:
        return state
    passed = jnp.sum(_progress(state, config) >= jnp.asarray(config.agent_resets))
    key, key_agent = jax.random.split(state.key)
    due, anew = passed > state.resets, agents.init(key_agent, config.agent, **_dims(env))
    return state.replace(
        agent=tree_where(due, anew, state.agent),
        key=key,
        resets=passed,
        updates_at_reset=jnp.where(due, state.updates, state.updates_at_reset),
    )


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
    key_act, key_reset, key_goals, key_nearby, key_cut = jax.random.split(key, 5)
    before = state.rollout
    action = act(key_act, before.observation, before.desired_goal)
    restarted = _new_episodes(key_reset, data, env, config, _progress(state, config))
    cut = None
    if config.random_truncation > 0.0:
        cut = jax.random.bernoulli(key_cut, config.random_truncation, (config.num_envs,))
    after, time_step = rollout.step(before, restarted, action, env, cut=cut)
    return remember(key_goals, key_nearby, state, action, time_step, after, data, env, config)


def remember(
    key_goals: Array,
    key_nearby: Array,
    state: TrainState,
    action: Array,
    time_step: TimeStep,
    after: RolloutState,
    data: Guidance,
    env: Environment,
    config: TrainConfig,
) -> TrainState:
    """Stores one step of every environment in the replay.

    Args:
      key_goals, key_nearby: random keys.
      state: before the step.
      action: (E, A) in [-1, 1], what was done there.
      time_step: (E, ...) what came of it, its observation the true next one.
      after: where the environments are now: in a new episode, those whose episode has ended.
      data, env, config: the run's; of the environment, only what goals and actions are.
    """
    before, progress = state.rollout, _progress(state, config)
    nearby_goal = None
    if config.batch.uses_intersections:
        achieved, inclusive = env.achieved_goal(time_step.observation), config.batch.inclusive_goal_test
        nearby_goal = goals.nearby_goal(key_nearby, data.goals, achieved, data.epsilon, inclusive=inclusive)
    stored = replay.add(
        state.replay,
        observation=before.observation,
        desired_goal=before.desired_goal,
        action=action,
        reward=time_step.reward,
        next_observation=time_step.observation,
        terminated=time_step.terminated,
        truncated=time_step.truncated,
        judged_by_goal=before.judged_by_goal,
        nearby_goal=nearby_goal,
    )
    if config.goal.has_achieved_goals:  # read from what is stored by now: of the replay as it was, a copy would have to be kept
        begun = _with_achieved_goals(key_goals, after, stored, env, config, progress)
        after = tree_where(time_step.terminated | time_step.truncated, begun, after)
    return state.replace(replay=stored, rollout=after, env_steps=state.env_steps + action.shape[0])


def act_at_random(env: Environment) -> Act:
    """Uniformly random actions."""

    def act(key: Array, observation: Array, desired_goal: Array) -> Array:
        return jax.random.uniform(key, (observation.shape[0], env.action_dim), minval=-1.0, maxval=1.0)

    return act


def collect(state: TrainState, data: Guidance, *, env: Environment, config: TrainConfig, num_iterations: int) -> TrainState:
    """Fills the replay by uniformly random actions: `num_iterations` steps of every environment."""

    def iteration(state: TrainState, _: None) -> tuple[TrainState, None]:
        key, key_interact = jax.random.split(state.key)
        return _interact(key_interact, state.replace(key=key), data, env, config, act_at_random(env)), None

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
        return improve(key_batch, key_updates, state, data, env, config)

    state, metrics = jax.lax.scan(iteration, _reset_agent_if_due(state, env, config), length=num_iterations)
    return state, jax.tree.map(jnp.mean, metrics)


def improve(
    key_batch: Array, key_updates: Array, state: TrainState, data: Guidance, env: Environment, config: TrainConfig
) -> tuple[TrainState, Metrics]:
    """`updates_per_iteration` gradient steps on batches drawn from the replay and the demonstrations, and their mean metrics."""
    given: dict[str, Any] = dict(
        replay=state.replay,
        demonstrations=data.demonstrations,
        table=data.goals,
        achieved_goal=env.achieved_goal,
        epsilon=data.epsilon,
        config=config.batch,
        retelling=replay.Retelling(env.retell, env.num_subgoals) if isinstance(env, RetellableEnvironment) else None,
    )
    if config.batch.has_priorities:
        key_batch, key_errors = jax.random.split(key_batch)
        keys = jax.random.split(key_batch, config.updates_per_iteration)
        batches, drawn = jax.vmap(lambda key: replay.sample_prioritised_batch(key, **given))(keys)
        state, metrics = _gradient_steps(key_updates, state, batches, data, env, config)
        return _with_new_priorities(key_errors, state, batches, drawn, data, env, config), metrics
    demo_rows = replay.num_demo_rows(state.env_steps, config.batch)
    keys = jax.random.split(key_batch, config.updates_per_iteration)
    batches = jax.vmap(lambda key: replay.sample_batch(key, demo_rows=demo_rows, **given))(keys)
    return _gradient_steps(key_updates, state, batches, data, env, config)


def _gradient_steps(
    key: Array, state: TrainState, batches: Transition, data: Guidance, env: Environment, config: TrainConfig
) -> tuple[TrainState, Metrics]:
    """One gradient step for each of the batches, leaves (number, B, ...), and their mean metrics."""
    num_updates = batches.reward.shape[0]

    def gradient_step(carry: tuple[Array, AgentState], update: tuple[Array, Transition]) -> tuple[tuple[Array, AgentState], Metrics]:
        (key, agent), (index, batch) = carry, update
        key, key_update = jax.random.split(key)
        schedule = _agent_schedule(state, config, state.updates + index, env)
        inputs = _network_inputs(batch, data.scale, env, config)
        agent, metrics = agents.update(key_update, agent, batch, **inputs, schedule=schedule, config=config.agent)
        shares = {"batch/relabelled": jnp.mean(batch.is_relabelled), "batch/demonstrations": jnp.mean(batch.is_demonstration)}
        return (key, agent), {**metrics, **shares}

    (_, agent), metrics = jax.lax.scan(gradient_step, (key, state.agent), (jnp.arange(num_updates), batches))
    return state.replace(agent=agent, updates=state.updates + num_updates), jax.tree.map(jnp.mean, metrics)


def _with_new_priorities(
    key: Array, state: TrainState, batches: Transition, drawn: Drawn, data: Guidance, env: Environment, config: TrainConfig
) -> TrainState:
    """The drawn transitions, leaves (number, B, ...), get the priorities of their errors after the gradient steps."""

    def errors_of(key: Array, batch: Transition) -> tuple[Array, Array]:
        key, key_error = jax.random.split(key)
        inputs = _network_inputs(batch, data.scale, env, config)
        return key, agents.td_error(key_error, state.agent, batch, **inputs, config=config.agent)

    _, errors = jax.lax.scan(errors_of, key, batches)
    renewed = priorities.assign(state.replay.priorities, drawn, errors, config.batch)
    return state.replace(replay=state.replay.replace(priorities=renewed))


def _demonstration_batch(key: Array, data: Guidance, config: TrainConfig) -> Transition:
    """A batch of demonstration rows alone."""
    key_demo, key_step = jax.random.split(key)
    rows = uniform_index(key_demo, (config.batch.batch_size,), data.demonstrations.lengths.shape[0])
    steps = replay.sample_steps(key_step, data.demonstrations, rows)
    return replay.demonstration_rows(data.demonstrations, rows, steps, config.batch)


def clone(state: TrainState, data: Guidance, *, env: Environment, config: TrainConfig, num_iterations: int) -> tuple[TrainState, Metrics]:
    """`num_iterations` gradient steps of behaviour cloning on demonstration batches; no environment is stepped."""

    def gradient_step(state: TrainState, _: None) -> tuple[TrainState, Metrics]:
        key, key_batch = jax.random.split(state.key)
        batch = _demonstration_batch(key_batch, data, config)
        inputs = _network_inputs(batch, data.scale, env, config)["inputs"]
        progress = jnp.minimum(state.updates / config.steps, 1.0) if config.algo == "bc" else 0.0
        schedule = agents.schedule(progress, state.updates, config.agent, action_dim=env.action_dim)
        agent, metrics = agents.update_bc(state.agent, batch, inputs=inputs, schedule=schedule, config=config.agent)
        return state.replace(agent=agent, key=key, updates=state.updates + 1), metrics

    state, metrics = jax.lax.scan(gradient_step, state, length=num_iterations)
    return state, jax.tree.map(jnp.mean, metrics)


def pretrain(state: TrainState, data: Guidance, *, env: Environment, config: TrainConfig) -> TrainState:
    """`bc_warm_start` gradient steps of cloning, then `pretrain_updates` of the whole agent on demonstrations alone."""

    def gradient_step(state: TrainState, _: None) -> tuple[TrainState, None]:
        key, key_batch, key_update = jax.random.split(state.key, 3)
        batch = _demonstration_batch(key_batch, data, config)
        batches = jax.tree.map(lambda leaf: leaf[None], batch)
        return _gradient_steps(key_update, state.replace(key=key), batches, data, env, config)[0], None

    if config.bc_warm_start > 0:
        state, _ = clone(state, data, env=env, config=config, num_iterations=config.bc_warm_start)
    return jax.lax.scan(gradient_step, state, length=config.pretrain_updates)[0] if config.pretrain_updates > 0 else state


def evaluate(
    key: Array, actor: Any, data: Guidance, *, env: Environment, config: TrainConfig, num_episodes: int, stochastic: bool = False
) -> Evaluation:
    """Plays fresh episodes with the actor, see `rollout.evaluate`."""
    act = make_policy(actor, data.scale, env, config, stochastic=stochastic)
    return rollout.evaluate(key, env, data.behavioural_goals, act, num_episodes)
