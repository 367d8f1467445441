"""Training as pure functions over one state: collect, learn (or clone), evaluate. The Python loop over jitted chunks is the caller's.

The chain relabel -> batch -> update is one program. The batches of an iteration are drawn together, in one read of the replay, before the scan
over its gradient steps.
"""

from __future__ import annotations

from typing import cast

import jax
import jax.numpy as jnp
from flax import struct

from hindrl_jax.base.environments import Environment, Steppable
from hindrl_jax.base.types import Array, TimeStep, Transition, tree_where
from hindrl_jax.config import TrainConfig
from hindrl_jax.core import agent as agents
from hindrl_jax.core import curriculum, replay, rollout
from hindrl_jax.core.agent import AgentState, Metrics, Policy
from hindrl_jax.core.batch import REWARDED_BY_GOAL, goal_test, sample_batch, sample_demonstrations
from hindrl_jax.core.curriculum import Curriculum
from hindrl_jax.core.goals import nearby_goal
from hindrl_jax.core.guidance import Guidance
from hindrl_jax.core.hindsight import NEARBY_GOAL, hindsight_steps
from hindrl_jax.core.inputs import network_inputs
from hindrl_jax.core.replay import RecordedStep, ReplayState
from hindrl_jax.core.rollout import Act, DemoResets, Evaluation, RolloutState
from hindrl_jax.core.schedules import Schedule, schedule


class TrainState(struct.PyTreeNode, kw_only=True):
    """All that a run needs to go on."""

    agent: AgentState
    replay: ReplayState
    rollout: RolloutState
    curriculum: Curriculum | None = None  # how far back in the demonstrations episodes begin; None without `demo_reset_curriculum`
    key: Array
    env_steps: Array  # () int32
    updates: Array  # () int32
    resets: Array  # () int32 times that the agent was reset
    updates_at_reset: Array  # () int32 updates when it last did, or 0


def init(key: Array, guidance: Guidance, env: Environment, config: TrainConfig, *, begun: RolloutState | None = None) -> TrainState:
    """A fresh agent, an empty replay and `num_envs` episodes about to begin.

    Args:
      key: random key.
      guidance: from `guidance.guidance`.
      env, config: static.
      begun: the episodes, where they have begun outside JAX.

    Raises:
      UserError: if the replay is too small.
    """
    key_agent, key_rollout, key_train = jax.random.split(key, 3)
    capacity = config.buffer_size if config.learns_from_rollouts else 2 * config.num_envs * env.horizon  # the smallest one
    notes: dict[str, int] = {NEARBY_GOAL: -1} if config.batch.uses_intersections else {}
    notes |= {REWARDED_BY_GOAL: False} if config.goal.has_achieved_goals else {}
    begins = curriculum.init(guidance.starts.lengths) if config.demo_reset_curriculum else None
    if begun is None:
        begun = _new_episodes(key_rollout, guidance, cast(Steppable, env), config, begins)
    return TrainState(
        agent=agents.init(key_agent, guidance.scale, config, action_dim=env.action_dim),
        replay=replay.init(env, num_envs=config.num_envs, capacity=capacity, notes=notes),
        rollout=_with_notes(begun, config),
        curriculum=begins,
        key=key_train,
        env_steps=jnp.zeros((), jnp.int32),
        updates=jnp.zeros((), jnp.int32),
        resets=jnp.zeros((), jnp.int32),
        updates_at_reset=jnp.zeros((), jnp.int32),
    )


def _new_episodes(key: Array, guidance: Guidance, env: Steppable, config: TrainConfig, begins: Curriculum | None) -> RolloutState:
    demo_resets = None
    if guidance.starts is not None:
        demo_resets = DemoResets(starts=guidance.starts, ratio=config.demo_reset_ratio, curriculum=begins)
    return rollout.reset(key, env, guidance.behavioural_goals, config.num_envs, demo_resets)


def _with_notes(episodes: RolloutState, config: TrainConfig) -> RolloutState:
    """New episodes, which are rewarded by the environment, with what is noted of them."""
    return episodes.replace(notes={REWARDED_BY_GOAL: jnp.zeros(config.num_envs, bool)} if config.goal.has_achieved_goals else {})


def _with_achieved_goals(key: Array, episodes: RolloutState, state: TrainState, env: Environment, config: TrainConfig) -> RolloutState:
    """New episodes, a share of which are given a goal from the replay and are judged by it; none before the replay holds an episode."""
    key_choice, key_row, key_step = jax.random.split(key, 3)
    past, num_envs = state.replay, config.num_envs
    rows = replay.sample_episodes(key_row, past, num_envs)
    steps = hindsight_steps(key_step, jnp.zeros_like(rows), past.episodes.lengths[rows], source="episode")
    chosen = jax.random.bernoulli(key_choice, config.goal.achieved_goal_ratio, (num_envs,)) & (jnp.sum(past.num_complete) > 0)
    achieved = env.achieved_goal(past.episodes.observations[rows, steps])
    return episodes.replace(desired_goal=jnp.where(chosen[:, None], achieved, episodes.desired_goal), notes={REWARDED_BY_GOAL: chosen})


def _progress(state: TrainState, config: TrainConfig) -> Array:
    """() share of the run that is over."""
    return jnp.minimum(state.env_steps / config.num_steps, 1.0)


def _agent_schedule(state: TrainState, updates: Array, env: Environment, config: TrainConfig) -> Schedule:
    """What holds for the agent at that number of updates: its schedules span the time between two resets."""
    progress = _progress(state, config)
    if config.agent_resets:
        begins, ends = (jnp.asarray(shares)[state.resets] for shares in ((0.0, *config.agent_resets), (*config.agent_resets, 1.0)))
        progress = jnp.clip((progress - begins) / (ends - begins), 0.0, 1.0)
    return schedule(progress, updates - state.updates_at_reset, config.agent, action_dim=env.action_dim)


def _reset_agent_if_due(state: TrainState, env: Environment, config: TrainConfig) -> TrainState:
    """The agent is reset, and all else stays, at the first call after each share of the run in `agent_resets`."""
    if not config.agent_resets:
        return state
    passed = jnp.sum(_progress(state, config) >= jnp.asarray(config.agent_resets))
    key, key_agent = jax.random.split(state.key)
    due, anew = passed > state.resets, agents.init(key_agent, state.agent.scale, config, action_dim=env.action_dim)
    return state.replace(
        agent=tree_where(due, anew.replace(imitation=state.agent.imitation), state.agent),
        key=key,
        resets=passed,
        updates_at_reset=jnp.where(due, state.updates, state.updates_at_reset),
    )


def warm_up_iterations(env: Environment, config: TrainConfig) -> int:
    """Decisions in every environment before learning: `learning_starts` in all, and enough for a complete episode in each."""
    return max(-(-config.learning_starts // config.steps_per_iteration), env.horizon)


def make_policy(policy: Policy, env: Environment, config: TrainConfig) -> Act:
    """The policy as a function of observations and goals."""

    def act(key: Array, observation: Array, desired_goal: Array) -> Array:
        inputs = network_inputs(observation, env.achieved_goal(observation), desired_goal, policy.scale, config)
        return agents.select_action(key, policy, inputs, config, action_dim=env.action_dim)

    return act


def act_at_random(env: Environment) -> Act:
    """Uniformly random actions."""

    def act(key: Array, observation: Array, desired_goal: Array) -> Array:
        return jax.random.uniform(key, (observation.shape[0], env.action_dim), minval=-1.0, maxval=1.0)

    return act


def _interact(key: Array, state: TrainState, guidance: Guidance, env: Steppable, config: TrainConfig, act: Act) -> TrainState:
    """One step of every environment, stored in the replay."""
    key_act, key_reset, key_goals, key_nearby = jax.random.split(key, 4)
    before = state.rollout
    action = act(key_act, before.observation, before.desired_goal)
    begun = _with_notes(_new_episodes(key_reset, guidance, env, config, state.curriculum), config)
    after, time_step = rollout.step(before, begun, action, env)
    if state.curriculum is not None:
        ended = time_step.terminated | time_step.truncated
        state = state.replace(curriculum=curriculum.record(state.curriculum, before.origin, ended, time_step.reward > 0.0))
    state = record(key_nearby, state, (action, time_step), guidance, env, config)
    return continue_from(key_goals, state, after, time_step, env, config)


def record(key: Array, state: TrainState, taken: tuple[Array, TimeStep], guidance: Guidance, env: Environment, config: TrainConfig) -> TrainState:
    """Stores one step of every environment in the replay.

    Args:
      key: random key.
      state: before the step.
      taken: the actions (E, A) in [-1, 1], and the time steps (E, ...) that came of them, their observations the true next ones.
      guidance, env, config: the run's; of the environment, only what goals and actions are.

    Returns:
      The state, whose episodes are still those of before the step, see `continue_from`.
    """
    before, (action, time_step) = state.rollout, taken
    notes = dict(before.notes)
    if config.batch.uses_intersections:
        notes[NEARBY_GOAL] = nearby_goal(key, guidance.goals, time_step.observation, goal_test(guidance, env, config))
    recorded = RecordedStep(
        observation=before.observation,
        desired_goal=before.desired_goal,
        action=action,
        reward=time_step.reward,
        next_observation=time_step.observation,
        terminated=time_step.terminated,
        truncated=time_step.truncated,
        notes=notes,
    )
    return state.replace(replay=replay.add(state.replay, recorded))


def continue_from(key: Array, state: TrainState, after: RolloutState, time_step: TimeStep, env: Environment, config: TrainConfig) -> TrainState:
    """Goes on from where the environments are after a recorded step: in a new episode, those whose episode has ended."""
    if config.goal.has_achieved_goals:  # read after storing, so that the old replay can be donated
        begun = _with_achieved_goals(key, after, state, env, config)
        after = tree_where(time_step.terminated | time_step.truncated, begun, after)
    return state.replace(rollout=after, env_steps=state.env_steps + config.steps_per_iteration)


def collect(state: TrainState, guidance: Guidance, *, env: Steppable, config: TrainConfig, num_iterations: int) -> TrainState:
    """Fills the replay by uniformly random actions: `num_iterations` steps of every environment."""

    def iteration(state: TrainState, _: None) -> tuple[TrainState, None]:
        key, key_interact = jax.random.split(state.key)
        return _interact(key_interact, state.replace(key=key), guidance, env, config, act_at_random(env)), None

    return jax.lax.scan(iteration, state, length=num_iterations)[0]


def learn(state: TrainState, guidance: Guidance, *, env: Steppable, config: TrainConfig, num_iterations: int) -> tuple[TrainState, Metrics]:
    """`num_iterations` times: one step of every environment, then `num_updates` gradient steps.

    Returns:
      The new state, and metrics averaged over the gradient steps.
    """

    def iteration(state: TrainState, _: None) -> tuple[TrainState, Metrics]:
        key, key_interact, key_batch, key_updates = jax.random.split(state.key, 4)
        act = make_policy(agents.policy(state.agent, average=False), env, config)
        state = _interact(key_interact, state.replace(key=key), guidance, env, config, act)
        return gradient_steps(key_updates, state, draw_batches(key_batch, state, guidance, env, config), env, config)

    state, metrics = jax.lax.scan(iteration, _reset_agent_if_due(state, env, config), length=num_iterations)
    return state, jax.tree.map(jnp.mean, metrics)


def draw_batches(key: Array, state: TrainState, guidance: Guidance, env: Environment, config: TrainConfig) -> Transition:
    """The batches of an iteration's gradient steps, leaves (U, B, ...), see `batch.sample_batch`."""
    keys = jax.random.split(key, config.num_updates)
    return jax.vmap(lambda key: sample_batch(key, state.replay, guidance, state.env_steps, env, config))(keys)


def gradient_steps(key: Array, state: TrainState, batches: Transition, env: Environment, config: TrainConfig) -> tuple[TrainState, Metrics]:
    """One gradient step for each of the batches, leaves (U, B, ...), and their mean metrics."""
    num_updates = batches.reward.shape[0]

    def gradient_step(carry: tuple[Array, AgentState], update: tuple[Array, Transition]) -> tuple[tuple[Array, AgentState], Metrics]:
        (key, agent), (index, batch) = carry, update
        key, key_update = jax.random.split(key)
        agent, metrics = agents.update(key_update, agent, batch, _agent_schedule(state, state.updates + index, env, config), config)
        shares = {
            "batch/relabelled": jnp.mean(batch.is_relabelled),
            "batch/demonstrations": jnp.mean(batch.is_demonstration),
            "batch/hindsight_reward": jnp.sum(jnp.where(batch.is_relabelled, batch.reward, 0.0)),
        }
        return (key, agent), {**metrics, **shares}

    (_, agent), metrics = jax.lax.scan(gradient_step, (key, state.agent), (jnp.arange(num_updates), batches))
    return state.replace(agent=agent, updates=state.updates + num_updates), jax.tree.map(jnp.mean, metrics)


def clone(state: TrainState, guidance: Guidance, *, env: Environment, config: TrainConfig, num_iterations: int) -> tuple[TrainState, Metrics]:
    """`num_iterations` gradient steps of behaviour cloning on demonstration batches; no environment is stepped."""

    def gradient_step(state: TrainState, _: None) -> tuple[TrainState, Metrics]:
        key, key_batch, key_update = jax.random.split(state.key, 3)
        batch = sample_demonstrations(key_batch, guidance.demonstrations, env, config)
        moment = schedule(0.0, state.updates, config.agent, action_dim=env.action_dim)
        agent, metrics = agents.update_bc(key_update, state.agent, batch, moment, config)
        return state.replace(agent=agent, key=key, updates=state.updates + 1), metrics

    state, metrics = jax.lax.scan(gradient_step, state, length=num_iterations)
    return state, jax.tree.map(jnp.mean, metrics)


def imitate(state: TrainState, guidance: Guidance, *, env: Environment, config: TrainConfig) -> TrainState:
    """Clones the policy that proposes actions beside the actor, by `imitation_proposal` gradient steps; all else stays as it is."""
    key, key_clone = jax.random.split(state.key)
    clone_of, _ = clone(state.replace(key=key_clone), guidance, env=env, config=config, num_iterations=config.imitation_proposal)
    return state.replace(key=key, agent=state.agent.replace(imitation=clone_of.agent.actor))


def evaluate(key: Array, policy: Policy, guidance: Guidance, *, env: Steppable, config: TrainConfig, num_episodes: int) -> Evaluation:
    """Plays fresh episodes with the policy, see `rollout.evaluate`."""
    return rollout.evaluate(key, env, guidance.behavioural_goals, make_policy(policy, env, config), num_episodes)
