"""Environments of Gymnasium by their id, many of them side by side."""

from __future__ import annotations

import contextlib
import functools
import importlib
import os
import warnings
from collections.abc import Iterator
from typing import Any

import numpy as np
from gymnasium import logger
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from gymnasium.vector.async_vector_env import AsyncState

from hindrl_jax.base.environments import holds_goal
from hindrl_jax.base.errors import UserError, one_line
from hindrl_jax.base.steppers import Outcome, SimulationFailed
from hindrl_jax.tasks.describing import GOAL_KEYS, is_whole, played_actions, quoted
from hindrl_jax.tasks.held_actions import make_held
from hindrl_jax.tasks.ids import make_single


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
            make = functools.partial(make_held, make, num_held, None if holds_goal(env) else env.success_rule)
        mode = dict(autoreset_mode=AutoresetMode.DISABLED)  # an episode that has reached its goal is to end, though its environment does not say so
        self._steps, self._has_failed = np.zeros(num_envs, int), False
        with self._failure("while it was made"):
            if env.vectorization == "async":
                # A fork of a process in which JAX runs threads may hang, so the processes are started afresh.
                self._envs = AsyncVectorEnv([make] * num_envs, context="spawn", **mode)
            else:
                self._envs = SyncVectorEnv([make] * num_envs, **mode)

    @contextlib.contextmanager
    def _failure(self, when: str) -> Iterator[None]:
        """Whatever the environment raises, or the death of one of its processes, as one line."""
        level, logger.min_level = logger.min_level, logger.ERROR + 1  # Gymnasium prints the traceback of another process
        try:
            yield
        except UserError:
            self._has_failed = True
            raise
        except Exception as error:  # of any kind: it is somebody else's code
            self._has_failed = True
            died = isinstance(error, EOFError | ConnectionError)
            what = "a process of it died" if died else f"it raised {quoted(error)}"
            raise SimulationFailed(f"{self.env.name} failed {when}: {what}") from error
        finally:
            logger.min_level = level

    def begin(self, seeds: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
        """Begins an episode in each environment: seeds (N,) -> observations (N, D), desired goals (N, G), or None where they give none.

        Raises:
          SimulationFailed: if one fails, or what it gives is no observation.
        """
        with self._failure("when an episode was to begin"):
            self._observed, _ = self._envs.reset(seed=[int(seed) for seed in seeds])
        self._steps[:] = 0
        observation, self._goals = self.now()
        return observation, self._goals

    def now(self) -> tuple[np.ndarray, np.ndarray | None]:
        """Observations (N, D) and desired goals (N, G) at present, both float32; None where observations are flat and give no goals.

        Raises:
          SimulationFailed: if they are not finite numbers.
        """
        with np.errstate(over="ignore"):
            parts = {key: values.astype(np.float32) for key, values in self._parts().items()}
        for key, values in parts.items():
            if not np.isfinite(values).all():
                index, dim = np.argwhere(~np.isfinite(values))[0]
                raise SimulationFailed(
                    f"{self.env.name} gave {key}[{dim}] = {self._parts()[key][index, dim]} after {self._steps[index]} steps of an episode, which is "
                    "no finite float32: mend the environment"
                )
        if not self.env.gives_goals:
            return parts["observation"], None
        return np.concatenate([parts["observation"], parts["achieved_goal"]], axis=1), parts["desired_goal"]

    def _parts(self) -> dict[str, np.ndarray]:
        """What all environments observe at present, by `GOAL_KEYS`; of flat observations the first alone."""
        return {key: self._observed[key] for key in GOAL_KEYS} if self.env.gives_goals else {"observation": self._observed}

    def raw_observation(self) -> Any:
        """The present observation of the first environment as it gives it: a dictionary of arrays, or an array where observations are flat."""
        return {key: values[0] for key, values in self._observed.items()} if self.env.gives_goals else self._observed[0]

    def step(self, actions: np.ndarray, *, autoreset: bool = True) -> Outcome:
        """Takes one step of each: actions (N, A) in the environment's own units. Episodes that end give way to new ones, if they are to.

        Raises:
          UserError: if the actions have another shape.
          SimulationFailed: if an environment fails, or what it gives is no observation.
        """
        space = self._envs.single_action_space
        if np.shape(actions) != (self.num_envs, *space.shape):
            raise UserError(
                f"actions of shape {np.shape(actions)} are not those of {self.num_envs} environments: give {(self.num_envs, *space.shape)}"
            )
        self._steps += 1
        first, last = self._steps.min(), self._steps.max()  # nobody says which of the environments it is that fails
        played = played_actions(actions, space.low, space.high, whole=is_whole(space))
        moment = f"at step {first}{'' if first == last else f' to {last}'} of an episode"
        with self._failure(moment):
            self._observed, rewards, terminated, truncated, info = self._envs.step(played.astype(space.dtype))
            success = self.env.success_rule.solved(info, rewards, terminated)
        next_observation, goal = self.now()
        if not holds_goal(self.env):
            terminated = terminated | success
        ended = terminated | truncated
        if goal is not None and ((goal != self._goals).any(axis=1) & ~ended).any():
            self._has_failed = True
            raise SimulationFailed(
                f"{self.env.name} changed the desired goal {moment} that went on, and a goal has to stay for an episode: let it end there, or try "
                "--success reached"
            )
        if autoreset and ended.any():
            with self._failure(f"{moment}, when the next one was to begin"):
                self._observed, _ = self._envs.reset(options={"reset_mask": ended})
            self._steps[ended] = 0
        observation, desired_goal = self.now()
        self._goals = desired_goal
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
        """Ends the environments, and their processes if they have some. One that fails at it is a warning: what was learnt is worth more."""
        terminate = self._has_failed and self.env.vectorization == "async"
        if terminate:  # else Gymnasium would wait for an answer of processes that are gone
            self._envs._state = AsyncState.DEFAULT
        try:
            with self._failure("when it was closed"):
                self._envs.close(**{"terminate": True} if terminate else {})
        except UserError as error:
            if not self._envs.closed:
                warnings.warn(str(error), stacklevel=2)
            self._envs.closed = True
