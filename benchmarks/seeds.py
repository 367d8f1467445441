"""What further seeds cost when they are trained side by side in one program, on one device and spread over the cores."""

from __future__ import annotations

import hindrl_jax
from benchmarks import report, timing
from benchmarks.loop import Loop
from benchmarks.timing import Contestant, Options, Row

TITLE = "Many seeds"
NUM_SEEDS = (1, 2, 8, 32)
UPDATES_PER_CALL = 10


def run(options: Options) -> list[Row]:
    """One row per number of seeds and of devices; milliseconds per gradient step of one seed."""
    print(f"{TITLE}: the default recipe, train.learn for all seeds at once", flush=True)
    config = hindrl_jax.preset("hindrl")

    def contestant(num_seeds: int, num_devices: int) -> Contestant:
        loop = Loop(config, num_seeds=num_seeds, num_devices=num_devices)
        return timing.calls(loop.learner(UPDATES_PER_CALL), units=num_seeds * UPDATES_PER_CALL)

    cases = [(seeds, devices) for seeds in NUM_SEEDS for devices in (1, options.cores) if seeds % devices == 0]
    if options.quick:
        cases = cases[1:3]
    rows = []
    for (num_seeds, num_devices), result in timing.take_turns({case: contestant(*case) for case in cases}, options.effort).items():
        rows.append({"num_seeds": num_seeds, "num_devices": num_devices} | result)
        rows[-1]["seed_updates_per_second"] = timing.rounded(1000.0 / result["wall_ms"])
        print(timing.line(f"{num_seeds} seeds on {num_devices} devices, per seed", result), flush=True)
    return rows


def tables(rows: list[Row]) -> str:
    """Cost per seed, and the throughput of all."""
    lines = [
        [
            row["num_seeds"],
            row["num_devices"],
            timing.milliseconds(row, "cpu"),
            timing.milliseconds(row, "wall"),
            f"{row['seed_updates_per_second']:,.0f}",
        ]
        for row in rows
    ]
    return (
        "The default recipe, `train.learn`. A gradient step of all seeds takes the number of seeds times what is given per seed. One device means "
        "that all cores share every operation, several that each core has seeds of its own, which is what the `hindrl` command does.\n\n"
        + report.table(
            ["seeds", "devices", "CPU ms per gradient step and seed", "wall ms per gradient step and seed", "gradient steps per second, all seeds"],
            lines,
        )
    )
