"""Environments of Gymnasium, as tasks to learn: `hindrl_jax.make("gymnasium:FetchReach-v4")`.

They are stepped on the host, by their own code, many side by side (`hindrl_jax.tasks.simulators`). Their actions are vectors with bounds.
States cannot be written down: episodes begin where the environment lets them begin. There are two kinds:

**With goals.** Observations are dictionaries of vectors `observation`, `achieved_goal` and `desired_goal`.

  * Here the observation is [observation, achieved_goal], and the goal of an episode is the desired goal of its first observation. Networks see what
    is left to the goal beside the observation, desired less achieved, so that the goal can be another in hindsight.
  * The reward is 1 where the environment says that the goal is reached (info["is_success"] or info["success"], else a reward as high as that of
    reaching the goal exactly), else 0, whatever the environment's own is.
  * With `success` = "held" an episode goes on to its horizon, and is a success where the goal is reached at its last step, which is what papers on
    the Fetch tasks count; each step there is worth 1 - gamma (`core.steps.as_occupancy`). With "reached" an episode ends, a success, where the goal
    is first reached, also where the environment itself would go on. By default it is "held" where the environment says that reaching a goal ends no
    episode (`compute_terminated`, of Gymnasium-Robotics).
  * `goal_tolerance` is the half-width of the largest box within the environment's ball, where it has one (`distance_threshold`). Goals in hindsight
    count as reached within a box, so they are never easier than the environment's own.

**Flat.** Observations are vectors, and a sparse reward or a success flag says when the task is solved.

  * The achieved goal is the observation, or the part of it that `achieved_goal_indices` names. Episodes come without goals, and all
    aim at one, the mean of the demonstrations' ends. Those that begin otherwise may have to end otherwise, so one demonstration's end is no goal for
    all. Goals in hindsight count as reached within epsilon, which follows from the demonstrations (thesis eq. 4.7 and 4.8).
  * The reward is 1 where the task is solved, else 0, and the episode ends there. It is solved where the info says so, info["is_success"] or
    info["success"]; where the first step's info has neither, at a step with a reward of at least `success_reward`; and where that is not given, at a
    step that ends the episode (terminated) with a reward above 0, unless that step's info says otherwise. An episode that the environment ends
    otherwise has failed, and its last state is worth nothing.
"""

from __future__ import annotations

import dataclasses
import functools
import json
from typing import Any, ClassVar, Literal

import numpy as np

from hindrl_jax.base.checks import check, check_types
from hindrl_jax.base.errors import UserError
from hindrl_jax.base.types import Array
from hindrl_jax.tasks.describing import Description, arguments_of, describe, played_actions
from hindrl_jax.tasks.ids import check_registered
from hindrl_jax.tasks.simulators import Simulators
from hindrl_jax.tasks.success import SuccessRule

PREFIX = "gymnasium:"


@dataclasses.dataclass(frozen=True)
class GymnasiumEnv:
    """An environment of Gymnasium, known by its name and arguments: `base.steppers.Watchable`, and not to be stepped inside a compiled program.

    Made by `hindrl_jax.make("gymnasium:ID", ...)`, which gives each id a class of its own.
    """

    name: ClassVar[str]
    id: ClassVar[str]
    interchangeable: ClassVar[tuple[str, ...]] = ("vectorization", "achieved_goal_indices", "success_reward", "success")
    """Arguments in which demonstrations may differ from the environment that learns from them."""

    horizon: int | None = None
    """Number of steps after which an episode is truncated; by default what Gymnasium's registry says."""
    make_kwargs: tuple[str, ...] = ()
    """Arguments for gymnasium.make, as NAME=VALUE, the value in JSON or a plain word."""
    vectorization: Literal["sync", "async"] = "sync"
    """Environments one after the other in one process, or each in a process of its own, which pays where a step takes milliseconds."""
    achieved_goal_indices: tuple[int, ...] = ()
    """Of flat observations: the numbers, from 0, that make up the achieved goal (default: all of the observation)."""
    success_reward: float | None = None
    """Of flat observations, where no info says when the task is solved: the least reward that does (default: any above 0 that ends an episode)."""

    success: Literal["reached", "held"] | None = None
    """Of goals: to reach one, which ends the episode, or to be there at its last step (default: held where the environment says that it ends no
    episode)."""

    def __post_init__(self) -> None:
        for name in ("make_kwargs", "achieved_goal_indices"):  # files have lists in their place
            if isinstance(getattr(self, name), list):
                object.__setattr__(self, name, tuple(getattr(self, name)))
        check_types(self)
        check(self, horizon=(self.horizon is None or self.horizon >= 1, "at least 1"))
        if self.horizon is None:
            if self.description.horizon is None:
                raise UserError(f"{self.name} sets no limit to the length of an episode: give a horizon")
            object.__setattr__(self, "horizon", self.description.horizon)
        if self.success is None:
            object.__setattr__(self, "success", "held" if self.description.ends_at_goal is False else "reached")
        if self.achieved_goal_indices or self.success_reward is not None:
            self._check_flat()
        if self.success == "held" and not self.gives_goals:
            raise UserError(f"success = held is for environments that give goals, which {self.name} does not: leave it out")
        if self.success == "held" and self.description.ends_at_goal:
            raise UserError(f"success = held is for environments that go on at a goal, and {self.name} ends episodes there: leave it out")

    def _check_flat(self) -> None:
        """Makes sure that the options of flat observations can be had."""
        indices, what = self.achieved_goal_indices, self.description
        if what.gives_goals:
            option = "achieved_goal_indices" if indices else "success_reward"
            raise UserError(f"{option} is for flat observations, and {self.name} says itself what its goals are: leave it out")
        if not all(0 <= index < what.observation_dim for index in indices) or len({*indices}) < len(indices):
            raise UserError(
                f"achieved_goal_indices = {list(indices)} is not usable: {self.name} observes {what.observation_dim} numbers, give different ones "
                f"from 0 to {what.observation_dim - 1}"
            )
        if self.success_reward is not None and what.success.key is not None:
            raise UserError(f"success_reward is of no use in {self.name}, whose info says {what.success.key!r} at each step: leave it out")

    @property
    def arguments(self) -> dict[str, Any]:
        """What `make_kwargs` says."""
        return arguments_of(self.make_kwargs)

    @property
    def description(self) -> Description:
        """Found by making the environment once."""
        return describe(self.id, self.make_kwargs)

    @property
    def gives_goals(self) -> bool:
        """Whether each episode comes with a goal of its own; not where observations are flat."""
        return self.description.gives_goals

    @property
    def success_rule(self) -> SuccessRule:
        """What says that the task is solved."""
        return self.description.success if self.success_reward is None else SuccessRule(reward=self.success_reward)

    @property
    def observation_dim(self) -> int:
        return self.description.observation_dim + self.description.goal_dim

    @property
    def goal_dim(self) -> int:
        return self.description.goal_dim if self.gives_goals else len(self.achieved_goal_indices) or self.observation_dim

    @property
    def action_dim(self) -> int:
        return self.description.action_low.shape[0]

    @property
    def action_low(self) -> np.ndarray:
        return self.description.action_low

    @property
    def action_high(self) -> np.ndarray:
        return self.description.action_high

    def played_action(self, action: np.ndarray) -> np.ndarray:
        """What the environment is given for an action (A,) in its own units: within the bounds, and whole where it takes whole numbers."""
        whole = self.description.whole_actions
        half = 0.5 * (whole & (self.action_low != self.action_high))  # see `action_bounds`
        return played_actions(action, self.action_low + half, self.action_high - half, whole=whole).astype(np.float32)

    @property
    def whole_actions(self) -> bool:
        """Whether it takes whole numbers, see `played_action`."""
        return bool(self.description.whole_actions)

    @property
    def render_fps(self) -> int:
        return self.description.render_fps

    @property
    def goal_tolerance(self) -> np.ndarray | None:
        """(G,) half-width of the goal's box, see the module's docstring; None where the environment has no threshold."""
        tolerance = self.description.goal_tolerance
        return None if tolerance is None else np.full(self.goal_dim, tolerance, np.float32)

    def achieved_goal(self, observation: Array) -> Array:
        """The end of the observation, or of a flat one all of it, or what `achieved_goal_indices` names: (..., D) -> (..., G)."""
        if self.gives_goals:
            return observation[..., self.description.observation_dim :]
        return observation[..., np.array(self.achieved_goal_indices)] if self.achieved_goal_indices else observation

    def task_goal(self) -> None:
        """None: that the task is solved is said otherwise."""

    def stepper(self, num_envs: int, *, num_held: int = 1) -> Simulators:
        return Simulators(self, num_envs, num_held=num_held)

    def watched(self, *, with_pictures: bool) -> Simulators:
        return Simulators(dataclasses.replace(self, vectorization="sync"), 1, render_mode="rgb_array" if with_pictures else None)


@functools.cache
def environment_class(name: str) -> type[GymnasiumEnv]:
    """The class of an environment's name, "gymnasium:ID" or "gymnasium:MODULE:ID"; the module registers the id when it is imported.

    Raises:
      UserError: if there is no such environment.
    """
    gymnasium_id = name.removeprefix(PREFIX)
    check_registered(gymnasium_id)
    return type("GymnasiumEnv", (GymnasiumEnv,), {"name": name, "id": gymnasium_id, "__doc__": GymnasiumEnv.__doc__})


def make(name: str, arguments: dict[str, Any]) -> GymnasiumEnv:
    """Builds an environment; arguments that are not fields of `GymnasiumEnv` are for gymnasium.make."""
    fields = {field.name for field in dataclasses.fields(GymnasiumEnv)}
    own = {key: value for key, value in arguments.items() if key in fields}
    others = tuple(_as_typed(key, value) for key, value in arguments.items() if key not in fields)
    return environment_class(name)(**own | {"make_kwargs": (*own.get("make_kwargs", ()), *others)})


def _as_typed(name: str, value: Any) -> str:
    """NAME=VALUE as one would type it, so that it is the same from Python and from the command line: a word as it is, all else in JSON."""
    plain = f"{name}={value}"
    return plain if isinstance(value, str) and arguments_of((plain,)) == {name: value} else f"{name}={json.dumps(value)}"
