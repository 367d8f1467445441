"""The reach and cable tasks simulated by robosuite itself, on the CPU, to record demonstrations and to evaluate policies.

Public are the names below. Only `installation`, `scene` and `cable_scene` know how robosuite is imported and what an environment of it looks like.
"""

from hindrl_jax.experts.robosuite_arm.arm import RobosuiteArm, RobosuiteScene
from hindrl_jax.experts.robosuite_arm.devices import DeviceName, open_device
from hindrl_jax.experts.robosuite_arm.installation import check_versions
from hindrl_jax.experts.robosuite_arm.playing import Act, Task, build_scene, play_episode, play_in_robosuite, shared_scene, stacked

__all__ = [
    "Act",
    "DeviceName",
    "RobosuiteArm",
    "RobosuiteScene",
    "Task",
    "build_scene",
    "check_versions",
    "open_device",
    "play_episode",
    "play_in_robosuite",
    "shared_scene",
    "stacked",
]
