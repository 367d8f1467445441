"""The reach tasks simulated by robosuite itself: one arm on the CPU, to record demonstrations and to evaluate policies.

Public are the names below. Only `installation` and `scene` know how robosuite is imported and what an environment of it looks like.
"""

from hindrl_jax.experts.robosuite_arm.arm import RobosuiteArm, shared_arm
from hindrl_jax.experts.robosuite_arm.devices import DeviceName, open_device
from hindrl_jax.experts.robosuite_arm.installation import check_versions
from hindrl_jax.experts.robosuite_arm.playing import Act, play_episode, play_in_robosuite, stacked

__all__ = ["Act", "DeviceName", "RobosuiteArm", "check_versions", "open_device", "play_episode", "play_in_robosuite", "shared_arm", "stacked"]
