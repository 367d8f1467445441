"""A trained policy in NumPy alone: this file and the .npz beside it run where no JAX is, on a robot's computer for example.

    from numpy_policy import load

    policy = load("policy.npz")
    action = policy(observation, goal)  # (D,), (G,) -> (A,)

`hindrl_jax.load_run(...).export_policy(folder)` writes both files. What the policy is given and gives is in the task's own units. It decides once for
`policy.action_hold` control steps: ask it, send the same action that many times, ask again. With `policy.chunks` it gives as many different actions,
(action_hold, A), to be sent one after the other.

What it does not do: it neither reads sensors nor keeps time, does not tell when the task is solved, knows of no limits but the bounds of the actions,
and does not learn.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np

FORMAT = 2
_LOG_STD_MIN, _LOG_STD_MAX = -20.0, 2.0
_LAYER_NORM_EPSILON = 1e-6
_MOST_DEVIATIONS = 100.0


class NumpyPolicy:
    """A policy as a function, observation and goal -> action."""

    def __init__(self, arrays: dict[str, np.ndarray], facts: dict[str, Any]):
        """Takes what `load` reads.

        Args:
          arrays: the layers, by the names that flax gave them, the scales of the inputs, the bounds of the actions.
          facts: plain data on how they belong together.
        """
        if facts["format"] != FORMAT:
            raise ValueError(f"this policy has format {facts['format']}, and this file reads {FORMAT}: use the numpy_policy.py that came with it")
        self._arrays, self._facts = arrays, facts
        self.task: str = facts["task"]
        """The name of the task that it was trained in."""
        self.action_hold: int = facts["action_hold"]
        """Control steps for which each action is held."""
        self.chunks: bool = facts["chunks"]
        """Whether a decision is `action_hold` different actions, (action_hold, A), in place of one."""
        self.noise: float = facts["noise"]
        """Of the actions that are drawn with `rng`: what the run has found to be best, 0 for the mean action, 1 for sampled ones."""
        self.action_low: np.ndarray = arrays["action_low"]
        """(A,) bounds of the actions."""
        self.action_high: np.ndarray = arrays["action_high"]
        """(A,)"""
        self.goal: np.ndarray | None = arrays.get("goal")
        """(G,) the goal that is meant where none is given; None where each episode has one of its own."""

    def __call__(self, observation: Any, goal: Any = None, rng: np.random.Generator | None = None) -> np.ndarray:
        """The action, within the bounds.

        Args:
          observation: (..., D) in the task's units.
          goal: (..., G) likewise; None for `self.goal`.
          rng: draws actions with `self.noise`; None for the mean action.

        Returns:
          (..., A) float32, or with `chunks` (..., action_hold, A).

        Raises:
          ValueError: if a shape is not that of the task, or a goal is missing.
        """
        arrays = self._arrays
        observation = _checked(observation, arrays["observation_scale"].size, "an observation", self.task)
        if goal is None and self.goal is None:
            raise ValueError(f"{self.task} has a goal of its own in each episode: give it, as policy(observation, goal)")
        goal = _checked(self.goal if goal is None else goal, arrays["goal_scale"].size, "a goal", self.task)
        if self._facts["achieved"] is not None:  # the networks see what is left to the goal
            goal = goal - observation[..., self._facts["achieved"]]
        leading = np.broadcast_shapes(observation.shape[:-1], goal.shape[:-1])
        parts = [self._encoded("observation", observation), self._encoded("goal", goal)]
        inputs = np.concatenate([np.broadcast_to(part, (*leading, part.shape[-1])) for part in parts], axis=-1)
        mean, log_std = np.split(self._network(inputs), 2, axis=-1)
        if rng is not None:
            deviation = np.exp(np.clip(log_std, _LOG_STD_MIN, _LOG_STD_MAX))
            mean = mean + self.noise * deviation * rng.standard_normal(mean.shape, np.float32)
        action = np.tanh(mean).reshape(*leading, *((self.action_hold, -1) if self.chunks else (-1,)))
        action = self.action_low + (action + 1.0) * (0.5 * (self.action_high - self.action_low))
        if self._facts["whole_actions"]:
            action = np.clip(np.rint(action), np.ceil(self.action_low), np.floor(self.action_high))
        return action.astype(np.float32)

    def _encoded(self, name: str, values: np.ndarray) -> np.ndarray:
        if self._facts["encoding"] == "raw":
            return values
        centre, scale = self._arrays[f"{name}_centre"], self._arrays[f"{name}_scale"]
        standardised = np.clip((values - centre) / scale, -_MOST_DEVIATIONS, _MOST_DEVIATIONS)
        if self._facts["encoding"] == "standardised":
            return standardised
        return np.concatenate([standardised, np.tanh(4.0 * values / np.sqrt(np.square(scale) + np.square(centre)))], axis=-1)

    def _network(self, features: np.ndarray) -> np.ndarray:
        depth = self._facts["depth"]
        if not self._facts["residual"]:
            for layer in range(depth):
                features = np.maximum(self._dense(layer, features), 0.0)
            return self._dense(depth, features)
        features = self._dense(0, features)
        for block in range(depth):
            inner = np.maximum(self._dense(2 * block + 1, self._normed(block, features)), 0.0)
            features = features + self._dense(2 * block + 2, inner)
        return self._dense(2 * depth + 1, self._normed(depth, features))

    def _dense(self, layer: int, features: np.ndarray) -> np.ndarray:
        return features @ self._arrays[f"Dense_{layer}/kernel"] + self._arrays[f"Dense_{layer}/bias"]

    def _normed(self, layer: int, features: np.ndarray) -> np.ndarray:
        mean, variance = features.mean(axis=-1, keepdims=True), features.var(axis=-1, keepdims=True)
        scale, bias = self._arrays[f"LayerNorm_{layer}/scale"], self._arrays[f"LayerNorm_{layer}/bias"]
        return (features - mean) / np.sqrt(variance + _LAYER_NORM_EPSILON) * scale + bias


def _checked(values: Any, dim: int, what: str, task: str) -> np.ndarray:
    values = np.asarray(values, np.float32)
    if values.ndim == 0 or values.shape[-1] != dim:
        raise ValueError(f"{what} of shape {values.shape} is none of {task}: give (..., {dim})")
    return values


def save(path: Any, arrays: dict[str, np.ndarray], facts: dict[str, Any]) -> None:
    """Writes what `load` reads; no pickle."""
    content: dict[str, Any] = {"facts": np.array(json.dumps(facts)), **arrays}
    np.savez(path, **content)


def load(path: Any) -> NumpyPolicy:
    """Reads a policy that `export_policy` has written.

    Args:
      path: of the .npz file.

    Raises:
      OSError, ValueError, KeyError: if it is not there, is no such file, or is of another format.
    """
    with np.load(path, allow_pickle=False) as archive:
        arrays = {name: archive[name] for name in archive.files}
    return NumpyPolicy(arrays, json.loads(str(arrays.pop("facts"))))
