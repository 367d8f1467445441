"""What one must know of an environment of Gymnasium to learn in it, found by making it once and taking a step."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import json
import numbers
from typing import Any

import numpy as np
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete

from hindrl_jax.base.errors import UserError, one_line
from hindrl_jax.tasks.ids import make_single
from hindrl_jax.tasks.success import SUCCESS_KEYS, SuccessRule

GOAL_KEYS = ("observation", "achieved_goal", "desired_goal")
_LARGEST_WHOLE = 2**22  # the halves between whole numbers up to it are float32
_PYTHONS = {"True": True, "False": False, "None": None}  # meant as Python writes them; JSON would take them for texts


@dataclasses.dataclass(frozen=True)
class Description:
    """What one must know of an environment of Gymnasium to learn in it."""

    gives_goals: bool
    """Whether its observations are dictionaries with goals; else they are flat."""
    observation_dim: int
    """Of its `observation` alone."""
    goal_dim: int
    """Of the goals that it gives; 0 where it gives none."""
    action_low: np.ndarray
    """(A,), see `action_bounds`."""
    action_high: np.ndarray
    """(A,)"""
    whole_actions: bool
    """Whether it takes whole numbers."""
    horizon: int | None
    goal_tolerance: float | None
    success: SuccessRule
    ends_at_goal: bool | None
    """Whether reaching a goal ends an episode; None where it has no goals or does not say it."""
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
        raise UserError(f"{gymnasium_id} fails at its first step ({quoted(error)}){hint}") from error
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


def quoted(error: Exception) -> str:
    return f"{type(error).__name__}: {one_line(error)}"


def _described(gymnasium_id: str, env: Any) -> Description:
    spaces, actions = env.observation_space, env.action_space
    low, high = action_bounds(gymnasium_id, actions)
    parts = _vectors(gymnasium_id, spaces)
    gives_goals = len(parts) > 1
    begun = env.reset(seed=0, options=None)
    if not (isinstance(begun, tuple) and len(begun) == 2):
        raise ValueError("reset returns no pair of observation and info")
    taken = env.step(np.clip(np.zeros(actions.shape), actions.low, actions.high).astype(actions.dtype))
    if not (isinstance(taken, tuple) and len(taken) == 5):
        raise ValueError(f"step returns {len(taken) if isinstance(taken, tuple) else 'no'} values")
    for observation in (begun[0], taken[0]):
        _check_observation(gymnasium_id, parts, observation)
    key = next((key for key in SUCCESS_KEYS if key in taken[4]), None)
    success = SuccessRule(key)
    if key is None and gives_goals:
        success = SuccessRule(reward=_reward_at_goal(gymnasium_id, env, np.asarray(begun[0]["desired_goal"]), taken[4]))
    success.solved(taken[4], np.asarray(taken[1], np.float64).reshape(()), taken[2])  # only to see that it can be read
    threshold = getattr(env.unwrapped, "distance_threshold", None)
    is_number = np.ndim(threshold) == 0 and isinstance(np.asarray(threshold).item(), numbers.Real) and 0.0 <= float(threshold) < np.inf
    goal_dim = parts["desired_goal"].shape[0] if gives_goals else 0
    return Description(
        gives_goals=gives_goals,
        observation_dim=parts["observation"].shape[0],
        goal_dim=goal_dim,
        action_low=low,
        action_high=high,
        whole_actions=is_whole(actions),
        horizon=env.spec.max_episode_steps,
        goal_tolerance=float(threshold) / goal_dim**0.5 if is_number and gives_goals else None,
        success=success,
        ends_at_goal=_ends_at_goal(env, np.asarray(begun[0]["desired_goal"]), taken[4]) if gives_goals else None,
        render_fps=env.metadata.get("render_fps", 25),
    )


def _vectors(gymnasium_id: str, space: Any) -> dict[str, Box]:
    """The spaces of the vectors that are observed, by `GOAL_KEYS`: all three, or the first alone where observations are flat.

    Raises:
      UserError: if it observes anything else.
    """
    parts: dict[str, Any] = {key: space.get(key) for key in GOAL_KEYS} if isinstance(space, Dict) else {"observation": space}
    if not all(isinstance(part, Box) and len(part.shape) == 1 and part.shape[0] >= 1 for part in parts.values()):
        raise UserError(
            f"{gymnasium_id} observes {_cut(space)}, and only vectors of numbers, or dictionaries of vectors {', '.join(GOAL_KEYS)}, can be learnt "
            "from: wrap it in gymnasium.wrappers.FlattenObservation, and register what comes of it"
        )
    if len(parts) > 1 and parts["achieved_goal"].shape != parts["desired_goal"].shape:
        achieved, desired = parts["achieved_goal"].shape, parts["desired_goal"].shape
        raise UserError(f"{gymnasium_id} has achieved goals of shape {achieved} and desired goals of shape {desired}: they must be equal")
    return parts


def _cut(space: Any) -> str:
    """How a space writes itself, on one line of bounded length."""
    text = " ".join(str(space).split())
    return text if len(text) <= 100 else f"{text[:97]}..."


def _reward_at_goal(gymnasium_id: str, env: Any, goal: np.ndarray, info: dict[str, Any]) -> float:
    """The reward for reaching a goal (G,) exactly.

    Raises:
      UserError: if it cannot be had.
    """
    compute_reward = getattr(env.unwrapped, "compute_reward", None)
    if compute_reward is None:
        raise UserError(
            f"{gymnasium_id} does not say when a goal is reached: it has neither {' nor '.join(SUCCESS_KEYS)} in its info, nor compute_reward"
        )
    reward = float(np.asarray(compute_reward(goal, goal, info), np.float64).reshape(()))
    if not np.isfinite(reward):
        raise UserError(f"{gymnasium_id} does not say when a goal is reached: compute_reward gives {reward} for the goal itself")
    return reward


def _ends_at_goal(env: Any, goal: np.ndarray, info: dict[str, Any]) -> bool | None:
    """Whether an episode ends where its goal (G,) is reached, as the interface of Gymnasium-Robotics says it; None where nothing says it."""
    compute_terminated = getattr(env.unwrapped, "compute_terminated", None)
    return None if compute_terminated is None else bool(compute_terminated(goal, goal, info))


def _check_observation(gymnasium_id: str, parts: dict[str, Box], observation: Any) -> None:
    """Makes sure that an observation is what its space says: else its numbers would be broadcast, or cut to whole ones."""
    given = (observation if isinstance(observation, dict) else {}) if len(parts) > 1 else {"observation": observation}
    for key, space in parts.items():
        value = np.asarray(given[key]) if key in given else None
        if value is None or value.shape != space.shape or not np.can_cast(value.dtype, space.dtype, "same_kind"):
            found = "nothing" if value is None else f"{value.dtype} of shape {value.shape}"
            raise UserError(f"{gymnasium_id} gives {found} as {key}, and its space says {space.dtype} of shape {space.shape}: mend one of them")


def is_whole(space: Box) -> bool:
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
    if isinstance(space, Discrete | MultiDiscrete | MultiBinary):
        raise UserError(
            f"{where}: its actions are {_cut(space)}, which are discrete, and only vectors of numbers with bounds can be learnt: choose the "
            "continuous form of the environment, if it has one"
        )
    if not (isinstance(space, Box) and len(space.shape) == 1 and space.shape[0] >= 1):
        raise UserError(f"{where}: its actions are {_cut(space)}; only vectors of numbers with bounds can be learnt: wrap it so that it takes such")
    low, high = space.low.astype(np.float64), space.high.astype(np.float64)
    if is_whole(space):
        if max(np.abs(low).max(), np.abs(high).max()) > _LARGEST_WHOLE:
            raise UserError(f"{where}: its actions are {space}; whole numbers beyond {_LARGEST_WHOLE} cannot be told apart: give it narrower bounds")
        half = np.where(low == high, 0.0, 0.5)
        low, high = low - half, high + half
    with np.errstate(over="ignore", invalid="ignore"):
        low, high = low.astype(np.float32), high.astype(np.float32)
        if not np.isfinite(high - low).all():
            raise UserError(
                f"{where}: its actions are {_cut(space)}; only vectors of numbers with bounds can be learnt: wrap it in a "
                "gymnasium.wrappers.TransformAction with finite bounds, and register what comes of it"
            )
    return low, high


def played_actions(actions: np.ndarray, low: np.ndarray, high: np.ndarray, *, whole: bool) -> np.ndarray:
    """What an environment is given for actions (..., A) in its own units: within its bounds (A,), and whole numbers where it takes such; float64."""
    return np.clip(np.asarray(np.rint(actions) if whole else actions, np.float64), low, high)
