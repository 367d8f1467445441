"""TQC with hindsight experience replay of Stable-Baselines3 or SBX, for `time_to_solve`: prints a line of JSON after every evaluation.

    python solve_sb3.py --env FetchPush-v4 --seed 0 --steps 100000 --every 10000 --episodes 50 --module gymnasium_robotics

The settings are those of the RL Zoo (hyperparams/tqc.yml), but for FetchReach made for a million steps and more on a GPU. With `--library sbx` it is
SBX, the same authors' TQC in JAX, with what fits minutes on a CPU: two critics, two layers of 256 and batches of 256, the rest as in the Zoo.
With `--demos FILE` the demonstrations of an npz file (`time_to_solve.save_episodes`) are in its replay buffer from the beginning. Seconds count from
the start of the program, without evaluations. It takes all cores that it may use.
"""

import importlib
import time
from typing import Any

BEGAN = time.perf_counter()

import episodes  # noqa: E402, the clock is to run from the start
import gymnasium  # noqa: E402
import numpy as np  # noqa: E402
from stable_baselines3 import HerReplayBuffer  # noqa: E402
from stable_baselines3.common.callbacks import BaseCallback  # noqa: E402
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize  # noqa: E402

GAMMA = 0.95
REACH = dict(ent_coef="auto", batch_size=256, learning_starts=1_000, policy_kwargs={"net_arch": [64, 64], "n_critics": 1})
OTHERS = dict(tau=0.05, batch_size=2048, policy_kwargs={"net_arch": [512, 512, 512], "n_critics": 2})
ON_A_CPU = dict(batch_size=256, policy_kwargs={"net_arch": [256, 256], "n_critics": 2})


def settings(library: str, env: str) -> dict[str, Any]:
    """What the RL Zoo sets for a task, and what becomes of it with SBX."""
    zoo = REACH if env.startswith("FetchReach") else OTHERS
    return zoo | ON_A_CPU if library == "sbx" else zoo


class Evaluate(BaseCallback):
    """Plays fresh episodes every so many steps."""

    def __init__(self, judge: episodes.Judge, every: int):
        super().__init__()
        self.judge, self.every = judge, every

    def _on_step(self) -> bool:
        if self.num_timesteps % self.every == 0:
            self.judge(self.num_timesteps, self.act)
        return True

    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        """The mean action for what the environment shows."""
        normalised = self.model.get_vec_normalize_env()
        return self.model.predict(normalised.normalize_obs(observation) if normalised else observation, deterministic=True)[0]


def add_demonstrations(buffer: HerReplayBuffer, path: str) -> None:
    """Stores the episodes of a file, cut off where they end, so that their last states have values as after any time-out."""
    with np.load(path) as file:
        stored = dict(file)
    for index, length in enumerate(stored["lengths"]):
        goal = stored["desired_goal"][index]
        for step in range(length):
            now, then = (
                {key: stored[key][index, at][None] for key in ("observation", "achieved_goal")} | {"desired_goal": goal[None]}
                for at in (step, step + 1)
            )
            last = step == length - 1
            info = {"TimeLimit.truncated": True} if last else {}
            buffer.add(now, then, stored["actions"][index, step][None], np.array([float(last) - 1.0]), np.array([last]), [info])


def main() -> None:
    parser = episodes.parser(__doc__)
    parser.add_argument("--demos", metavar="FILE")
    parser.add_argument("--library", choices=("sb3_contrib", "sbx"), default="sb3_contrib")
    arguments = parser.parse_args()
    importlib.import_module(arguments.module)
    env = DummyVecEnv([lambda: gymnasium.make(arguments.env)])
    if arguments.env.startswith("FetchReach"):
        env = VecNormalize(env, gamma=GAMMA)
    model = importlib.import_module(arguments.library).TQC(
        "MultiInputPolicy",
        env,
        replay_buffer_class=HerReplayBuffer,
        replay_buffer_kwargs={"n_sampled_goal": 4, "goal_selection_strategy": "future"},
        buffer_size=1_000_000,
        gamma=GAMMA,
        learning_rate=1e-3,
        seed=arguments.seed,
        device="cpu",
        **settings(arguments.library, arguments.env),
    )
    if arguments.demos:
        add_demonstrations(model.replay_buffer, arguments.demos)
    model.learn(arguments.steps, callback=Evaluate(episodes.Judge(BEGAN, arguments), arguments.every))


if __name__ == "__main__":
    main()
