"""What the two peers have in common: the command line, the task, the settings, and the conversation with whoever does the timing.

A worker is a program of its own, so that a peer may live in another environment than hindrl_jax and workers can take turns on the same cores:

    python worker_sbx.py --batch-size 4096 --layers 64,64,64,64 --drop 2 --steps-per-call 10

It builds the peer's own TQC, fills the peer's own replay buffer, runs WARM_UP_CALLS calls, and prints `ready`. Each line it then reads is a number
of gradient steps; it runs them through the peer's public `model.train(gradient_steps=..., batch_size=...)`, replay sampling included and without
environment steps, and answers with one line of JSON, milliseconds per gradient step:

    {"steps": 20, "cpu_ms": 153.2, "wall_ms": 94.8}

It ends where its input ends. Standard output holds nothing else; all that the peer may say goes to standard error. `--versions` prints the versions
of the packages as JSON and ends. Linux only, because the cores are held by `sched_setaffinity`.
"""

import argparse
import json
import os
import platform
import sys
import time
from collections.abc import Callable, Sequence
from importlib import metadata
from itertools import pairwise
from typing import Any, TextIO

import gymnasium
import numpy as np
import torch
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.logger import Logger

NUM_TRANSITIONS = 20_000
WARM_UP_CALLS = 2  # SBX compiles in the first and looks its program up again in the second


class RandomBox(gymnasium.Env):
    """Gives the peers their spaces; it is never stepped, because the transitions are written straight into the replay buffer."""

    def __init__(self, observation_dim: int, action_dim: int):
        self.observation_space = gymnasium.spaces.Box(-1.0, 1.0, (observation_dim,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (action_dim,), np.float32)


def run(build: Callable[[argparse.Namespace], Callable[[int], None]], *, description: str, packages: Sequence[str]) -> None:
    """Runs a worker from its command line to the end of its input.

    Args:
      build: takes the parsed arguments and returns `train(gradient_steps)`, which comes back when the new parameters are computed.
      description: shown by `--help`.
      packages: distributions whose versions `--versions` prints.
    """
    arguments = parse_arguments(description)
    if arguments.versions:
        print(json.dumps({"python": platform.python_version()} | {name: metadata.version(name) for name in packages}))
        return
    answers = claim_stdout()
    hold_cores(arguments.threads)
    train = build(arguments)
    for _ in range(WARM_UP_CALLS):
        train(arguments.steps_per_call)
    print("ready", file=answers, flush=True)
    for line in sys.stdin:
        print(json.dumps(timed(train, int(line), arguments.steps_per_call)), file=answers, flush=True)


def parse_arguments(description: str) -> argparse.Namespace:
    """Reads the command line; `layers` comes back as a list of widths."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--batch-size", type=int, default=4096)
    parser.add_argument("--layers", type=widths, default=[64, 64, 64, 64], metavar="W,W,...", help="hidden widths of the actor and of each critic")
    parser.add_argument("--drop", type=int, default=2, help="top quantiles dropped per critic")
    parser.add_argument("--observation-dim", type=int, default=30, help="all of the network's input but the action, goals included")
    parser.add_argument("--action-dim", type=int, default=5)
    parser.add_argument("--num-quantiles", type=int, default=25)
    parser.add_argument("--num-critics", type=int, default=2)
    parser.add_argument("--threads", type=int, default=2, help="cores that the worker may use")
    parser.add_argument("--steps-per-call", type=int, default=10, help="gradient steps per call of train; each line read must be a multiple")
    parser.add_argument("--versions", action="store_true", help="print the versions of the packages and end")
    return parser.parse_args()


def widths(text: str) -> list[int]:
    return [int(width) for width in text.split(",")]


def claim_stdout() -> TextIO:
    """Returns standard output for the answers alone and sends whatever else is printed, by Python or below it, to standard error."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    return answers


def hold_cores(threads: int) -> None:
    """Keeps this process on the first `threads` of the cores it may use, before XLA and PyTorch start their threads.

    XLA makes as many threads as it sees cores and has no other switch. PyTorch counted the cores when it was imported, so it is told again; SBX
    needs it too, whose replay buffer hands out PyTorch tensors.
    """
    cores = sorted(os.sched_getaffinity(0))
    if threads > len(cores):
        raise SystemExit(f"--threads {threads}, but this process may use only {len(cores)} cores")
    os.sched_setaffinity(0, cores[:threads])
    torch.set_num_threads(threads)


def tqc_settings(arguments: argparse.Namespace, activation: Any) -> dict[str, Any]:
    """The keyword arguments of TQC; SBX took over the names that SB3 gave them. What is not here stays at the peer's default."""
    return {
        "policy": "MlpPolicy",
        "env": RandomBox(arguments.observation_dim, arguments.action_dim),
        "learning_rate": 1e-3,
        "gamma": 0.99,
        "ent_coef": "auto",
        "batch_size": arguments.batch_size,
        "buffer_size": NUM_TRANSITIONS,
        "top_quantiles_to_drop_per_net": arguments.drop,
        "policy_kwargs": {
            "net_arch": arguments.layers,
            "activation_fn": activation,
            "n_quantiles": arguments.num_quantiles,
            "n_critics": arguments.num_critics,
        },
        "device": "cpu",
        "seed": 0,
    }


def prepare(model: Any) -> None:
    """Puts a model where `learn` would have brought it before its first gradient step: a logger (a silent one) and a filled replay buffer."""
    model.set_logger(Logger(folder=None, output_formats=[]))
    fill(model.replay_buffer)


def fill(buffer: ReplayBuffer) -> None:
    """Adds random transitions with a reward of 0 or -1, one in fifty of them terminal, until the buffer is full."""
    rng = np.random.default_rng(0)
    for _ in range(buffer.buffer_size):
        observation, next_observation = rng.uniform(-1, 1, (2, 1, *buffer.obs_shape))
        action = rng.uniform(-1, 1, (1, buffer.action_dim))
        terminated = rng.random(1) < 0.02
        buffer.add(observation, next_observation, action, terminated - 1.0, terminated, [{}])


def check_sizes(arguments: argparse.Namespace, *, actor: int, critics: int) -> None:
    """Stops the worker if its networks do not have the number of parameters that its arguments ask for, so that no peer is timed on another task."""

    def mlp(*sizes: int) -> int:
        return sum((inputs + 1) * outputs for inputs, outputs in pairwise(sizes))

    expected_actor = mlp(arguments.observation_dim, *arguments.layers, 2 * arguments.action_dim)  # mean and log standard deviation
    critic = mlp(arguments.observation_dim + arguments.action_dim, *arguments.layers, arguments.num_quantiles)
    expected = {"actor": expected_actor, "critics": arguments.num_critics * critic}
    found = {"actor": actor, "critics": critics}
    if found != expected:
        raise SystemExit(f"the networks have {found} parameters, the arguments ask for {expected}")


def timed(train: Callable[[int], None], steps: int, steps_per_call: int) -> dict[str, float]:
    """Runs `steps` gradient steps and returns how long one of them took, in milliseconds of CPU time (all threads) and of wall-clock time."""
    calls, rest = divmod(steps, steps_per_call)
    if calls < 1 or rest:
        raise SystemExit(f"{steps} gradient steps are no multiple of --steps-per-call {steps_per_call}")
    wall, cpu = time.perf_counter(), time.process_time()
    for _ in range(calls):
        train(steps_per_call)
    cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
    return {"steps": steps, "cpu_ms": round(1000 * cpu / steps, 3), "wall_ms": round(1000 * wall / steps, 3)}
