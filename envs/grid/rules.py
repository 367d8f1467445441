"""The rules of the two grid worlds of thesis section 3.1: pick up numbered objects in order and carry each one to the goal cell.

Cells are (x, y) with 0 <= x, y < size. One step does, in this order:

1. Grab. If grab is on (action[4] > 0.5), nothing is held and an undelivered object lies on the agent's cell, the lowest-numbered such object is held.
2. Move. The largest of action[:4] moves the agent by +x, +y, -x or -y; walls stop it. A held object moves along.
3. Release. If grab is off and an object was held, it stays on the cell where it was BEFORE the move. If that cell is the goal and the object is the
   next in order, it is delivered and stays there for good. Otherwise it is teleported.
4. Check. The task is solved when the last object is held on the goal cell after the move and all others are delivered. Any other object that is
   held on the goal out of order is teleported at once.

Differences from the thesis: none in the default rules. `strict_order=False` gives the rules that the original code enforced instead: holding the last
object on the goal wins whatever has been delivered, and out-of-order objects are teleported only when they are released.
"""

from __future__ import annotations

import abc
from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from hindrl_jax.base.checks import check_types
from hindrl_jax.base.types import Array, TimeStep
from hindrl_jax.envs.grid.cells import direction, same_cell
from hindrl_jax.envs.grid.types import Box, GridState


@dataclass(frozen=True)
class GridTask(abc.ABC):
    """What both tasks share. They differ in where things start and where teleported objects go."""

    name: ClassVar[str]
    render_fps: ClassVar[int] = 7
    """Steps shown per second of a film."""

    size: int = 10
    """Number of cells along each side of the square grid."""
    num_objects: int = 2
    """Number of objects to deliver; the thesis text says 3, its experiments use 2."""
    horizon: int = 100
    """Number of steps after which an episode is truncated."""
    strict_order: bool = True
    """Enforce the order of the objects at success, as the thesis says; off: holding the last object on the goal always wins."""

    def __post_init__(self):
        check_types(self)
        for field in ("size", "num_objects", "horizon"):
            if getattr(self, field) < 1:
                raise ValueError(f"{field} must be at least 1, got {getattr(self, field)}.")
        for field, most in (("size", 2**15), ("num_objects", 100)):  # the cells are counted in int32, and each object is a part of the program
            if getattr(self, field) > most:
                raise ValueError(f"{field} must be at most {most}, got {getattr(self, field)}.")

    @property
    def observation_dim(self) -> int:
        return 4 * self.num_objects + 2

    @property
    def goal_dim(self) -> int:
        return self.observation_dim

    @property
    def action_dim(self) -> int:
        return 5

    @property
    def action_low(self) -> float:
        return 0.0

    @property
    def action_high(self) -> float:
        return 1.0

    @property
    def observation_low(self) -> np.ndarray:
        """(4K+2,) float32, the least value of each entry of an observation."""
        return np.concatenate([np.full(2 * self.num_objects + 2, 1 - self.size), np.zeros(2 * self.num_objects)]).astype(np.float32)

    @property
    def observation_high(self) -> np.ndarray:
        """(4K+2,) float32, the greatest."""
        return np.concatenate([np.full(2 * self.num_objects + 2, self.size - 1), np.ones(2 * self.num_objects)]).astype(np.float32)

    @property
    def goal_tolerance(self) -> np.ndarray | None:
        """(4K+2,) zeros: a state solves the task where its achieved goal is `task_goal()`. None without `strict_order`, where others do as well."""
        return np.zeros(self.goal_dim, np.float32) if self.strict_order else None

    @property
    def state_dim(self) -> int:
        """Length of `state_to_vector`."""
        return 2 * self.num_objects + 7

    @property
    def start_boxes(self) -> tuple[Box, ...]:
        """The boxes in which the agent, the goal and the objects start, in that order; empty if they start anywhere."""
        return ()

    def reset(self, key: Array) -> tuple[GridState, Array]:
        """Starts an episode: key -> (state, observation (4K+2,))."""
        key_episode, key_start = jax.random.split(key)
        cells = self._start_cells(jax.random.bits(key_start, (self.num_objects + 2,)))
        zero = jnp.zeros((), jnp.int32)
        state = GridState(key=key_episode, agent=cells[0], goal=cells[1], objects=cells[2:], num_delivered=zero, held=zero - 1, step=zero)
        return state, self.observe(state)

    def step(self, state: GridState, action: Array) -> tuple[GridState, TimeStep]:
        """Takes one step by the rules in the module docstring.

        Args:
          state: the state to step from.
          action: (5,) four movement scores and the grab switch; clipped to [0, 1].

        Returns:
          The next state, and the time step with the true next observation.
        """
        action = jnp.clip(action, self.action_low, self.action_high)
        grab = action[4] > 0.5
        index = jnp.arange(self.num_objects)

        in_reach = (index >= state.num_delivered) & same_cell(state.objects, state.agent[None])
        found = jnp.min(jnp.where(in_reach, index, self.num_objects))
        found = jnp.where(found < self.num_objects, found, -1)
        held = jnp.where(grab, jnp.where(state.held >= 0, state.held, found), -1)

        agent = jnp.clip(state.agent + direction(action[:4]), 0, self.size - 1)
        objects = jnp.where((index == held)[:, None], agent[None], state.objects)

        released = ~grab & (state.held >= 0)
        delivered = released & (state.held == state.num_delivered) & same_cell(state.agent, state.goal)
        num_delivered = state.num_delivered + delivered

        rejected = jnp.zeros((), bool)
        if self.strict_order:
            rejected = (held >= 0) & (held != num_delivered) & same_cell(agent, state.goal)

        # At most one object is lost per step: the released one (grab off) or the rejected one (grab on).
        lost = jnp.where(rejected, held, jnp.where(released & ~delivered, state.held, -1))
        bits = jax.random.bits(jax.random.fold_in(state.key, state.step))
        objects = jnp.where((index == lost)[:, None], self._teleport_cell(bits, lost, agent, objects, state.goal)[None], objects)
        held = jnp.where(rejected, -1, held)

        state = state.replace(agent=agent, objects=objects, num_delivered=num_delivered, held=held, step=state.step + 1)
        terminated = self.is_solved(state)
        return state, TimeStep(
            observation=self.observe(state),
            reward=terminated.astype(jnp.float32),
            terminated=terminated,
            truncated=(state.step >= self.horizon) & ~terminated,
        )

    def is_solved(self, state: GridState) -> Array:
        """() bool, whether the last object is held on the goal and, under `strict_order`, all others are delivered."""
        last = self.num_objects - 1
        solved = (state.held == last) & same_cell(state.agent, state.goal)
        return solved & (state.num_delivered == last) if self.strict_order else solved

    def observe(self, state: GridState) -> Array:
        """(4K+2,) float32: object - agent for each object, goal - agent, K flags for delivered objects, K flags for the held one."""
        index = jnp.arange(self.num_objects)
        return jnp.concatenate(
            [
                (state.objects - state.agent[None]).reshape(-1),
                state.goal - state.agent,
                index < state.num_delivered,
                index == state.held,
            ],
            dtype=jnp.float32,
        )

    def achieved_goal(self, observation: Array) -> Array:
        """The observation itself (thesis section 3.1.1): (..., 4K+2) -> (..., 4K+2)."""
        return observation

    def task_goal(self) -> Array:
        """(4K+2,) the achieved goal of every final state that solves the task in order: zero distances, last object held, all others delivered."""
        last = np.arange(self.num_objects) == self.num_objects - 1
        return jnp.asarray(np.concatenate([np.zeros(2 * self.num_objects + 2), ~last, last]), jnp.float32)

    def state_to_vector(self, state: GridState) -> Array:
        """(state_dim,) float32: agent, objects, goal, num_delivered, held, step; all of the state but its key."""
        counters = jnp.stack([state.num_delivered, state.held, state.step])
        return jnp.concatenate([state.agent, state.objects.reshape(-1), state.goal, counters], dtype=jnp.float32)

    def vector_to_state(self, key: Array, vector: Array) -> GridState:
        """The inverse of `state_to_vector`: (state_dim,) -> the state, with `key` for the teleports that follow."""
        vector = jnp.asarray(vector).astype(jnp.int32)
        split = 2 + 2 * self.num_objects
        return GridState(
            key=key,
            agent=vector[:2],
            objects=vector[2:split].reshape(self.num_objects, 2),
            goal=vector[split : split + 2],
            num_delivered=vector[split + 2],
            held=vector[split + 3],
            step=vector[split + 4],
        )

    @abc.abstractmethod
    def _start_cells(self, bits: Array) -> Array:
        """Start cells of the agent, the goal and the objects: random bits (K+2,) uint32 -> (K+2, 2) int32."""

    @abc.abstractmethod
    def _teleport_cell(self, bits: Array, lost: Array, agent: Array, objects: Array, goal: Array) -> Array:
        """(2,) int32 cell to which object `lost` is teleported, given random bits () uint32 and all cells after the move."""
