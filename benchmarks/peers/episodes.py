"""How all learners of `time_to_solve` are started and judged: fresh episodes of an environment of Gymnasium, played to their horizons."""

import argparse
import json
import time
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
      The shares of episodes that were solved at some step ("reached"), and at the last ("held"), which is what papers on
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


def parser(description: str) -> argparse.ArgumentParser:
    """What every worker is told; it adds its demonstrations."""
    made = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("--env", required=True)
    made.add_argument("--module", required=True, help="what registers it")
    for name in ("seed", "steps", "every", "episodes"):
        made.add_argument(f"--{name}", type=int, required=True)
    return made


class Judge:
    """Prints a line of JSON for every evaluation; seconds count from `began`, without the evaluations."""

    def __init__(self, began: float, arguments: argparse.Namespace):
        self.env, self.began, self.spent = gymnasium.make(arguments.env), began, 0.0
        first = 10**6 * (1 + arguments.seed)
        self.seeds = range(first, first + arguments.episodes)

    def __call__(self, steps: int, act: Callable[[dict[str, Any]], np.ndarray]) -> None:
        """Judges a policy as it is after so many environment steps."""
        before = time.perf_counter()
        found = outcomes(act, self.env, self.seeds)
        print(json.dumps({"steps": steps, "seconds": round(before - self.began - self.spent, 1)} | found), flush=True)
        self.spent += time.perf_counter() - before
