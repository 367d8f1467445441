"""What a GPU makes of the project, in at most ten minutes: kernels, environments, a task solved by many seeds, gradient steps, hours of the thesis.

python -m benchmarks.gpu                    # prints Markdown and writes gpu.json; on a CPU, too, where fewer cases fit into the time
python -m benchmarks.gpu --quick            # does it still work? Writes gpu-quick.json, whose figures mean nothing

Each part has to end by a certain time after the start, and the script ends within ten minutes whatever it does. A case that does not fit in any
more, or not into the memory, is named and left out.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import functools
import json
import os
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import hindrl_jax
from benchmarks import report, timing
from benchmarks.environments import stepper
from benchmarks.loop import Loop, whole_episodes
from benchmarks.run import FOLDER, QUICK_FLAGS
from benchmarks.settings import SETTINGS
from benchmarks.timing import Effort, Row
from hindrl_jax.base.errors import UserError
from hindrl_jax.base.types import Array
from hindrl_jax.config import TrainConfig
from hindrl_jax.core import kernels

REPEATS = 20  # evaluations of a kernel in one call
KERNELS: dict[tuple[str, str], Callable[..., Array]] = {
    ("quantile loss", "whole arrays"): lambda quantiles, targets: kernels._quantile_huber_of_all_pairs(quantiles, targets)[1],
    ("quantile loss", "loop over atoms"): lambda quantiles, targets: kernels._quantile_huber_in_one_pass(quantiles, targets)[1],
    ("truncation", "whole arrays"): lambda atoms: kernels._drop_by_sorting(atoms, num_dropped=4),
    ("truncation", "loop over atoms"): lambda atoms: kernels._drop_by_registers(atoms, num_dropped=4),
}
"""The forms of `core.kernels`: which is chosen on a CPU is the loop, and everywhere else the whole arrays."""

GRADIENT_CASES = [("grid", 8), ("reach", 8), *(("default", seeds) for seeds in (1, 8, 32, 128))]
GRADIENT_CASES += [(setting, seeds) for seeds in (1, 32, 128) for setting in ("grid", "reach")]
"""Settings and numbers of seeds, what is needed most first."""

SEEDS_OF_THESIS = 8
"""Seeds of each cell: as many as most curves of the thesis show."""
THESIS = (
    ("table 5.1: GridPickAndPlace, TQCfD and HinDRL, 4 numbers of demonstrations", "grid", 8),
    ("table 5.2: FixedGridPickAndPlace, TQCfD and HinDRL, 3 numbers of demonstrations", "grid", 6),
    ("table 5.3: FixedParameterizedReach, TQCfD and HinDRL, 4 numbers of demonstrations", "reach", 8),
    ("figure 5.6: FixedParameterizedReach, Smoothed HinDRL", "reach", 1),
    ("section 5.3: FixedParameterizedReach, TQCfD and HinDRL, cloning weights 1 and 0.1", "reach", 4),
)
"""What the thesis trained besides cloning, which takes minutes: experiment, setting, cells. Each cell trains for the thesis preset's steps."""


@dataclasses.dataclass(frozen=True)
class Task:
    """What a part is asked for."""

    quick: bool
    ends: float
    """When the part has to be over, by `time.perf_counter`."""

    @property
    def effort(self) -> Effort:
        return Effort(rounds=1, turn_seconds=0.0) if self.quick else Effort(rounds=3, turn_seconds=0.3)

    def fits(self, case: str, seconds: float = 0.0) -> bool:
        """Whether a case that takes so long is over in time; says so if not."""
        fits = time.perf_counter() + seconds < self.ends
        if not fits:
            print(f"  left out for want of time: {case}", flush=True)
        return fits


def forms(task: Task) -> list[Row]:
    """Both forms of each kernel, milliseconds per evaluation, for 2 critics of 25 quantiles."""
    rows = []
    for batch in (64,) if task.quick else (256, 4096, 12_000, 32 * 256):
        key_quantiles, key_targets, key_atoms = jax.random.split(jax.random.key(0), 3)
        inputs = {
            "quantile loss": (jax.random.normal(key_quantiles, (2, 25, batch)), jax.random.normal(key_targets, (46, batch))),
            "truncation": (jax.random.normal(key_atoms, (50, batch)),),
        }
        chosen = {name: timing.calls(_repeated(form, *inputs[name[0]]), units=REPEATS) for name, form in KERNELS.items()}
        if task.fits(f"kernels at batch {batch}"):
            for (kernel, form), result in timing.take_turns(chosen, task.effort).items():
                rows.append({"kernel": kernel, "form": form, "batch": batch} | result)
    return rows


def _repeated(form: Callable[..., Array], varied: Array, *fixed: Array) -> Callable[[], Array]:
    """Evaluates a kernel again and again, each time on what the last result makes of the first argument, so that nothing can be left out."""

    @jax.jit
    def program(varied: Array) -> Array:
        def evaluate(varied: Array, _: None) -> tuple[Array, None]:
            return varied + 1e-3 * jnp.mean(form(varied, *fixed), axis=0, keepdims=True), None

        return jax.lax.scan(evaluate, varied, length=REPEATS)[0]

    return lambda: jax.block_until_ready(program(varied))


def environment_steps(task: Task) -> list[Row]:
    """Random actions, with the resets that a rollout needs; steps per second, all environments together."""
    rows = []
    for num_envs in (4,) if task.quick else (64, 4096, 65_536):
        for name in ("FixedGridPickAndPlace", "GridPickAndPlace", "FixedParameterizedReach")[: 1 if task.quick else None]:
            if task.fits(f"{num_envs} of {name}", 10.0):
                steps = stepper(hindrl_jax.make(name), num_envs, resets=True, num_actions=16, steps_per_call=16 * num_envs)
                result = timing.take_turns({name: steps}, task.effort)[name]
                rows.append({"env": name, "num_envs": num_envs, "steps_per_second": round(1000.0 / result["wall_ms"])} | result)
    return rows


class _Enough(Exception):
    """All that was to be seen has been seen."""


def solving(task: Task) -> list[Row]:
    """FixedGridPickAndPlace from one demonstration, by the default recipe, until every seed has reached 95% once, or the time is up."""
    num_seeds, config = 128, dataclasses.replace(hindrl_jax.preset("hindrl"), imitation_steps=0)
    if task.quick:
        num_seeds, config = 2, _small(dataclasses.replace(config, num_envs=2, learning_starts=200, steps=400, eval_every=100, eval_episodes=2))
    env = hindrl_jax.make("FixedGridPickAndPlace")
    recorded = jax.device_get(hindrl_jax.record_demonstrations(env, num_seeds))
    demonstrations = [jax.tree.map(lambda leaf, i=i: leaf[i : i + 1], recorded) for i in range(num_seeds)]
    row: Row = dict.fromkeys(("compile_seconds", "train_seconds", "env_steps", "seeds_solved", "seconds_to_half", "seconds_to_all"))
    row["num_seeds"] = num_seeds
    solved: dict[int, float] = {}

    def watch(result: Any) -> None:
        for line in result.rows:
            if line.success >= 0.95:
                solved.setdefault(line.seed, line.seconds)
        times = sorted(solved.values())
        row.update(compile_seconds=result.compile_seconds, train_seconds=result.train_seconds, env_steps=result.env_steps, seeds_solved=len(solved))
        row["seconds_to_half"] = times[num_seeds // 2 - 1] if len(times) >= num_seeds // 2 else None
        row["seconds_to_all"] = times[-1] if len(times) == num_seeds else None
        if len(times) == num_seeds or not task.fits("the rest of the training"):
            raise _Enough

    try:
        with contextlib.suppress(_Enough):
            hindrl_jax.fit(env, demonstrations, config, seeds=range(num_seeds), report=watch)
    except UserError as error:  # it does not fit into the memory
        print(f"  left out: {error}", flush=True)
    return [row]


def gradient_steps(task: Task) -> list[Row]:
    """`train.learn` on FixedGridPickAndPlace: environment steps, replay and relabelling included; milliseconds per step of all seeds together."""
    rows: list[Row] = []
    longest_start, per_column = 0.0, float("inf")
    for setting, num_seeds in [("default", 1), ("grid", 2)] if task.quick else GRADIENT_CASES:
        config = SETTINGS[setting].config
        # A small replay of few episodes: its size changes little (part replay_size of the benchmark), and filling it would take long.
        episodes = dict(learning_starts=0, buffer_size=whole_episodes(20_000, config.num_envs))
        config = dataclasses.replace(config, **episodes)
        num_updates = config.num_updates if task.quick else SETTINGS[setting].steps_per_call
        config, columns = _small(config) if task.quick else config, num_updates * num_seeds * config.batch.batch_size
        calls = 2 + 2 * task.effort.rounds
        if not task.fits(f"{setting}, {num_seeds} seeds", longest_start + (calls * columns * per_column if rows else 0.0)):
            continue
        began = time.perf_counter()
        try:
            learn = Loop(config, num_seeds=num_seeds).learner(num_updates)
            longest_start = max(longest_start, time.perf_counter() - began)
            result = timing.take_turns({setting: timing.calls(learn, units=num_updates)}, task.effort)[setting]
        except jax.errors.JaxRuntimeError as error:
            if "RESOURCE_EXHAUSTED" not in str(error):
                raise
            print(f"  left out for want of memory: {setting}, {num_seeds} seeds", flush=True)
            continue
        per_column = min(per_column, result["wall_ms"] / 1000.0 * num_updates / columns)
        rows.append({"setting": setting, "num_seeds": num_seeds, "ms_per_seed": timing.rounded(result["wall_ms"] / num_seeds)} | result)
    return rows


def _small(config: TrainConfig) -> TrainConfig:
    """The same with hardly any work in it."""
    batch, agent = dataclasses.replace(config.batch, batch_size=16), dataclasses.replace(config.agent, net_arch=(8,))
    return dataclasses.replace(config, batch=batch, agent=agent)


def hours_of_the_thesis(gradient_rows: Sequence[Row]) -> list[Row]:
    """Hours that the thesis's trainings take, from the milliseconds of its settings with the nearest number of seeds side by side."""
    rows = []
    steps = hindrl_jax.preset("hindrl", "thesis").steps
    for experiment, setting, cells in THESIS:
        measured = [row for row in gradient_rows if row["setting"] == setting]
        if measured:
            nearest = min(measured, key=lambda row: abs(np.log(row["num_seeds"] / SEEDS_OF_THESIS)))
            hours = cells * SEEDS_OF_THESIS * steps * nearest["ms_per_seed"] / 3.6e6
            rows.append({"experiment": experiment, "cells": cells, "steps": steps, "hours": timing.rounded(float(hours))})
    return rows


def tables(results: dict[str, Any]) -> str:
    """What there is of the parts, as Markdown."""
    table, milliseconds = report.table, functools.partial(timing.milliseconds, clock="wall")
    text = ""
    if "gradient_steps" in results:
        gradient = [
            [f"`{row['setting']}`", row["num_seeds"], milliseconds(row), row["ms_per_seed"], f"{1000.0 / row['ms_per_seed']:,.0f}"]
            for row in results["gradient_steps"]
        ]
        header = ["setting", "seeds", "ms per step of all seeds", "ms per step and seed", "gradient steps per second, all seeds"]
        text += f"Gradient steps, `train.learn`: the whole loop\n\n{table(header, gradient)}\n"
        text += "\n".join(f"- `{name}`: {setting.description}" for name, setting in SETTINGS.items())
        hours = hours_of_the_thesis(results["gradient_steps"])
        lines = [[row["experiment"], row["cells"] * SEEDS_OF_THESIS, f"{row['steps']:,}", f"{row['hours']:.2g}"] for row in hours]
        lines.append(["all", sum(row["cells"] for row in hours) * SEEDS_OF_THESIS, "", f"{sum(row['hours'] for row in hours):.2g}"])
        text += f"\n\nHours of the thesis, {SEEDS_OF_THESIS} seeds side by side; as much again for the original code's quirks\n\n"
        text += table(["experiment", "trainings", "steps of each", "hours"], lines)
    if "solving" in results:
        row = results["solving"][0]
        seconds = ["-" if row[name] is None else f"{row[name]:.0f} s" for name in ("compile_seconds", "seconds_to_half", "seconds_to_all")]
        header = ["compilation", "half of the seeds have reached 95%", "all have", "seeds that have", "environment steps each"]
        text += f"\nFixedGridPickAndPlace, one demonstration, default recipe, {row['num_seeds']} seeds side by side\n\n"
        text += table(header, [[*seconds, row["seeds_solved"], row["env_steps"]]])
    if "environment_steps" in results:
        lines = [[f"`{row['env']}`", f"{row['num_envs']:,}", f"{row['steps_per_second']:,}"] for row in results["environment_steps"]]
        text += f"\nEnvironment steps per second\n\n{table(['environment', 'side by side', 'steps per second'], lines)}"
    if "forms" in results:
        lines = [[row["kernel"], row["form"], f"{row['batch']:,}", milliseconds(row)] for row in results["forms"]]
        text += f"\nForms of the kernels\n\n{table(['kernel', 'form', 'batch', 'ms'], lines)}"
    return text


PARTS: dict[str, tuple[Callable[[Task], list[Row]], float]] = {
    "forms": (forms, 60.0),
    "environment_steps": (environment_steps, 130.0),
    "gradient_steps": (gradient_steps, 400.0),
    "solving": (solving, 570.0),
}
"""Each part, and by how many seconds after the start it has to be over."""

LIMIT = 590.0
"""Seconds after which the script ends whatever it does, since a compilation cannot be broken off."""


def main() -> None:
    began = time.perf_counter()
    parser = argparse.ArgumentParser(prog="python -m benchmarks.gpu", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="hardly any work, to see that it works")
    parser.add_argument("--out", type=Path, default=FOLDER, metavar="FOLDER", help="where the results go (default: benchmarks)")
    given = parser.parse_args()
    if given.quick:  # read when JAX makes its first array
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {QUICK_FLAGS}".strip()
    path = given.out / f"gpu{'-quick' if given.quick else ''}.json"
    head = f"{time.strftime('%Y-%m-%d')}, {report.machine()}; {', '.join(f'{name} {version}' for name, version in report.versions().items())}"
    print(f"{head}\n", flush=True)
    results: dict[str, Any] = {"measured": head, "quick": given.quick}

    def finish() -> None:
        path.write_text(json.dumps(results | {"seconds": round(time.perf_counter() - began)}, indent=1))
        print(f"\n{tables(results)}\nwrote {path}", flush=True)

    def give_up() -> None:
        print(f"stopped after {LIMIT:.0f} s", flush=True)
        finish()
        os._exit(0)

    watchdog = threading.Timer(LIMIT, give_up)
    watchdog.daemon = True
    watchdog.start()
    for name, (part, ends) in PARTS.items():
        results[name] = part(Task(quick=given.quick, ends=began + ends))
        print(f"{name}: {time.perf_counter() - began:.0f} s after the start", flush=True)
    watchdog.cancel()
    finish()


if __name__ == "__main__":
    main()
