"""Environments of Gymnasium by their id: what one must know of them to learn in them, and many of them side by side."""

from __future__ import annotations

import dataclasses
import functools
import importlib
import json
import os
from typing import Any

import numpy as np
from gymnasium.spaces import Box, Dict
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv

from hindrl_jax.base.errors import UserError, one_line
from hindrl_jax.base.steppers import Outcome
from hindrl_jax.tasks.held_actions import make_held
from hindrl_jax.tasks.ids import make_single

_KEYS = ("observation", "achieved_goal", "desired_goal")
_SUCCESS = ("is_success", "success")  # in the info, the latter in gymnasium-robotics's mazes
_PYTHONS = {"True": True, "False": False, "None": None}  # meant as Python writes them; JSON would take them for texts


@dataclasses.dataclass(frozen=True)
class Description:
    """What one must know of an environment of Gymnasium to learn in it."""

    observation_dim: int
    """Of its `observation` alone."""
    goal_dim: int
    action_low: np.ndarray
    """(A,)"""
    action_high: np.ndarray
    """(A,)"""
    horizon: int | None
    goal_tolerance: float | None
    success_key: str | None
    """Where its info says that the goal is reached; None where its reward says so."""
    success_reward: float
    """The reward of reaching the goal exactly; NaN where nobody can say."""
    render_fps: int


def arguments_of(make_kwargs: tuple[str, ...]) -> dict[str, Any]:
    """Arguments of gymnasium.make, written as NAME=VALUE, the value in JSON or a plain word.

    Raises:
      UserError: if one is not written so.
    """
    arguments = {}
    for given in make_kwargs:
        name, equals, value = given.partition("=")
        if not (equals and name.isidentifier()):
            raise UserError(f"make_kwargs: {given!r} is not an argument and its value: write NAME=VALUE")
        try:
            arguments[name] = _PYTHONS[value] if value in _PYTHONS else json.loads(value)
        except ValueError:
            arguments[name] = value
    return arguments


@functools.cache
def describe(gymnasium_id: str, make_kwargs: tuple[str, ...]) -> Description:
    """Makes the environment, looks at it and takes a step.

    Raises:
      UserError: if it cannot be made or is not of the kind that can be learnt in.
    """
    env = make_single(gymnasium_id, arguments_of(make_kwargs), None)
    spaces, actions = env.observation_space, env.action_space
    if not (isinstance(spaces, Dict) and all(isinstance(spaces.get(key), Box) and len(spaces[key].shape) == 1 for key in _KEYS)):
        raise UserError(f"{gymnasium_id} is not goal-conditioned: its observations must be dictionaries of vectors {', '.join(_KEYS)}")
    if not (isinstance(actions, Box) and len(actions.shape) == 1 and np.isfinite([actions.low, actions.high]).all()):
        raise UserError(f"{gymnasium_id} takes no vectors with bounds as actions, but {actions}: this is not supported")
    observation, _ = env.reset(seed=0)
    *_, info = env.step(np.zeros(actions.shape, actions.dtype))
    success_key = next((key for key in _SUCCESS if key in info), None)
    compute_reward = getattr(env.unwrapped, "compute_reward", None)
    if success_key is None and compute_reward is None:
        raise UserError(
            f"{gymnasium_id} does not say when a goal is reached: it has neither {' nor '.join(_SUCCESS)} in its info, nor compute_reward"
        )
    goal_dim = spaces["desired_goal"].shape[0]
    threshold = getattr(env.unwrapped, "distance_threshold", None)
    goal = observation["desired_goal"]
    description = Description(
        observation_dim=spaces["observation"].shape[0],
        goal_dim=goal_dim,
        action_low=actions.low.astype(np.float32),
        action_high=actions.high.astype(np.float32),
        horizon=env.spec.max_episode_steps,
        goal_tolerance=None if threshold is None else float(threshold) / goal_dim**0.5,
        success_key=success_key,
        success_reward=float("nan") if compute_reward is None else float(compute_reward(goal, goal, info)),
        render_fps=env.metadata.get("render_fps", 25),
    )
    env.close()
    return description


class Simulators:
    """N environments side by side, a `base.steppers.Stepper`; of one alone a `WatchedStepper`."""

    def __init__(self, env: Any, num_envs: int, *, num_held: int = 1, render_mode: str | None = None):
        """Starts them.

        Args:
          env: a `from_gymnasium.GymnasiumEnv`.
          num_envs: N.
          num_held: steps for which each action is held.
          render_mode: "rgb_array" for pictures.
        """
        self.env, self.num_envs = env, num_envs
        if render_mode is not None and not os.environ.get("MUJOCO_GL"):
            # Else Gymnasium would try one library after the other, and the first failure spoils the next.
            os.environ["MUJOCO_GL"] = importlib.import_module("hindrl_jax.envs.panda.opengl").opengl_library()
        make = functools.partial(make_single, env.id, env.arguments, env.horizon, render_mode)
        if num_held > 1:
            what = env.description
            make = functools.partial(make_held, make, num_held, what.success_key, what.success_reward)
        mode = dict(autoreset_mode=AutoresetMode.DISABLED)  # an episode that has reached its goal is to end, though its environment does not say so
        if env.vectorization == "async":
            # A fork of a process in which JAX runs threads may hang, so the processes are started afresh.
            self._envs = AsyncVectorEnv([make] * num_envs, context="spawn", **mode)
        else:
            self._envs = SyncVectorEnv([make] * num_envs, **mode)

    def begin(self, seeds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Begins an episode in each environment: seeds (N,) -> observations (N, D), desired goals (N, G)."""
        self._observed, _ = self._envs.reset(seed=[int(seed) for seed in seeds])
        return self.now()

    def now(self) -> tuple[np.ndarray, np.ndarray]:
        """Observations (N, D) and desired goals (N, G) at present, both float32."""
        parts = (self._observed["observation"], self._observed["achieved_goal"])
        return np.concatenate(parts, axis=1, dtype=np.float32), self._observed["desired_goal"].astype(np.float32)

    def raw_observation(self) -> dict[str, np.ndarray]:
        """The present observation of the first environment as it gives it."""
        return {key: values[0] for key, values in self._observed.items()}

    def step(self, actions: np.ndarray, *, autoreset: bool = True) -> Outcome:
        """Takes one step of each: actions (N, A) in the environment's own units. Episodes that end give way to new ones, if they are to."""
        space = self._envs.single_action_space
        actions = np.clip(actions, space.low, space.high).astype(space.dtype)
        self._observed, rewards, terminated, truncated, info = self._envs.step(actions)
        next_observation, _ = self.now()
        what = self.env.description
        success = rewards >= what.success_reward if what.success_key is None else np.asarray(info[what.success_key], np.float32) > 0.5
        terminated = terminated | success
        ended = terminated | truncated
        if autoreset and ended.any():
            self._observed, _ = self._envs.reset(options={"reset_mask": ended})
        observation, desired_goal = self.now()
        return Outcome(
            next_observation=next_observation,
            success=success,
            terminated=terminated,
            truncated=truncated & ~terminated,
            observation=observation,
            desired_goal=desired_goal,
        )

    def picture(self) -> np.ndarray:
        """A picture (H, W, 3) uint8 of the first environment.

        Raises:
          UserError: if it draws none, or cannot draw here.
        """
        try:
            picture = np.asarray(self._envs.render()[0])
        except Exception as error:  # the libraries fail in many ways
            raise UserError(
                f"{self.env.name} cannot be drawn ({one_line(error)}): if that is for want of OpenGL, install libegl1 or libosmesa6, or set "
                "MUJOCO_GL=egl, osmesa or glfw"
            ) from error
        if picture.ndim != 3:
            raise UserError(f"{self.env.name} draws no pictures: it has no render mode rgb_array")
        return picture

    def close(self) -> None:
        """Ends the environments, and their processes if they have some."""
        self._envs.close()
