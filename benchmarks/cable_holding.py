"""How long an action may be held, and how noisy it may be: the expert of the cable tasks, asked only once for each decision."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import report
from benchmarks.timing import Options, Row, rounded
from hindrl_jax.base.types import Array, Episodes
from hindrl_jax.envs.cable import BringNear, CableInsertion, CableTask
from hindrl_jax.experts.cable import CableExpert
from hindrl_jax.training.playing import play

TITLE = "Cables, held and noisy actions"
HELD = (1, 3, 5, 7)  # control steps
NOISE = (0.0, 0.03, 0.1, 0.2)  # standard deviation, of each entry of an action in [-1, 1]
NUM_EPISODES = 100


def run(options: Options) -> list[Row]:
    """A row for each task, number of steps and noise."""
    held, noise, num_episodes = ((5,), (0.0,), 2) if options.quick else (HELD, NOISE, NUM_EPISODES)
    print(f"{TITLE}: solved of {num_episodes}", flush=True)
    rows: list[Row] = []
    for env in (BringNear(), CableInsertion()):
        for num_held in held:
            for scale in noise:
                episodes = _play(jax.random.key(0), jnp.asarray(scale), env=env, num_held=num_held, num_episodes=num_episodes)
                solved = np.asarray(episodes.terminated)
                row: Row = {"task": env.name, "held": num_held, "noise": scale, "episodes": num_episodes, "solved": int(solved.sum())}
                row["median_steps"] = rounded(float(np.median(episodes.lengths)))
                print(f"  {env.name} held for {num_held}, noise {scale}: {row['solved']}, median {row['median_steps']} steps", flush=True)
                rows.append(row)
    return rows


@functools.partial(jax.jit, static_argnames=("env", "num_held", "num_episodes"))
def _play(key: Array, scale: Array, *, env: CableTask, num_held: int, num_episodes: int) -> Episodes:
    expert = CableExpert()

    def act(key: Array, state: Any, _: Array) -> Array:
        key_expert, key_noise = jax.random.split(key)
        return expert.act(key_expert, env, state) + scale * env.action_high * jax.random.normal(key_noise, (env.action_dim,))

    return play(key, env, act, num_episodes, num_held)


def tables(rows: list[Row]) -> str:
    """A table for people: of each task a line for each number of held steps, a column for each noise."""
    noise = list(dict.fromkeys(row["noise"] for row in rows))
    lines = []
    for task, held in dict.fromkeys((row["task"], row["held"]) for row in rows):
        of_line = [row for row in rows if (row["task"], row["held"]) == (task, held)]
        lines.append([f"`{task}`", held, *(f"{row['solved']} of {row['episodes']}, {row['median_steps']:g} steps" for row in of_line)])
    return (
        "The expert of the cable tasks decides, and its command is held for some control steps, with Gaussian noise on each entry of the action in\n"
        "[-1, 1]: episodes solved, and the median of their lengths.\n\n"
    ) + report.table(["task", "held for", *(f"noise {scale:g}" for scale in noise)], lines)
