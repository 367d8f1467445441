"""An environment of Gymnasium with whatever oddity is asked for, registered when this is imported: a point goes to its goal."""

import os
import signal
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict

ID = "odd_env:Odd-v0"
FAULTS = ("raise", "nan", "nan_goal", "infinite", "die", "no_success", "success_none", "success_nan", "wrong_shape", "no_reset")
"""What goes wrong at step `when` of an episode from number `episode` on, or, `no_reset`, when the next one is to begin."""
SIGNATURES = ("new", "old_reset", "old_step", "no_seed", "no_options")


class Odd(gymnasium.Env):
    """The action moves the point by at most 1/3; where it is and where it is to go lie within [-1, 1]. `moves` are the actions as they came."""

    def __init__(
        self,
        dims: int = 1,
        action: str = "float32",
        low: Any = -1.0,
        high: Any = 1.0,
        dtype: str = "float32",
        reward: str = "float",
        says: str = "is_success",
        truth: str = "bool",
        threshold: Any = 0.35,
        signature: str = "new",
        fault: str | None = None,
        when: int = 3,
        episode: int = 1,
        render_mode: str | None = None,
    ):
        self.dims, self.dtype, self.reward, self.says, self.truth = dims, np.dtype(dtype), reward, says, truth
        self.signature, self.fault, self.when, self.distance_threshold = signature, fault, when, threshold
        self.episode, self.episodes = episode, 0
        place = Box(-2.0, 2.0, (dims,), self.dtype)
        self.observation_space = Dict(observation=Box(-9.0, 9.0, (dims + 1,), self.dtype), achieved_goal=place, desired_goal=place)
        kind = np.dtype(action)
        self.action_space = Box(*(np.broadcast_to(np.asarray(bound, kind), dims).copy() for bound in (low, high)), dtype=kind.type)
        self.moves: list[np.ndarray] = []

    def reset(self, **options):
        if self.signature == "no_seed" and "seed" in options:
            raise TypeError("Odd.reset() got an unexpected keyword argument 'seed'")
        if self.signature == "no_options" and "options" in options:
            raise TypeError("Odd.reset() got an unexpected keyword argument 'options'")
        super().reset(seed=options.get("seed"))
        if self.fault == "no_reset" and self.episodes >= self.episode:
            raise RuntimeError("the door\nis shut")
        self.episodes += 1
        self.steps, self.place, self.goal = 0, *self.np_random.uniform(-1.0, 1.0, (2, self.dims))
        return self.observation() if self.signature == "old_reset" else (self.observation(), {})

    def step(self, action):
        self.moves.append(np.array(action))
        self.steps += 1
        space = self.action_space
        width = np.maximum(space.high.astype(float) - space.low, 1e-9)
        self.place = np.clip(self.place + (2.0 * (action.astype(float) - space.low) / width - 1.0) / 3.0, -1.0, 1.0)
        reached = bool(self.distance(self.place, self.goal) <= self.radius)
        now = self.steps == self.when and self.episodes >= self.episode
        if now and self.fault == "raise":
            raise RuntimeError("the arm\nfell off")
        if now and self.fault == "die":
            os.kill(os.getpid(), signal.SIGKILL)
        info = {"other": self.steps} | ({} if self.says == "reward" else {self.says: self.said(reached)})
        if now and self.fault == "no_success":
            info.pop(self.says, None)
        if now and self.fault in ("success_none", "success_nan") and self.says != "reward":
            info[self.says] = None if self.fault == "success_none" else float("nan")
        observation = self.observation()
        if now and self.fault in ("nan", "nan_goal", "infinite"):
            observation["desired_goal" if self.fault == "nan_goal" else "achieved_goal"][0] = np.inf if self.fault == "infinite" else np.nan
        if now and self.fault == "wrong_shape":
            observation["observation"] = observation["observation"][:-1]
        reward = self.compute_reward(self.place, self.goal, info)
        if self.signature == "old_step":
            return observation, reward, reached, info
        return observation, reward, reached, False, info

    @property
    def radius(self):
        return self.distance_threshold if isinstance(self.distance_threshold, float) else 0.35

    def distance(self, one, other):
        return np.linalg.norm(np.asarray(one, float) - other, axis=-1)

    def said(self, reached):
        return {"bool": reached, "float": float(reached), "array": np.array([reached]), "int": int(reached), "numpy": np.float32(reached)}[self.truth]

    def compute_reward(self, achieved_goal, desired_goal, info):
        reward = np.where(self.distance(achieved_goal, desired_goal) <= self.radius, 0.1, -0.9)
        return {"float": float, "float32": np.float32, "array": lambda value: np.array(value, np.float32)}[self.reward](reward)

    def observation(self):
        return {
            "observation": np.append(self.place, self.steps / 9.0).astype(self.dtype),
            "achieved_goal": self.place.astype(self.dtype),
            "desired_goal": self.goal.astype(self.dtype),
        }


def to_goal(observation, rng, env):
    """The shortest way, in the environment's own units, as far as the actions go."""
    part = np.clip(3.0 * (observation["desired_goal"] - observation["achieved_goal"]), -1.0, 1.0)
    return env.action_low + (part + 1.0) * (env.action_high - env.action_low) / 2.0


if "Odd-v0" not in gymnasium.registry:
    gymnasium.register("Odd-v0", entry_point="odd_env:Odd", max_episode_steps=12)
    gymnasium.register("OddForever-v0", entry_point="odd_env:Odd")
