"""A corridor whose observations say which episode and which step they belong to, and demonstrations of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from hindrl_jax.base.types import Array, Episodes, TimeStep


@struct.dataclass(kw_only=True)
class CorridorState:
    key: Array  # () typed, constant within an episode
    start: Array  # () float32, different in every episode
    position: Array  # () float32
    step: Array  # () int32


@dataclass(frozen=True)
class Corridor:
    """Walk right until the position exceeds `width`. The action is a velocity in [0, 2]; the observation is (start, step, position)."""

    name: ClassVar[str] = "Corridor"

    horizon: int = 5
    width: float = 3.0

    @property
    def observation_dim(self) -> int:
        return 3

    @property
    def goal_dim(self) -> int:
        return 1

    @property
    def action_dim(self) -> int:
        return 2

    @property
    def state_dim(self) -> int:
        return 3

    @property
    def action_low(self) -> float:
        return 0.0

    @property
    def action_high(self) -> float:
        return 2.0

    def reset(self, key: Array) -> tuple[CorridorState, Array]:
        key_episode, key_start = jax.random.split(key)
        start = jax.random.uniform(key_start)
        state = CorridorState(key=key_episode, start=start, position=jnp.zeros(()), step=jnp.zeros((), jnp.int32))
        return state, self.observe(state)

    def step(self, state: CorridorState, action: Array) -> tuple[CorridorState, TimeStep]:
        velocity = jnp.clip(action, self.action_low, self.action_high)[0]
        state = state.replace(position=state.position + velocity, step=state.step + 1)
        solved = state.position > self.width
        time_step = TimeStep(
            observation=self.observe(state),
            reward=solved.astype(jnp.float32),
            terminated=solved,
            truncated=(state.step >= self.horizon) & ~solved,
        )
        return state, time_step

    def observe(self, state: CorridorState) -> Array:
        return jnp.stack([state.start, state.step.astype(jnp.float32), state.position])

    def state_to_vector(self, state: CorridorState) -> Array:
        return jnp.stack([state.start, state.position, state.step.astype(jnp.float32)])

    def vector_to_state(self, key: Array, vector: Array) -> CorridorState:
        return CorridorState(key=key, start=vector[0], position=vector[1], step=vector[2].astype(jnp.int32))

    def achieved_goal(self, observation: Array) -> Array:
        """The position."""
        return observation[..., 2:]

    def task_goal(self) -> Array:
        return jnp.array([self.width])


def corridor_demonstrations(speeds=(1.0, 1.25, 0.8), *, env=None) -> Episodes:
    """Demonstrations that walk at constant speeds until the corridor ends, with the second action dimension at 0.5 (policy units: -0.5).

    Demonstration i has `start` 10 + i, which no episode of the environment's own has. Past the end, states are NaN, so that reading them shows.
    """
    env = env or Corridor()
    num = len(speeds)
    observations = np.zeros((num, env.horizon + 1, 3), np.float32)
    actions = np.zeros((num, env.horizon, 2), np.float32)
    rewards = np.zeros((num, env.horizon), np.float32)
    states = np.full((num, env.horizon + 1, 3), np.nan, np.float32)
    lengths = []
    for i, speed in enumerate(speeds):
        length = int(env.width // speed) + 1
        assert length <= env.horizon
        for t in range(length + 1):
            observations[i, t] = (10 + i, t, t * speed)
            states[i, t] = (10 + i, t * speed, t)
        actions[i, :length] = (speed - 1.0, -0.5)
        rewards[i, length - 1] = 1.0
        lengths.append(length)
    return Episodes(
        observations=jnp.asarray(observations),
        actions=jnp.asarray(actions),
        rewards=jnp.asarray(rewards),
        lengths=jnp.asarray(lengths, jnp.int32),
        terminated=jnp.ones(num, bool),
        desired_goals=jnp.zeros((num, 1)),
        states=jnp.asarray(states),
    )
