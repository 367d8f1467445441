"""Goal-conditioned environments of Gymnasium, as tasks to learn: `hindrl_jax.make("gymnasium:FetchReach-v4")`.

They are stepped on the host, by their own code, many side by side (`Simulators`); `hindrl_jax.training.host` learns from what they say.

  * Any environment will do whose observations are dictionaries of vectors `observation`, `achieved_goal` and `desired_goal`, and whose actions are
    vectors with bounds. Here the observation is [observation, achieved_goal], and the goal of an episode is the desired goal of its first
    observation. Networks see the goal beside the observation, so that it can be another in hindsight.
  * The reward is 1 where the environment says that the goal is reached (info["is_success"] or info["success"], else a reward as high as that of
    reaching the goal exactly), else 0, whatever the environment's own is. The episode ends there, as in all our tasks, also where the environment
    itself would go on. So success means that the goal was reached at some step, not that it was held until the last one.
  * `goal_tolerance` is the half-width of the largest box within the environment's ball, where it has one (`distance_threshold`). Goals in hindsight
    count as reached within a box, so they are never easier than the environment's own.
  * States cannot be written down: episodes begin where the environment lets them begin.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
import json
import os
from typing import Any, ClassVar, Literal, TypeGuard

import numpy as np
from gymnasium.spaces import Box, Dict
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv

from hindrl_jax.base.checks import check, check_types
from hindrl_jax.base.errors import UserError, one_line
from hindrl_jax.base.types import Array
from hindrl_jax.tasks.ids import check_registered, make_single

PREFIX = "gymnasium:"
_KEYS = ("observation", "achieved_goal", "desired_goal")
_SUCCESS = ("is_success", "success")  # in the info, the latter in gymnasium-robotics's mazes


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


@dataclasses.dataclass(frozen=True)
class GymnasiumEnv:
    """An environment of Gymnasium, known by its name and arguments; a `types.Environment`, but not to be stepped inside a compiled program.

    Made by `hindrl_jax.make("gymnasium:ID", ...)`, which gives each id a class of its own.
    """

    name: ClassVar[str]
    id: ClassVar[str]
    interchangeable: ClassVar[tuple[str, ...]] = ("vectorization",)
    """Arguments in which demonstrations may differ from the environment that learns from them."""

    horizon: int | None = None
    """Number of steps after which an episode is truncated; by default what Gymnasium's registry says."""
    make_kwargs: tuple[str, ...] = ()
    """Arguments for gymnasium.make, as NAME=VALUE, the value in JSON or a plain word."""
    vectorization: Literal["sync", "async"] = "sync"
    """Environments one after the other in one process, or each in a process of its own, which pays where a step takes milliseconds."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "make_kwargs", tuple(self.make_kwargs))
        check_types(self)
        check(self, horizon=(self.horizon is None or self.horizon >= 1, "at least 1"))
        if self.horizon is None:
            if self.description.horizon is None:
                raise UserError(f"{self.name} sets no limit to the length of an episode: give a horizon")
            object.__setattr__(self, "horizon", self.description.horizon)

    @property
    def arguments(self) -> dict[str, Any]:
        """What `make_kwargs` says."""
        return _arguments(self.make_kwargs)

    @property
    def description(self) -> Description:
        """Found by making the environment once."""
        return describe(self.id, self.make_kwargs)

    @property
    def observation_dim(self) -> int:
        return self.description.observation_dim + self.description.goal_dim

    @property
    def goal_dim(self) -> int:
        return self.description.goal_dim

    @property
    def action_dim(self) -> int:
        return self.description.action_low.shape[0]

    @property
    def action_low(self) -> np.ndarray:
        return self.description.action_low

    @property
    def action_high(self) -> np.ndarray:
        return self.description.action_high

    @property
    def state_dim(self) -> int:
        """0: there are no states."""
        return 0

    @property
    def goal_tolerance(self) -> np.ndarray | None:
        """(G,) half-width of the goal's box, see the module's docstring; None where the environment has no threshold."""
        tolerance = self.description.goal_tolerance
        return None if tolerance is None else np.full(self.goal_dim, tolerance, np.float32)

    def achieved_goal(self, observation: Array) -> Array:
        """The end of the observation: (..., D) -> (..., G)."""
        return observation[..., self.description.observation_dim :]

    def task_goal(self) -> Array:
        raise UserError(f"{self.name} has no one goal for all episodes: choose other behavioural goals")

    def reset(self, key: Array) -> tuple[Any, Array]:
        raise ValueError(f"{self.name} is stepped outside JAX: see Simulators")

    def step(self, state: Any, action: Array) -> tuple[Any, Any]:
        raise ValueError(f"{self.name} is stepped outside JAX: see Simulators")


@functools.cache
def environment_class(name: str) -> type[GymnasiumEnv]:
    """The class of an environment's name, "gymnasium:ID" or "gymnasium:MODULE:ID"; the module registers the id when it is imported.

    Raises:
      UserError: if there is no such environment.
    """
    gymnasium_id = name.removeprefix(PREFIX)
    check_registered(gymnasium_id)
    return type("GymnasiumEnv", (GymnasiumEnv,), {"name": name, "id": gymnasium_id, "__doc__": GymnasiumEnv.__doc__})


def is_gymnasium(env: Any) -> TypeGuard[GymnasiumEnv]:
    """Whether an environment is one of Gymnasium's."""
    return isinstance(env, GymnasiumEnv)


def make(name: str, arguments: dict[str, Any]) -> GymnasiumEnv:
    """Builds an environment; arguments that are not fields of `GymnasiumEnv` are for gymnasium.make."""
    fields = {field.name for field in dataclasses.fields(GymnasiumEnv)}
    own = {key: value for key, value in arguments.items() if key in fields}
    others = tuple(f"{key}={json.dumps(value)}" for key, value in arguments.items() if key not in fields)
    return environment_class(name)(**own | {"make_kwargs": (*own.get("make_kwargs", ()), *others)})


_PYTHONS = {"True": True, "False": False, "None": None}
"""Values that are meant as Python writes them; JSON would take them for texts."""


def _arguments(make_kwargs: tuple[str, ...]) -> dict[str, Any]:
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
    env = make_single(gymnasium_id, _arguments(make_kwargs), None)
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


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What a step of N environments has brought."""

    next_observation: np.ndarray  # (N, D) float32, the true next one
    success: np.ndarray  # (N,) bool, the goal was reached by this step
    terminated: np.ndarray  # (N,) bool, the episode is over, be it by success or by the environment's own rules
    truncated: np.ndarray  # (N,) bool, the horizon cut it; never both
    observation: np.ndarray  # (N, D) where the environments are now: in a new episode, if the old one is over
    desired_goal: np.ndarray  # (N, G) of the episode in which they are now

    @property
    def ended(self) -> np.ndarray:
        """(N,) bool"""
        return self.terminated | self.truncated


class Simulators:
    """N environments side by side, which begin anew as soon as their episodes end."""

    def __init__(self, env: GymnasiumEnv, num_envs: int, *, render_mode: str | None = None):
        self.env, self.num_envs = env, num_envs
        if render_mode is not None and not os.environ.get("MUJOCO_GL"):
            # Else Gymnasium would try one library after the other, and the first failure spoils the next.
            os.environ["MUJOCO_GL"] = importlib.import_module("hindrl_jax.envs.panda.opengl").opengl_library()
        make = functools.partial(make_single, env.id, env.arguments, env.horizon, render_mode)
        mode = dict(autoreset_mode=AutoresetMode.DISABLED)  # an episode that has reached its goal is to end, though its environment does not say so
        if env.vectorization == "async":
            # A fork of a process in which JAX runs threads may hang, so the processes are started afresh.
            self._envs = AsyncVectorEnv([make] * num_envs, context="spawn", **mode)
        else:
            self._envs = SyncVectorEnv([make] * num_envs, **mode)

    def begin(self, seeds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Begins an episode in each environment: seeds (N,) -> observations (N, D), desired goals (N, G)."""
        self._told, _ = self._envs.reset(seed=[int(seed) for seed in seeds])
        return self.now()

    def now(self) -> tuple[np.ndarray, np.ndarray]:
        """Observations (N, D) and desired goals (N, G) at present, both float32."""
        parts = (self._told["observation"], self._told["achieved_goal"])
        return np.concatenate(parts, axis=1, dtype=np.float32), self._told["desired_goal"].astype(np.float32)

    def told(self, index: int = 0) -> dict[str, np.ndarray]:
        """The present observation of one environment as it gives it."""
        return {key: values[index] for key, values in self._told.items()}

    def step(self, actions: np.ndarray, *, begin_anew: bool = True) -> Outcome:
        """Takes one step of each: actions (N, A) in the environment's own units. Episodes that end give way to new ones, if they are to."""
        space = self._envs.single_action_space
        actions = np.clip(actions, space.low, space.high).astype(space.dtype)
        self._told, rewards, terminated, truncated, info = self._envs.step(actions)
        next_observation, _ = self.now()
        what = self.env.description
        success = rewards >= what.success_reward if what.success_key is None else np.asarray(info[what.success_key], np.float32) > 0.5
        terminated = terminated | success
        ended = terminated | truncated
        if begin_anew and ended.any():
            self._told, _ = self._envs.reset(options={"reset_mask": ended})
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
