"""Scripted experts that act from the state of an environment (thesis section 4.2), and robosuite's arm, to play in or to steer by hand.

Public are the experts below, `experts.robosuite_arm`, and `experts.by_hand.record_by_hand`. An expert is a frozen dataclass of its options with a
method act(key, env, state) -> action; for environments of Gymnasium act(observation, rng), or acting_in(env), which returns such a function.
"""

from hindrl_jax.experts.cable import CableExpert
from hindrl_jax.experts.fetch import FetchPickAndPlaceExpert, FetchPushExpert, FetchReachExpert, FetchSlideExpert
from hindrl_jax.experts.grid import GridExpert
from hindrl_jax.experts.metaworld import MetaWorldExpert
from hindrl_jax.experts.reach import ReachExpert

__all__ = [
    "CableExpert",
    "FetchPickAndPlaceExpert",
    "FetchPushExpert",
    "FetchReachExpert",
    "FetchSlideExpert",
    "GridExpert",
    "MetaWorldExpert",
    "ReachExpert",
]
