"""A goal-conditioned environment of Gymnasium, registered when this is imported: a point in a square is to be brought to a place."""

from typing import ClassVar

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict

from hindrl_jax.config import AgentConfig, BatchConfig, GoalConfig, TrainConfig

SPEED = 0.5
CONFIG = TrainConfig(
    steps=240,
    num_envs=4,
    updates_per_iteration=2,
    learning_starts=40,
    buffer_size=1_000,
    eval_every=80,
    eval_episodes=6,
    goal=GoalConfig(behavioural_goals="environment", epsilon=0.1),
    batch=BatchConfig(batch_size=16, n_step=2, hindrl_sampling_strategy="joint_union"),
    agent=AgentConfig(net_arch=(8,), num_quantiles=3, top_quantiles_to_drop_per_net=1),
)


class PointGoal(gymnasium.Env):
    """Actions in [-2, 2] move the point by a quarter of that. `says` is what says that the goal is reached: an entry of the info, or the reward;
    `ends` whether an episode ends there, or None, where it does not and nothing says so; `moves` has the goal jump at each step."""

    metadata: ClassVar = {"render_modes": ["rgb_array"], "render_fps": 10}
    distance_threshold = 0.2

    def __init__(self, says: str = "is_success", ends: bool | None = None, moves: bool = False, render_mode: str | None = None):
        self.says, self.ends, self.moves, self.render_mode = says, bool(ends), moves, render_mode
        if ends is not None:
            self.compute_terminated = lambda achieved_goal, desired_goal, info: ends and self.compute_reward(achieved_goal, desired_goal, info) == 0.0
        place = Box(-1.0, 1.0, (2,))
        self.observation_space = Dict(observation=Box(-1.0, 1.0, (3,)), achieved_goal=place, desired_goal=place)
        self.action_space = Box(-2.0, 2.0, (2,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place, self.goal = self.np_random.uniform(-1.0, 1.0, (2, 2))
        return self._observation(), {}

    def step(self, action):
        self.place = np.clip(self.place + SPEED * np.asarray(action) / 2.0, -1.0, 1.0)
        if self.moves:
            self.goal = -self.goal
        reward = float(self.compute_reward(self.place, self.goal, {}))
        return self._observation(), reward, self.ends and reward == 0.0, False, {} if self.says == "reward" else {self.says: reward == 0.0}

    def compute_reward(self, achieved_goal, desired_goal, info):
        return -(np.linalg.norm(achieved_goal - desired_goal, axis=-1) > self.distance_threshold).astype(np.float32)

    def render(self):
        picture = np.zeros((20, 20, 3), np.uint8)
        for place, channel in ((self.place, 0), (self.goal, 1)):
            picture[(*np.round(9.5 + 9.5 * place).astype(int), channel)] = 255
        return picture

    def _observation(self):
        return {"observation": np.append(self.place, 0.5).astype(np.float32), "achieved_goal": self.place.astype(np.float32)} | {
            "desired_goal": self.goal.astype(np.float32)
        }


def to_goal(observation, rng):
    """The shortest way, in the environment's own units."""
    return np.clip((observation["desired_goal"] - observation["achieved_goal"]) / SPEED, -1.0, 1.0) * 2.0


if "PointGoal-v0" not in gymnasium.registry:
    gymnasium.register("PointGoal-v0", entry_point="point_env:PointGoal", max_episode_steps=10)
    gymnasium.register("PointGoalForever-v0", entry_point="point_env:PointGoal")
