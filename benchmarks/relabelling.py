"""What the relabelling strategies add to a gradient step and to drawing a batch, and what the epsilon filter costs once per run."""

from __future__ import annotations

import dataclasses

import jax

import hindrl_jax
from benchmarks import report, timing
from benchmarks.loop import Loop, sampler, whole_episodes
from benchmarks.timing import Contestant, Options, Row
from hindrl_jax.config import TrainConfig
from hindrl_jax.core import goals

TITLE = "Relabelling"
STRATEGIES = ("final", "future", "episode", "random", "task_conditioned", "joint_union", "joint_intersection")
REFERENCE = "task_conditioned"
UPDATES_PER_CALL = 20
STORED = 1_000_000
BATCH_SIZE = 4096
BATCHES_PER_CALL = 10
NUM_DEMONSTRATIONS = (1, 10, 100)


def run(options: Options) -> list[Row]:
    """Two rows per strategy, milliseconds per gradient step of the whole loop and per batch, and one per number of demonstrations, milliseconds
    for filtering all of them."""
    config = hindrl_jax.preset("hindrl")
    print(f"{TITLE}: train.learn, default recipe, {max(NUM_DEMONSTRATIONS)} demonstrations, a full replay", flush=True)
    stored = whole_episodes(20_000 if options.quick else STORED, config.num_envs)
    contestants = {}
    for strategy in (REFERENCE, STRATEGIES[-1]) if options.quick else STRATEGIES:
        batch = dataclasses.replace(config.batch, hindrl_sampling_strategy=strategy)
        loop = Loop(dataclasses.replace(config, buffer_size=stored, batch=batch), num_demonstrations=max(NUM_DEMONSTRATIONS), full=True)
        contestants[strategy] = timing.calls(loop.learner(UPDATES_PER_CALL), units=UPDATES_PER_CALL)
    learning = [{"what": "learn", "strategy": strategy} | result for strategy, result in timing.take_turns(contestants, options.effort).items()]

    loop = Loop(dataclasses.replace(config, buffer_size=12_800) if options.quick else config, full=True)
    print(f"{TITLE}: batch.sample_batch, batch {BATCH_SIZE}, from a full replay of {loop.capacity:,} transitions", flush=True)
    batches = {"off": dataclasses.replace(config.batch, batch_size=BATCH_SIZE, relabelled_per_original=0.0)} | {
        strategy: dataclasses.replace(config.batch, batch_size=BATCH_SIZE, hindrl_sampling_strategy=strategy)
        for strategy in (STRATEGIES[-2:-1] if options.quick else STRATEGIES[:-1])  # an intersection needs what a replay made for it notes
    }
    contestants = {strategy: _draws(loop, dataclasses.replace(config, batch=batch)) for strategy, batch in batches.items()}
    rows = learning + [
        {"what": "sample_batch", "strategy": strategy} | result for strategy, result in timing.take_turns(contestants, options.effort).items()
    ]

    env = loop.env
    demonstrations = hindrl_jax.record_demonstrations(env, max(NUM_DEMONSTRATIONS))
    achieved = env.achieved_goal(demonstrations.observations)
    epsilon = goals.epsilon_from_demonstrations(achieved, demonstrations.lengths, steps=5, deviations=0.0)
    contestants = {number: _filter(achieved[:number], epsilon) for number in NUM_DEMONSTRATIONS}
    rows += [
        {"what": "epsilon_filter", "demonstrations": number} | result for number, result in timing.take_turns(contestants, options.effort).items()
    ]
    for row in rows:
        print(timing.line(_name(row), row), flush=True)
    return rows


def _draws(loop: Loop, config: TrainConfig) -> Contestant:
    return timing.calls(sampler(loop, config, BATCHES_PER_CALL), units=BATCHES_PER_CALL)


def _filter(achieved_goals: jax.Array, epsilon: jax.Array) -> Contestant:
    program = jax.jit(jax.vmap(goals.epsilon_filter, (0, None)))
    return timing.calls(lambda: jax.block_until_ready(program(achieved_goals, epsilon)))


def _name(row: Row) -> str:
    if row["what"] == "learn":
        return f"gradient step, {row['strategy']}"
    return f"batch, {row['strategy']}" if row["what"] == "sample_batch" else f"epsilon filter, demonstrations: {row['demonstrations']}"


def tables(rows: list[Row]) -> str:
    """One table for both."""
    text = (
        f"One gradient step of the whole loop by strategy, default recipe with {max(NUM_DEMONSTRATIONS)} demonstrations and a full replay of a "
        f"million transitions; drawing one batch of {BATCH_SIZE} alone, demonstration rows included; and the epsilon filter over all demonstrations "
        "(101 states each, once per run, the call from Python included). The relabelled share of a batch does not change its cost: goals are drawn "
        "for all rows. An intersection is prepared while episodes are recorded, so its cost is in the gradient step alone.\n\n"
    )
    reference = next(row for row in rows if row["what"] == "learn" and row["strategy"] == REFERENCE)
    lines = []
    for row in rows:
        ratio = f"{row['cpu_ms'] / reference['cpu_ms']:.2f}" if row["what"] == "learn" else ""
        lines.append([_name(row), timing.milliseconds(row, "cpu"), timing.milliseconds(row, "wall"), ratio])
    return text + report.table(["what", "CPU ms", "wall ms", f"CPU, x {REFERENCE}"], lines)
