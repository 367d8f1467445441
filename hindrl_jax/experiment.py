"""Running an experiment: demonstrations, many seeds in one program, evaluations along the way. Touches no disk and prints nothing."""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experts.recording import RecordableEnvironment, Recording, record
from hindrl_jax import train as training
from hindrl_jax.config import TrainConfig
from hindrl_jax.errors import UserError
from hindrl_jax.registry import task
from hindrl_jax.train import Guidance, TrainState
from hindrl_jax.types import Episodes

SOLVED = 0.95
FRESH_EPISODES = 100
CHUNKS_PER_EVALUATION = 10
_RUN_ONCE = {"xla_backend_optimization_level": 0}  # for programs whose compilation takes longer than their one run


@dataclasses.dataclass(frozen=True)
class Row:
    """One evaluation of one seed."""

    seed: int
    env_steps: int
    updates: int
    seconds: float
    """Wall-clock training time of the whole run up to here, evaluations included, compilation not."""
    success: float
    """Share of the evaluation's episodes that solved the task."""
    episode_length: float
    """Mean number of steps of those episodes."""
    metrics: dict[str, float]
    """Losses and values, averaged over the gradient steps since the last evaluation."""


@dataclasses.dataclass(frozen=True)
class SeedSummary:
    """What became of one seed. The threshold of 95% refers to the evaluations along the run; None where it was never reached."""

    seed: int
    final_success: float
    """Share of 100 fresh episodes that the final policy solves."""
    best_success: float
    """The best evaluation, the final one included."""
    env_steps_to_95: int | None
    updates_to_95: int | None
    seconds_to_95: float | None
    """Wall-clock time of the whole run, all its seeds side by side."""
    episode_length: float
    """Mean length of the 100 fresh episodes."""


@dataclasses.dataclass
class Result:
    """An experiment, finished or under way."""

    env: RecordableEnvironment
    config: TrainConfig
    seeds: tuple[int, ...]
    guidance: Guidance
    """Leaves (S, ...)."""
    state: TrainState
    """Leaves (S, ...); the policies' parameters are `state.agent.average_actor`. While the run is under way the next chunk consumes it."""
    rows: list[Row]
    """One row per evaluation and seed, in order of time."""
    compile_seconds: float
    train_seconds: float
    """Wall-clock time so far, evaluations included, compilation not."""
    steps_done: int
    """Environment steps per seed so far; for bc, gradient steps."""
    final_success: np.ndarray | None = None
    """(S,) share of 100 fresh episodes that the final policies solve; None while the run is under way."""
    final_length: np.ndarray | None = None
    """(S,) mean length of those episodes."""

    @property
    def updates(self) -> int:
        """Gradient steps per seed so far."""
        return int(self.state.updates[0])

    @property
    def env_steps(self) -> int:
        """Environment steps per seed so far."""
        return int(self.state.env_steps[0])

    def latest_success(self) -> float | None:
        """Success of the newest evaluation, averaged over seeds; None before the first."""
        newest = self.rows[-len(self.seeds) :]
        return float(np.mean([row.success for row in newest])) if newest else None

    def summaries(self) -> list[SeedSummary]:
        """One summary per seed of a finished run."""
        return [self._summary(index, seed) for index, seed in enumerate(self.seeds)]

    def _summary(self, index: int, seed: int) -> SeedSummary:
        rows = [row for row in self.rows if row.seed == seed]
        first = next((row for row in rows if row.success >= SOLVED), None)
        return SeedSummary(
            seed=seed,
            final_success=float(self.final_success[index]),
            best_success=max(float(self.final_success[index]), *(row.success for row in rows)),
            env_steps_to_95=first and first.env_steps,
            updates_to_95=first and first.updates,
            seconds_to_95=first and first.seconds,
            episode_length=float(self.final_length[index]),
        )


def record_demonstrations(env: RecordableEnvironment, num_demos: int, *, seed: int = 0, expert: Any = None) -> Recording:
    """Records demonstrations with the task's own expert.

    Args:
      env: from `make`.
      num_demos: at least 1; only solved episodes are kept.
      seed: equal seeds give equal demonstrations.
      expert: another expert: a frozen dataclass with a method act(key, env, state).

    Raises:
      UserError: if `num_demos` is below 1 or the expert cannot solve the task within its horizon.
    """
    expert = task(env.name).expert() if expert is None else expert
    return record(jax.random.fold_in(jax.random.key(seed), 1), env, expert, num_demos)


def fit(
    env: RecordableEnvironment,
    demonstrations: Episodes | Sequence[Episodes],
    config: TrainConfig,
    *,
    seeds: Sequence[int] = (0,),
    report: Callable[[Result], None] = lambda result: None,
) -> Result:
    """Trains one policy per seed, all of them side by side in one compiled program.

    Args:
      env: the task.
      demonstrations: one table for all seeds, or one table per seed (with equal numbers of demonstrations).
      config: for example from `preset`.
      seeds: non-negative integers. A seed gives the same run whatever the others are, up to floating-point rounding.
      report: called after compilation, several times between evaluations, after each evaluation, and at the end.

    Returns:
      The finished experiment.

    Raises:
      UserError: if the config does not fit the environment.
    """
    demonstrations = _demonstrations_per_seed(demonstrations, seeds, env)
    if config.goal.misalign_demo_actions and int(demonstrations.lengths.min()) < 2:
        raise UserError("misalign_demo_actions needs demonstrations of at least 2 steps: turn it off or record others")
    keys = jax.vmap(lambda seed: jax.random.split(jax.random.key(seed)))(jnp.asarray(seeds, jnp.uint32))
    key_init, key_eval = keys[:, 0], keys[:, 1]

    started = time.perf_counter()
    programs = _Programs(env, config, demonstrations, key_init)
    guidance, state = programs.guidance, programs.state
    result = Result(
        env=env,
        config=config,
        seeds=tuple(seeds),
        guidance=guidance,
        state=state,
        rows=[],
        compile_seconds=time.perf_counter() - started,
        train_seconds=0.0,
        steps_done=0,
    )
    report(result)

    started = time.perf_counter()
    if config.algo != "bc":
        result.state = jax.block_until_ready(programs.collect(result.state, guidance))
        result.steps_done = result.env_steps
    chunks_metrics: list[dict[str, np.ndarray]] = []
    next_evaluation = result.steps_done + config.eval_every
    while result.steps_done < config.steps:
        result.state, metrics = programs.learn(result.state, guidance)
        chunks_metrics.append(jax.device_get(metrics))
        result.steps_done = result.updates if config.algo == "bc" else result.env_steps
        if result.steps_done >= min(next_evaluation, config.steps):
            key_eval, key_now = _split_all(key_eval)
            evaluation = jax.device_get(programs.evaluate(key_now, result.state.agent.average_actor, guidance))
            result.train_seconds = time.perf_counter() - started
            averaged = {name: np.mean([chunk[name] for chunk in chunks_metrics], axis=0) for name in chunks_metrics[0]}
            result.rows += _rows(result, evaluation, averaged)
            chunks_metrics.clear()
            next_evaluation += config.eval_every
        result.train_seconds = time.perf_counter() - started
        report(result)

    fresh = jax.device_get(programs.evaluate_fresh(key_eval, result.state.agent.average_actor, guidance))
    result.final_success, result.final_length = fresh.success.mean(axis=1), fresh.length.mean(axis=1)
    report(result)
    return result


def _demonstrations_per_seed(demonstrations: Episodes | Sequence[Episodes], seeds: Sequence[int], env: RecordableEnvironment) -> Episodes:
    """Stacks one table per seed (leaves (S, ...)), having checked that the tables fit the seeds and the environment."""
    if not seeds or not all(0 <= seed < 2**32 for seed in seeds):
        raise UserError(f"seeds = {list(seeds)} is not usable: give at least one whole number from 0 to {2**32 - 1}")
    tables = [demonstrations] * len(seeds) if isinstance(demonstrations, Episodes) else list(demonstrations)
    if len(tables) != len(seeds):
        raise UserError(f"{len(tables)} tables of demonstrations for {len(seeds)} seeds: give one for all, or one for each")
    expected = (env.horizon + 1, env.observation_dim, env.horizon, env.action_dim)
    for table in tables:
        found = table.observations.shape[1:] + table.actions.shape[1:]
        if found != expected or table.observations.shape[0] < 1 or table.observations.shape != (len(tables[0].lengths), *found[:2]):
            raise UserError(
                f"demonstrations of shapes {table.observations.shape} and {table.actions.shape} do not fit {env.name}: it takes one or more, "
                f"as many for each seed, with observations (N, {expected[0]}, {expected[1]}) and actions (N, {expected[2]}, {expected[3]})"
            )
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *tables)


class _Programs:
    """The compiled programs of one experiment, mapped over seeds."""

    def __init__(self, env: RecordableEnvironment, config: TrainConfig, demonstrations: Episodes, key_init: jax.Array):
        def program(function: Callable[..., Any], **static: Any) -> Callable[..., Any]:
            return jax.vmap(functools.partial(function, env=env, config=config, **static))

        cloning = config.algo == "bc"
        warm_up, per_iteration = (0, 1) if cloning else (training.warm_up_iterations(env, config), config.num_envs)
        to_learn = config.steps - warm_up * per_iteration
        if to_learn < 1:
            raise UserError(f"steps = {config.steps} ends within the {warm_up * per_iteration} random steps before learning: raise steps")
        chunk = max(1, min(config.eval_every // CHUNKS_PER_EVALUATION, to_learn) // per_iteration)
        self.guidance = jax.jit(program(training.guidance))(demonstrations)
        init = jax.jit(program(training.init)).lower(key_init, self.guidance).compile(_RUN_ONCE)
        self.state = init(key_init, self.guidance)
        state, policy = (self.state, self.guidance), (key_init, self.state.agent.average_actor, self.guidance)
        learn = program(training.clone if cloning else training.learn, num_iterations=chunk)
        collect = program(training.collect, num_iterations=warm_up)
        lowered = {
            "learn": jax.jit(learn, donate_argnums=0).lower(*state),
            "evaluate": jax.jit(program(training.evaluate, num_episodes=config.eval_episodes)).lower(*policy),
        }
        if not cloning:
            lowered["collect"] = jax.jit(collect, donate_argnums=0).lower(*state)
        if config.eval_episodes != FRESH_EPISODES:
            lowered["evaluate_fresh"] = jax.jit(program(training.evaluate, num_episodes=FRESH_EPISODES)).lower(*policy)
        # Compilation leaves most of a core idle, so the programs are compiled side by side.
        with ThreadPoolExecutor() as pool:
            compiled = dict(
                zip(lowered, pool.map(lambda name: lowered[name].compile(_RUN_ONCE if name == "collect" else None), lowered), strict=True)
            )
        self.learn, self.evaluate, self.collect = compiled["learn"], compiled["evaluate"], compiled.get("collect")
        self.evaluate_fresh = compiled.get("evaluate_fresh", self.evaluate)


def _split_all(keys: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Splits a vector of keys (S,) into two."""
    split = jax.vmap(jax.random.split)(keys)
    return split[:, 0], split[:, 1]


def _rows(result: Result, evaluation: Any, metrics: dict[str, np.ndarray]) -> list[Row]:
    return [
        Row(
            seed=seed,
            env_steps=result.env_steps,
            updates=result.updates,
            seconds=result.train_seconds,
            success=float(evaluation.success[index].mean()),
            episode_length=float(evaluation.length[index].mean()),
            metrics={name: float(values[index]) for name, values in metrics.items()},
        )
        for index, seed in enumerate(result.seeds)
    ]
