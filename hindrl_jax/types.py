"""Data that every part of the project shares: episodes, batches and the interface of an environment.

Shape letters, project-wide: B batch, T time (the horizon), N critics, Q quantiles, G goal, D observation, A action, E environments, S seeds.
"""

from __future__ import annotations

from typing import Any, ClassVar, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from flax import struct

Array = jax.Array


class TimeStep(struct.PyTreeNode, kw_only=True):
    """What one environment step returns.

    `observation` is always the true next observation, also when the episode has just ended: resetting is the caller's business.
    """

    observation: Array  # (D,) float32
    reward: Array  # () float32, 1 where the task is solved by this step, else 0
    terminated: Array  # () bool, the task is over (solved); there is no future value
    truncated: Array  # () bool, the horizon, or the training, cut the episode; the future value still exists


class Episodes(struct.PyTreeNode, kw_only=True):
    """A table of episodes, padded to the horizon. Used for demonstrations and, through `replay`, for rollouts.

    Row t of an episode is the transition (observations[t], actions[t], rewards[t], observations[t + 1]) for 0 <= t < length. Entries past the
    length are padding and are never read. Leading axes other than the first (episode) axis are named where the table is made.
    """

    observations: Array  # (N, T + 1, D) float32
    actions: Array  # (N, T, A) float32, in the policy's range [-1, 1]
    rewards: Array  # (N, T) float32
    lengths: Array  # (N,) int32, number of transitions, 1 <= length <= T
    terminated: Array  # (N,) bool, whether the last transition ended the task (rather than the horizon)
    desired_goals: Array  # (N, G) float32, the goal that the episode was acted under
    states: Array | None = None  # (N, T + 1, S) environment states as vectors; None where they are not kept


class Transition(struct.PyTreeNode, kw_only=True):
    """A batch of (n-step) transitions, ready for the losses."""

    observation: Array  # (B, D)
    action: Array  # (B, A), in [-1, 1]
    reward: Array  # (B,), sum of the discounted rewards of the n steps
    discount: Array  # (B,), factor of the bootstrapped value: gamma**steps, or 0 after termination
    next_observation: Array  # (B, D)
    desired_goal: Array  # (B, G)
    is_demonstration: Array  # (B,) bool
    is_relabelled: Array  # (B,) bool, whether the goal, or what the observations are about, was chosen in hindsight
    obtained_return: Array | None = None  # (B,), the discounted return that the episode went on to obtain; None where it is not used
    weight: Array | None = None  # (B,), in [0, 1], of the row in the critics' loss; None for equal weights


@runtime_checkable
class Environment(Protocol):
    """A goal-conditioned task as pure functions. Implementations are frozen dataclasses: hashable, and static under `jax.jit`.

    `reset` and `step` are unbatched; the caller applies `jax.vmap`. The state is any pytree and carries its own random key.
    """

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

    def reset(self, key: Array) -> tuple[Any, Array]:
        """Starts an episode: key -> (state, observation (D,))."""

    def step(self, state: Any, action: Array) -> tuple[Any, TimeStep]:
        """Takes one step: action (A,) in the environment's own units, clipped to its bounds."""

    def achieved_goal(self, observation: Array) -> Array:
        """The projection Phi of thesis section 2.2: observations (..., D) -> achieved goals (..., G)."""

    def task_goal(self) -> Array:
        """(G,) one fixed goal that stands for "the task is solved"."""


def compiler_options(env: Environment) -> dict[str, Any]:
    """Options that XLA needs for programs that step this environment, for `jax.jit` or `compile`; most environments need none."""
    return getattr(env, "compiler_options", {})


@runtime_checkable
class RestorableEnvironment(Environment, Protocol):
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


@runtime_checkable
class RetellableEnvironment(Environment, Protocol):
    """An environment whose observations say what an episode is about, and whose motion does not depend on that: what has happened can be told
    again as though the episode had been about something else. Hindsight then changes observations in place of goals."""

    @property
    def num_subgoals(self) -> int:
        """J, how many states one story is about."""

    def retell(self, key: Array, observations: Array, subgoals: Array) -> tuple[Array, Array]:
        """What would have been seen, had the episode been about other states.

        Args:
          key: random key.
          observations: (n + 1, D) of states that follow each other, the task not solved in the first.
          subgoals: (J, D) observations of the states that it is now about, in the order in which they are to be reached.

        Returns:
          The observations anew, and (n,) bool for each but the first, whether the task is solved there.
        """


def action_to_env(action: Array, env: Environment) -> Array:
    """Maps policy actions (..., A) in [-1, 1] to the environment's own units."""
    low, high = _action_bounds(action, env)
    return low + (action + 1.0) * (0.5 * (high - low))


def action_from_env(action: Array, env: Environment) -> Array:
    """Maps actions (..., A) in the environment's own units to the policy's [-1, 1]; the inverse of `action_to_env`."""
    low, high = _action_bounds(action, env)
    return 2.0 * (action - low) / (high - low) - 1.0


def _action_bounds(action: Array, env: Environment) -> tuple[Array, Array]:
    low, high = (jnp.broadcast_to(jnp.asarray(bound, action.dtype), action.shape) for bound in (env.action_low, env.action_high))
    return low, high


def tree_where(condition: Array, if_true: Any, if_false: Any) -> Any:
    """`jnp.where` over two pytrees of equal structure, random keys included; `condition` (B,) selects along the leading axis."""

    def select(a: Array, b: Array) -> Array:
        if jnp.issubdtype(a.dtype, jax.dtypes.prng_key):
            return jax.random.wrap_key_data(select(jax.random.key_data(a), jax.random.key_data(b)), impl=jax.random.key_impl(a))
        return jnp.where(condition.reshape(condition.shape + (1,) * (a.ndim - condition.ndim)), a, b)

    return jax.tree.map(select, if_true, if_false)
