"""How all learners of `time_to_solve` are judged: fresh episodes of an environment of Gymnasium, played to their horizons."""

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np


def outcomes(act: Callable[[dict[str, Any]], np.ndarray], env: gymnasium.Env, seeds: range) -> dict[str, float]:
    """Plays an episode for each seed.

    Args:
      act: an observation -> an action, both as the environment has them.
      env: with is_success in the info of each step.
      seeds: of the episodes.

    Returns:
      The shares of episodes that were solved at some step ("reached"), which is where ours end, and at the last ("held"), which is what papers on
      Fetch count.
    """
    reached, held = [], []
    for seed in seeds:
        observation, _ = env.reset(seed=seed)
        solved, over = [], False
        while not over:
            observation, _, terminated, truncated, info = env.step(act(observation))
            solved.append(bool(info["is_success"]))
            over = terminated or truncated
        reached.append(any(solved))
        held.append(solved[-1])
    return {"reached": float(np.mean(reached)), "held": float(np.mean(held))}
