"""The Panda arm that environments share: its model, kinematics, controller, two simulations of its motion, and pictures of it.

Public here are the constants and functions below. `closed_form` and `mjx_dynamics` each have a `control_step`; `renderer` draws the arm, and is
imported only by viewers.
"""

from hindrl_jax.envs.panda.closed_form import mass_matrix
from hindrl_jax.envs.panda.controller import (
    CONTROL_PERIOD,
    MAX_ROTATION,
    MAX_TRANSLATION,
    STIFFNESS,
    SUBSTEPS,
    TRACKING_DAMPING,
    joint_targets,
    shortened_command,
)
from hindrl_jax.envs.panda.kinematics import Posture, jacobian, joints_at_reset, posture
from hindrl_jax.envs.panda.robot import INITIAL_JOINTS, MODEL_PATH, NUM_JOINTS, Chain, chain, import_mujoco, longest_reach, model

__all__ = [
    "CONTROL_PERIOD",
    "Chain",
    "INITIAL_JOINTS",
    "MAX_ROTATION",
    "MAX_TRANSLATION",
    "MODEL_PATH",
    "NUM_JOINTS",
    "Posture",
    "STIFFNESS",
    "SUBSTEPS",
    "TRACKING_DAMPING",
    "chain",
    "import_mujoco",
    "jacobian",
    "joint_targets",
    "joints_at_reset",
    "longest_reach",
    "mass_matrix",
    "model",
    "posture",
    "shortened_command",
]
