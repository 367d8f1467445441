"""Environments that are stepped outside JAX, many at once, by code outside this project: a simulator in C, or another Python package."""

from __future__ import annotations

import dataclasses
from typing import Any, Protocol, TypeGuard, runtime_checkable

import numpy as np

from hindrl_jax.base.environments import Environment, can_step
from hindrl_jax.base.errors import UserError


class SimulationFailed(UserError):
    """An environment that is stepped outside JAX has failed: it raised, its process died, or it gave what is no observation."""


@dataclasses.dataclass(frozen=True)
class Outcome:
    """The result of one step of E environments."""

    next_observation: np.ndarray  # (E, D) float32, the true next one
    success: np.ndarray  # (E,) bool, the task was solved by this step
    terminated: np.ndarray  # (E,) bool, the episode is over by the environment's own rules, or by success, unless the goal is to be held
    truncated: np.ndarray  # (E,) bool, the horizon cut it; never both
    observation: np.ndarray  # (E, D) float32, where the environments are now: in a new episode, if the old one is over
    desired_goal: np.ndarray | None  # (E, G) float32, of the episode in which they are now; None where episodes have no goals of their own

    @property
    def ended(self) -> np.ndarray:
        """(E,) bool"""
        return self.terminated | self.truncated


class Stepper(Protocol):
    """E environments side by side, each of which starts a new episode as soon as its episode ends."""

    @property
    def num_envs(self) -> int: ...

    def begin(self, seeds: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
        """Begins an episode in each: seeds (E,) uint32 -> observations (E, D), and desired goals (E, G) or None, see `Outcome`."""

    def step(self, actions: np.ndarray) -> Outcome:
        """Takes one step of each: actions (E, A) in the environment's own units."""

    def close(self) -> None:
        """Ends the environments."""


class WatchedStepper(Stepper, Protocol):
    """One environment with its raw observations, for an expert, and with pictures."""

    def step(self, actions: np.ndarray, *, autoreset: bool = True) -> Outcome:
        """As of `Stepper`, but a new episode begins only if it is to, so that the last state can be looked at."""

    def raw_observation(self) -> Any:
        """The present observation as the environment's own code gives it, for an expert."""

    def picture(self) -> np.ndarray:
        """A picture (H, W, 3) uint8 of the present state.

        Raises:
          UserError: if it draws none, or cannot draw here.
        """


@runtime_checkable
class HostStepped(Environment, Protocol):
    """An environment that is stepped outside JAX, many at once.

    Where the choice of a back end decides whether it is, a property `steps_on_host` says so; ask with `can_step_on_host`.
    """

    @property
    def gives_goals(self) -> bool:
        """Whether each of its episodes comes with a goal of its own, rather than with a behavioural goal from the demonstrations. If so, an attribute
        `success` may say that the goal is to be held (`base.environments.holds_goal`)."""

    def stepper(self, num_envs: int, *, num_held: int = 1) -> Stepper:
        """That many environments side by side, which hold each action for `num_held` steps, or until the episode is over."""


@runtime_checkable
class Watchable(HostStepped, Protocol):
    """A host-stepped environment that can be watched: by an expert who demonstrates it, and, as it draws itself, by a person."""

    @property
    def render_fps(self) -> int:
        """Steps shown per second of a film."""

    def watched(self, *, with_pictures: bool) -> WatchedStepper:
        """One environment, in this process."""


def can_step_on_host(env: Any) -> TypeGuard[HostStepped]:
    """Whether the environment can be stepped outside JAX, many at once, with the back end that it has now."""
    return isinstance(env, HostStepped) and getattr(env, "steps_on_host", True)


def can_be_watched(env: Any) -> TypeGuard[Watchable]:
    """Whether the environment, stepped outside JAX, shows its raw observations and draws itself."""
    return isinstance(env, Watchable) and not can_step(env)


def gives_goals(env: Any) -> bool:
    """Whether each episode comes with a goal of the environment's own, which only those that are stepped outside JAX have."""
    return can_step_on_host(env) and env.gives_goals
