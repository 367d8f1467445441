"""Goal-conditioned environments of Gymnasium, as tasks to learn: `hindrl_jax.make("gymnasium:FetchReach-v4")`.

They are stepped on the host, by their own code, many side by side (`hindrl_jax.tasks.simulators`).

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
import json
from typing import Any, ClassVar, Literal

import numpy as np

from hindrl_jax.base.checks import check, check_types
from hindrl_jax.base.errors import UserError
from hindrl_jax.base.types import Array
from hindrl_jax.tasks.ids import check_registered
from hindrl_jax.tasks.simulators import Description, Simulators, arguments_of, describe, played_actions

PREFIX = "gymnasium:"


@dataclasses.dataclass(frozen=True)
class GymnasiumEnv:
    """An environment of Gymnasium, known by its name and arguments: `base.steppers.Watchable`, and not to be stepped inside a compiled program.

    Made by `hindrl_jax.make("gymnasium:ID", ...)`, which gives each id a class of its own.
    """

    name: ClassVar[str]
    id: ClassVar[str]
    interchangeable: ClassVar[tuple[str, ...]] = ("vectorization",)
    """Arguments in which demonstrations may differ from the environment that learns from them."""
    gives_goals: ClassVar[bool] = True

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
        return arguments_of(self.make_kwargs)

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

    def played_action(self, action: np.ndarray) -> np.ndarray:
        """What the environment is given for an action (A,) in its own units: within the bounds, and whole where it takes whole numbers."""
        whole = self.description.whole_actions
        half = 0.5 * (whole & (self.action_low != self.action_high))  # see `action_bounds`
        return played_actions(action, self.action_low + half, self.action_high - half, whole=whole).astype(np.float32)

    @property
    def render_fps(self) -> int:
        return self.description.render_fps

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
    others = tuple(f"{key}={json.dumps(value)}" for key, value in arguments.items() if key not in fields)
    return environment_class(name)(**own | {"make_kwargs": (*own.get("make_kwargs", ()), *others)})
