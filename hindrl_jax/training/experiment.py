"""Running an experiment: demonstrations, many seeds in one program, evaluations along the way. Touches no disk and prints nothing."""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

from hindrl_jax.base.environments import RelabelsObservations, RestorableEnvironment, compiler_options
from hindrl_jax.base.errors import UserError
from hindrl_jax.base.types import Array, Episodes
from hindrl_jax.config import SWEEPABLE, TrainConfig, sweepable_value, with_traced_values
from hindrl_jax.core import train as training
from hindrl_jax.core.agent import Metrics, policy
from hindrl_jax.core.guidance import Guidance
from hindrl_jax.core.guidance import guidance as guidance_of
from hindrl_jax.core.rollout import Evaluation
from hindrl_jax.core.train import TrainState
from hindrl_jax.tasks.from_gymnasium import is_gymnasium
from hindrl_jax.tasks.registry import task
from hindrl_jax.training.devices import free_memory, gather, over_seeds, seed_mesh, shapes_on, spread, tree_bytes
from hindrl_jax.training.host import FRESH_EPISODES, HostPrograms, record_gymnasium
from hindrl_jax.training.prioritised import sampler_for
from hindrl_jax.training.recording import on_host, record

SOLVED = 0.95
CHUNKS_PER_EVALUATION = 10
_RUN_ONCE = {"xla_backend_optimization_level": 0}  # for programs whose compilation takes longer than their one run


class Diverged(UserError):
    """A loss or a value is not a finite number."""


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
    """An experiment, finished or under way: S runs side by side."""

    env: RestorableEnvironment
    configs: tuple[TrainConfig, ...]
    """(S,) the config of each run."""
    seeds: tuple[int, ...]
    """(S,) the seed of each run."""
    guidance: Guidance
    """Leaves (S, ...)."""
    state: TrainState
    """Leaves (S, ...); the policies' parameters are `state.agent.average_actor`. While the run is under way the next chunk consumes it."""
    rows: list[Row]
    """In order of time, S rows per evaluation, in order of the runs."""
    compile_seconds: float
    train_seconds: float = 0.0
    """Wall-clock time so far, evaluations included, compilation not."""
    env_steps: int = 0
    """Environment steps of each run so far."""
    updates: int = 0
    """Gradient steps of each run so far."""
    final_success: np.ndarray | None = None
    """(S,) share of 100 fresh episodes that the final policies solve; None while the run is under way."""
    final_length: np.ndarray | None = None
    """(S,) mean length of those episodes."""
    key: Array | None = None
    """(S,) keys of the evaluations to come."""
    chunks: list[dict[str, np.ndarray]] = dataclasses.field(default_factory=list)
    """Metrics, leaves (S,), of the chunks since the last evaluation."""

    @property
    def config(self) -> TrainConfig:
        """The config of the first run; of all runs, unless `fit` was given several configs."""
        return self.configs[0]

    @property
    def steps_done(self) -> int:
        """What `TrainConfig.steps` counts: environment steps of each run so far; for bc, gradient steps."""
        return self.updates if self.config.algo == "bc" else self.env_steps

    def latest_success(self) -> float | None:
        """Success of the newest evaluation, averaged over runs; None before the first."""
        newest = self.rows[-len(self.seeds) :]
        return float(np.mean([row.success for row in newest])) if newest else None

    def summaries(self) -> list[SeedSummary]:
        """One summary per run of a finished experiment."""
        return [self._summary(index, seed) for index, seed in enumerate(self.seeds)]

    def rows_of(self, runs: slice) -> list[Row]:
        """The rows of some of the runs, in order of time."""
        return [row for start in range(0, len(self.rows), len(self.seeds)) for row in self.rows[start : start + len(self.seeds)][runs]]

    def part(self, runs: slice) -> Result:
        """The finished experiment as if about some of its runs only; but times, and all of the state except the agent, are those of all."""
        guidance, agent = jax.tree.map(lambda leaf: leaf[runs], jax.device_get((self.guidance, self.state.agent)))
        return dataclasses.replace(
            self,
            configs=self.configs[runs],
            seeds=self.seeds[runs],
            guidance=guidance,
            state=self.state.replace(agent=agent),
            rows=self.rows_of(runs),
            final_success=self.final_success[runs],
            final_length=self.final_length[runs],
        )

    def _summary(self, index: int, seed: int) -> SeedSummary:
        rows = self.rows[index :: len(self.seeds)]
        first = next((row for row in rows if row.success >= SOLVED), None)
        return SeedSummary(
            seed=seed,
            final_success=float(self.final_success[index]),
            best_success=max(float(self.final_success[index]), *(row.success for row in rows)),
            env_steps_to_95=None if first is None else first.env_steps,
            updates_to_95=None if first is None else first.updates,
            seconds_to_95=None if first is None else first.seconds,
            episode_length=float(self.final_length[index]),
        )


def record_demonstrations(env: Any, num_demos: int, *, seed: int = 0, expert: Any = None) -> Episodes:
    """Records demonstrations with the task's own expert.

    Args:
      env: from `make`.
      num_demos: at least 1; only solved episodes are kept.
      seed: equal seeds give equal demonstrations.
      expert: another expert: a frozen dataclass with a method act(key, env, state), for Gymnasium's environments act(observation, rng).

    Raises:
      UserError: if `num_demos` is below 1, the expert cannot solve the task within its horizon, or there is none.
    """
    if expert is None:
        expert_class = task(env.name).expert
        if expert_class is None:
            raise UserError(f"no expert is known for {env.name}: give one, or demonstrations from a file, which hindrl_jax.record_gymnasium can make")
        expert = expert_class()
    if is_gymnasium(env):
        return record_gymnasium(env, expert.act, num_demos, seed=seed)
    return record(jax.random.fold_in(jax.random.key(seed), 1), env, expert, num_demos)


def check_trainable(env: RestorableEnvironment) -> None:
    """Makes sure that the environment can be stepped inside a compiled program.

    Raises:
      UserError: if not.
    """
    if on_host(env):
        raise UserError(f"{env.name} cannot be trained in robosuite, which steps one arm outside JAX: train with backend closed_form or mjx")


def check_config(env: RestorableEnvironment, config: TrainConfig) -> None:
    """Makes sure that the environment can give what the config asks for.

    Raises:
      UserError: if not.
    """
    if not is_gymnasium(env):
        if config.goal.behavioural_goals == "environment":
            raise UserError(
                f"behavioural_goals = environment is for Gymnasium's environments: {env.name} gives its episodes no goals; choose another"
            )
        if isinstance(env, RelabelsObservations):
            if config.batch.uses_intersections:
                raise UserError(
                    f"joint_intersection compares goals, and hindsight changes none in {env.name}: choose another hindrl_sampling_strategy"
                )
            if config.goal.has_achieved_goals:
                raise UserError(f"achieved_goal_ratio is for tasks with other goals than their own, which {env.name} has not: set it to 0")
        return
    if config.goal.behavioural_goals != "environment":
        raise UserError(
            f"behavioural_goals = {config.goal.behavioural_goals} cannot be had in {env.name}, whose episodes come with goals of their own: "
            "choose environment"
        )
    if config.demo_reset_ratio > 0.0:
        raise UserError(f"demo_reset_ratio = {config.demo_reset_ratio} cannot be had in {env.name}, whose states are not known: set it to 0")
    if config.random_truncation > 0.0:
        raise UserError(f"random_truncation = {config.random_truncation} is for environments in JAX, which {env.name} is not: set it to 0")
    if config.agent_resets:
        raise UserError(f"agent_resets = {config.agent_resets} is for environments in JAX, which {env.name} is not: set it to ()")


def steps_to_learn(env: RestorableEnvironment, config: TrainConfig) -> int:
    """What is left of `config.steps` after the random steps at the start.

    Raises:
      UserError: if nothing is.
    """
    at_random = 0 if config.algo == "bc" else training.warm_up_iterations(env, config) * config.num_envs
    if config.steps <= at_random:
        raise UserError(f"steps = {config.steps} ends within the {at_random} random steps before learning: raise steps")
    return config.steps - at_random


def fit(
    env: RestorableEnvironment,
    demonstrations: Episodes | Sequence[Episodes],
    config: TrainConfig | Sequence[TrainConfig],
    *,
    seeds: Sequence[int] = (0,),
    report: Callable[[Result], None] = lambda result: None,
    restore: Callable[[Result], Result | None] = lambda begun: None,
) -> Result:
    """Trains one policy per seed, all of them side by side in one compiled program.

    With several devices the seeds are spread over as many as divide their number; with several hosts (after `jax.distributed.initialize`, the
    same call on each) they are shared evenly between the hosts first.

    Args:
      env: the task.
      demonstrations: one table for all seeds, or one table per seed (with equal numbers of demonstrations).
      config: for example from `preset`; one for all seeds, or one per seed. They may differ in the fields of `config.SWEEPABLE`.
      seeds: non-negative integers. A seed gives the same run whatever the others are, up to floating-point rounding.
      report: called after compilation, several times between evaluations, after each evaluation, and at the end.
      restore: called before anything is computed with a result whose guidance, state and key are `jax.ShapeDtypeStruct`s. Where it returns
        what `report` was given at some time in an earlier call with the same arguments, the experiment goes on from there, and all that
        follows is the same, bit for bit; see `hindrl_jax.runs.checkpoints`. Where it returns None, the experiment begins. In environments of
        Gymnasium the episodes that were under way are lost, so there what follows is another experiment, as good as the first.

    Returns:
      The finished experiment. With several hosts, its agents are gathered on each of them, and the replay is not.

    Raises:
      UserError: if the config does not fit the environment, or the environment cannot be trained in, or the experiment does not fit into the
        memory.
      Diverged: if a loss or a value is not a finite number.
    """
    check_trainable(env)
    if not seeds or not all(0 <= seed < 2**32 for seed in seeds):
        raise UserError(f"seeds = {list(seeds)} is not usable: give at least one whole number from 0 to {2**32 - 1}")
    tables = _demonstrations_per_seed(demonstrations, seeds, env)
    configs = _configs_per_seed(config, seeds)
    config = configs[0]
    check_config(env, config)
    if config.quirks.misaligned_demo_actions and int(tables.lengths.min()) < 2:
        raise UserError("misaligned_demo_actions needs demonstrations of at least 2 steps: turn it off or record others")

    if config.demo_reset_ratio == 0.0:
        tables = tables.replace(states=None)  # nobody needs them on the devices

    started = time.perf_counter()
    programs = _programs(env, configs, tables)
    result = Result(env=env, configs=configs, seeds=tuple(seeds), **programs.shapes, rows=[], compile_seconds=0.0)
    restored = restore(result)
    seeds_on_devices, tables, values = spread((np.asarray(seeds, np.uint32), tables, programs.values), programs.mesh)
    if restored is None:
        result.guidance, result.state, result.key = jax.block_until_ready(programs.start(seeds_on_devices, tables, values))
    else:
        result = restored
    result.compile_seconds = time.perf_counter() - started
    report(result)

    started = time.perf_counter() - result.train_seconds
    if restored is None and config.algo != "bc":
        result.state = jax.block_until_ready(programs.collect(result.state, result.guidance, values))
        result.env_steps = programs.steps_at_random
        if programs.pretrain is not None:
            result.state = jax.block_until_ready(programs.pretrain(result.state, result.guidance, values))
            result.updates = config.bc_warm_start
    while result.steps_done < config.steps:
        result.state, metrics = programs.learn(result.state, result.guidance, values)
        result.chunks.append(gather(metrics))
        if config.algo == "bc":
            result.updates += programs.chunk
        else:
            result.env_steps += programs.chunk * config.num_envs
            result.updates += programs.chunk * config.updates_per_iteration
        _check_finite(result)
        evaluations_done = len(result.rows) // len(seeds)
        if result.steps_done >= min(programs.steps_at_random + (evaluations_done + 1) * config.eval_every, config.steps):
            result.key, evaluation = programs.evaluate(result.key, policy(result.state.agent, average=True), result.guidance, values)
            evaluation = gather(evaluation)
            result.train_seconds = time.perf_counter() - started
            averaged = {name: np.mean([chunk[name] for chunk in result.chunks], axis=0) for name in result.chunks[0]}
            result.rows += _rows(result, evaluation, averaged)
            result.chunks.clear()
        result.train_seconds = time.perf_counter() - started
        report(result)

    _, fresh = programs.evaluate_fresh(result.key, policy(result.state.agent, average=True), result.guidance, values)
    fresh = gather(fresh)
    result.final_success, result.final_length = fresh.success.mean(axis=1), fresh.length.mean(axis=1)
    if jax.process_count() > 1:
        result.guidance, agent = gather((result.guidance, result.state.agent))
        result.state = result.state.replace(agent=agent)
    report(result)
    return result


def _check_fits_into_memory(state: TrainState, num_seeds: int, mesh: Mesh) -> None:
    """Compares the size of the state, nearly all of it replay, with the memory there is, before any of it is taken."""
    needed, free = tree_bytes(state) / jax.process_count(), free_memory(mesh)
    if free is not None and needed > free:
        raise UserError(
            f"{num_seeds} runs side by side take {needed / 2**30:,.1f} GiB of memory, {tree_bytes(state.replay) / tree_bytes(state):.0%} of it "
            f"for the replay, and {free / 2**30:,.1f} GiB are free: lower buffer_size or the number of seeds"
        )


def _check_finite(result: Result) -> None:
    """Ends an experiment that cannot be rescued: a number that is not finite spreads to all parameters within a few gradient steps."""
    for name, values in result.chunks[-1].items():
        if not np.isfinite(values).all():
            index = int(np.argmin(np.isfinite(values)))
            raise Diverged(
                f"{name} of seed {result.seeds[index]} is {values[index]} after {result.env_steps} environment steps and {result.updates} updates: "
                "try a lower learning_rate, or layer_norm"
            )


def _one_for_each(seeds: Sequence[int], given: Any, kind: type[Any], noun: str) -> tuple[Any, ...]:
    """What was given for all seeds, repeated, or for each of them."""
    items = (given,) * len(seeds) if isinstance(given, kind) else tuple(given)
    if len(items) != len(seeds):
        raise UserError(f"{len(items)} {noun} for {len(seeds)} seeds: give one for all, or one for each")
    return items


def _demonstrations_per_seed(demonstrations: Episodes | Sequence[Episodes], seeds: Sequence[int], env: RestorableEnvironment) -> Episodes:
    """Stacks one table per seed (numpy leaves (S, ...)), having checked that the tables fit the seeds and the environment."""
    tables = _one_for_each(seeds, demonstrations, Episodes, "tables of demonstrations")
    expected = (env.horizon + 1, env.observation_dim, env.horizon, env.action_dim)
    for table in tables:
        found = table.observations.shape[1:] + table.actions.shape[1:]
        if found != expected or table.observations.shape[0] < 1 or table.observations.shape != (len(tables[0].lengths), *found[:2]):
            raise UserError(
                f"demonstrations of shapes {table.observations.shape} and {table.actions.shape} do not fit {env.name}: it takes one or more, "
                f"as many for each seed, with observations (N, {expected[0]}, {expected[1]}) and actions (N, {expected[2]}, {expected[3]})"
            )
        if table.states is not None and table.states.shape != (*table.observations.shape[:2], env.state_dim):
            raise UserError(f"demonstrated states of shape {table.states.shape} are not those of {env.name}, which has {env.state_dim}: record again")
    if any(table.states is None for table in tables):
        tables = tuple(table.replace(states=None) for table in tables)
    return jax.tree.map(lambda *leaves: np.stack(leaves), *jax.device_get(tables))


def _configs_per_seed(config: TrainConfig | Sequence[TrainConfig], seeds: Sequence[int]) -> tuple[TrainConfig, ...]:
    """One config per seed, having checked that one program can serve them all."""
    configs = _one_for_each(seeds, config, TrainConfig, "configs")
    swept = _swept_fields(configs)
    for other in configs[1:]:
        if with_traced_values(configs[0], {name: sweepable_value(other, name) for name in swept}) != other:
            raise UserError(f"configs of one experiment may differ only in {', '.join(SWEEPABLE)}; these differ in more: run them apart")
    for name in swept:
        if any(sweepable_value(config, name) is None for config in configs):
            raise UserError(f"{name} is None in some configs and a number in others: give numbers only")
    return configs


def _swept_fields(configs: Sequence[TrainConfig]) -> list[str]:
    return [name for name in SWEEPABLE if len({sweepable_value(config, name) for config in configs}) > 1]


def _programs(env: Any, configs: Sequence[TrainConfig], demonstrations: Episodes) -> _Programs | HostPrograms:
    if not is_gymnasium(env):
        return _Programs(env, configs, demonstrations)
    warm_up, chunk, values = _extent(env, configs)
    programs = HostPrograms(env, configs, demonstrations, values, chunk=chunk, warm_up=warm_up)
    _check_fits_into_memory(programs.shapes["state"], len(configs), programs.mesh)
    return programs


def _extent(env: Any, configs: Sequence[TrainConfig]) -> tuple[int, int, dict[str, np.ndarray]]:
    """Iterations of the random steps at the start and of a chunk, and the swept values (S,) of the configs."""
    config = configs[0]
    warm_up, per_iteration = (0, 1) if config.algo == "bc" else (training.warm_up_iterations(env, config), config.num_envs)
    chunk = max(1, min(config.eval_every // CHUNKS_PER_EVALUATION, steps_to_learn(env, config)) // per_iteration)
    return warm_up, chunk, {name: np.asarray([sweepable_value(c, name) for c in configs], np.float32) for name in _swept_fields(configs)}


class _Programs:
    """The compiled programs of one experiment, mapped over its runs. Each takes the swept values (S,) of the config as its last argument."""

    def __init__(self, env: RestorableEnvironment, configs: Sequence[TrainConfig], demonstrations: Episodes):
        config = configs[0]
        cloning = config.algo == "bc"
        self.warm_up, self.chunk, self.values = _extent(env, configs)
        self.steps_at_random = self.warm_up * config.num_envs
        self.mesh = seed_mesh(len(configs))

        def program(function: Callable[..., Any], *, donate: bool = False) -> Any:
            return jax.jit(over_seeds(function, self.mesh), donate_argnums=0 if donate else ())

        def start(seed: Array, demonstrations: Episodes, values: dict[str, Array]) -> tuple[Guidance, TrainState, Array]:
            actual = with_traced_values(config, values)
            key_init, key_evaluate = jax.random.split(jax.random.key(seed))
            guidance = guidance_of(demonstrations, env, actual)
            return guidance, training.init(key_init, guidance, env, actual, sampler=sampler_for(env, actual)), key_evaluate

        def collect(state: TrainState, guidance: Guidance, values: dict[str, Array]) -> TrainState:
            actual = with_traced_values(config, values)
            return training.collect(state, guidance, env=env, config=actual, num_iterations=self.warm_up, sampler=sampler_for(env, actual))

        def pretrain(state: TrainState, guidance: Guidance, values: dict[str, Array]) -> TrainState:
            actual = with_traced_values(config, values)
            return training.clone(state, guidance, env=env, config=actual, num_iterations=config.bc_warm_start)[0]

        def learn(state: TrainState, guidance: Guidance, values: dict[str, Array]) -> tuple[TrainState, Metrics]:
            actual = with_traced_values(config, values)
            if cloning:
                return training.clone(state, guidance, env=env, config=actual, num_iterations=self.chunk)
            return training.learn(state, guidance, env=env, config=actual, num_iterations=self.chunk, sampler=sampler_for(env, actual))

        def evaluate(key: Array, actor: Any, guidance: Guidance, values: dict[str, Array], *, num_episodes: int) -> tuple[Array, Evaluation]:
            key, key_play = jax.random.split(key)
            actual = with_traced_values(config, values)
            return key, training.evaluate(key_play, actor, guidance, env=env, config=actual, num_episodes=num_episodes)

        # Everything is traced from shapes, and each program is handed to a thread that compiles it while the next one is being traced.
        with ThreadPoolExecutor() as pool:

            def compiled(traced: Any, options: dict[str, Any] | None = None) -> Future[Any]:
                return pool.submit(traced.lower().compile, compiler_options(env) | (options or {}))

            values = shapes_on(self.values, self.mesh)
            seeds = jax.ShapeDtypeStruct((len(configs),), np.uint32)
            traced = program(start).trace(*shapes_on((seeds, demonstrations), self.mesh), values)
            guidance, state, key = shapes_on(traced.out_info, self.mesh)
            self.shapes = {"guidance": guidance, "state": state, "key": key}
            _check_fits_into_memory(state, len(configs), self.mesh)
            actor = policy(state.agent, average=True)
            learning = compiled(program(learn, donate=True).trace(state, guidance, values))
            starting = compiled(traced, _RUN_ONCE)
            evaluating = {
                num_episodes: compiled(program(functools.partial(evaluate, num_episodes=num_episodes)).trace(key, actor, guidance, values))
                for num_episodes in {config.eval_episodes, FRESH_EPISODES}
            }
            collecting = None if cloning else compiled(program(collect, donate=True).trace(state, guidance, values), _RUN_ONCE)
            pretrains = not cloning and config.bc_warm_start > 0
            pretraining = compiled(program(pretrain, donate=True).trace(state, guidance, values)) if pretrains else None
        self.start, self.learn, self.collect = starting.result(), learning.result(), collecting.result() if collecting else None
        self.pretrain = pretraining.result() if pretraining else None
        self.evaluate, self.evaluate_fresh = evaluating[config.eval_episodes].result(), evaluating[FRESH_EPISODES].result()


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
