"""What one of our environments and many of them side by side need to be Gymnasium's: spaces, the goal test, and compiled programs."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from gymnasium.spaces import Box, Dict
from gymnasium.vector import AutoresetMode

from hindrl_jax.base.environments import action_to_env, backends_with, can_step, compiler_options
from hindrl_jax.base.errors import UserError
from hindrl_jax.base.types import Array, tree_where
from hindrl_jax.tasks.ids import check_not_forked
from hindrl_jax.tasks.registry import make, viewer

Observation = dict[str, np.ndarray]
NEVER = 2**31 - 1
"""The horizon of an environment whose episodes are cut by Gymnasium, or where there are many, by `vector_programs`."""


class GoalTask:
    """What one environment and many side by side have in common: the environment, its spaces, and the goal test."""

    def __init__(self, name: str, arguments: dict[str, Any], render_mode: str | None, continuing_task: bool):
        if "horizon" in arguments:
            raise UserError(f"horizon = {arguments['horizon']} is not for Gymnasium, which has max_episode_steps: give that")
        env = make(name, horizon=NEVER, **arguments)
        if not can_step(env):
            choices = " or ".join(map(repr, backends_with(env, can_step)))
            now = f" with backend = {arguments.get('backend')!r}: choose {choices}" if choices else ", since it has no step in JAX"
            raise UserError(f"{name} cannot be stepped here{now}")
        if env.goal_tolerance is None:
            given = ", ".join(f"{key} = {value!r}" for key, value in arguments.items())
            raise UserError(
                f"{name} with {given} is solved in states that no goal tells from others, so compute_reward cannot be had: leave that out"
            )
        if render_mode not in (None, "rgb_array"):
            raise UserError(f"render_mode = {render_mode!r} is not usable: choose 'rgb_array' or None")
        if not isinstance(continuing_task, bool):
            raise UserError(f"continuing_task = {continuing_task!r} is not usable: choose True or False")
        self.env = env
        self.goal, self.tolerance = np.asarray(env.task_goal()), env.goal_tolerance
        low, high = env.observation_low, env.observation_high
        # A goal is some entries of an observation, and at both bounds the same ones.
        goals = Box(*(np.asarray(env.achieved_goal(bound)) for bound in (low, high)), dtype=np.float32)
        self.observation_space = Dict(observation=Box(low, high, dtype=np.float32), achieved_goal=goals, desired_goal=goals)
        self.action_space = Box(-1.0, 1.0, (env.action_dim,), np.float32)
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": env.render_fps}

    def checked_actions(self, actions: Any, shape: tuple[int, ...]) -> np.ndarray:
        """Actions as float32, if they have the shape, which JAX would broadcast them to or cut them at, and are numbers.

        Raises:
          UserError: if not.
        """
        given = np.asarray(actions, np.float32)
        if given.shape != shape:
            raise UserError(f"an action of {self.env.name} has shape {shape}, and the one given has shape {given.shape}: give one of action_space")
        if np.isnan(given).any():
            raise UserError(f"the action given to {self.env.name} is not a number in dimension {int(np.argwhere(np.isnan(given))[0][-1])}")
        return given

    def unpack(self, rows: Any) -> tuple[Observation, np.ndarray, np.ndarray, np.ndarray]:
        """What `_pack` put together, in memory of its own: rows (..., D + G + 3) -> observation, reward, terminated, truncated."""
        dims = np.cumsum([self.env.observation_dim, self.env.goal_dim])
        observation, achieved_goal, rest = (part.copy() for part in np.split(np.asarray(rows), dims, axis=-1))
        desired_goal = np.broadcast_to(self.goal, achieved_goal.shape).copy()
        named = {"observation": observation, "achieved_goal": achieved_goal, "desired_goal": desired_goal}
        return named, rest[..., 0], rest[..., 1] > 0.0, rest[..., 2] > 0.0

    def compute_reward(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any) -> np.ndarray:
        """1 where the goal is reached, else 0: goals (..., G) -> (...) float32. `info` is not used."""
        del info
        return _is_reached(np.asarray(achieved_goal), np.asarray(desired_goal), self.tolerance).astype(np.float32)

    def picture(self, state: Any) -> np.ndarray:
        """(H, W, 3) uint8."""
        return viewer(self.env).frame(self.env, state)


def _is_reached(achieved_goal: Any, desired_goal: Any, tolerance: Any) -> Any:
    """Goals (..., G), of NumPy or of JAX -> (...) bool."""
    return (abs(achieved_goal - desired_goal) <= tolerance).all(axis=-1)


def _pack(env: Any, observation: Array, *results: Array | float) -> Array:
    """(D + G + 3,) all that a step has to say as one row of numbers, since every array on its way out of JAX takes its time."""
    observation = jnp.clip(observation, env.observation_low, env.observation_high)  # only rounding leads out of the bounds
    return jnp.concatenate([observation, env.achieved_goal(observation), jnp.stack([jnp.asarray(result, jnp.float32) for result in results])])


def _start(env: Any, seed: Array, episode: Array) -> tuple[Any, Array]:
    """The first state and row of one of a seed's episodes, counted from 0."""
    state, observation = env.reset(jax.random.fold_in(jax.random.key(seed), episode))
    return state, _pack(env, observation, 0.0, 0.0, 0.0)


def _step(env: Any, continuing_task: bool, state: Any, action: Array) -> tuple[Any, Array]:
    """The next state, and its row, in which nothing is truncated yet."""
    state, time_step = env.step(state, action_to_env(jnp.clip(action, -1.0, 1.0), env))
    if continuing_task:
        observation = jnp.clip(time_step.observation, env.observation_low, env.observation_high)
        reward = _is_reached(env.achieved_goal(observation), env.task_goal(), env.goal_tolerance)
        return state, _pack(env, observation, reward, 0.0, 0.0)
    return state, _pack(env, time_step.observation, time_step.reward, time_step.terminated, 0.0)


def goal_task(name: str, arguments: dict[str, Any], render_mode: str | None, continuing_task: bool) -> GoalTask:
    """A `GoalTask`, one for all that are equal: so a forked process, in which JAX computes no more, can still say what its spaces are."""
    try:
        return _equal_goal_task(name, tuple((key, type(value), value) for key, value in arguments.items()), render_mode, continuing_task)
    except TypeError:  # an argument that cannot be hashed, which is refused, if so, in a line of its own
        return GoalTask(name, arguments, render_mode, continuing_task)


@functools.lru_cache(maxsize=64, typed=True)
def _equal_goal_task(name: str, arguments: tuple[tuple[str, type, Any], ...], render_mode: str | None, continuing_task: bool) -> GoalTask:
    check_not_forked()
    return GoalTask(name, {key: value for key, _, value in arguments}, render_mode, continuing_task)


def draw_seed(generator: np.random.Generator) -> int:
    return int(generator.integers(2**32))


@functools.cache
def programs(env: Any, continuing_task: bool) -> tuple[Any, Any]:
    """`_start` and `_step`, compiled once for all environments that are equal."""
    functions = functools.partial(_start, env), functools.partial(_step, env, continuing_task)
    return tuple(jax.jit(function, compiler_options=compiler_options(env)) for function in functions)


@struct.dataclass(kw_only=True)
class Running:
    """E environments side by side."""

    states: Any  # leaves (E, ...)
    rows: Array  # (E, D + G + 3), what was said last
    seeds: Array  # (E,) uint32
    episodes: Array  # (E,) int32, which of the seed's episodes this is
    steps: Array  # (E,) int32, taken in this episode


@functools.cache
def vector_programs(env: Any, continuing_task: bool, max_episode_steps: int, mode: AutoresetMode) -> tuple[Any, Any, Any]:
    """The compiled start, restart and step of E environments."""

    def start(seeds: Array, episodes: Array) -> Running:
        states, rows = jax.vmap(functools.partial(_start, env))(seeds, episodes)
        return Running(states=states, rows=rows, seeds=seeds, episodes=episodes, steps=jnp.zeros_like(episodes))

    def restart(running: Running, chosen: Array, seeds: Array, is_new: Array) -> Running:
        """New episodes where `chosen`: the next ones, or where the seed is new its first."""
        return tree_where(chosen, start(jnp.where(is_new, seeds, running.seeds), jnp.where(is_new, 0, running.episodes + 1)), running)

    def step(running: Running, actions: Array) -> tuple[Running, Array]:
        """The environments after the step, and the rows before any of them was reset at its end."""
        states, rows = jax.vmap(functools.partial(_step, env, continuing_task))(running.states, actions)
        steps = running.steps + 1
        rows = rows.at[:, -1].set(steps >= max_episode_steps)  # also where the step solves the task, as Gymnasium's own limit has it
        stepped = running.replace(states=states, rows=rows, steps=steps)
        if mode is AutoresetMode.DISABLED:
            return stepped, rows
        ended = jnp.any((running.rows if mode is AutoresetMode.NEXT_STEP else rows)[:, -2:] > 0.0, axis=1)
        anew = restart(stepped, ended, running.seeds, jnp.zeros_like(ended))
        if mode is AutoresetMode.SAME_STEP:  # with the observation that begins an episode goes the reward that ended the one before
            anew = anew.replace(rows=jnp.concatenate([anew.rows[:, :-3], rows[:, -3:]], axis=1))
        return anew, rows

    return tuple(jax.jit(function, compiler_options=compiler_options(env)) for function in (start, restart, step))
