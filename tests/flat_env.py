"""Environments of Gymnasium with flat observations, registered when this is imported: a point in a plane is to be brought into a corner."""

from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete, MultiDiscrete

from hindrl_jax.config import AgentConfig, BatchConfig, TrainConfig

SPEED = 0.25
CORNER = np.array([0.8, 0.8])
CONFIG = TrainConfig(
    steps=240,
    num_envs=4,
    action_hold=1,
    updates_per_iteration=2,
    learning_starts=40,
    buffer_size=1_000,
    eval_every=80,
    eval_episodes=6,
    batch=BatchConfig(batch_size=16, n_step=2),
    agent=AgentConfig(net_arch=(8,), num_quantiles=3, top_quantiles_to_drop_per_net=1),
)


class PointFlat(gymnasium.Env):
    """The observation is the place (2,) and the last move (2,). Actions move the point, the largest by SPEED; it arrives within `near` of the corner.

    `says` is what says so: "success" or "is_success", an entry of each step's info; "last", is_success in the info of the step that ends the episode;
    "reward" with the end of the episode; "zero", a reward of 0 in place of -1, where the episode goes on; "two", two numbers in place of one truth.
    In the opposite corner the episode ends, too, with `fall` as its reward.
    """

    metadata: ClassVar = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(
        self,
        says: str = "reward",
        low: Any = (-1.0, -1.0),
        high: Any = (1.0, 1.0),
        fall: float = 0.0,
        near: float = 0.2,
        actions: str = "box",
        observes: str = "vector",
        fault: str | None = None,
        render_mode: str | None = None,
    ):
        self.says, self.fall, self.observes, self.fault, self.near, self.render_mode = says, fall, observes, fault, near, render_mode
        self.observation_space = Box(0, 255, (4, 4, 3), np.uint8) if observes == "picture" else Box(-1.0, 1.0, (4,))
        if observes == "dictionary":
            self.observation_space = gymnasium.spaces.Dict(place=Box(-1.0, 1.0, (2,)))
        box = Box(np.array(low, np.float32), np.array(high, np.float32))
        self.action_space = {"box": box, "discrete": Discrete(4), "several": MultiDiscrete([3, 3]), "matrix": Box(-1.0, 1.0, (2, 2))}[actions]

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place, self.move = self.np_random.uniform(-0.5, 0.0, 2), np.zeros(2)
        return self.observation(), {}

    def step(self, action):
        low, high = self.action_space.low, self.action_space.high
        self.move = SPEED * (2.0 * (np.asarray(action, float) - low) / (high - low) - 1.0)
        self.place = np.clip(self.place + self.move, -1.0, 1.0)
        reached, fallen = bool(np.abs(self.place - CORNER).max() <= self.near), bool(np.abs(self.place + 1.0).max() <= 0.2)
        reward = float(reached) - (self.says == "zero") + self.fall * fallen
        ends = (reached and self.says in ("reward", "last")) or fallen
        info: dict[str, Any] = {self.says: reached} if self.says in ("success", "is_success") else {}
        info |= {"is_success": reached} if self.says == "last" and ends else {}
        info |= {"is_success": np.zeros(2)} if self.says == "two" else {}
        observation = self.observation()
        if self.fault == "nan":
            observation[1] = np.nan
        if self.fault == "shape":
            observation = observation[:3]
        return observation, reward, ends, False, info

    def render(self):
        picture = np.zeros((20, 20, 3), np.uint8)
        for place, channel in ((self.place, 0), (CORNER, 1)):
            picture[(*np.round(9.5 + 9.5 * place).astype(int), channel)] = 255
        return picture

    def observation(self):
        return np.concatenate([self.place, self.move]).astype(np.float32)


def to_corner(observation, rng):
    """Into the corner with some noise, for actions within -1 and 1."""
    return np.clip((CORNER - observation[:2]) / SPEED + rng.normal(0.0, 0.3, 2), -1.0, 1.0)


if "PointFlat-v0" not in gymnasium.registry:
    gymnasium.register("PointFlat-v0", entry_point="flat_env:PointFlat", max_episode_steps=20)
