"""The motion of the Panda under position actuators, in closed form: for models in which MuJoCo itself drives the joints to their targets.

Such actuators have constant gains, about the diagonal of the mass matrix at the initial joints times the controller's own, and MuJoCo's integrator
`implicitfast` takes their damping, and the joints', implicitly. They need no torques to be computed between substeps, so that steps of 5 ms do.

Differences from MuJoCo:
  * The mass matrix is that at the beginning of the control step, and there are no Coriolis forces.
  * Force limits are left out, which targets of `controller.joint_targets` do not reach, and joint limits are hard.
  * There is no dry friction and no drag; the model must have none either.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from hindrl_jax.base.types import Array
from hindrl_jax.envs.panda.closed_form import mass_matrix
from hindrl_jax.envs.panda.controller import CONTROL_PERIOD, STIFFNESS, TRACKING_DAMPING
from hindrl_jax.envs.panda.kinematics import Posture, jacobian
from hindrl_jax.envs.panda.linear_algebra import inverse, times
from hindrl_jax.envs.panda.robot import chain

SUBSTEPS = 10
"""Physics steps in a control step."""
SUBSTEP = CONTROL_PERIOD / SUBSTEPS
"""s"""
_TYPICAL_INERTIA = np.array([6.45, 4.26, 2.83, 2.41, 1.4, 1.12, 0.886])  # kg m^2, the mass matrix's diagonal near the initial joints
POSITION_GAINS = STIFFNESS * _TYPICAL_INERTIA
"""(7,) N m/rad"""
VELOCITY_GAINS = TRACKING_DAMPING * _TYPICAL_INERTIA
"""(7,) N m s/rad"""
FORCE_LIMITS = np.array(5 * [80.0] + 2 * [12.0])
"""(7,) N m"""


def track(joints: Array, velocities: Array, goal: Array, posture: Posture, load: Array) -> tuple[Array, Array]:
    """10 substeps of 5 ms towards the goal: v' = v + h (M + h D)^-1 (k_p (q_goal - q) - D v - J^T load), q' = q + h v', with D the damping of all.

    Args:
      joints, velocities, goal: (7,) rad, rad/s and rad.
      posture: at `joints`.
      load: () N, a weight that hangs on the hand.

    Returns:
      Joints and velocities (7,) at the end.
    """
    c = chain()
    damping = jnp.asarray(VELOCITY_GAINS + c.damping, jnp.float32)
    gains = jnp.asarray(POSITION_GAINS, jnp.float32)
    lower, upper = jnp.asarray(c.lower, jnp.float32), jnp.asarray(c.upper, jnp.float32)
    mobility = inverse(mass_matrix(posture) + SUBSTEP * jnp.diag(damping))
    weight = -load * jacobian(posture)[2]

    def substep(carry: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], None]:
        q, v = carry
        v = v + SUBSTEP * times(mobility, gains * (goal - q) - damping * v + weight)
        moved = q + SUBSTEP * v
        q = jnp.clip(moved, lower, upper)
        return (q, jnp.where(q == moved, v, 0.0)), None

    return jax.lax.scan(substep, (joints, velocities), length=SUBSTEPS)[0]
