"""Environment steps per second, many environments side by side, with and without the resets that a rollout needs."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

import hindrl_jax
from benchmarks import report, timing
from benchmarks.timing import Contestant, Options, Row
from hindrl_jax.base.environments import Steppable, action_to_env, compiler_options
from hindrl_jax.base.types import Array
from hindrl_jax.core import rollout
from hindrl_jax.core.goals import constant_goal

TITLE = "Environment steps"
ENVIRONMENTS = ("GridPickAndPlace", "FixedGridPickAndPlace")
NUM_ENVS = (1, 64, 1024, 4096)
NUM_ACTIONS = 64  # random actions per environment, drawn beforehand and taken over and over
STEPS_PER_CALL = 64_000  # or more, of all environments together


def run(options: Options) -> list[Row]:
    """One row per environment, number of environments and way of stepping, milliseconds per step of one environment."""
    rows = []
    for name in ENVIRONMENTS:
        print(f"{TITLE}, {name}: uniformly random actions, drawn beforehand", flush=True)
        env = hindrl_jax.make(name)
        sizes = NUM_ENVS[1:2] if options.quick else NUM_ENVS
        contestants = {(num_envs, resets): stepper(env, num_envs, resets=resets) for num_envs in sizes for resets in (True, False)}
        for (num_envs, resets), result in timing.take_turns(contestants, options.effort).items():
            row = {"env": name, "num_envs": num_envs, "resets": resets, "steps_per_second": round(1000.0 / result["wall_ms"])} | result
            print(f"  {num_envs:5d} side by side, {'with' if resets else 'no'} resets: {row['steps_per_second']:12,d} steps per second", flush=True)
            rows.append(row)
    return rows


def stepper(env: Steppable, num_envs: int, *, resets: bool, num_actions: int = NUM_ACTIONS, steps_per_call: int = STEPS_PER_CALL) -> Contestant:
    """Steps `num_envs` environments in one compiled loop.

    With resets this is `rollout.step`, which goes on from one of the new episodes of `rollout.reset` where one has ended; without, the bare steps,
    on beyond the end of episodes. The rewards are summed, so that nothing of a step can be left out.
    """
    goals = constant_goal(env.task_goal())
    key_reset, key_actions, key_steps = jax.random.split(jax.random.key(0), 3)
    actions = jax.random.uniform(key_actions, (num_actions, num_envs, env.action_dim), minval=-1.0, maxval=1.0)
    keys = jax.random.split(key_steps, num_actions)
    repeats = max(1, steps_per_call // (num_envs * num_actions))
    start = jax.jit(lambda key: rollout.reset(key, env, goals, num_envs))(key_reset), jnp.zeros(num_envs)

    def with_resets(carry: tuple[Any, Array], inputs: tuple[Array, Array]) -> tuple[tuple[Any, Array], None]:
        state, rewards = carry
        key, action = inputs
        state, time_step = rollout.step(state, rollout.reset(key, env, goals, num_envs), action, env)
        return (state, rewards + time_step.reward), None

    def without_resets(carry: tuple[Any, Array], inputs: tuple[Array, Array]) -> tuple[tuple[Any, Array], None]:
        state, rewards = carry
        env_state, time_step = jax.vmap(env.step)(state.env_state, action_to_env(inputs[1], env))
        return (state.replace(env_state=env_state, observation=time_step.observation), rewards + time_step.reward), None

    def steps(carry: tuple[Any, Array], keys: Array, actions: Array) -> tuple[Any, Array]:
        def all_actions(carry: tuple[Any, Array], _: None) -> tuple[tuple[Any, Array], None]:
            return jax.lax.scan(with_resets if resets else without_resets, carry, (keys, actions))[0], None

        return jax.lax.scan(all_actions, carry, length=repeats)[0]

    return timing.calls(
        timing.advancing(jax.jit(steps, donate_argnums=0, compiler_options=compiler_options(env)), start, keys, actions),
        units=num_envs * num_actions * repeats,
    )


def tables(rows: list[Row]) -> str:
    """Steps per second of wall-clock time."""
    by_case = {(row["env"], row["resets"], row["num_envs"]): row["steps_per_second"] for row in rows}
    sizes = sorted({row["num_envs"] for row in rows})
    lines = [
        [f"`{env}`", "yes" if resets else "no", *(f"{by_case[env, resets, size]:,}" for size in sizes)]
        for env, resets in dict.fromkeys((row["env"], row["resets"]) for row in rows)
    ]
    return "Steps per second of wall-clock time, all environments together.\n\n" + report.table(
        ["environment", "resets", *(f"{size:,} side by side" for size in sizes)], lines
    )
