"""Recording demonstrations by hand: a person steers robosuite's arm, or one of its two, shown in a window, with one of robosuite's devices."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from typing import Any, get_args

import jax
import jax.numpy as jnp
import numpy as np

from hindrl_jax.base.errors import UserError
from hindrl_jax.base.types import Array, Episodes
from hindrl_jax.envs import panda
from hindrl_jax.envs.cable import CableTask
from hindrl_jax.experts.robosuite_arm import DeviceName, RobosuiteScene, Task, build_scene, open_device, play_episode, stacked

FULL_TRANSLATION, FULL_ROTATION = 0.05, 0.5  # m and rad that robosuite's default controller makes of a device's 1
CONTROLS = {
    "keyboard": "arrow keys: sideways, to and fro; ; and . : up and down; r e, y h, o p: turn about x, y, z; q: start over",
    "spacemouse": "push and twist the cap to move and turn the hand; right button: start over",
}
WITH_TWO_ARMS = "; space: close or open the fingers; =: the other arm"


class _StartOver(Exception):
    """The person gives this episode up."""


class _WindowClosed(Exception):
    """The person has had enough."""


def record_by_hand(key: Array, env: Task, device: DeviceName, num_demos: int, *, report: Callable[[str], None] = lambda line: None) -> Episodes:
    """Records demonstrations that a person plays. Unsolved episodes are discarded.

    An episode begins with the first movement, runs at 20 Hz, and ends when the task is solved or the horizon reached: 300 steps are 15 seconds.

    Args:
      key: random key, of starts and waypoints.
      env: the task, with the robosuite back end.
      device: what to steer with.
      num_demos: N, at least 1. Closing the window, or Ctrl-C, ends the recording early.
      report: called with lines for the person: the controls, and what became of each episode.

    Returns:
      N episodes, or fewer but at least one if the person stopped early.

    Raises:
      UserError: if there is no screen, the device or robosuite are unusable, or nothing was recorded.
    """
    if num_demos < 1:
        raise UserError(f"num_demos = {num_demos} is too few: record at least 1 demonstration")
    if device not in get_args(DeviceName):
        raise UserError(f"there is no device {device!r}: choose one of {', '.join(get_args(DeviceName))}")
    if isinstance(env, CableTask) and device != "keyboard":
        raise UserError(f"two arms need a device that keeps one hand closed while the other moves, and the {device} does not: use the keyboard")
    if env.steps_in_jax:
        raise UserError(f"a person steers the arm of robosuite, not that of backend = {env.backend}: use backend = robosuite")
    scene = build_scene(env, on_screen=True)
    with contextlib.closing(scene):
        opened = open_device(device, scene)
        scene.refresh()
        report(f"{CONTROLS[device]}{WITH_TWO_ARMS if isinstance(env, CableTask) else ''}; close the window to stop early")
        try:
            return record_with(key, env, scene, opened, num_demos, report=report)
        finally:
            opened.listener.stop()


def record_with(
    key: Array,
    env: Task,
    scene: RobosuiteScene,
    device: Any,
    num_demos: int,
    *,
    report: Callable[[str], None] = lambda line: None,
    period: float = panda.CONTROL_PERIOD,
) -> Episodes:
    """`record_by_hand`, with a scene and a device that are open; `period` is the time between two steps in s."""
    kept: list[Episodes] = []
    while len(kept) < num_demos:
        key, key_episode = jax.random.split(key)
        try:
            episode = play_episode(key_episode, env, scene, _Hand(scene, device, period, has_two_arms=isinstance(env, CableTask)))
        except _StartOver:
            report("discarded: started over")
        except (_WindowClosed, KeyboardInterrupt):
            if not kept:
                raise UserError("stopped before anything was recorded: solve at least one episode") from None
            report(f"stopped after {len(kept)} of {num_demos} demonstrations")
            break
        else:
            length, solved = int(episode.lengths), bool(episode.terminated)
            if solved:
                kept.append(episode)
            outcome = f"demonstration {len(kept)} of {num_demos}: {length} steps" if solved else f"discarded: not solved within {length} steps"
            report(outcome)
    return stacked(kept)


class _Hand:
    """The person of one episode, as a policy that looks at the screen instead of the state."""

    def __init__(self, scene: RobosuiteScene, device: Any, period: float, *, has_two_arms: bool = False):
        self._scene, self._device, self._period, self._has_two_arms = scene, device, period, has_two_arms
        self._moved, self._due = False, time.monotonic()
        device.start_control()

    def __call__(self, key: Array, state: Any, observation: Array) -> Any:
        """Waits for the next step's turn, and at the beginning of the episode for a movement; returns the action (A,)."""
        del key, state, observation
        while True:
            self._due = max(self._due + self._period, time.monotonic())  # after a delay, go on from there instead of hurrying
            time.sleep(max(0.0, self._due - time.monotonic()))
            if not self._scene.is_open():
                raise _WindowClosed
            command = command_of(self._device)
            if command is None:
                raise _StartOver
            self._moved = self._moved or bool(command.any())
            if self._moved:
                return for_both_arms(self._device, command) if self._has_two_arms else command
            self._scene.refresh()


def command_of(device: Any) -> np.ndarray | None:
    """What a device asks for since the last call.

    robosuite's devices give a displacement and roll, pitch and yaw, which it scales to [-1, 1] with each device's own gain and hands to a
    controller that makes at most 0.05 m and 0.5 rad of them. Here they are shortened further, to what the reach tasks take.

    Args:
      device: one of robosuite's, or anything with its methods `get_controller_state` and `_postprocess_device_outputs`.

    Returns:
      (6,) displacement in m and rotation vector in rad, both in the base's axes; or None if the person wants to start over.
    """
    given = device.get_controller_state()
    if given["reset"]:
        return None
    roll, pitch, yaw = given["raw_drotation"]
    translation, rotation = device._postprocess_device_outputs(np.asarray(given["dpos"], float), np.array([pitch, roll, -yaw]))
    return np.asarray(panda.shortened_command(jnp.asarray([*FULL_TRANSLATION * translation, *FULL_ROTATION * rotation], jnp.float32)))


def for_both_arms(device: Any, command: np.ndarray) -> np.ndarray:
    """The action (14,) of the cable tasks: the arm that the device steers now takes its command (6,), the other one stays, and each keeps its fingers
    closed or open as it was last told to.

    Args:
      device: robosuite's keyboard, or anything with its attributes `active_robot` and `grasp_states`, of two robots of one arm each.
      command: in m and rad, from `command_of`.
    """
    action = np.zeros((2, 7), np.float32)
    action[device.active_robot, :6] = command
    action[:, 6] = [1.0 if closes else -1.0 for (closes,) in device.grasp_states]
    return action.reshape(-1)
