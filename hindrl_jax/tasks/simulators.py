"""Environments of Gymnasium by their id: what one must know of them to learn in them, and many of them side by side."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import importlib
import json
import numbers
import os
import warnings
from collections.abc import Iterator
from typing import Any

import numpy as np
from gymnasium import logger
from gymnasium.spaces import Box, Dict
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from gymnasium.vector.async_vector_env import AsyncState

from hindrl_jax.base.errors import UserError, one_line
from hindrl_jax.base.steppers import Outcome, SimulationFailed
from hindrl_jax.tasks.held_actions import is_success, make_held
from hindrl_jax.tasks.ids import make_single

_KEYS = ("observation", "achieved_goal", "desired_goal")
_SUCCESS = ("is_success", "success")  # in the info, the latter in gymnasium-robotics's mazes
_LARGEST_WHOLE = 2**22  # the halves between whole numbers up to it are float32
_PYTHONS = {"True": True, "False": False, "None": None}  # meant as Python writes them; JSON would take them for texts


@dataclasses.dataclass(frozen=True)
class Description:
    """What one must know of an environment of Gymnasium to learn in it."""

    observation_dim: int
    """Of its `observation` alone."""
    goal_dim: int
    action_low: np.ndarray
    """(A,), see `action_bounds`."""
    action_high: np.ndarray
    """(A,)"""
    whole_actions: bool
    """Whether it takes whole numbers."""
    horizon: int | None
    goal_tolerance: float | None
    success_key: str | None
    """Where its info says that the goal is reached; None where its reward says so."""
    success_reward: float
    """The reward of reaching the goal exactly; NaN where the info says it."""
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
    try:
        return _described(gymnasium_id, env)
    except UserError:
        raise
    except Exception as error:  # of any kind: it is somebody else's code
        hint = next((f": {advice}" for sign, advice in _OLD_GYM.items() if sign in str(error)), "")
        raise UserError(f"{gymnasium_id} fails at its first step ({_quoted(error)}){hint}") from error
    finally:
        with contextlib.suppress(Exception):
            env.close()


_OLD_GYM = {
    sign: f"its {what} is that of old Gym, and Gymnasium's is {form}; wrap it in one that has that"
    for what, form, signs in (
        ("reset", "reset(*, seed=None, options=None) -> observation, info", ("argument 'seed'", "argument 'options'", "reset returns")),
        ("step", "step(action) -> observation, reward, terminated, truncated, info", ("expected 5", "step returns")),
    )
    for sign in signs
}
"""What is said where an environment has the signatures of old Gym, by what the error says of it."""


def _quoted(error: Exception) -> str:
    return f"{type(error).__name__}: {one_line(error)}"


def _described(gymnasium_id: str, env: Any) -> Description:
    spaces, actions = env.observation_space, env.action_space
    if not (isinstance(spaces, Dict) and all(isinstance(spaces.get(key), Box) and len(spaces[key].shape) == 1 for key in _KEYS)):
        raise UserError(f"{gymnasium_id} is not goal-conditioned: its observations must be dictionaries of vectors {', '.join(_KEYS)}")
    achieved, desired = spaces["achieved_goal"].shape, spaces["desired_goal"].shape
    if achieved != desired or desired[0] < 1:
        raise UserError(f"{gymnasium_id} has achieved goals of shape {achieved} and desired goals of shape {desired}: they must be equal")
    low, high = action_bounds(gymnasium_id, actions)
    begun = env.reset(seed=0, options=None)
    if not (isinstance(begun, tuple) and len(begun) == 2):
        raise ValueError("reset returns no pair of observation and info")
    taken = env.step(np.clip(np.zeros(actions.shape), actions.low, actions.high).astype(actions.dtype))
    if not (isinstance(taken, tuple) and len(taken) == 5):
        raise ValueError(f"step returns {len(taken) if isinstance(taken, tuple) else 'no'} values")
    for observation in (begun[0], taken[0]):
        _check_observation(gymnasium_id, spaces, observation)
    info, goal = taken[4], np.asarray(begun[0]["desired_goal"])
    success_key = next((key for key in _SUCCESS if key in info), None)
    compute_reward = getattr(env.unwrapped, "compute_reward", None)
    if success_key is None and compute_reward is None:
        raise UserError(
            f"{gymnasium_id} does not say when a goal is reached: it has neither {' nor '.join(_SUCCESS)} in its info, nor compute_reward"
        )
    is_success(info.get(success_key), 0.0, success_key, 0.0)  # only to see that it can be read
    success_reward = float("nan")
    if success_key is None:
        success_reward = float(np.asarray(compute_reward(goal, goal, info), np.float64).reshape(()))
        if not np.isfinite(success_reward):
            raise UserError(f"{gymnasium_id} does not say when a goal is reached: compute_reward gives {success_reward} for the goal itself")
    threshold = getattr(env.unwrapped, "distance_threshold", None)
    is_number = np.ndim(threshold) == 0 and isinstance(np.asarray(threshold).item(), numbers.Real) and 0.0 <= float(threshold) < np.inf
    return Description(
        observation_dim=spaces["observation"].shape[0],
        goal_dim=desired[0],
        action_low=low,
        action_high=high,
        whole_actions=_is_whole(actions),
        horizon=env.spec.max_episode_steps,
        goal_tolerance=float(threshold) / desired[0] ** 0.5 if is_number else None,
        success_key=success_key,
        success_reward=success_reward,
        render_fps=env.metadata.get("render_fps", 25),
    )


def _check_observation(gymnasium_id: str, spaces: Dict, observation: Any) -> None:
    """Makes sure that an observation is what its space says: else its numbers would be broadcast, or cut to whole ones."""
    for key in _KEYS:
        value = np.asarray(observation[key]) if isinstance(observation, dict) and key in observation else None
        if value is None or value.shape != spaces[key].shape or not np.can_cast(value.dtype, spaces[key].dtype, "same_kind"):
            found = "nothing" if value is None else f"{value.dtype} of shape {value.shape}"
            raise UserError(
                f"{gymnasium_id} gives {found} as {key}, and its space says {spaces[key].dtype} of shape {spaces[key].shape}: mend one of them"
            )


def _is_whole(space: Box) -> bool:
    return space.dtype.kind in "iub"


def action_bounds(where: str, space: Any) -> tuple[np.ndarray, np.ndarray]:
    """The lowest and the highest actions (A,) that a policy may choose, float32.

    Whole numbers from a to b are chosen by rounding a number from a - 1/2 to b + 1/2, so that all of them are equally likely. A dimension whose
    bounds are equal stays fixed.

    Args:
      where: begins the message.
      space: of Gymnasium.

    Raises:
      UserError: if it is not one of vectors with bounds.
    """
    if not (isinstance(space, Box) and len(space.shape) == 1 and space.shape[0] >= 1):
        raise UserError(f"{where}: its actions are {space}; only vectors of numbers with bounds are supported")
    low, high = space.low.astype(np.float64), space.high.astype(np.float64)
    if _is_whole(space):
        if max(np.abs(low).max(), np.abs(high).max()) > _LARGEST_WHOLE:
            raise UserError(f"{where}: its actions are {space}; whole numbers beyond {_LARGEST_WHOLE} cannot be told apart: give it narrower bounds")
        half = np.where(low == high, 0.0, 0.5)
        low, high = low - half, high + half
    with np.errstate(over="ignore", invalid="ignore"):
        low, high = low.astype(np.float32), high.astype(np.float32)
        if not np.isfinite(high - low).all():
            raise UserError(f"{where}: its actions are {space}; only vectors of numbers with bounds are supported")
    return low, high


def played_actions(actions: np.ndarray, low: np.ndarray, high: np.ndarray, *, whole: bool) -> np.ndarray:
    """What an environment is given for actions (..., A) in its own units: within its bounds (A,), and whole numbers where it takes such; float64."""
    return np.clip(np.asarray(np.rint(actions) if whole else actions, np.float64), low, high)


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
            what = "a process of it died" if died else f"it raised {_quoted(error)}"
            raise SimulationFailed(f"{self.env.name} failed {when}: {what}") from error
        finally:
            logger.min_level = level

    def begin(self, seeds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Begins an episode in each environment: seeds (N,) -> observations (N, D), desired goals (N, G).

        Raises:
          SimulationFailed: if one fails, or what it gives is no observation.
        """
        with self._failure("when an episode was to begin"):
            self._observed, _ = self._envs.reset(seed=[int(seed) for seed in seeds])
        self._steps[:] = 0
        return self.now()

    def now(self) -> tuple[np.ndarray, np.ndarray]:
        """Observations (N, D) and desired goals (N, G) at present, both float32.

        Raises:
          SimulationFailed: if they are not finite numbers.
        """
        with np.errstate(over="ignore"):
            parts = {key: self._observed[key].astype(np.float32) for key in _KEYS}
        for key, values in parts.items():
            if not np.isfinite(values).all():
                index, dim = np.argwhere(~np.isfinite(values))[0]
                raise SimulationFailed(
                    f"{self.env.name} gave {key}[{dim}] = {self._observed[key][index, dim]} after {self._steps[index]} steps of an episode, which is "
                    "no finite float32: mend the environment"
                )
        return np.concatenate([parts["observation"], parts["achieved_goal"]], axis=1), parts["desired_goal"]

    def raw_observation(self) -> dict[str, np.ndarray]:
        """The present observation of the first environment as it gives it."""
        return {key: values[0] for key, values in self._observed.items()}

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
        played = played_actions(actions, space.low, space.high, whole=_is_whole(space))
        moment = f"at step {first}{'' if first == last else f' to {last}'} of an episode"
        with self._failure(moment):
            self._observed, rewards, terminated, truncated, info = self._envs.step(played.astype(space.dtype))
            success = self._successes(rewards, info)
        next_observation, _ = self.now()
        terminated = terminated | success
        ended = terminated | truncated
        if autoreset and ended.any():
            with self._failure(f"{moment}, when the next one was to begin"):
                self._observed, _ = self._envs.reset(options={"reset_mask": ended})
            self._steps[ended] = 0
        observation, desired_goal = self.now()
        return Outcome(
            next_observation=next_observation,
            success=success,
            terminated=terminated,
            truncated=truncated & ~terminated,
            observation=observation,
            desired_goal=desired_goal,
        )

    def _successes(self, rewards: np.ndarray, info: dict[str, Any]) -> np.ndarray:
        """(N,) bool, of a step's rewards (N,) and infos."""
        key = self.env.description.success_key
        if key is not None and not np.all(info.get(f"_{key}", False)):
            raise ValueError(f"info has no {key!r}, which it had at the first step")
        return is_success(info.get(key), rewards, key, self.env.description.success_reward)

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
