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

import numbers
from collections.abc import Sequence
from typing import Any

import gymnasium
import jax
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from hindrl_jax.base.compilation import in_float32
from hindrl_jax.base.errors import UserError
from hindrl_jax.tasks._goal_task import NEVER, Observation, Running, draw_seed, goal_task, programs, vector_programs
from hindrl_jax.tasks.ids import check_not_forked


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

    @in_float32
    def __init__(self, name: str, *, render_mode: str | None = None, continuing_task: bool = False, **arguments: Any):
        self._task = goal_task(name, arguments, render_mode, continuing_task)
        self.observation_space, self.action_space = self._task.observation_space, self._task.action_space
        self.metadata, self.render_mode = self._task.metadata, render_mode
        self._start, self._step = programs(self._task.env, continuing_task)
        self._seed: int | None = None
        self._episode = 0
        self._state: Any = None

    @in_float32
    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, dict[str, Any]]:
        """Starts an episode: the first of the seed's episodes, or without a seed the next."""
        check_not_forked()
        super().reset(seed=seed)
        if seed is not None or self._seed is None:
            self._seed, self._episode = draw_seed(self.np_random), 0
        else:
            self._episode += 1
        self._cpu = jax.devices("cpu")[0]
        with jax.default_device(self._cpu):
            self._state, row = self._start(np.uint32(self._seed), np.int32(self._episode))
        return self._task.unpack(row)[0], {"is_success": False}

    @in_float32
    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Takes one step: action (A,), clipped to [-1, 1].

        Raises:
          UserError: for an action of another shape, or one that is not a number.
          gymnasium.error.ResetNeeded: before the first `reset`.
        """
        if self._state is None:
            raise gymnasium.error.ResetNeeded("no episode has begun: call reset first")
        action = self._task.checked_actions(action, self.action_space.shape)
        with jax.default_device(self._cpu):
            self._state, row = self._step(self._state, action)
        observation, reward, terminated, truncated = self._task.unpack(row)
        return observation, float(reward), bool(terminated), bool(truncated), {"is_success": bool(reward > 0.0)}

    def compute_reward(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any) -> np.ndarray:
        """1 where the goal is reached, else 0: goals (..., G) -> (...) float32. `info` is not used."""
        return self._task.compute_reward(achieved_goal, desired_goal, info)

    @in_float32
    def render(self) -> np.ndarray | None:
        """A picture (H, W, 3) uint8 of the present state; None without a render mode."""
        return None if self.render_mode is None else self._task.picture(self._state)


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

    @in_float32
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
        limit: Any = NEVER if max_episode_steps in (None, -1) else max_episode_steps  # -1 is Gymnasium's word for never
        if not isinstance(limit, numbers.Integral) or limit < 1:
            raise UserError(f"max_episode_steps = {limit!r} is not usable: it must be at least 1, or -1 for never")
        self._task = goal_task(name, arguments, render_mode, continuing_task)
        self.num_envs, self.render_mode = num_envs, render_mode
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {**self._task.metadata, "autoreset_mode": self.autoreset_mode}
        self.single_observation_space, self.single_action_space = self._task.observation_space, self._task.action_space
        self.observation_space, self.action_space = (
            batch_space(space, num_envs) for space in (self.single_observation_space, self.single_action_space)
        )
        self._start, self._restart, self._step = vector_programs(self._task.env, continuing_task, min(int(limit), NEVER), self.autoreset_mode)
        self._running: Running | None = None

    @in_float32
    def reset(self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, dict[str, Any]]:
        """Starts episodes everywhere, or where options["reset_mask"] (E,) says so.

        Args:
          seed: environment i gets seed + i, or item i of a sequence; without, each goes on to the next episode of the seed that it has.
          options: see above.
        """
        check_not_forked()
        seed = int(seed) if isinstance(seed, numbers.Integral) else seed
        super().reset(seed=seed if isinstance(seed, int) else None)
        of_each = [seed + i for i in range(self.num_envs)] if isinstance(seed, int) else [None] * self.num_envs if seed is None else list(seed)
        if len(of_each) != self.num_envs:
            raise UserError(f"{len(of_each)} seeds for {self.num_envs} environments: give one for each, or a single number")
        is_new = np.array([one is not None or self._running is None for one in of_each])
        seeds = np.array([draw_seed(self.np_random if one is None else seeding.np_random(one)[0]) for one in of_each], np.uint32)
        chosen = np.asarray((options or {}).get("reset_mask", np.ones(self.num_envs, bool)), bool)
        if self._running is None:
            self._running = self._start(seeds, np.zeros(self.num_envs, np.int32))
        else:
            self._running = self._restart(self._running, chosen, seeds, is_new)
        return self._task.unpack(self._running.rows)[0], self._info(np.zeros(self.num_envs, bool), chosen)

    @in_float32
    def step(self, actions: np.ndarray) -> tuple[Observation, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Takes one step of all: actions (E, A), clipped to [-1, 1].

        Raises:
          UserError: for actions of another shape, or that are not numbers.
          gymnasium.error.ResetNeeded: before the first `reset`.
        """
        self._check_reset()
        self._running, rows = self._step(self._running, self._task.checked_actions(actions, self.action_space.shape))
        observation, reward, terminated, truncated = self._task.unpack(self._running.rows)
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

    @in_float32
    def render(self) -> tuple[np.ndarray, ...] | None:
        """A picture (H, W, 3) uint8 of each environment; None without a render mode."""
        if self.render_mode is None:
            return None
        self._check_reset()
        return tuple(self._task.picture(jax.tree.map(lambda leaf, i=i: leaf[i], self._running.states)) for i in range(self.num_envs))

    def _check_reset(self) -> None:
        if self._running is None:
            raise gymnasium.error.ResetNeeded("no episode has begun: call reset first")

    def _info(self, is_success: np.ndarray, present: np.ndarray | None = None) -> dict[str, np.ndarray]:
        return {"is_success": is_success, "_is_success": np.ones(self.num_envs, bool) if present is None else present}
