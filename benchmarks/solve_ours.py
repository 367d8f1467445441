"""The default recipe, for `time_to_solve`: prints a line of JSON after every evaluation, as the workers of the peers do.

    python -m benchmarks.solve_ours --env FetchPush-v4 --seed 0 --steps 100000 --every 10000 --episodes 50 --module gymnasium_robotics --demos FILE

Seconds count from the start of the program, compilation included; of evaluations those of a few episodes that `fit` makes for itself, but not these.
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib
import json
import os
import time

BEGAN = time.perf_counter()
os.environ.setdefault("JAX_NUM_CPU_DEVICES", "1")

import gymnasium  # noqa: E402, the clock is to run from the start
import jax  # noqa: E402
import numpy as np  # noqa: E402

import hindrl_jax  # noqa: E402
from benchmarks.peers import episodes  # noqa: E402
from hindrl_jax.core.agent import policy  # noqa: E402
from hindrl_jax.runs.acting import TrainedPolicy  # noqa: E402


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", required=True)
    parser.add_argument("--module", required=True, help="what registers it")
    for name in ("seed", "steps", "every", "episodes"):
        parser.add_argument(f"--{name}", type=int, required=True)
    parser.add_argument("--demos", metavar="FILE", required=True, help="of the project's own")
    parser.add_argument("--algo", default="hindrl")
    arguments = parser.parse_args()
    importlib.import_module(arguments.module)
    env = hindrl_jax.make(f"gymnasium:{arguments.env}")
    demonstrations = hindrl_jax.load_demonstrations(arguments.demos, env=env)
    config = hindrl_jax.preset(arguments.algo, env=env)
    if config.learns_from_rollouts:
        config = dataclasses.replace(config, steps=arguments.steps, eval_every=arguments.every)
    config = dataclasses.replace(config, action_hold=1, eval_episodes=config.num_envs)  # all evaluations are those below
    fresh = gymnasium.make(arguments.env)
    seeds = range(10**6 * (1 + arguments.seed), 10**6 * (1 + arguments.seed) + arguments.episodes)
    seen, spent = 0, 0.0

    def report(result: hindrl_jax.Result) -> None:
        nonlocal seen, spent
        if len(result.rows) == seen:
            return
        seen, before = len(result.rows), time.perf_counter()
        act = TrainedPolicy(env, config, jax.tree.map(lambda leaf: leaf[0], policy(result.state.agent, average=True)), None)

        def action(observation: dict[str, np.ndarray]) -> np.ndarray:
            seen_now = np.concatenate([observation["observation"], observation["achieved_goal"]])
            return np.asarray(act(seen_now, observation["desired_goal"]))

        found = episodes.outcomes(action, fresh, seeds)
        print(json.dumps({"steps": result.env_steps, "seconds": round(before - BEGAN - spent, 1)} | found), flush=True)
        spent += time.perf_counter() - before

    hindrl_jax.fit(env, demonstrations, config, seeds=[arguments.seed], report=report)


if __name__ == "__main__":
    main()
