"""A robot of your own: a planar arm with two joints presses a button, then goes to its place of rest. docs/tutorial.md explains every part.

hindrl train --env planar_arm:PlanarArm --demos 1 --stop-at 0.98 --out runs/arm
"""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
from flax import struct

import hindrl_jax as hindrl

matplotlib.use("Agg")
from matplotlib import pyplot as plt

LINKS = (0.6, 0.4)  # m


def elbow_and_hand(joints):
    """Positions (2,) of the elbow and of the hand, in metres, for joint angles (2,) in radians."""
    elbow = LINKS[0] * jnp.array([jnp.cos(joints[0]), jnp.sin(joints[0])])
    return elbow, elbow + LINKS[1] * jnp.array([jnp.cos(joints.sum()), jnp.sin(joints.sum())])


@struct.dataclass(kw_only=True)
class ArmState:
    key: jax.Array  # () typed random key, constant within an episode
    joints: jax.Array  # (2,) rad
    pressed: jax.Array  # () bool, whether the button was pressed
    step: jax.Array  # () int32, steps taken


@dataclasses.dataclass(frozen=True)
class PlanarArm:
    """The hand presses a button, then rests. An observation, which is also the achieved goal, is the hand (2,), the joints (2,) and "pressed"."""

    name: ClassVar[str] = "PlanarArm"
    observation_dim: ClassVar[int] = 5
    goal_dim: ClassVar[int] = 5
    action_dim: ClassVar[int] = 2
    state_dim: ClassVar[int] = 4
    action_low: ClassVar[float] = -0.15  # rad per step, of each joint
    action_high: ClassVar[float] = 0.15
    button: ClassVar[tuple[float, float]] = (0.5, 0.6)  # m
    rest: ClassVar[tuple[float, float]] = (-0.6, 0.5)  # m
    horizon: int = 80
    """Number of steps after which an episode is truncated."""
    reach: float = 0.05
    """Distance in metres at which the button counts as pressed, and the place of rest as reached."""

    def reset(self, key):
        key, key_joints = jax.random.split(key)
        joints = jnp.array([-0.3, 0.8]) + jax.random.uniform(key_joints, (2,), minval=-0.1, maxval=0.1)
        state = ArmState(key=key, joints=joints, pressed=jnp.zeros((), bool), step=jnp.zeros((), jnp.int32))
        return state, self.observe(state)

    def step(self, state, action):
        joints = state.joints + jnp.clip(action, self.action_low, self.action_high)
        joints = jnp.clip(joints, -2.5, 2.5)  # the joints' limits
        _, hand = elbow_and_hand(joints)
        pressed = state.pressed | (jnp.linalg.norm(hand - jnp.array(self.button)) < self.reach)
        solved = pressed & (jnp.linalg.norm(hand - jnp.array(self.rest)) < self.reach)
        state = state.replace(joints=joints, pressed=pressed, step=state.step + 1)
        truncated = (state.step >= self.horizon) & ~solved
        reward = solved.astype(jnp.float32)
        return state, hindrl.TimeStep(observation=self.observe(state), reward=reward, terminated=solved, truncated=truncated)

    def observe(self, state):
        _, hand = elbow_and_hand(state.joints)
        return jnp.concatenate([hand, state.joints, state.pressed[None].astype(jnp.float32)])

    def achieved_goal(self, observation):
        return observation

    def task_goal(self):
        joints = joints_at(jnp.array(self.rest))
        return jnp.concatenate([jnp.array(self.rest), joints, jnp.ones((1,))])

    def state_to_vector(self, state):
        return jnp.concatenate([state.joints, jnp.stack([state.pressed.astype(jnp.float32), state.step.astype(jnp.float32)])])

    def vector_to_state(self, key, vector):
        return ArmState(key=key, joints=vector[:2], pressed=vector[2] > 0.5, step=vector[3].astype(jnp.int32))


def joints_at(point):
    """Joint angles (2,) that bring the hand to a point (2,) within reach: the law of cosines, elbow bent to the left."""
    cosine = (point @ point - LINKS[0] ** 2 - LINKS[1] ** 2) / (2 * LINKS[0] * LINKS[1])
    bend = jnp.arccos(jnp.clip(cosine, -1.0, 1.0))
    shoulder = jnp.arctan2(point[1], point[0]) - jnp.arctan2(LINKS[1] * jnp.sin(bend), LINKS[0] + LINKS[1] * jnp.cos(bend))
    return jnp.stack([shoulder, bend])


@dataclasses.dataclass(frozen=True)
class ArmExpert:
    """Straight, in joint angles, to the button and then to the place of rest; with noise on every step."""

    noise: float = 0.5
    """Standard deviation of the noise on its steps, as a share of the longest step."""

    def act(self, key, env, state):
        target = jnp.where(state.pressed, jnp.array(env.rest), jnp.array(env.button))
        direction = jnp.clip(joints_at(target) - state.joints, 0.4 * env.action_low, 0.4 * env.action_high)
        return direction + self.noise * env.action_high * jax.random.normal(key, (2,))


class ArmViewer:
    """Draws states with matplotlib, for films and pictures."""

    def frame(self, env, state, caption):
        figure, axes = plt.subplots(figsize=(4, 3), dpi=100)
        elbow, hand = (np.asarray(point) for point in elbow_and_hand(state.joints))
        axes.plot([0, elbow[0], hand[0]], [0, elbow[1], hand[1]], "-o", color="#1c2733", linewidth=6, solid_capstyle="round")
        for point, colour in ((env.button, "#8a97a6" if state.pressed else "#d9822b"), (env.rest, "#4b8f5b")):
            axes.add_patch(plt.Circle(point, env.reach, color=colour))
        axes.set(xlim=(-1.1, 1.1), ylim=(-0.35, 1.05), aspect="equal", title=caption)
        axes.axis("off")
        figure.canvas.draw()
        picture = np.asarray(figure.canvas.buffer_rgba())[..., :3].copy()
        plt.close(figure)
        return picture

    def save_png(self, env, state, path):
        plt.imsave(path, self.frame(env, state, env.name))

    def animation(self, env, states, captions=None):
        captions = captions or [f"step {int(state.step)}{', pressed' if state.pressed else ''}" for state in states]
        pictures = [self.frame(env, state, caption) for state, caption in zip(states, captions, strict=True)]
        return pictures, [0.1] * len(pictures)


hindrl.register(PlanarArm, expert=ArmExpert, viewer=ArmViewer(), summary="a planar arm presses a button, then rests")
