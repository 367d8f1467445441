"""Probe problems for the agent: batches made by hand, a few hundred updates of small networks, values that are known."""

import dataclasses
import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np

from hindrl_jax.base.types import Transition
from hindrl_jax.config import AgentConfig, QuirksConfig, TrainConfig
from hindrl_jax.core import agent as agents
from hindrl_jax.core.inputs import InputScale, network_inputs
from hindrl_jax.core.networks import apply_critics
from hindrl_jax.core.schedules import schedule

# The entropy coefficient starts at e^-9 and aims far below the policy's entropy, so that it only falls: values are those of the plain return.
CONFIG = TrainConfig(
    agent=AgentConfig(
        net_arch=(16,),
        layer_norm=False,
        clip_targets=False,
        learning_rate=1e-2,
        num_quantiles=4,
        top_quantiles_to_drop_per_net=0,
        target_update_rate=0.1,
        actor_average_span=0.25,
        relative_value=False,
        initial_alpha=1e-4,
        target_entropy=-50.0,
        final_target_entropy=None,
        bc_weight=0.0,
        input_encoding="raw",
    ),
    quirks=QuirksConfig(bc_loss="squared"),
)
NUM_UPDATES = 400
B = 32
UNIT_SCALE = InputScale(observation=jnp.ones(2), goal=jnp.ones(1), observation_centre=jnp.zeros(2), goal_centre=jnp.zeros(1))
ACTIONS = np.linspace(-1.0, 1.0, B, dtype=np.float32)[:, None]


def with_agent(config=CONFIG, **changes):
    """The config with other fields of the agent."""
    return dataclasses.replace(config, agent=dataclasses.replace(config.agent, **changes))


def with_quirks(config=CONFIG, **changes):
    """The config with other quirks."""
    return dataclasses.replace(config, quirks=dataclasses.replace(config.quirks, **changes))


def schedule_of(config):
    """What holds at the start of a run, but for the actor's average: after 16 gradient steps its rate is 1 / (1 + 16 / 4) = 0.2."""
    return schedule(0.0, 16, config.agent, action_dim=1)


SCHEDULE = schedule_of(CONFIG)


def make_batch(*, action, reward, discount, observation=None, next_observation=None, is_demonstration=False):
    """A batch of B rows of two-dimensional observations; scalars are repeated."""

    def rows(values, width=None):
        values = jnp.asarray(values, jnp.float32)
        shape = (B,) if width is None else (B, width)
        return jnp.broadcast_to(values.reshape((1,) * (len(shape) - values.ndim) + values.shape), shape)

    return Transition(
        observation=rows([0.0, 0.0] if observation is None else observation, 2),
        achieved_goal=jnp.zeros((B, 1)),
        action=rows(action, 1),
        reward=rows(reward),
        discount=rows(discount),
        next_observation=rows([0.0, 0.0] if next_observation is None else next_observation, 2),
        next_achieved_goal=jnp.zeros((B, 1)),
        desired_goal=jnp.zeros((B, 1)),
        is_demonstration=jnp.broadcast_to(jnp.asarray(is_demonstration), (B,)),
        is_relabelled=jnp.zeros(B, bool),
    )


def inputs_of(observation, config):
    """What the networks see, where all goals are 0."""
    zeros = jnp.zeros((observation.shape[0], 1))
    return network_inputs(observation, zeros, zeros, UNIT_SCALE, config)


@functools.partial(jax.jit, static_argnames="config")
def fresh_agent(key, config=CONFIG):
    """An agent that has learnt nothing, for one-dimensional actions."""
    return agents.init(key, UNIT_SCALE, config, action_dim=1)


@functools.partial(jax.jit, static_argnames="config")
def updates(key, start, batch, config):
    """NUM_UPDATES updates on the same batch: the agent after each of them, and their metrics."""

    def step(state, key):
        state, metrics = agents.update(key, state, batch, schedule_of(config), config)
        return state, (state, metrics)

    return jax.lax.scan(step, start, jax.random.split(key, NUM_UPDATES))[1]


@functools.partial(jax.jit, static_argnames="config")
def one_update(key, start, batch, config=CONFIG):
    """The agent after one update, and its metrics."""
    return agents.update(key, start, batch, schedule_of(config), config)


def train(seed, batch, config=CONFIG, start=None):
    """As `updates`. All of it must be finite."""
    start = fresh_agent(jax.random.key(seed), config) if start is None else start
    states, metrics = updates(jax.random.key(1000 + seed), start, batch, config)
    chex.assert_tree_all_finite((states, metrics))
    return states, metrics


def last(states):
    """The last of a number of states."""
    return jax.tree.map(lambda leaf: leaf[-1], states)


def with_constant_critics(state, constants, *, target=True):
    """The state with (target) critics that say constants, whatever they see: (C,) one each, or (C, Q) one for each quantile."""
    name = "target_critics" if target else "critics"
    critics = getattr(state, name)["params"]
    last_layer = critics["Dense_1"]
    bias = jnp.broadcast_to(jnp.asarray(constants, jnp.float32).reshape(last_layer["bias"].shape[0], -1), last_layer["bias"].shape)
    last_layer = {"kernel": jnp.zeros_like(last_layer["kernel"]), "bias": bias}
    return state.replace(**{name: {"params": {**critics, "Dense_1": last_layer}}})


@functools.partial(jax.jit, static_argnames="config")
def values(state, observation, action, config=CONFIG):
    """Mean over critics and quantiles: (rows,)."""
    return jnp.mean(apply_critics(state.critics, inputs_of(observation, config).T, action.T, config.agent), axis=(0, 1))


@jax.jit
def mean_action(state, observation):
    """The mode of the actor, which is the same network in all of the agent's algorithms: (rows, 1)."""
    inputs = inputs_of(observation, CONFIG)
    policy = agents.policy(state, CONFIG, average=False).replace(noise=0.0)
    return agents.select_action(jax.random.key(0), policy, inputs, CONFIG, action_dim=1)
