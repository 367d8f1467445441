"""Control steps of the cable tasks per second, by each back end: two arms, two cables, observations, rewards and resets."""

from __future__ import annotations

import dataclasses

from benchmarks import report, timing
from benchmarks.environments import stepper
from benchmarks.timing import Options, Row
from hindrl_jax.envs.cable import CableInsertion

TITLE = "Cables, control steps"
BACKENDS = {"closed_form": 6400, "mujoco": 2048, "mjx": 256}
"""With the control steps of one call, all environments together."""
NUM_ENVS = (1, 16, 64, 256, 1024)
NUM_ACTIONS = 4
TURN_SECONDS = 0.3  # of those of the other parts


def run(options: Options) -> list[Row]:
    """One row per back end and number of environments, milliseconds per control step of one environment."""
    print(f"{TITLE}: uniformly random commands, drawn beforehand", flush=True)
    effort = dataclasses.replace(options.effort, turn_seconds=TURN_SECONDS * options.effort.turn_seconds)
    sizes = NUM_ENVS[1:2] if options.quick else NUM_ENVS
    backends = [backend for backend in BACKENDS if backend != "mjx" or not options.quick]  # it takes minutes to compile
    contestants = {
        (backend, size): stepper(CableInsertion(backend=backend), size, resets=True, num_actions=NUM_ACTIONS, steps_per_call=BACKENDS[backend])
        for backend in backends
        for size in (sizes if backend != "mjx" else sizes[:3])
    }
    rows = []
    for (backend, size), result in timing.take_turns(contestants, effort).items():
        row = {"backend": backend, "num_envs": size, "steps_per_second": round(1000.0 / result["wall_ms"])} | result
        print(f"  {backend:12s} {size:5d} side by side: {row['steps_per_second']:10,d} control steps per second", flush=True)
        rows.append(row)
    return rows


def versions(options: Options) -> dict[str, str]:
    """Versions of what moves arms and cables."""
    del options
    return report.installed("mujoco", "mujoco-mjx")


def tables(rows: list[Row]) -> str:
    """Control steps per second of wall-clock time, and per second of CPU time."""
    by_case = {(row["backend"], row["num_envs"]): row for row in rows}
    sizes = sorted({row["num_envs"] for row in rows})
    header = ["back end", *(f"{size:,} side by side" for size in sizes)]
    text = ""
    for title, which in (("wall-clock time", "wall_ms"), ("CPU time, all threads", "cpu_ms")):
        lines = [
            [f"`{backend}`", *(f"{1000.0 / by_case[backend, size][which]:,.0f}" if (backend, size) in by_case else "" for size in sizes)]
            for backend in dict.fromkeys(row["backend"] for row in rows)
        ]
        text += f"Control steps of 50 ms per second of {title}, all environments together:\n\n{report.table(header, lines)}\n"
    return text
