"""Recording by hand, with a device that is a script and an arm without inertia: signs and units by hand, and which episodes are kept."""

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from kinematic_arm import KinematicArm

from hindrl_jax.base.environments import action_to_env
from hindrl_jax.base.errors import UserError
from hindrl_jax.envs.cable import BringNear
from hindrl_jax.envs.reach import FixedParameterizedReach
from hindrl_jax.experts import by_hand
from hindrl_jax.experts.by_hand import command_of, record_by_hand, record_with
from hindrl_jax.experts.reach import ReachExpert
from hindrl_jax.experts.robosuite_arm import arm as arms
from hindrl_jax.experts.robosuite_arm import devices, play_episode

# Every episode of this task is the same: a fixed start, and one fixed waypoint, which is reached within 20 steps or so.
ENV = FixedParameterizedReach(num_waypoints=1, horizon=40, joint_noise=0.0, position_tolerance=0.1, rotation_tolerance=0.3, backend="robosuite")
EXPERT = ReachExpert(randomness_scale=0.02)


class Device:
    """Answers as robosuite's devices do, from a list: raw (dx, dy, dz, roll, pitch, yaw) each, or "reset"; afterwards nothing."""

    def __init__(self, *answers, translation_gain=1.0, rotation_gain=1.0):
        self.answers, self.gains = list(answers), (translation_gain, rotation_gain)
        self.episodes = 0

    def start_control(self):
        self.episodes += 1

    def get_controller_state(self):
        answer = self.answers.pop(0) if self.answers else np.zeros(6)
        if isinstance(answer, str):
            return dict(dpos=np.zeros(3), raw_drotation=np.zeros(3), grasp=0, reset=1)
        return dict(dpos=np.array(answer[:3], float), raw_drotation=np.array(answer[3:], float), grasp=0, reset=0)

    def _postprocess_device_outputs(self, dpos, drotation):
        translation, rotation = self.gains
        return np.clip(dpos * translation, -1, 1), np.clip(drotation * rotation, -1, 1)


KEYBOARD, SPACEMOUSE = dict(translation_gain=75, rotation_gain=1.5), dict(translation_gain=125, rotation_gain=50)  # robosuite's own


@pytest.mark.parametrize(
    ("gains", "raw", "expected"),
    [
        # An arrow key is 0.05, times 75 clipped to 1: 0.05 m, shortened to 0.02 m.
        (KEYBOARD, (-0.05, 0, 0, 0, 0, 0), (-0.02, 0, 0, 0, 0, 0)),
        # Two keys at once: the direction is kept, the length is 0.02 m.
        (KEYBOARD, (0, 0.05, -0.05, 0, 0, 0), (0, 0.02 / np.sqrt(2), -0.02 / np.sqrt(2), 0, 0, 0)),
        # A turning key is 0.1, times 1.5: 0.15 of 0.5 rad, shortened to 0.05 rad. The second number is about x, the first about y, the third
        # about -z.
        (KEYBOARD, (0, 0, 0, 0, 0.1, 0), (0, 0, 0, 0.05, 0, 0)),
        (KEYBOARD, (0, 0, 0, 0.1, 0, 0), (0, 0, 0, 0, 0.05, 0)),
        (KEYBOARD, (0, 0, 0, 0, 0, 0.1), (0, 0, 0, 0, 0, -0.05)),
        # A cap pushed by a fifth: 0.2 * 0.005 * 125 = 0.125 of 0.05 m; twisted by a tenth: 0.1 * 0.005 * 50 = 0.025 of 0.5 rad.
        (SPACEMOUSE, (0.001, 0, 0, 0.0005, 0, 0), (0.00625, 0, 0, 0, 0.0125, 0)),
        (SPACEMOUSE, (0, 0, 0, 0, 0, 0), (0, 0, 0, 0, 0, 0)),
    ],
)
def test_commands_in_metres_and_radians(gains, raw, expected):
    np.testing.assert_allclose(command_of(Device(raw, **gains)), expected, atol=1e-8)


def test_reset_is_no_command():
    assert command_of(Device("reset")) is None


@pytest.fixture(scope="module")
def played():
    """An episode of the expert, and the answers of a device that asks for the same."""
    episode = play_episode(jax.random.key(0), ENV, KinematicArm(), jax.jit(lambda key, state, observation: EXPERT.act(key, ENV, state)))
    assert episode.terminated
    actions = np.asarray(action_to_env(jnp.asarray(episode.actions[: int(episode.lengths)]), ENV))
    x, y, z = actions[:, 3:].T / by_hand.FULL_ROTATION
    return episode, list(np.concatenate([actions[:, :3] / by_hand.FULL_TRANSLATION, np.stack([y, x, -z], axis=1)], axis=1))


def test_only_solved_episodes_are_kept_and_they_begin_with_the_first_movement(played):
    episode, answers = played
    idle, wrong = np.zeros(6), np.array([0.0, 0.0, 0.01, 0.0, 0.0, 0.0])
    device = Device(*answers[:9], "reset", idle, idle, *answers, *[wrong] * ENV.horizon, idle, *answers)
    arm, lines = KinematicArm(), []
    recording = record_with(jax.random.key(1), ENV, arm, device, 2, report=lines.append, period=0.0)
    length = int(episode.lengths)
    assert lines == [
        "discarded: started over",
        f"demonstration 1 of 2: {length} steps",
        "discarded: not solved within 40 steps",
        f"demonstration 2 of 2: {length} steps",
    ]
    assert (device.episodes, arm.redrawn) == (4, 3)
    for n in range(2):
        mine = jax.tree.map(lambda leaf, n=n: np.asarray(leaf[n]), recording)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), mine, jax.tree.map(np.asarray, episode))


def test_closing_the_window_keeps_what_is_recorded(played):
    episode, answers = played
    device, arm = Device(*answers), KinematicArm()
    arm.is_open = lambda: bool(device.answers)
    recording = record_with(jax.random.key(1), ENV, arm, device, 2, period=0.0)
    assert recording.lengths.tolist() == [int(episode.lengths)]
    with pytest.raises(UserError, match="before anything was recorded"):
        record_with(jax.random.key(1), ENV, arm, Device(), 2, period=0.0)


def test_so_does_an_interrupt(played):
    episode, answers = played
    device, arm = Device(*answers, np.ones(6)), KinematicArm()

    def interrupted():
        if len(device.answers) <= 1:
            raise KeyboardInterrupt
        return True

    arm.is_open = interrupted
    assert record_with(jax.random.key(1), ENV, arm, device, 2, period=0.0).lengths.tolist() == [int(episode.lengths)]


def test_steps_keep_the_time():
    hand = by_hand._Hand(KinematicArm(), Device(*[np.ones(6)] * 3), 0.02)
    started = by_hand.time.monotonic()
    for _ in range(3):
        hand(None, None, None)
    assert 0.05 < by_hand.time.monotonic() - started < 5.0


@pytest.mark.parametrize(
    ("changes", "arguments", "message"),
    [
        ({}, ("keyboard", 0), "num_demos = 0"),
        ({}, ("joystick", 1), "no device 'joystick'"),
        ({"backend": "closed_form"}, ("keyboard", 1), "use backend = robosuite"),
        ({}, ("keyboard", 1), "needs a screen"),
    ],
)
def test_what_cannot_work_is_refused_at_once(changes, arguments, message, monkeypatch):
    monkeypatch.setattr(arms.sys, "platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr(arms, "environment_class", lambda: pytest.fail("robosuite was opened"))
    with pytest.raises(UserError, match=message):
        record_by_hand(jax.random.key(0), dataclasses.replace(ENV, **changes), *arguments)


@pytest.mark.parametrize(
    ("missing", "error", "message"),
    [
        ("pynput.keyboard", ImportError("No module named 'pynput'"), "pip install pynput"),
        ("robosuite.devices.spacemouse", ImportError("Unable to load module hid"), "pip install hidapi"),
        (None, OSError("open failed"), "plugged in"),
    ],
)
def test_devices_that_are_not_there_are_refused(missing, error, message, monkeypatch):
    def import_module(name):
        if name == missing:
            raise error
        return SimpleNamespace(SpaceMouse=not_plugged_in)

    def not_plugged_in(env):
        raise error

    monkeypatch.setattr(devices.importlib, "import_module", import_module)
    with pytest.raises(UserError, match=message) as refusal:
        devices.open_device("spacemouse", SimpleNamespace(environment=None))
    assert "\n" not in str(refusal.value)


# --- two arms


def test_the_arm_that_is_not_steered_stays_and_keeps_its_hand_closed():
    device = SimpleNamespace(active_robot=1, grasp_states=[[True], [False]])
    action = by_hand.for_both_arms(device, np.array([0.01, 0, 0, 0, 0.05, 0]))
    np.testing.assert_allclose(action, [0, 0, 0, 0, 0, 0, 1, 0.01, 0, 0, 0, 0.05, 0, -1], atol=1e-8)


def test_two_arms_are_steered_with_the_keyboard_alone():
    with pytest.raises(UserError, match="spacemouse does not: use the keyboard"):
        record_by_hand(jax.random.key(0), BringNear(backend="robosuite"), "spacemouse", 1)
