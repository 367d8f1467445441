"""The controller of the arm: robosuite 1.5.1's IK_POSE at 20 Hz, with inverse kinematics by damped least squares. Unbatched and pure.

A command is a displacement of the hand. `joint_targets` turns it into the joints that the arm should go to within the control step, whatever then
simulates the arm. Towards these, in each of the `SUBSTEPS` of a control step, the joints are accelerated by STIFFNESS (q_goal - q) -
TRACKING_DAMPING q'.
"""

from __future__ import annotations

import jax.numpy as jnp

from hindrl_jax.base.types import Array
from hindrl_jax.envs.panda.kinematics import Posture, jacobian
from hindrl_jax.envs.panda.linear_algebra import inverse, product, times

MAX_TRANSLATION = 0.02  # m, per control step; longer commands are shortened
MAX_ROTATION = 0.05  # rad, likewise
CONTROL_PERIOD = 0.05  # s
SUBSTEPS = 25
STIFFNESS, TRACKING_DAMPING = 100.0, 20.0  # 1/s^2, 1/s

_COMMAND_GAIN = 0.95  # share of the command that the inverse kinematics aims at within the integration time
_INTEGRATION_TIME = 0.1  # s
_DAMPING = 0.05  # of the least squares
_NULL_SPACE_GAINS = (10.0, 10.0, 10.0, 10.0, 5.0, 5.0, 5.0)  # 1/s
_MAX_JOINT_SPEED = 1.0  # rad/s


def joint_targets(joints: Array, rest: Array, command: Array, posture: Posture) -> Array:
    """Where the joints should go, by inverse kinematics.

    dq = J^T (J J^T + 0.05^2 1)^-1 9.5 [d; w] + (1 - J^+ J) K (rest - q), scaled down so that no joint exceeds 1 rad/s; q_goal = q + 0.1 dq.

    Args:
      joints: (7,) rad, q.
      rest: (7,) rad, the joints at reset, towards which the null space pulls.
      command: (6,) displacement d of the grip site in m and rotation vector w in rad, both in the base's axes; shortened to 0.02 m and 0.05 rad.
      posture: at `joints`.

    Returns:
      (7,) rad, q_goal.
    """
    j = jacobian(posture)
    gram = product(j, j.T)
    twist = shortened_command(command) * (_COMMAND_GAIN / _INTEGRATION_TIME)
    pull = jnp.asarray(_NULL_SPACE_GAINS) * (rest - joints)
    damped = inverse(gram + _DAMPING**2 * jnp.eye(6))
    undamped = inverse(gram + 1e-7 * jnp.eye(6))  # no more than keeps float32 from dividing by 0
    in_range = times(damped, twist) - times(undamped, times(j, pull))
    speeds = times(j.T, in_range) + pull
    slowdown = jnp.minimum(1.0, _MAX_JOINT_SPEED / jnp.maximum(jnp.max(jnp.abs(speeds)), 1e-9))
    return joints + _INTEGRATION_TIME * slowdown * speeds


def shortened_command(command: Array) -> Array:
    """A command (6,), its displacement shortened to 0.02 m and its rotation vector to 0.05 rad, as the controller does."""
    return jnp.concatenate([shortened(command[:3], MAX_TRANSLATION), shortened(command[3:], MAX_ROTATION)])


def shortened(vector: Array, limit: float) -> Array:
    """A vector (n,), no longer than the limit."""
    return vector * jnp.minimum(1.0, limit / jnp.maximum(jnp.sqrt(jnp.sum(jnp.square(vector))), 1e-12))
