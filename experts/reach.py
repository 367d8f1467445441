"""The scripted expert of the reach tasks (thesis section 4.2.2): straight to the next waypoint, with a shaky hand."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from hindrl_jax.base.checks import check, check_types
from hindrl_jax.base.types import Array
from hindrl_jax.envs import panda, rotations
from hindrl_jax.envs.reach import ReachState, ReachTask


@dataclass(frozen=True)
class ReachExpert:
    """Proportional control with Gaussian noise. Unbatched and pure: apply `jax.vmap` over keys and states."""

    randomness_scale: float = 0.1
    """Standard deviation of the noise on the displacement, in m, and on the rotation vector, in rad."""

    def __post_init__(self):
        check_types(self)
        check(self, randomness_scale=(self.randomness_scale >= 0.0, "0 or more"))

    def act(self, key: Array, env: ReachTask, state: ReachState) -> Array:
        """Chooses an action from the state: (P_next - P) + e, e ~ N(0, randomness_scale) (thesis eq. 4.10).

        Both halves are shortened to 0.02 m and 0.05 rad, as the controller would do itself. So the action is the motion that is commanded, and lies
        within the action bounds.

        Args:
          key: random key.
          env: the environment that `state` belongs to.
          state: unbatched state.

        Returns:
          (6,) displacement in m and rotation vector in rad.
        """
        arm = panda.posture(state.joints)
        position, rotation = env.next_waypoint(state)
        towards = jnp.concatenate([position - arm.hand_position, rotations.between(arm.hand_rotation, rotation)])
        return panda.shortened_command(towards + self.randomness_scale * jax.random.normal(key, (6,)))
