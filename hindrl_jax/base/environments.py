"""What an environment is, and what it may be able to do beyond that.

`Environment` describes a task. What can be done with it are abilities: `Steppable` in JAX, `hindrl_jax.base.steppers.HostStepped` outside it,
`Restorable` states, and observations that hindsight can change (`RelabelsObservations`). Code checks for the ability that it needs, not for a class.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar, Protocol, TypeGuard, get_args, get_type_hints, runtime_checkable

import jax.numpy as jnp

from hindrl_jax.base.compilation import without_fusion_emitters
from hindrl_jax.base.types import Array, TimeStep


@runtime_checkable
class Environment(Protocol):
    """A goal-conditioned task, stepped in JAX or outside it. Implementations are frozen dataclasses: hashable, and static under `jax.jit`."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    def __hash__(self) -> int: ...

    @property
    def name(self) -> str: ...

    @property
    def horizon(self) -> int:
        """Number of steps after which an episode is truncated."""

    @property
    def observation_dim(self) -> int: ...

    @property
    def goal_dim(self) -> int: ...

    @property
    def action_dim(self) -> int: ...

    @property
    def action_low(self) -> Any:
        """Lower bound of the actions in the environment's own units: a number for all dimensions, or (A,)."""

    @property
    def action_high(self) -> Any:
        """Upper bound, likewise."""

    def achieved_goal(self, observation: Array) -> Array:
        """The projection Phi of thesis section 2.2: observations (..., D) -> achieved goals (..., G)."""

    def task_goal(self) -> Array | None:
        """(G,) one fixed goal that stands for "the task is solved"; None, which only one that is stepped outside JAX may say, if it knows none."""


@runtime_checkable
class Steppable(Environment, Protocol):
    """An environment that is stepped by pure functions in JAX. They are unbatched; the caller applies `jax.vmap`.

    The state is any pytree and carries its own random key. Where the choice of a back end decides whether the functions work, a property
    `steps_in_jax` says so; ask with `can_step`.
    """

    def reset(self, key: Array) -> tuple[Any, Array]:
        """Starts an episode: key -> (state, observation (D,))."""

    def step(self, state: Any, action: Array) -> tuple[Any, TimeStep]:
        """Takes one step: action (A,) in the environment's own units, clipped to its bounds."""


def can_step(env: Any) -> TypeGuard[Steppable]:
    """Whether the environment can be stepped inside a compiled program, with the back end that it has now."""
    return isinstance(env, Steppable) and getattr(env, "steps_in_jax", True)


def backends_with(env: Any, ability: Callable[[Any], bool]) -> list[str]:
    """The back ends of an environment, choices of its field `backend`, with which it has an ability, for example `can_step`."""
    choices = get_args(get_type_hints(type(env))["backend"]) if hasattr(env, "backend") else ()
    return [choice for choice in choices if ability(dataclasses.replace(env, backend=choice))]


def holds_goal(env: Environment) -> bool:
    """Whether episodes go on where the goal is reached, to their horizon, and are solved where it is still reached at their last step.

    Environments that are stepped outside JAX and give goals say so by an attribute `success`, "held" or "reached"; all others end at their goals.
    """
    return getattr(env, "success", None) == "held"


def compiler_options(env: Environment, *, learns: bool = False) -> dict[str, Any]:
    """Options of XLA for a program of this environment, for `jax.jit` or `compile`: those that it needs, of which most need none, and those with
    which the program compiles sooner, unless it `learns`: is mostly gradient steps of reinforcement learning.
    """
    return ({} if learns else without_fusion_emitters()) | getattr(env, "compiler_options", {})


@runtime_checkable
class Restorable(Environment, Protocol):
    """An environment whose state can be written down as a vector and read back: to be drawn, or to begin an episode there."""

    @property
    def state_dim(self) -> int:
        """S, the length of the vector."""

    def observe(self, state: Any) -> Array:
        """The observation (D,) of a state."""

    def state_to_vector(self, state: Any) -> Array:
        """(S,) float32: all of the state but its key."""

    def vector_to_state(self, key: Array, vector: Array) -> Any:
        """The state of a vector (S,), with this key."""


def state_dim(env: Environment) -> int:
    """S, the length of the vectors of a `Restorable` environment's states; 0 for one that has none."""
    return getattr(env, "state_dim", 0)


@runtime_checkable
class RestorableEnvironment(Steppable, Restorable, Protocol):
    """A steppable environment with restorable states: what a task of your own is."""


@runtime_checkable
class RelabelsObservations(Environment, Protocol):
    """An environment whose task has parameters, such as where the waypoints are, that hindsight can replace.

    The task's parameters are part of the observation and do not affect the dynamics, so hindsight rewrites observations instead of goals.
    """

    @property
    def num_subgoals(self) -> int:
        """J, how many states the parameters are made of: for example one for each waypoint."""

    def relabel_observations(self, key: Array, observations: Array, subgoals: Array) -> tuple[Array, Array]:
        """What would have been observed in the same states if the task had had other parameters.

        Args:
          key: random key.
          observations: (n + 1, D) of consecutive states, the task not solved in the first.
          subgoals: (J, D) observations of the states that the new parameters are made of, in the order in which they are to be reached.

        Returns:
          The relabelled observations (n + 1, D), and (n,) bool for each but the first, whether the task is solved there.
        """


def action_to_env(action: Array, env: Environment) -> Array:
    """Maps policy actions (..., A) in [-1, 1] to the environment's own units."""
    low, high = _action_bounds(action, env)
    return low + (action + 1.0) * (0.5 * (high - low))


def action_from_env(action: Array, env: Environment) -> Array:
    """Maps actions (..., A) in the environment's own units to the policy's [-1, 1]; the inverse of `action_to_env`.

    A dimension whose bounds are equal has one action only, which is 0 to the policy.
    """
    low, high = _action_bounds(action, env)
    fixed = low == high
    return jnp.where(fixed, 0.0, 2.0 * (action - low) / jnp.where(fixed, 1.0, high - low) - 1.0)


def command_of(decision: Array, index: Array | int, action_dim: int) -> Array:
    """What is done at one of the control steps of a decision (`core.holding`): the action (..., A) that is held, or that one of a chunk (..., k A).

    Args:
      decision: (..., A) or (..., k A).
      index: which of the control steps, 0 .. k - 1.
      action_dim: A.

    Example:
      >>> command_of(jnp.array([1.0, 2.0, 3.0, 4.0]), 1, 2).tolist(), command_of(jnp.array([1.0, 2.0]), 1, 2).tolist()
      ([3.0, 4.0], [1.0, 2.0])
    """
    if decision.shape[-1] == action_dim:
        return decision
    return jnp.take(decision.reshape(*decision.shape[:-1], -1, action_dim), index, axis=-2)


def _action_bounds(action: Array, env: Environment) -> tuple[Array, Array]:
    low, high = (jnp.broadcast_to(jnp.asarray(bound, action.dtype), action.shape) for bound in (env.action_low, env.action_high))
    return low, high
