"""An arm without inertia: a reach task that compiles quickly, and the same arm with the methods of `experts.robosuite_arm.RobosuiteArm`."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from hindrl_jax.envs import panda
from hindrl_jax.envs.reach import FixedParameterizedReach


def control_step(joints, rest, command):
    """The joints (7,) go at once where the inverse kinematics wants them."""
    return panda.joint_targets(joints, rest, command, panda.posture(joints))


@dataclass(frozen=True)
class KinematicReach(FixedParameterizedReach):
    def step(self, state, action):
        joints = control_step(state.joints, state.rest, jnp.clip(action, self.action_low, self.action_high))
        return self.arrive(state, joints, jnp.zeros(panda.NUM_JOINTS))


class KinematicArm:
    _control_step = staticmethod(jax.jit(control_step))

    def __init__(self):
        self.redrawn = 0

    def begin(self, state):
        self.joints = self.rest = np.asarray(state.joints)

    def step(self, command):
        self.joints = np.asarray(self._control_step(self.joints, self.rest, command))
        return self.joints, np.zeros_like(self.joints)

    def is_open(self):
        return True

    def refresh(self):
        self.redrawn += 1
