"""Our environments as Gymnasium's: `gymnasium.make("hindrl/FixedGridPickAndPlace-v0")` and `gymnasium.make_vec` of the same.

Observations are dictionaries of `observation`, `achieved_goal` and `desired_goal`, as goal-conditioned learners expect them (Stable-Baselines3's HER,
for one), all float32 within bounds.

  * Actions are in [-1, 1], the range of the policies and of demonstrations on disk, not in the units of the environment itself.
  * The desired goal is the same in every episode: `env.task_goal()`, which says that the task is solved, not where things are. Where they are to
    be brought is part of the observation, or, in the fixed reach task, is not observed at all.
  * The reward is the environment's own: 1 at the step that solves the task, else 0. That step terminates the episode. The horizon truncates it: it
    is Gymnasium's `max_episode_steps`. With `continuing_task=True`, as in the mazes of Gymnasium-Robotics, the episode goes on until the horizon,
    with a reward of 1 for each step at the goal. Hindsight that ends no episode at the goals that it draws (Stable-Baselines3's HER) needs that:
    they are worth up to 1 / (1 - gamma) there, against 1 for the task's own.
  * compute_reward(achieved_goal, desired_goal, info) is 1 where |achieved - desired| <= `env.goal_tolerance` in every dimension. For the desired goal
    it agrees with the reward of every step; an environment with rules under which it could not is refused.
  * info["is_success"] says whether the reward is 1: in a continuing task, whether the goal is reached now. A grid has no action to stay, and an agent
    that releases the last object can no longer hold it at the goal; so count solved episodes without `continuing_task`.
"""

from __future__ import annotations

import functools
import numbers
from collections.abc import Sequence
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from gymnasium.spaces import Box, Dict
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from hindrl_jax.base.environments import RestorableEnvironment, action_to_env, compiler_options
from hindrl_jax.base.errors import UserError
from hindrl_jax.base.types import Array, tree_where
from hindrl_jax.tasks.registry import make, viewer
from hindrl_jax.training.recording import on_host

Observation = dict[str, np.ndarray]
_NEVER = 2**31 - 1  # the horizon of an environment whose episodes are cut here, or by Gymnasium


class _GoalTask:
    """What one environment and many side by side have in common: the environment, its spaces, and the goal test."""

    def __init__(self, name: str, arguments: dict[str, Any], render_mode: str | None, continuing_task: bool):
        if "horizon" in arguments:
            raise UserError(f"horizon = {arguments['horizon']} is not for Gymnasium, which has max_episode_steps: give that")
        env = make(name, horizon=_NEVER, **arguments)
        if on_host(env):
            raise UserError(f"{name} cannot be stepped here with backend = 'robosuite': choose 'closed_form' or 'mjx'")
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


def _pack(env: RestorableEnvironment, observation: Array, *results: Array | float) -> Array:
    """(D + G + 3,) all that a step has to say as one row of numbers, since every array on its way out of JAX takes its time."""
    observation = jnp.clip(observation, env.observation_low, env.observation_high)  # only rounding leads out of the bounds
    return jnp.concatenate([observation, env.achieved_goal(observation), jnp.stack([jnp.asarray(result, jnp.float32) for result in results])])


def _start(env: RestorableEnvironment, seed: Array, episode: Array) -> tuple[Any, Array]:
    """The first state and row of one of a seed's episodes, counted from 0."""
    state, observation = env.reset(jax.random.fold_in(jax.random.key(seed), episode))
    return state, _pack(env, observation, 0.0, 0.0, 0.0)


def _step(env: RestorableEnvironment, continuing_task: bool, state: Any, action: Array) -> tuple[Any, Array]:
    """The next state, and its row, in which nothing is truncated yet."""
    state, time_step = env.step(state, action_to_env(jnp.clip(action, -1.0, 1.0), env))
    if continuing_task:
        observation = jnp.clip(time_step.observation, env.observation_low, env.observation_high)
        reward = _is_reached(env.achieved_goal(observation), env.task_goal(), env.goal_tolerance)
        return state, _pack(env, observation, reward, 0.0, 0.0)
    return state, _pack(env, time_step.observation, time_step.reward, time_step.terminated, 0.0)


def _draw_seed(generator: np.random.Generator) -> int:
    return int(generator.integers(2**32))


@functools.cache
def _programs(env: RestorableEnvironment, continuing_task: bool) -> tuple[Any, Any]:
    """`_start` and `_step`, compiled once for all environments that are equal."""
    functions = functools.partial(_start, env), functools.partial(_step, env, continuing_task)
    return tuple(jax.jit(function, compiler_options=compiler_options(env)) for function in functions)


class GoalEnv(gymnasium.Env[Observation, np.ndarray]):
    """One environment. It is computed on the CPU: one alone would only wait for a GPU.

    Args:
      name: of the environment, as in `hindrl_jax.make`.
      render_mode: None, or "rgb_array".
      continuing_task: whether an episode goes on once it is solved, see above.
      **arguments: fields of the environment but `horizon`, which is Gymnasium's `max_episode_steps`.

    Raises:
      UserError: for a name, an argument, a render mode or a value of continuing_task that does not exist, or rules under which there is no
        `compute_reward`.
    """

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012, as Gymnasium reads it off the class

    def __init__(self, name: str, *, render_mode: str | None = None, continuing_task: bool = False, **arguments: Any):
        self._task = _GoalTask(name, arguments, render_mode, continuing_task)
        self.observation_space, self.action_space = self._task.observation_space, self._task.action_space
        self.metadata, self.render_mode = self._task.metadata, render_mode
        self._start, self._step = _programs(self._task.env, continuing_task)
        self._cpu = jax.devices("cpu")[0]
        self._seed: int | None = None
        self._episode = 0
        self._state: Any = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, dict[str, Any]]:
        """Starts an episode: the first of the seed's episodes, or without a seed the next."""
        super().reset(seed=seed)
        if seed is not None or self._seed is None:
            self._seed, self._episode = _draw_seed(self.np_random), 0
        else:
            self._episode += 1
        with jax.default_device(self._cpu):
            self._state, row = self._start(np.uint32(self._seed), np.int32(self._episode))
        return self._task.unpack(row)[0], {"is_success": False}

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Takes one step: action (A,), clipped to [-1, 1]."""
        with jax.default_device(self._cpu):
            self._state, row = self._step(self._state, np.asarray(action, np.float32))
        observation, reward, terminated, truncated = self._task.unpack(row)
        return observation, float(reward), bool(terminated), bool(truncated), {"is_success": bool(reward > 0.0)}

    def compute_reward(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any) -> np.ndarray:
        """1 where the goal is reached, else 0: goals (..., G) -> (...) float32. `info` is not used."""
        return self._task.compute_reward(achieved_goal, desired_goal, info)

    def render(self) -> np.ndarray | None:
        """A picture (H, W, 3) uint8 of the present state; None without a render mode."""
        return None if self.render_mode is None else self._task.picture(self._state)


@struct.dataclass(kw_only=True)
class _Lives:
    """E environments side by side."""

    states: Any  # leaves (E, ...)
    rows: Array  # (E, D + G + 3), what was said last
    seeds: Array  # (E,) uint32
    episodes: Array  # (E,) int32, which of the seed's episodes this is
    steps: Array  # (E,) int32, taken in this episode


@functools.cache
def _vector_programs(env: RestorableEnvironment, continuing_task: bool, max_episode_steps: int, mode: AutoresetMode) -> tuple[Any, Any, Any]:
    """The compiled start, restart and step of E environments."""

    def start(seeds: Array, episodes: Array) -> _Lives:
        states, rows = jax.vmap(functools.partial(_start, env))(seeds, episodes)
        return _Lives(states=states, rows=rows, seeds=seeds, episodes=episodes, steps=jnp.zeros_like(episodes))

    def restart(lives: _Lives, chosen: Array, seeds: Array, is_new: Array) -> _Lives:
        """New episodes where `chosen`: the next ones, or where the seed is new its first."""
        return tree_where(chosen, start(jnp.where(is_new, seeds, lives.seeds), jnp.where(is_new, 0, lives.episodes + 1)), lives)

    def step(lives: _Lives, actions: Array) -> tuple[_Lives, Array]:
        """The environments after the step, and the rows before any of them began anew at its end."""
        states, rows = jax.vmap(functools.partial(_step, env, continuing_task))(lives.states, actions)
        steps = lives.steps + 1
        rows = rows.at[:, -1].set(steps >= max_episode_steps)  # also where the step solves the task, as Gymnasium's own limit has it
        stepped = lives.replace(states=states, rows=rows, steps=steps)
        if mode is AutoresetMode.DISABLED:
            return stepped, rows
        ended = jnp.any((lives.rows if mode is AutoresetMode.NEXT_STEP else rows)[:, -2:] > 0.0, axis=1)
        anew = restart(stepped, ended, lives.seeds, jnp.zeros_like(ended))
        if mode is AutoresetMode.SAME_STEP:  # with the observation that begins an episode goes the reward that ended the one before
            anew = anew.replace(rows=jnp.concatenate([anew.rows[:, :-3], rows[:, -3:]], axis=1))
        return anew, rows

    return tuple(jax.jit(function, compiler_options=compiler_options(env)) for function in (start, restart, step))


class GoalVectorEnv(VectorEnv[Observation, np.ndarray, np.ndarray]):
    """E environments in one compiled program, on JAX's default device.

    Given the same seed, its episodes are those of E single environments (`vectorization_mode="sync"`).

    Args:
      name, render_mode, continuing_task, arguments: as for `GoalEnv`.
      num_envs: E.
      max_episode_steps: number of steps after which an episode is truncated; None or -1 is never.
      autoreset_mode: when an ended episode gives way to the next. "NextStep", Gymnasium's default: at the next step, whose action is ignored.
        "SameStep": at once; its last observation is in info["final_obs"]. "Disabled": by `reset`, with options {"reset_mask": (E,) bool}.

    Raises:
      UserError: as `GoalEnv`, and for a horizon that is none.
    """

    def __init__(
        self,
        name: str,
        *,
        num_envs: int = 1,
        max_episode_steps: int | None = None,
        render_mode: str | None = None,
        continuing_task: bool = False,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        **arguments: Any,
    ):
        super().__init__()
        limit: Any = _NEVER if max_episode_steps in (None, -1) else max_episode_steps  # -1 is Gymnasium's word for never
        if not isinstance(limit, numbers.Integral) or limit < 1:
            raise UserError(f"max_episode_steps = {limit!r} is not usable: it must be at least 1, or -1 for never")
        self._task = _GoalTask(name, arguments, render_mode, continuing_task)
        self.num_envs, self.render_mode = num_envs, render_mode
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {**self._task.metadata, "autoreset_mode": self.autoreset_mode}
        self.single_observation_space, self.single_action_space = self._task.observation_space, self._task.action_space
        self.observation_space, self.action_space = (
            batch_space(space, num_envs) for space in (self.single_observation_space, self.single_action_space)
        )
        self._start, self._restart, self._step = _vector_programs(self._task.env, continuing_task, min(int(limit), _NEVER), self.autoreset_mode)
        self._lives: _Lives | None = None

    def reset(self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, dict[str, Any]]:
        """Starts episodes everywhere, or where options["reset_mask"] (E,) says so.

        Args:
          seed: environment i gets seed + i, or item i of a sequence; without, each goes on to the next episode of the seed that it has.
          options: see above.
        """
        seed = int(seed) if isinstance(seed, numbers.Integral) else seed
        super().reset(seed=seed if isinstance(seed, int) else None)
        of_each = [seed + i for i in range(self.num_envs)] if isinstance(seed, int) else [None] * self.num_envs if seed is None else list(seed)
        if len(of_each) != self.num_envs:
            raise UserError(f"{len(of_each)} seeds for {self.num_envs} environments: give one for each, or a single number")
        is_new = np.array([one is not None or self._lives is None for one in of_each])
        seeds = np.array([_draw_seed(self.np_random if one is None else seeding.np_random(one)[0]) for one in of_each], np.uint32)
        chosen = np.asarray((options or {}).get("reset_mask", np.ones(self.num_envs, bool)), bool)
        if self._lives is None:
            self._lives = self._start(seeds, np.zeros(self.num_envs, np.int32))
        else:
            self._lives = self._restart(self._lives, chosen, seeds, is_new)
        return self._task.unpack(self._lives.rows)[0], self._info(np.zeros(self.num_envs, bool), chosen)

    def step(self, actions: np.ndarray) -> tuple[Observation, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Takes one step of all: actions (E, A), clipped to [-1, 1].

        Raises:
          gymnasium.error.ResetNeeded: before the first `reset`.
        """
        self._check_reset()
        self._lives, rows = self._step(self._lives, np.asarray(actions, np.float32))
        observation, reward, terminated, truncated = self._task.unpack(self._lives.rows)
        ended = terminated | truncated
        if self.autoreset_mode is not AutoresetMode.SAME_STEP or not ended.any():
            return observation, reward.astype(np.float64), terminated, truncated, self._info(reward > 0.0)
        final, *_ = self._task.unpack(rows)
        final_obs = np.full(self.num_envs, None, object)
        for i in np.flatnonzero(ended):
            final_obs[i] = {name: values[i] for name, values in final.items()}
        info = {"final_obs": final_obs, "_final_obs": ended, "final_info": self._info(reward > 0.0, ended), "_final_info": ended}
        return observation, reward.astype(np.float64), terminated, truncated, self._info((reward > 0.0) & ~ended) | info

    def compute_reward(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any) -> np.ndarray:
        """As of `GoalEnv`."""
        return self._task.compute_reward(achieved_goal, desired_goal, info)

    def render(self) -> tuple[np.ndarray, ...] | None:
        """A picture (H, W, 3) uint8 of each environment; None without a render mode."""
        if self.render_mode is None:
            return None
        self._check_reset()
        return tuple(self._task.picture(jax.tree.map(lambda leaf, i=i: leaf[i], self._lives.states)) for i in range(self.num_envs))

    def _check_reset(self) -> None:
        if self._lives is None:
            raise gymnasium.error.ResetNeeded("no episode has begun: call reset first")

    def _info(self, is_success: np.ndarray, present: np.ndarray | None = None) -> dict[str, np.ndarray]:
        return {"is_success": is_success, "_is_success": np.ones(self.num_envs, bool) if present is None else present}
