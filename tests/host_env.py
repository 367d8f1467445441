"""The corridor of `toy_env`, stepped outside JAX by NumPy: an environment of one's own whose episodes come without goals."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import jax.numpy as jnp
import numpy as np

from hindrl_jax.base.steppers import Outcome


class CorridorStepper:
    """N corridors side by side. The observation is (start, step, position), start being different in every episode.

    Each action is held for `num_held` steps, or until the episode is over.
    """

    def __init__(self, env, num_envs, num_held=1):
        self.env, self.num_envs, self.num_held, self.closed = env, num_envs, num_held, False

    def begin(self, seeds):
        self.randomness = [np.random.default_rng(seed) for seed in seeds]
        self.start = np.array([rng.uniform() for rng in self.randomness], np.float32)
        self.step_in_episode, self.position = np.zeros((2, self.num_envs), np.float32)
        return self._observation(), None

    def step(self, actions):
        going_on = np.ones(self.num_envs, bool)
        for _ in range(self.num_held):
            self.position = self.position + going_on * np.clip(actions, self.env.action_low, self.env.action_high)[:, 0]
            self.step_in_episode = self.step_in_episode + going_on
            solved = self.position > self.env.width
            truncated = (self.step_in_episode >= self.env.horizon) & ~solved
            going_on = ~(solved | truncated)
        next_observation = self._observation()
        for index in np.flatnonzero(solved | truncated):
            self.start[index], self.step_in_episode[index], self.position[index] = self.randomness[index].uniform(), 0, 0
        return Outcome(
            next_observation=next_observation,
            success=solved,
            terminated=solved,
            truncated=truncated,
            observation=self._observation(),
            desired_goal=None,
        )

    def close(self):
        self.closed = True

    def _observation(self):
        return np.stack([self.start, self.step_in_episode, self.position], axis=1).astype(np.float32)


@dataclass(frozen=True)
class HostCorridor:
    """Walk right until the position exceeds `width`. The first action is a velocity in [0, 2]."""

    name: ClassVar[str] = "HostCorridor"
    gives_goals: ClassVar[bool] = False
    observation_dim: ClassVar[int] = 3
    goal_dim: ClassVar[int] = 1
    action_dim: ClassVar[int] = 2
    action_low: ClassVar[float] = 0.0
    action_high: ClassVar[float] = 2.0
    made: ClassVar[list] = []
    """All steppers so far."""

    horizon: int = 5
    width: float = 3.0

    def achieved_goal(self, observation):
        return observation[..., 2:]

    def task_goal(self):
        return jnp.array([self.width])

    def stepper(self, num_envs, *, num_held=1):
        self.made.append(CorridorStepper(self, num_envs, num_held))
        return self.made[-1]
