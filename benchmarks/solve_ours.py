"""The default recipe, for `time_to_solve`: prints a line of JSON after every evaluation, as the workers of the peers do.

    python -m benchmarks.solve_ours --env FetchPush-v4 --seed 0 --steps 100000 --every 10000 --episodes 50 --module gymnasium_robotics --demos FILE

Seconds count from the start of the program, compilation included; of evaluations those of a few episodes that `fit` makes for itself, but not these.
"""

from __future__ import annotations

import dataclasses
import importlib
import os
import time

BEGAN = time.perf_counter()
os.environ.setdefault("JAX_NUM_CPU_DEVICES", "1")

import jax  # noqa: E402, the clock is to run from the start
import numpy as np  # noqa: E402

import hindrl_jax  # noqa: E402
from benchmarks.peers import episodes  # noqa: E402
from hindrl_jax.core.agent import policy  # noqa: E402
from hindrl_jax.runs.acting import TrainedPolicy  # noqa: E402


def main() -> None:
    parser = episodes.parser(__doc__)
    parser.add_argument("--demos", metavar="FILE", required=True, help="of the project's own")
    parser.add_argument("--algo", default="hindrl")
    arguments = parser.parse_args()
    importlib.import_module(arguments.module)
    env = hindrl_jax.make(f"gymnasium:{arguments.env}")
    demonstrations = hindrl_jax.load_demonstrations(arguments.demos, env=env)
    config = hindrl_jax.preset(arguments.algo, env=env)
    if config.learns_from_rollouts:
        config = dataclasses.replace(config, steps=arguments.steps, eval_every=arguments.every, imitation_steps=0)  # what is judged is what is learnt
    config = dataclasses.replace(config, action_hold=1, eval_episodes=config.num_envs)  # all evaluations are those below
    judge = episodes.Judge(BEGAN, arguments)
    seen = 0

    def report(result: hindrl_jax.Result) -> None:
        nonlocal seen
        if len(result.rows) == seen:
            return
        seen = len(result.rows)
        act = TrainedPolicy(env, config, jax.tree.map(lambda leaf: leaf[0], policy(result.state.agent, config, average=True)), None)

        def action(observation: dict[str, np.ndarray]) -> np.ndarray:
            seen_now = np.concatenate([observation["observation"], observation["achieved_goal"]])
            return np.asarray(act(seen_now, observation["desired_goal"]))

        judge(result.env_steps, action)

    hindrl_jax.fit(env, demonstrations, config, seeds=[arguments.seed], report=report)


if __name__ == "__main__":
    main()
