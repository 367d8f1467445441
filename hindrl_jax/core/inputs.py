"""What the networks see: observations and goals, scaled by what the demonstrations look like."""

from __future__ import annotations

import jax.numpy as jnp
from flax import struct

from hindrl_jax.base.types import Array
from hindrl_jax.config import AgentConfig, TrainConfig

_LEAST_EXTENT = 1e-6
_LEAST_DEVIATION = 0.1  # of the root mean square
_MOST_DEVIATIONS = 100.0  # what is almost constant in the demonstrations would else be an input of 1e5 and more once it moves


class InputScale(struct.PyTreeNode, kw_only=True):
    """Where each input dimension lies in the demonstrations and how large it is; the encodings other than raw see (x - centre) / scale, from -100
    to 100."""

    observation: Array  # (D,) scale, > 0
    goal: Array  # (G,)
    observation_centre: Array  # (D,)
    goal_centre: Array  # (G,)


def input_scale(observations: Array, goals: Array, is_visited: Array, config: AgentConfig) -> InputScale:
    """The mean and the standard deviation of each dimension over demonstration states; raw inputs have 0 and 1.

    A deviation below a tenth of the root mean square counts as that tenth: what hardly moved in the demonstrations may move elsewhere. A dimension
    that is always 0 has scale 1.

    Args:
      observations: (..., D)
      goals: (..., G), like those that networks see: what is left to the goal, or the achieved ones.
      is_visited: (...) bool, false for padding.
      config: its `input_encoding` decides.
    """

    def moments(values: Array) -> tuple[Array, Array]:
        axes, visited = tuple(range(values.ndim - 1)), is_visited[..., None]
        count = jnp.sum(is_visited)

        def mean(values: Array) -> Array:
            return jnp.sum(jnp.where(visited, values, 0.0), axis=axes) / count

        centre, size = mean(values), jnp.sqrt(mean(jnp.square(values)))
        deviation = jnp.sqrt(mean(jnp.square(values - centre.reshape((1,) * len(axes) + centre.shape))))
        scale = jnp.maximum(deviation, _LEAST_DEVIATION * size)
        return centre, jnp.where(scale > _LEAST_EXTENT, scale, 1.0)

    if config.input_encoding == "raw":
        observation_dim, goal_dim = observations.shape[-1], goals.shape[-1]
        return InputScale(
            observation=jnp.ones(observation_dim),
            goal=jnp.ones(goal_dim),
            observation_centre=jnp.zeros(observation_dim),
            goal_centre=jnp.zeros(goal_dim),
        )
    observation_centre, observation = moments(observations)
    goal_centre, goal = moments(goals)
    return InputScale(observation=observation, goal=goal, observation_centre=observation_centre, goal_centre=goal_centre)


def _encode(values: Array, centre: Array, scale: Array, config: AgentConfig) -> Array:
    if config.input_encoding == "raw":
        return values
    leading = (1,) * (values.ndim - 1)
    centre, scale = centre.reshape(leading + centre.shape), scale.reshape(leading + scale.shape)
    standardised = jnp.clip((values - centre) / scale, -_MOST_DEVIATIONS, _MOST_DEVIATIONS)
    if config.input_encoding == "standardised":
        return standardised
    return jnp.concatenate([standardised, jnp.tanh(4.0 * values / jnp.sqrt(jnp.square(scale) + jnp.square(centre)))], axis=-1)


def seen_goal(achieved_goal: Array, desired_goal: Array, config: TrainConfig) -> Array:
    """The goal as networks see it, (..., G): what is left to it, where each episode has one of its own (`TrainConfig.relative_goals`); else as it is.

    Args:
      achieved_goal, desired_goal: (..., G) in task units.
      config: of the run.
    """
    return desired_goal - achieved_goal if config.relative_goals else desired_goal


def network_inputs(observation: Array, achieved_goal: Array, desired_goal: Array, scale: InputScale, config: TrainConfig) -> Array:
    """Joins what the networks see, along the last axis: (..., D), (..., G), (..., G) -> (..., input_dim).

    The multiscale encoding gives each dimension twice: standardised, for where in the task it is; and saturating around 0 in units of its root mean
    square, so that where a dimension is a distance, "exactly there" and "one step off" are far apart. Small networks blur the two else.
    """
    observation = _encode(observation, scale.observation_centre, scale.observation, config.agent)
    goal = _encode(seen_goal(achieved_goal, desired_goal, config), scale.goal_centre, scale.goal, config.agent)
    if config.quirks.achieved_goal_input:
        return jnp.concatenate([_encode(achieved_goal, scale.goal_centre, scale.goal, config.agent), goal, observation], axis=-1)
    return jnp.concatenate([observation, goal], axis=-1)
