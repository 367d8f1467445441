"""Reaching with a Panda arm (thesis sections 3.2.1 and 3.2.2)."""

from hindrl_jax.envs.reach.parameterized_reach import FixedParameterizedReach, ParameterizedReach, ReachState

__all__ = ["FixedParameterizedReach", "ParameterizedReach", "ReachState"]
