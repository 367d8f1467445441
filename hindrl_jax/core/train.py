"""Training as pure functions over one state: collect, learn (or clone), evaluate. The Python loop over jitted chunks is the caller's.

The chain relabel -> batch -> update is one program. The batches of an iteration are drawn together, in one read of the replay, before the scan
over its gradient steps.
"""

from __future__ import annotations

from collections.abc import Callable
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
from hindrl_jax.core.batch import goal_test, sample_batch, sample_demonstrations
from hindrl_jax.core.curriculum import Curriculum
from hindrl_jax.core.goals import nearby_goal
from hindrl_jax.core.guidance import Guidance
from hindrl_jax.core.hindsight import NEARBY_GOAL
from hindrl_jax.core.inputs import network_inputs
from hindrl_jax.core.replay import RecordedStep, ReplayState
from hindrl_jax.core.rollout import Act, DemoResets, Evaluation, RolloutState
from hindrl_jax.core.schedules import schedule

_RESET = 2**18  # the random numbers of fresh agents are none of those that a state's key gives when it is split


class TrainState(struct.PyTreeNode, kw_only=True):
    """All that a run needs to go on."""

    agent: AgentState
    replay: ReplayState
    rollout: RolloutState
    curriculum: Curriculum | None = None  # how far back in the demonstrations episodes begin; None without `demo_reset_curriculum`
    key: Array
    env_steps: Array  # () int32
    updates: Array  # () int32, of the present agent


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
    begins = curriculum.init(guidance.starts.lengths) if config.demo_reset_curriculum else None
    if begun is None:
        begun = _new_episodes(key_rollout, guidance, cast(Steppable, env), config, begins)
    return TrainState(
        agent=agents.init(key_agent, guidance.scale, config, action_dim=env.action_dim),
        replay=replay.init(env, num_envs=config.num_envs, capacity=capacity, notes=notes),
        rollout=begun,
        curriculum=begins,
        key=key_train,
        env_steps=jnp.zeros((), jnp.int32),
        updates=jnp.zeros((), jnp.int32),
    )


def _new_episodes(key: Array, guidance: Guidance, env: Steppable, config: TrainConfig, begins: Curriculum | None) -> RolloutState:
    demo_resets = None
    if guidance.starts is not None:
        demo_resets = DemoResets(starts=guidance.starts, ratio=config.demo_reset_ratio, curriculum=begins)
    return rollout.reset(key, env, guidance.behavioural_goals, config.num_envs, demo_resets)


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
    key_act, key_reset, key_nearby = jax.random.split(key, 3)
    before = state.rollout
    action = act(key_act, before.observation, before.desired_goal)
    begun = _new_episodes(key_reset, guidance, env, config, state.curriculum)
    after, time_step = rollout.step(before, begun, action, env)
    if state.curriculum is not None:
        ended = time_step.terminated | time_step.truncated
        state = state.replace(curriculum=curriculum.record(state.curriculum, before.origin, ended, time_step.reward > 0.0))
    return record(key_nearby, state, (action, time_step, after), guidance, env, config)


def record(
    key: Array, state: TrainState, taken: tuple[Array, TimeStep, RolloutState], guidance: Guidance, env: Environment, config: TrainConfig
) -> TrainState:
    """Stores one step of every environment in the replay, and goes on from where it led.

    Args:
      key: random key.
      state: before the step.
      taken: the actions (E, A) in [-1, 1]; the time steps (E, ...) that came of them, their observations the true next ones; and where the
        environments are now: in a new episode, those whose episode has ended.
      guidance, env, config: the run's; of the environment, only what goals and actions are.
    """
    before, (action, time_step, after) = state.rollout, taken
    notes = {}
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
    return state.replace(replay=replay.add(state.replay, recorded), rollout=after, env_steps=state.env_steps + config.steps_per_iteration)


def collect(state: TrainState, guidance: Guidance, *, env: Steppable, config: TrainConfig, num_iterations: int) -> TrainState:
    """Fills the replay by uniformly random actions: `num_iterations` steps of every environment."""

    def iteration(state: TrainState, _: None) -> tuple[TrainState, None]:
        key, key_interact = jax.random.split(state.key)
        return _interact(key_interact, state.replace(key=key), guidance, env, config, act_at_random(env)), None

    return jax.lax.scan(iteration, state, length=num_iterations)[0]


def reset_networks(state: TrainState, is_stuck: Array, *, env: Environment, config: TrainConfig) -> TrainState:
    """A fresh agent in the place of one that is stuck, which learns from what the replay holds (Nikishin et al., the primacy bias in deep
    reinforcement learning, 2022). The policy that imitates, if there is one, stays.

    Args:
      state: a run.
      is_stuck: () bool; where it is False the state stays as it is.
      env, config: static.
    """
    key, agent = jax.random.fold_in(state.key, _RESET), state.agent
    fresh = agents.init(key, agent.scale, config, action_dim=env.action_dim).replace(imitation=agent.imitation)
    return state.replace(agent=tree_where(is_stuck, fresh, agent), updates=jnp.where(is_stuck, 0, state.updates))


def learn(state: TrainState, guidance: Guidance, *, env: Steppable, config: TrainConfig, num_iterations: int) -> tuple[TrainState, Metrics]:
    """`num_iterations` times: one step of every environment, then `num_updates` gradient steps.

    Returns:
      The new state, and metrics averaged over the gradient steps.
    """

    def iteration(state: TrainState, _: None) -> tuple[TrainState, Metrics]:
        key, key_interact, key_batch, key_updates = jax.random.split(state.key, 4)
        act = make_policy(agents.policy(state.agent, config, average=False), env, config)
        state = _interact(key_interact, state.replace(key=key), guidance, env, config, act)
        return gradient_steps(key_updates, state, draw_batches(key_batch, state, guidance, env, config), env, config)

    state, metrics = jax.lax.scan(iteration, state, length=num_iterations)
    return state, jax.tree.map(jnp.mean, metrics)


def draw_batches(key: Array, state: TrainState, guidance: Guidance, env: Environment, config: TrainConfig) -> Transition:
    """The batches of an iteration's gradient steps, leaves (U, B, ...), see `batch.sample_batch`."""
    keys = jax.random.split(key, config.num_updates)
    return jax.vmap(lambda key: sample_batch(key, state.replay, guidance, state.env_steps, env, config))(keys)


def gradient_steps(key: Array, state: TrainState, batches: Transition, env: Environment, config: TrainConfig) -> tuple[TrainState, Metrics]:
    """One gradient step for each of the batches, leaves (U, B, ...), and their mean metrics."""
    num_updates, progress = batches.reward.shape[0], jnp.minimum(state.env_steps / config.num_steps, 1.0)

    def gradient_step(carry: tuple[Array, AgentState], update: tuple[Array, Transition]) -> tuple[tuple[Array, AgentState], Metrics]:
        (key, agent), (index, batch) = carry, update
        key, key_update = jax.random.split(key)
        moment = schedule(progress, state.updates + index, config.agent, action_dim=env.action_dim)
        agent, metrics = agents.update(key_update, agent, batch, moment, config)
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
    return clone_from(state, lambda key: sample_demonstrations(key, guidance.demonstrations, env, config), env, config, num_iterations)


def clone_from(
    state: TrainState, draw: Callable[[Array], Transition], env: Environment, config: TrainConfig, num_iterations: int
) -> tuple[TrainState, Metrics]:
    """The same on the batches that `draw` gives for random keys."""

    def gradient_step(state: TrainState, _: None) -> tuple[TrainState, Metrics]:
        key, key_batch, key_update = jax.random.split(state.key, 3)
        moment = schedule(0.0, state.updates, config.agent, action_dim=env.action_dim)
        agent, metrics = agents.update_bc(key_update, state.agent, draw(key_batch), moment, config)
        return state.replace(agent=agent, key=key, updates=state.updates + 1), metrics

    state, metrics = jax.lax.scan(gradient_step, state, length=num_iterations)
    return state, jax.tree.map(jnp.mean, metrics)


def evaluate(key: Array, policy: Policy, guidance: Guidance, *, env: Steppable, config: TrainConfig, num_episodes: int) -> Evaluation:
    """Plays fresh episodes with the policy, see `rollout.evaluate`."""
    return rollout.evaluate(key, env, guidance.behavioural_goals, make_policy(policy, env, config), num_episodes)
