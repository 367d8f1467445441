"""The state of the cable tasks, what all back ends say about it, and the names of what can simulate it."""

from __future__ import annotations

from typing import Any, Literal

from flax import struct

from hindrl_jax.base.types import Array

Backend = Literal["closed_form", "mujoco", "mjx", "robosuite"]
"""What simulates arms and cables."""


class Scene(struct.PyTreeNode, kw_only=True):
    """Where everything is, in m and in the world's axes. Of two, the first is the plug or the arm that takes it."""

    hand_positions: Array  # (2, 3) of the grip sites
    hand_rotations: Array  # (2, 3, 3)
    head_positions: Array  # (2, 3) of the grip sites of plug and socket
    head_rotations: Array  # (2, 3, 3) their z axes point to their tips
    fingers: Array  # (2,) mean coordinate of an arm's fingers, half of their opening
    held: Array  # (2,) bool, whether the fingers hold the head


class CableState(struct.PyTreeNode, kw_only=True):
    """Everything that the next step depends on."""

    key: Array  # () typed random key, constant within an episode
    rest: Array  # (2, 7) rad, the joints at reset
    finger_targets: Array  # (2,) m, where the grippers' commands want the fingers
    physics: Any  # what the back end simulates, in its own form
    scene: Scene  # follows from `physics`
    step: Array  # () int32, steps taken in this episode
