"""Learning in an environment that is stepped outside JAX: what the environments cost, beside the gradient steps that they take turns with."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

import hindrl_jax
from benchmarks import report, timing
from benchmarks.timing import Contestant, Options, Row
from hindrl_jax.base.errors import UserError
from hindrl_jax.base.steppers import Outcome, Stepper
from hindrl_jax.base.types import Episodes
from hindrl_jax.config import TrainConfig
from hindrl_jax.tasks.from_gymnasium import GymnasiumEnv
from hindrl_jax.training.devices import spread
from hindrl_jax.training.host import HostPrograms

TITLE = "Loop on the host"
ENV = "gymnasium:FetchReach-v4"
WHO = {
    "environments": "the environments alone, taking a step each, at random",
    "program": "the rest of an iteration alone: deciding, a gradient step for each environment, remembering",
    "loop": "`HostPrograms.learn`: both, the gradient steps under way while the environments take their step",
}
NUM_ENVS = (1, 8, 32)
MODES = ("sync", "async")
NUM_DEMONSTRATIONS = 10


class Motionless:
    """In the place of environments: says at once what was said before."""

    def __init__(self, outcome: Outcome):
        self.outcome = outcome

    def step(self, actions: np.ndarray) -> Outcome:
        del actions
        return self.outcome


def run(options: Options) -> list[Row]:
    """One row per number of environments, mode and who, milliseconds per step of one environment. None without gymnasium-robotics."""
    try:
        envs = {mode: hindrl_jax.make(ENV, vectorization=mode) for mode in MODES}
    except UserError as error:
        print(f"{TITLE}: left out, since {error}", flush=True)
        return []
    demonstrations = hindrl_jax.record_demonstrations(envs["sync"], NUM_DEMONSTRATIONS)
    rows = []
    for num_envs in NUM_ENVS[:1] if options.quick else NUM_ENVS:
        contestants: dict[tuple[str, str], Contestant] = {}
        for mode, env in envs.items():
            whole, program, stepper = loops(env, demonstrations, num_envs)
            contestants["environments", mode] = timing.calls(stepping(env, stepper), units=num_envs)
            contestants["loop", mode] = timing.calls(whole, units=num_envs)
            if mode == "sync":
                contestants["program", ""] = timing.calls(program, units=num_envs)
        for (who, mode), result in timing.take_turns(contestants, options.effort).items():
            row = {"who": who, "mode": mode, "num_envs": num_envs, "steps_per_second": round(1000.0 / result["wall_ms"])} | result
            print(f"  {who:12s} {mode:5s} {num_envs:3d} side by side: {row['steps_per_second']:8,d} steps per second", flush=True)
            rows.append(row)
        del contestants  # and with them the environments
    return rows


def config_of(env: GymnasiumEnv, num_envs: int) -> TrainConfig:
    """The default recipe with a gradient step for each step of an environment, and one iteration between two reports."""
    return dataclasses.replace(
        hindrl_jax.preset("hindrl", env=env), num_envs=num_envs, updates_per_iteration=num_envs, learning_starts=0, eval_every=10 * num_envs
    )


def loops(env: GymnasiumEnv, demonstrations: Episodes, num_envs: int) -> tuple[Callable[[], None], Callable[[], None], Stepper]:
    """An iteration of the whole loop, one without environments, and environments that no loop has."""
    tables = jax.tree.map(lambda leaf: np.stack([leaf]), jax.device_get(demonstrations).replace(states=None))
    programs = HostPrograms(env, [config_of(env, num_envs)], tables)
    guidance, state, _ = programs.start(*spread((np.zeros(1, np.uint32), tables), programs.mesh))
    state = programs.collect(state, guidance)
    real, spare = programs.stepper, env.stepper(num_envs)
    observation, goal = spare.begin(np.arange(num_envs))
    never, ended = np.zeros(num_envs, bool), np.ones(num_envs, bool)
    moved = Outcome(next_observation=observation, success=never, terminated=never, truncated=ended, observation=observation, desired_goal=goal)

    def iteration(stepper: Any) -> Callable[[], None]:
        def call() -> None:
            nonlocal state
            programs.stepper = stepper
            state, _ = programs.learn(state, guidance)
            jax.block_until_ready(state)

        return call

    return iteration(real), iteration(Motionless(moved)), spare


def stepping(env: GymnasiumEnv, stepper: Stepper) -> Callable[[], None]:
    """A step of each environment at random."""
    rng, shape = np.random.default_rng(0), (stepper.num_envs, env.action_dim)
    return lambda: stepper.step(rng.uniform(env.action_low, env.action_high, shape)) and None


def versions(options: Options) -> dict[str, str]:
    """Versions of what steps the environments."""
    del options
    return report.installed("gymnasium", "gymnasium-robotics", "mujoco")


def tables(rows: list[Row]) -> str:
    """Steps per second, and the environments' share of the loop."""
    by_case = {(row["who"], row["mode"], row["num_envs"]): row for row in rows}
    sizes = sorted({row["num_envs"] for row in rows})
    header = ["who", *(f"{size} side by side" for size in sizes)]
    cases = [(who, mode) for who in WHO for mode in dict.fromkeys(row["mode"] for row in rows if row["who"] == who)]

    def lines(cell: Callable[[Row], str]) -> list[list[str]]:
        return [[f"`{who}` {mode}".strip(), *(cell(by_case[who, mode, size]) for size in sizes)] for who, mode in cases]

    text = f"{ENV}, 20 physics steps of 2 ms per step, networks of 256 x 256, batch 256. `sync`: one process; `async`: one for each.\n\n"
    text += "".join(f"- `{who}`: {WHO[who]}.\n" for who in WHO)
    text += "\nEnvironment steps per second of wall-clock time, all together:\n\n" + report.table(
        header, lines(lambda row: f"{row['steps_per_second']:,}")
    )
    text += "\nMilliseconds of wall-clock time per step of one environment, median (least .. largest turn):\n\n"
    text += report.table(header, lines(lambda row: timing.milliseconds(row, "wall")))
    shares = [
        [f"`{mode}`", *(f"{by_case['environments', mode, size]['wall_ms'] / by_case['loop', mode, size]['wall_ms']:.0%}" for size in sizes)]
        for mode in MODES
    ]
    return text + "\nTime of the environments alone over that of the loop:\n\n" + report.table(["", *header[1:]], shares)
