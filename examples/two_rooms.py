"""A task of your own: from the left room to a target in the right room, through a gate whose height differs from episode to episode.

hindrl train --env two_rooms:TwoRooms --demos 3 --steps 40000
"""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp
from flax import struct

import hindrl_jax as hindrl


@struct.dataclass(kw_only=True)
class RoomsState:
    key: jax.Array  # () typed random key, constant within an episode
    position: jax.Array  # (2,) in the unit square; the wall between the rooms is at x = 0.5
    gate: jax.Array  # () height of the gate in that wall
    step: jax.Array  # () int32, steps taken


@dataclasses.dataclass(frozen=True)
class TwoRooms:
    """The square is [0, 1] x [0, 1]. An observation is the position (2,) and the height of the gate; a goal is a position (2,)."""

    name: ClassVar[str] = "TwoRooms"
    observation_dim: ClassVar[int] = 3
    goal_dim: ClassVar[int] = 2
    action_dim: ClassVar[int] = 2
    state_dim: ClassVar[int] = 4
    action_low: ClassVar[float] = -0.05  # actions are steps in x and y
    action_high: ClassVar[float] = 0.05
    horizon: int = 60
    """Number of steps after which an episode is truncated."""
    gate_width: float = 0.1
    """Width of the gate; the square's sides are 1."""

    def reset(self, key):
        key, key_start, key_gate = jax.random.split(key, 3)
        start = jax.random.uniform(key_start, (2,), minval=0.05, maxval=0.4)
        gate = jax.random.uniform(key_gate, minval=0.15, maxval=0.85)
        state = RoomsState(key=key, position=start, gate=gate, step=jnp.zeros((), jnp.int32))
        return state, self.observe(state)

    def step(self, state, action):
        action = jnp.clip(action, self.action_low, self.action_high)
        position = jnp.clip(state.position + action, 0.0, 1.0)
        crosses = (state.position[0] < 0.5) != (position[0] < 0.5)
        blocked = crosses & (jnp.abs(position[1] - state.gate) > self.gate_width / 2)
        state = state.replace(position=jnp.where(blocked, state.position, position), step=state.step + 1)
        solved = jnp.linalg.norm(state.position - self.task_goal()) < 0.05
        truncated = (state.step >= self.horizon) & ~solved
        reward = solved.astype(jnp.float32)
        return state, hindrl.TimeStep(observation=self.observe(state), reward=reward, terminated=solved, truncated=truncated)

    def observe(self, state):
        return jnp.append(state.position, state.gate)

    def achieved_goal(self, observation):
        return observation[..., :2]  # the position

    def task_goal(self):
        return jnp.array([0.9, 0.9])

    def state_to_vector(self, state):
        return jnp.concatenate([state.position, jnp.stack([state.gate, state.step.astype(jnp.float32)])])

    def vector_to_state(self, key, vector):
        return RoomsState(key=key, position=vector[:2], gate=vector[2], step=vector[3].astype(jnp.int32))


@dataclasses.dataclass(frozen=True)
class RoomsExpert:
    """Straight to the gate, through it, and to the target; with noise on every step."""

    noise: float = 0.5
    """Standard deviation of the noise on its steps, as a share of the longest step."""

    def act(self, key, env, state):
        gate = jnp.stack([jnp.asarray(0.5), state.gate])
        beside_gate = jnp.abs(state.position[1] - state.gate) > env.gate_width / 4
        waypoint = jnp.where(beside_gate, gate - jnp.array([0.05, 0.0]), gate + jnp.array([0.1, 0.0]))
        waypoint = jnp.where(state.position[0] >= 0.5, env.task_goal(), waypoint)
        return jnp.clip(waypoint - state.position, env.action_low, env.action_high) + self.noise * env.action_high * jax.random.normal(key, (2,))


hindrl.register(TwoRooms, expert=RoomsExpert, summary="through a gate from one room to another")
