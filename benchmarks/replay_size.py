"""Whether a large replay slows learning down, and how much memory a stored transition takes."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import numpy as np

import hindrl_jax
from benchmarks import report, timing
from benchmarks.loop import Loop, sampler, whole_episodes
from benchmarks.timing import Options, Row
from hindrl_jax.base.environments import Environment

TITLE = "Replay size"
SIZES = (10_000, 1_000_000)
QUICK_SIZES = (10_000, 20_000)
UPDATES_PER_CALL = 20
BATCHES_PER_CALL = 20
ROUNDS = 3  # times those of the other parts, since the difference sought is small


def run(options: Options) -> list[Row]:
    """For the whole loop (milliseconds per gradient step) and for the drawing of a batch alone, a row per size; one row for the memory."""
    print(f"{TITLE}: the default recipe with a full replay", flush=True)
    config = hindrl_jax.preset("hindrl")
    loops = {}
    for size in QUICK_SIZES if options.quick else SIZES:
        loop = Loop(dataclasses.replace(config, buffer_size=whole_episodes(size, config.num_envs)), full=True)
        loops[loop.capacity] = loop
    largest = loops[max(loops)]
    effort = dataclasses.replace(options.effort, rounds=ROUNDS * options.effort.rounds)
    sampling = {capacity: timing.calls(sampler(loop, config, BATCHES_PER_CALL), units=BATCHES_PER_CALL) for capacity, loop in loops.items()}
    learning = {capacity: timing.calls(loop.learner(UPDATES_PER_CALL), units=UPDATES_PER_CALL) for capacity, loop in loops.items()}
    rows = []
    for what, contestants in (("learn", learning), ("sample_batch", sampling)):
        for capacity, result in timing.take_turns(contestants, effort).items():
            rows.append({"what": what, "capacity": capacity, "can_be_sampled": _can_be_sampled(loops[capacity])} | result)
            print(timing.line(f"{what}, {capacity:,} transitions", rows[-1]), flush=True)
        for clock in ("cpu", "wall"):
            print(f"  {what}: {clock} time with the large one / with the small one = {_ratio(rows, what, clock):.3f}", flush=True)

    row = {
        "what": "memory",
        "capacity": largest.capacity,
        "bytes_per_transition": timing.rounded(_bytes(largest.state.replay) / largest.capacity),
        "conventional_bytes_per_transition": conventional_bytes(largest.env),
    }
    print(f"  {row['bytes_per_transition']} bytes per transition; conventionally {row['conventional_bytes_per_transition']}", flush=True)
    return [*rows, row]


def _can_be_sampled(loop: Loop) -> int:
    """Room for transitions in the episodes that are complete."""
    return int(loop.state.replay.num_complete.sum()) * loop.env.horizon


def _bytes(tree: Any) -> int:
    return sum(leaf.nbytes for leaf in jax.tree.leaves(tree))


def conventional_bytes(env: Environment) -> int:
    """A transition stored by itself, in float32: observation, achieved goal and desired goal at both ends, action, reward, done."""
    floats = 2 * (env.observation_dim + 2 * env.goal_dim) + env.action_dim + 2
    return floats * np.dtype(np.float32).itemsize


def _ratio(rows: list[Row], what: str, clock: str) -> float:
    small, large = (row[f"{clock}_ms"] for row in rows if row["what"] == what)
    return large / small


def tables(rows: list[Row]) -> str:
    """Costs by size, their ratio, and the memory."""
    config = hindrl_jax.preset("hindrl")
    names = {"learn": "one gradient step, whole loop", "sample_batch": "drawing one batch alone"}
    lines = [
        [
            names[row["what"]],
            f"{row['capacity']:,}",
            f"{row['can_be_sampled']:,}",
            timing.milliseconds(row, "cpu"),
            timing.milliseconds(row, "wall"),
        ]
        for row in rows
        if row["what"] in names
    ]
    text = (
        f"The default recipe (batch {config.batch.batch_size}, {config.num_envs} environments) with a full replay. Two episodes per environment are "
        "the least that a replay can hold; one of them is being written. So the small replay is the smallest there is.\n\n"
    )
    text += report.table(["what", "room for transitions", "of which can be sampled", "CPU ms", "wall ms"], lines)
    for what, name in names.items():
        text += f"\n- Large over small, {name}: {_ratio(rows, what, 'cpu'):.3f} in CPU time, {_ratio(rows, what, 'wall'):.3f} in wall-clock time."
    memory = next(row for row in rows if row["what"] == "memory")
    text += (
        f"\n- A stored transition takes {memory['bytes_per_transition']} bytes. Stored by itself in float32, with observation, achieved goal and "
        f"desired goal at both ends, action, reward and done, it takes {memory['conventional_bytes_per_transition']}.\n"
    )
    return text
