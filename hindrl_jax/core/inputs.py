"""What the networks see: observations and goals, scaled by what the demonstrations look like."""

from __future__ import annotations

import jax.numpy as jnp
from flax import struct

from hindrl_jax.base.types import Array
from hindrl_jax.config import AgentConfig, TrainConfig

_LEAST_EXTENT = 1e-6


class InputScale(struct.PyTreeNode, kw_only=True):
    """Where each input dimension lies in the demonstrations and how large it is; the encodings other than raw see (x - centre) / scale."""

    observation: Array  # (D,) scale, > 0
    goal: Array  # (G,)
    observation_centre: Array  # (D,)
    goal_centre: Array  # (G,)


def input_scale(observations: Array, achieved_goals: Array, is_visited: Array, config: AgentConfig) -> InputScale:
    """The scale of each dimension over demonstration states.

    Standardised inputs have their mean as centre and their standard deviation as scale; others have centre 0 and the root mean square. A dimension
    without extent has scale 1.

    Args:
      observations, achieved_goals: (..., D) and (..., G).
      is_visited: (...) bool, false for padding.
      config: its `input_encoding` decides.
    """

    def moments(values: Array) -> tuple[Array, Array]:
        axes, visited = tuple(range(values.ndim - 1)), is_visited[..., None]
        count = jnp.sum(is_visited)
        centre = jnp.zeros(values.shape[-1])
        if config.input_encoding == "standardised":
            centre = jnp.sum(jnp.where(visited, values, 0.0), axis=axes) / count
        offset = values - centre.reshape((1,) * len(axes) + centre.shape)
        mean_square = jnp.sum(jnp.where(visited, jnp.square(offset), 0.0), axis=axes) / count
        return centre, jnp.where(mean_square > _LEAST_EXTENT**2, jnp.sqrt(mean_square), 1.0)

    observation_centre, observation = moments(observations)
    goal_centre, goal = moments(achieved_goals)
    return InputScale(observation=observation, goal=goal, observation_centre=observation_centre, goal_centre=goal_centre)


def _encode(values: Array, centre: Array, scale: Array, config: AgentConfig) -> Array:
    if config.input_encoding == "raw":
        return values
    leading = (1,) * (values.ndim - 1)
    scaled = (values - centre.reshape(leading + centre.shape)) / scale.reshape(leading + scale.shape)
    return jnp.concatenate([scaled, jnp.tanh(4.0 * scaled)], axis=-1) if config.input_encoding == "multiscale" else scaled


def network_inputs(observation: Array, achieved_goal: Array, desired_goal: Array, scale: InputScale, config: TrainConfig) -> Array:
    """Joins what the networks see, along the last axis: (..., D), (..., G), (..., G) -> (..., input_dim).

    The multiscale encoding gives each dimension twice: once linear, for distances, once saturating, so that "exactly there" and "one
    step off" are far apart. With inputs as they are, small networks blur the two.
    """
    observation, achieved_goal, desired_goal = (
        _encode(observation, scale.observation_centre, scale.observation, config.agent),
        _encode(achieved_goal, scale.goal_centre, scale.goal, config.agent),
        _encode(desired_goal, scale.goal_centre, scale.goal, config.agent),
    )
    if config.quirks.achieved_goal_input:
        return jnp.concatenate([achieved_goal, desired_goal, observation], axis=-1)
    return jnp.concatenate([observation, desired_goal], axis=-1)
