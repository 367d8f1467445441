"""What the programs of a run take to compile and to run, with XLA's fusion emitters and without: `base.compilation.without_fusion_emitters`."""

from __future__ import annotations

import contextlib
import functools
import statistics
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from typing import Any

import jax
import numpy as np
from jax.experimental.compilation_cache import compilation_cache

import hindrl_jax
from benchmarks import report, timing
from benchmarks.timing import Options, Row
from hindrl_jax.base.compilation import without_fusion_emitters
from hindrl_jax.base.environments import holds_goal
from hindrl_jax.core.agent import policy
from hindrl_jax.core.holding import hold, hold_demonstrations, with_action_hold
from hindrl_jax.training.programs import FRESH_EPISODES, Compile, JaxPrograms

TITLE = "Compilation"
TASKS = ("FixedGridPickAndPlace", "FixedParameterizedReach", "BringNear")
REPEATS = 3


def run(options: Options) -> list[Row]:
    """One row per task, program and way to compile it, CPU seconds."""
    rows = []
    for name in TASKS[:1] if options.quick else TASKS:
        print(f"{TITLE}, {name}: the default recipe, one demonstration, one seed", flush=True)
        for emitters in (True, False):
            for row in measure(name, emitters=emitters):
                way = "with" if emitters else "without"
                print(f"  {way} fusion emitters, {row['program']}: {row['compile_s']} s, runs {row['run_s']} s", flush=True)
                rows.append(row)
    return rows


def measure(name: str, *, emitters: bool) -> list[Row]:
    """Compiles and runs all programs of a run."""
    env = hindrl_jax.make(name)
    demonstrations = hindrl_jax.record_demonstrations(env, 1)
    config = with_action_hold(hindrl_jax.preset("hindrl", env=env), demonstrations)
    held = hold_demonstrations(demonstrations.replace(states=None), config.num_held, holds_goal=holds_goal(env))
    demonstrations = jax.tree.map(lambda leaf: np.asarray(leaf)[None], held)  # of one run
    programs = Timed(hold(env, config.num_held), [config], demonstrations, emitters=emitters)
    runs: dict[str, list[float]] = {}

    def timed(program: str, call: Callable[[], Any]) -> Any:
        began = time.process_time()
        result = jax.block_until_ready(call())
        runs.setdefault(program, []).append(time.process_time() - began)
        return result

    seeds = np.zeros(1, np.uint32)
    guidance, state, key = timed("start", lambda: programs.start(seeds, demonstrations))
    for _ in range(REPEATS):
        state, _clones = timed("imitate", functools.partial(programs.imitate, state, guidance, programs.no_practice()))
        timed("practise", functools.partial(programs.practise, state, guidance, programs.no_practice()))
        actor = policy(state.agent, programs.config, average=True)
        timed(f"evaluate {FRESH_EPISODES}", functools.partial(programs.evaluate, key, actor, guidance, FRESH_EPISODES))
    state = timed("collect", functools.partial(programs.collect, state, guidance))
    for _ in range(REPEATS):
        state, _metrics = timed("learn", functools.partial(programs.learn, state, guidance))
    return [
        {
            "env": name,
            "program": program,
            "emitters": emitters,
            "compile_s": timing.rounded(seconds),
            "run_s": timing.rounded(statistics.median(runs[program])),
            "updates": programs.chunk * programs.config.num_updates if program == "learn" else None,
        }
        for program, seconds in zip(programs._programs, programs.seconds, strict=True)
    ]


class Timed(JaxPrograms):
    """Programs that are compiled one after the other, and how long that took each, in the order in which they are kept."""

    def __init__(self, *given: Any, emitters: bool):
        self.options, self.seconds = {} if emitters else without_fusion_emitters(), list[float]()
        super().__init__(*given)

    @contextlib.contextmanager
    def _compiler(self) -> Iterator[Compile]:
        def compile_(traced: Any, *, learns: bool = False, **options: Any) -> Future[Any]:
            lowered, began, program = traced.lower(), time.process_time(), Future[Any]()
            program.set_result(lowered.compile(self.options | options))
            self.seconds.append(time.process_time() - began)
            return program

        with without_kept_programs():
            yield compile_


@contextlib.contextmanager
def without_kept_programs() -> Iterator[None]:
    """Compiles what an earlier run has already compiled."""
    before = jax.config.jax_enable_compilation_cache
    jax.config.update("jax_enable_compilation_cache", False)
    compilation_cache.reset_cache()  # else JAX remembers that there is one
    try:
        yield
    finally:
        jax.config.update("jax_enable_compilation_cache", before)
        compilation_cache.reset_cache()


def tables(rows: list[Row]) -> str:
    """Both ways beside each other."""
    by_way = {(row["env"], row["program"], row["emitters"]): row for row in rows}
    lines = []
    for env, program in dict.fromkeys((row["env"], row["program"]) for row in rows):
        both = [by_way[env, program, emitters] for emitters in (True, False)]
        what = f"{program}, {both[0]['updates']} gradient steps" if both[0]["updates"] else program
        lines.append([env, what, *(f"{row[name]:.2f}" for name in ("compile_s", "run_s") for row in both)])
    text = (
        "The programs of a run by the default recipe with one demonstration and one seed, CPU seconds of all threads; a run is the median of "
        f"{REPEATS}, but for start and collect. `hindrl train` compiles learn with the emitters and all others without.\n\n"
    )
    return text + report.table(["task", "program", "compile, with", "without", "run, with", "without"], lines)
