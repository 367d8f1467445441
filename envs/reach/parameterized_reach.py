"""The two reach tasks of thesis sections 3.2.1 and 3.2.2: where their waypoints are, and what is observed of them. `rules` has all else."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from hindrl_jax.base.types import Array
from hindrl_jax.envs import panda, rotations
from hindrl_jax.envs.reach.rules import ReachTask
from hindrl_jax.envs.reach.types import ReachState
from hindrl_jax.envs.reach.waypoints import HIGHEST, LOWEST, fixed_waypoints, random_waypoints


@dataclass(frozen=True)
class FixedParameterizedReach(ReachTask):
    """The waypoints are the same in every episode and are not observed (thesis 3.2.2).

    Observation and achieved goal: the hand's position (3), its orientation (6), and a mask of the waypoints reached (K). The first two waypoints are
    the thesis's; further ones are drawn once and for all from the distribution of the random task.
    """

    name: ClassVar[str] = "FixedParameterizedReach"

    @property
    def observation_dim(self) -> int:
        return self.pose_dim + self.num_waypoints

    @property
    def goal_dim(self) -> int:
        return self.observation_dim

    def achieved_goal(self, observation: Array) -> Array:
        """The observation itself (thesis section 3.2.1)."""
        return observation

    def task_goal(self) -> Array:
        """(G,) the last waypoint's pose, and a mask of ones."""
        positions, matrices = self._waypoints(jax.random.key(0))
        return jnp.concatenate([self._pose(positions[-1], matrices[-1]), jnp.ones(self.num_waypoints)])

    @property
    def goal_tolerance(self) -> np.ndarray | None:
        """As for both tasks. None where the angle decides and axis-angles are observed, which can be far apart for hands that are close."""
        return None if (self.orientation, self.rotation_test) == ("axis_angle", "angle") else super().goal_tolerance

    def _observe(self, state: ReachState, arm: panda.Posture) -> Array:
        return jnp.concatenate([self._pose(arm.hand_position, arm.hand_rotation), self._mask(state)])

    def _waypoints(self, key: Array) -> tuple[Array, Array]:
        del key
        return fixed_waypoints(self.num_waypoints)


@dataclass(frozen=True)
class ParameterizedReach(ReachTask):
    """The waypoints are drawn for every episode, and observed (thesis 3.2.1).

    Observation: the hand's position (3), its orientation (6), a mask of the waypoints reached (K), and for each waypoint the displacement (3, in m)
    and the rotation vector (3, in rad) from the hand to it: first the waypoint whose turn it is, then those after it, then those reached. Achieved
    goal: the last waypoint's displacement and rotation vector, and the mask.
    """

    name: ClassVar[str] = "ParameterizedReach"

    @property
    def observation_dim(self) -> int:
        return self.pose_dim + 7 * self.num_waypoints

    @property
    def goal_dim(self) -> int:
        return 6 + self.num_waypoints

    def achieved_goal(self, observation: Array) -> Array:
        """(..., D) -> (..., 6 + K): what remains to the last waypoint, and the mask."""
        _, mask, remaining = self._parts(observation)
        place = jnp.mod(self.num_waypoints - 1 - jnp.sum(mask, axis=-1).astype(jnp.int32), self.num_waypoints)
        last = jnp.take_along_axis(remaining, place[..., None, None], axis=-2)[..., 0, :]
        return jnp.concatenate([last, mask], axis=-1)

    def task_goal(self) -> Array:
        """(6 + K,) nothing remains, and all is reached."""
        return jnp.concatenate([jnp.zeros(6), jnp.ones(self.num_waypoints)])

    @property
    def num_subgoals(self) -> int:
        """K: `relabel_observations` takes one state for each waypoint."""
        return self.num_waypoints

    def relabel_observations(self, key: Array, observations: Array, subgoals: Array) -> tuple[Array, Array]:
        """What would have been observed if the waypoints that remain had been where the hand was in other states.

        The waypoints do not affect the motion of the arm, so this is exact. How many waypoints have been reached at the beginning is as recorded or
        drawn uniformly, with equal chances. Without the draws, no row could be about a later waypoint before the policy has found the first.

        Args:
          key: random key.
          observations: (n + 1, D) of consecutive states, the task not solved in the first.
          subgoals: (K, D) observations of the states whose poses become the remaining waypoints, in the order in which these are to be reached. If
            only r waypoints remain, the first r are used.

        Returns:
          The relabelled observations (n + 1, D), and (n,) bool for each but the first, whether the task is solved there.
        """
        key_choice, key_count = jax.random.split(key)
        poses, masks, remaining = self._parts(observations)
        positions, matrices = jax.vmap(self._from_pose)(poses)
        recorded = jnp.sum(masks[0]).astype(jnp.int32)
        drawn = jax.random.randint(key_count, (), 0, self.num_waypoints)
        count = jnp.where(jax.random.bernoulli(key_choice), recorded, drawn)

        displacements, turns = jnp.split(jnp.roll(remaining[0], recorded, axis=0), 2, axis=-1)
        old_positions = positions[:1] + displacements
        old_matrices = jnp.sum(jax.vmap(rotations.from_rotation_vector)(turns)[:, :, :, None] * matrices[0][None, None], axis=2)
        new_positions, new_matrices = jax.vmap(self._from_pose)(self._parts(jnp.roll(subgoals, count, axis=0))[0])
        moved = jnp.arange(self.num_waypoints) >= count
        waypoints = jnp.where(moved[:, None], new_positions, old_positions), jnp.where(moved[:, None, None], new_matrices, old_matrices)

        remaining = jax.vmap(_remaining, (0, 0, None, None))(positions, matrices, *waypoints)  # (n + 1, K, 6)
        within = jax.vmap(jax.vmap(self._is_within, (None, None, 0, 0)), (0, 0, None, None))(positions, matrices, *waypoints)  # (n + 1, K)

        def arrive(count: Array, within: Array) -> tuple[Array, Array]:
            count = count + jnp.any(within & (jnp.arange(self.num_waypoints) == count))
            return count, count

        _, counts = jax.lax.scan(arrive, count, within[1:])
        counts = jnp.concatenate([count[None], counts])
        return jax.vmap(self._joined)(poses, counts, remaining), counts[1:] >= self.num_waypoints

    def _parts(self, observation: Array) -> tuple[Array, Array, Array]:
        """(..., D) -> the pose (..., P), the mask (..., K), and what remains to each waypoint (..., K, 6) as it is ordered there."""
        pose, mask, remaining = jnp.split(observation, [self.pose_dim, self.pose_dim + self.num_waypoints], axis=-1)
        return pose, mask, remaining.reshape((*remaining.shape[:-1], self.num_waypoints, 6))

    def _joined(self, pose: Array, num_reached: Array, remaining: Array) -> Array:
        """The observation of a pose (P,), a number of waypoints reached (), and what remains to each waypoint (K, 6), from first to last."""
        mask = (jnp.arange(self.num_waypoints) < num_reached).astype(jnp.float32)
        return jnp.concatenate([pose, mask, jnp.roll(remaining, -num_reached, axis=0).reshape(-1)])

    def _from_pose(self, pose: Array) -> tuple[Array, Array]:
        """The inverse of `_pose`: (P,) -> a position (3,) and a rotation matrix (3, 3)."""
        orientation = rotations.from_six_d if self.orientation == "six_d" else rotations.from_rotation_vector
        return pose[:3], orientation(pose[3:])

    def _observe(self, state: ReachState, arm: panda.Posture) -> Array:
        remaining = _remaining(arm.hand_position, arm.hand_rotation, state.positions, state.rotations)
        return self._joined(self._pose(arm.hand_position, arm.hand_rotation), state.num_reached, remaining)

    def _observation_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        low, high = super()._observation_bounds()
        reach = panda.longest_reach()
        nearest, farthest = ([corner + sign * reach for corner in box] for box, sign in ((LOWEST, -1.0), (HIGHEST, 1.0)))
        remaining = [np.array(self.num_waypoints * [*place, *turn], np.float32) for place, turn in ((nearest, 3 * [-np.pi]), (farthest, 3 * [np.pi]))]
        return np.concatenate([low, remaining[0]]), np.concatenate([high, remaining[1]])

    def _waypoints(self, key: Array) -> tuple[Array, Array]:
        return random_waypoints(key, self.num_waypoints)


def _remaining(hand_position: Array, hand_rotation: Array, positions: Array, matrices: Array) -> Array:
    """(K, 6) displacement in m and rotation vector in rad from the hand to each of K poses."""
    turns = jax.vmap(rotations.between, (None, 0))(hand_rotation, matrices)
    return jnp.concatenate([positions - hand_position[None], turns], axis=1)
