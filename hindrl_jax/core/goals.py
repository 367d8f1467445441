"""Goals: when one counts as reached, how wide epsilon is, which demonstration states serve as goals.

Follows thesis section 4.1.2 and algorithm 6 (after Davchev et al., HinDRL, 2021). Differences from the thesis:
  * The box test is `<=` by default. With the grid's epsilon = 0 the strict `<` of eq. 4.8 can never hold; `inclusive=False` restores it.
  * Epsilon-filtering keeps array shapes: it returns a mask, and the goal table carries a count.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct

from hindrl_jax.base.types import Array
from hindrl_jax.core.randomness import uniform_index


def goal_reached(achieved_goal: Array, desired_goal: Array, epsilon: Array, *, inclusive: bool = True) -> Array:
    """The box test of thesis eq. 4.8: every dimension of the achieved goal lies within epsilon of the desired goal.

    Args:
      achieved_goal: (..., G) in task units.
      desired_goal: (..., G), same leading axes.
      epsilon: (G,) half-width of the box per dimension, >= 0.
      inclusive: `<=` if true (default), the strict `<` of the thesis's formula otherwise.

    Returns:
      (...) bool.

    Example:
      >>> goal_reached(jnp.array([[0.0, 1.0], [0.0, 1.5]]), jnp.zeros((2, 2)), jnp.array([0.0, 1.0])).tolist()
      [True, False]
    """
    distance = jnp.abs(achieved_goal - desired_goal)
    epsilon = epsilon.reshape((1,) * (distance.ndim - 1) + epsilon.shape)
    within = distance <= epsilon if inclusive else distance < epsilon
    return jnp.all(within, axis=-1)


def epsilon_from_demonstrations(achieved_goals: Array, lengths: Array, *, steps: int, deviations: float) -> Array:
    """Half-width of the goal box per dimension (thesis eq. 4.7).

    epsilon_i = mean |z_{t+m,i} - z_{t,i}| + k * std |z_{t+m,i} - z_{t,i}|, mean and (population) deviation pooled over all pairs of all
    demonstrations; m is `steps` and k is `deviations`. With m = 0 it is zero. If no demonstration has m steps there are no pairs and epsilon is zero.

    Args:
      achieved_goals: (N, T + 1, G) goals along the demonstrations, padded.
      lengths: (N,) int32 number of transitions; demonstration n holds lengths[n] + 1 goals.
      steps: distance between the paired goals, >= 0.
      deviations: weight of the deviation.

    Returns:
      (G,) float32, in task units.
    """
    num_goals, goal_dim = achieved_goals.shape[1], achieved_goals.shape[2]
    if steps >= num_goals:
        return jnp.zeros(goal_dim, jnp.float32)
    distance = jnp.abs(achieved_goals[:, steps:] - achieved_goals[:, : num_goals - steps])  # (N, T + 1 - m, G)
    is_pair = (jnp.arange(num_goals - steps)[None] + steps <= lengths[:, None])[..., None]
    count = jnp.maximum(jnp.sum(is_pair), 1)
    mean = jnp.sum(jnp.where(is_pair, distance, 0.0), axis=(0, 1)) / count
    variance = jnp.sum(jnp.where(is_pair, jnp.square(distance - mean.reshape(1, 1, -1)), 0.0), axis=(0, 1)) / count
    return mean + deviations * jnp.sqrt(variance)


def epsilon_filter(achieved_goals: Array, epsilon: Array) -> Array:
    """Marks the steps of one demonstration that are worth keeping as goals.

    Walking forward in time, step t is kept when its goal lies outside the box of half-width epsilon around the last kept goal. The first
    step is always kept. The edge belongs to the box, as in the original code, whatever the test of rewards.  (Thesis, algorithm 6.)

    Args:
      achieved_goals: (T, G) goals reached along one demonstration, in task units.
      epsilon: (G,) half-width of the box, same units, >= 0.

    Returns:
      (T,) bool mask; its length does not depend on the data, so the function can be vmapped over demonstrations.

    Example:
      >>> goals = jnp.array([[0.0], [0.1], [0.5], [0.55], [1.0]])
      >>> epsilon_filter(goals, jnp.array([0.3])).tolist()
      [True, False, True, False, True]
    """

    def walk(last_goal: Array, goal: Array) -> tuple[Array, Array]:
        keep = ~goal_reached(goal, last_goal, epsilon)
        return jnp.where(keep, goal, last_goal), keep

    _, keep_rest = jax.lax.scan(walk, achieved_goals[0], achieved_goals[1:])
    return jnp.concatenate([jnp.ones(1, bool), keep_rest])


def without_last(keep: Array) -> Array:
    """The mask (T,) without the last step that it marks; the only one stays, since a demonstration without goals could not be drawn from.

    Example:
      >>> without_last(jnp.array([True, False, True, False])).tolist()
      [True, False, False, False]
    """
    rank = jnp.cumsum(keep)
    return keep & (rank < jnp.maximum(rank[-1], 2))


class GoalTest(struct.PyTreeNode, kw_only=True):
    """When a goal counts as reached, wherever a reward is computed from goals, and what that means for the return."""

    achieved_goal: Callable[[Array], Array] = struct.field(pytree_node=False)  # projection of observations (..., D) to goals (..., G)
    epsilon: Array  # (G,) half-width of the goal box
    inclusive: bool = struct.field(pytree_node=False, default=True)  # which box test, see `goal_reached`
    ends_return: bool = struct.field(pytree_node=False, default=True)  # whether the return ends where the goal is reached
    own_goals: bool = struct.field(pytree_node=False, default=False)  # whether episodes have goals of their own

    def reached(self, observations: Array, goals: Array) -> Array:
        """Whether goals (..., G) are reached at observations (..., D): (...) bool."""
        return goal_reached(self.achieved_goal(observations), goals, self.epsilon, inclusive=self.inclusive)


class GoalTable(struct.PyTreeNode, kw_only=True):
    """Goals to draw from: the first `count` rows, in the order in which the demonstrations reached them."""

    goals: Array  # (M, G) float32; rows from `count` on are padding
    count: Array  # () int32, 1 <= count <= M
    observations: Array | None = None  # (M, D) where they were reached; None where only the goals matter


def is_visited(lengths: Array, num_states: int) -> Array:
    """Marks the states that are not padding: lengths (N,) -> (N, num_states) bool; an episode of length l visits l + 1 states."""
    return jnp.arange(num_states)[None] <= lengths[:, None]


def goal_table(observations: Array, achieved_goals: Array, keep: Array) -> GoalTable:
    """Collects the goals that the demonstrations reach: the database G_db of the thesis, smoothed or not.

    Args:
      observations: (N, T + 1, D) states along the demonstrations, padded.
      achieved_goals: (N, T + 1, G) the goals that they reach.
      keep: (N, T + 1) bool, which of them are goals: `is_visited`, and for Smooth HinDRL `epsilon_filter`, too.

    Returns:
      A table with M = N * (T + 1) rows, of which `count` are goals.
    """
    keep = keep.reshape(-1)
    order = jnp.argsort(~keep, stable=True)

    def kept(values: Array) -> Array:
        return values.reshape(-1, values.shape[-1])[order]

    return GoalTable(goals=kept(achieved_goals), count=jnp.sum(keep), observations=kept(observations))


def final_goals(achieved_goals: Array, lengths: Array) -> GoalTable:
    """The goals at the end of each demonstration: the behavioural goals of thesis algorithm 5. Shapes as in `goal_table`, M = N."""
    goals = jnp.take_along_axis(achieved_goals, lengths[:, None, None], axis=1)[:, 0]
    return GoalTable(goals=goals, count=jnp.asarray(goals.shape[0]))


def constant_goal(goal: Array) -> GoalTable:
    """A table of one goal (G,): the constant behavioural goal of the original code."""
    return GoalTable(goals=goal.reshape(1, -1), count=jnp.asarray(1))


def sample_goals(key: Array, table: GoalTable, num_goals: int) -> Array:
    """Draws goals uniformly, with replacement, from the table (thesis eq. 4.2): (num_goals, G)."""
    return table.goals[uniform_index(key, (num_goals,), table.count)]


def nearby_goal(key: Array, table: GoalTable, observations: Array, test: GoalTest) -> Array:
    """Picks, for each observation, one of the table's goals that count as reached there, uniformly.

    Args:
      key: random key; the choices of one call use the same random order of the table.
      table: M rows.
      observations: (E, D).
      test: when a goal counts as reached.

    Returns:
      (E,) int32 row of the table, -1 where no goal is near.
    """
    achieved_goals, num_goals = test.achieved_goal(observations), table.goals.shape[0]
    index_bits = num_goals.bit_length()
    row = jnp.arange(num_goals, dtype=jnp.uint32)
    # The row's number plus 1, below random bits: the maximum over rows is a random row, and says which.
    label = (jax.random.bits(key, (num_goals,)) << index_bits) | (row + 1)
    label = jnp.where(row < table.count, label, 0)
    near = jnp.ones((achieved_goals.shape[0], num_goals), bool)
    for goal, reference, width in zip(achieved_goals.T, table.goals.T, test.epsilon, strict=True):  # dimension by dimension, over long rows
        near &= goal_reached(goal[:, None, None], reference[None, :, None], width[None], inclusive=test.inclusive)
    chosen = jnp.max(jnp.where(near, label[None], 0), axis=1)
    return (chosen & jnp.uint32(2**index_bits - 1)).astype(jnp.int32) - 1
