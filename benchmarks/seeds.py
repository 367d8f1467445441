"""What further seeds cost when they are trained side by side in one program."""

from __future__ import annotations

import hindrl_jax
from benchmarks import report, timing
from benchmarks.loop import Loop
from benchmarks.timing import Contestant, Options, Row

TITLE = "Many seeds"
NUM_SEEDS = (None, 1, 2, 8, 32)  # None: one seed, not mapped
UPDATES_PER_CALL = 10


def run(options: Options) -> list[Row]:
    """One row per number of seeds, and one for a seed that is not mapped; milliseconds per gradient step of one seed."""
    print(f"{TITLE}: the default recipe, train.learn mapped over seeds", flush=True)
    config = hindrl_jax.preset("hindrl")

    def contestant(num_seeds: int | None) -> Contestant:
        return timing.calls(Loop(config, num_seeds=num_seeds).learner(UPDATES_PER_CALL), units=(num_seeds or 1) * UPDATES_PER_CALL)

    contestants = {num_seeds: contestant(num_seeds) for num_seeds in (NUM_SEEDS[2:3] if options.quick else NUM_SEEDS)}
    rows = []
    for num_seeds, result in timing.take_turns(contestants, options.effort).items():
        rows.append({"num_seeds": num_seeds or 1, "mapped": num_seeds is not None} | result)
        rows[-1]["seed_updates_per_second"] = timing.rounded(1000.0 / result["wall_ms"])
        print(timing.line(f"{_name(rows[-1])}, per seed", result), flush=True)
    return rows


def _name(row: Row) -> str:
    return str(row["num_seeds"]) if row["mapped"] else "1, not mapped"


def tables(rows: list[Row]) -> str:
    """Cost per seed, and the throughput of all."""
    lines = [
        [_name(row), timing.milliseconds(row, "cpu"), timing.milliseconds(row, "wall"), f"{row['seed_updates_per_second']:,.0f}"] for row in rows
    ]
    return (
        "The default recipe, `train.learn` under `jax.vmap`. A gradient step of all seeds takes the number of seeds times what is given per seed.\n\n"
        + report.table(
            ["seeds side by side", "CPU ms per gradient step and seed", "wall ms per gradient step and seed", "gradient steps per second, all seeds"],
            lines,
        )
    )
