"""What reproduces the thesis's literal settings and the original code's defects."""

from __future__ import annotations

import dataclasses
from typing import Literal

from hindrl_jax.base.checks import check_types


@dataclasses.dataclass(frozen=True)
class QuirksConfig:
    """Deviations that explain published figures; no recipe of this project has any. Off by default."""

    strict_goal_test: bool = False
    """A goal counts as reached at distance < epsilon, as in the thesis's formula and code, not <=. With epsilon 0 it never does. The filter of
    demonstrated goals keeps what is farther than epsilon all the same, as in the code."""
    bootstrap_past_relabelled_goals: bool = False
    """Reaching a relabelled goal does not end the return, as in the thesis, so that values can exceed 1. Where goals are to be held it never does.
    Where hindsight relabels observations in place of goals (ParameterizedReach), a solved task always ends it."""
    timeouts_are_terminal: bool = False
    """Treat episodes that are cut by the horizon as terminated, as the original code does by mistake."""
    exclude_last_goal: bool = False
    """Never draw the last goal of a demonstration, of those that the filter keeps, as the original code does by mistake; its only one is drawn."""
    unscaled_demo_actions: bool = False
    """Leave demonstrated actions in the environment's own range, as the original code does, in place of the policy's [-1, 1]."""
    misaligned_demo_actions: bool = False
    """Pair each demonstrated action with the observation after it, as the original code does for robot demonstrations."""
    bc_loss: Literal["relative", "squared", "norm"] = "relative"
    """Squared distance to the demonstrated action, relative to the mean squared length of demonstrated actions, so that one weight serves tasks with
    large and with small actions; or as it is (thesis); or its square root per row (original code)."""
    bc_action: Literal["mean", "sample"] = "mean"
    """Compare the policy's mean action (thesis) or a sampled one (original code) with the demonstrated action."""
    achieved_goal_input: bool = False
    """Networks see achieved goal, desired goal and observation, as in the thesis's framework, in place of observation and desired goal, or, where
    episodes have goals of their own, in place of observation and what is left to the goal."""

    def __post_init__(self) -> None:
        check_types(self)
