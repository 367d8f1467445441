"""TQC with hindsight experience replay, as Stable-Baselines3 has it, on our environments as Gymnasium registers them.

python examples/sb3_her_tqc.py                     # one object on a 4 x 4 grid
python examples/sb3_her_tqc.py --learner sbx       # the same with SBX
python examples/sb3_her_tqc.py --set num_objects=2 size=4 max_episode_steps=50     # any arguments of the task; --env names another

Episodes of training go on when the task is solved (`continuing_task`). This learner's hindsight does not end at the goals that it draws, so it values
them up to twenty times as much as a task that ends when it is solved. The policy is tried where episodes end.

Nothing here is ours but the environment. It needs `pip install sb3-contrib` or sbx-rl; or, where `make bench` has installed them, it is run by
`PYTHONPATH=. benchmarks/.venv/bin/python`.
"""

from __future__ import annotations

import argparse
import importlib
import json
import time

import gymnasium
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv

import hindrl_jax  # noqa: F401, registers the environments


def success_rate(model: BaseAlgorithm, envs: VecEnv, episodes: int) -> float:
    """Share of fresh episodes that the policy's mean actions solve: as many in each environment, since solved ones are over sooner."""
    solved: list[list[bool]] = [[] for _ in range(envs.num_envs)]
    observation, each = envs.reset(), -(-episodes // envs.num_envs)
    while min(map(len, solved)) < each:
        observation, _, ended, infos = envs.step(model.predict(observation, deterministic=True)[0])
        for outcomes, info, over in zip(solved, infos, ended, strict=True):
            if over:
                outcomes.append(info["is_success"])
    return sum(sum(outcomes[:each]) for outcomes in solved) / (each * envs.num_envs)


class Evaluate(BaseCallback):
    """Prints success and speed every so many steps."""

    def __init__(self, envs: VecEnv, every: int, episodes: int):
        super().__init__()
        self.envs, self.every, self.episodes = envs, every, episodes
        self.seconds, self.last = 0.0, time.perf_counter()
        self.success: list[float] = []

    def _on_step(self) -> bool:
        if self.num_timesteps % self.every < self.training_env.num_envs:
            self.seconds += time.perf_counter() - self.last
            self.success.append(success_rate(self.model, self.envs, self.episodes))
            print(f"{self.num_timesteps:8,d} steps {self.seconds:7.1f} s   success {self.success[-1]:4.0%}", flush=True)
            self.last = time.perf_counter()
        return True


def train(arguments: argparse.Namespace) -> list[float]:
    """Trains, and returns the success rates along the run."""
    task = {name: json.loads(value) for name, _, value in (given.partition("=") for given in arguments.set)}
    envs = make_vec_env(arguments.env, n_envs=arguments.num_envs, seed=arguments.seed, env_kwargs={"continuing_task": True} | task)
    fresh = make_vec_env(arguments.env, n_envs=arguments.num_envs, seed=arguments.seed + 10_000, env_kwargs=task | {"continuing_task": False})
    learner = importlib.import_module({"sb3": "sb3_contrib", "sbx": "sbx"}[arguments.learner])
    horizon = task.get("max_episode_steps", gymnasium.spec(arguments.env).max_episode_steps)
    model = learner.TQC(
        "MultiInputPolicy",
        envs,
        replay_buffer_class=HerReplayBuffer,
        replay_buffer_kwargs={"n_sampled_goal": 4, "goal_selection_strategy": "future"},
        learning_starts=2 * horizon * arguments.num_envs,
        learning_rate=1e-3,
        gamma=0.95,
        ent_coef="auto_0.05",  # it would begin at 1, as much as there is to win in a step
        batch_size=256,
        gradient_steps=arguments.gradient_steps,
        policy_kwargs={"net_arch": [128, 128]},
        seed=arguments.seed,
        device="cpu",
    )
    evaluate = Evaluate(fresh, arguments.eval_every, arguments.eval_episodes)
    model.learn(arguments.steps, callback=evaluate)
    return evaluate.success


def parse(given: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="hindrl/FixedGridPickAndPlace-v0")
    parser.add_argument("--set", nargs="*", default=["num_objects=1", "size=4", "max_episode_steps=50"], metavar="NAME=VALUE")
    parser.add_argument("--learner", choices=["sb3", "sbx"], default="sb3")
    parser.add_argument("--steps", type=int, default=20_000, help="environment steps")
    parser.add_argument("--num-envs", type=int, default=8)
    parser.add_argument("--gradient-steps", type=int, default=4, help="after each step of all environments")
    parser.add_argument("--eval-every", type=int, default=2_000)
    parser.add_argument("--eval-episodes", type=int, default=50, help="rounded up to as many in each environment")
    parser.add_argument("--seed", type=int, default=0)
    return parser.parse_args(given)


if __name__ == "__main__":
    train(parse())
