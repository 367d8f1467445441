"""Reaching with a Panda arm: bring the hand to a number of poses, in order (thesis sections 3.2.1 and 3.2.2).

Public are the two tasks, their common class, their state, and the module `viewer`.
"""

from hindrl_jax.envs.reach.parameterized_reach import FixedParameterizedReach, ParameterizedReach
from hindrl_jax.envs.reach.rules import ReachTask
from hindrl_jax.envs.reach.types import ReachState

__all__ = ["FixedParameterizedReach", "ParameterizedReach", "ReachState", "ReachTask"]
