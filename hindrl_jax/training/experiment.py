"""Running an experiment: demonstrations, many seeds in one program, evaluations along the way. Touches no disk."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from hindrl_jax.base.compilation import in_float32, keep_compiled_programs
from hindrl_jax.base.environments import Environment, can_step, holds_goal
from hindrl_jax.base.errors import UserError
from hindrl_jax.base.types import Episodes
from hindrl_jax.config import TrainConfig
from hindrl_jax.core.agent import policy
from hindrl_jax.core.holding import hold, hold_demonstrations, with_action_hold
from hindrl_jax.training.checks import check_config, check_memory, check_seeds, check_trainable, configs_per_seed, demonstrations_per_seed
from hindrl_jax.training.devices import gather, spread
from hindrl_jax.training.evaluating import check_finite, choose_returned, evaluate
from hindrl_jax.training.host import HostPrograms
from hindrl_jax.training.imitating import imitate
from hindrl_jax.training.judging import as_judged_by, steps_to_goal
from hindrl_jax.training.programs import JaxPrograms, Programs
from hindrl_jax.training.progress import ProgressBar
from hindrl_jax.training.result import Report, Result, asks_to_end
from hindrl_jax.training.selection import nothing_kept


@in_float32
def fit(
    env: Environment,
    demonstrations: Episodes | Sequence[Episodes],
    config: TrainConfig | Sequence[TrainConfig],
    *,
    seeds: Sequence[int] = (0,),
    report: Report | None = None,
    restore: Callable[[Result], Result | None] = lambda begun: None,
) -> Result:
    """Trains one policy per seed, all of them side by side in one compiled program.

    With several devices the seeds are spread over as many as divide their number; with several hosts (after `jax.distributed.initialize`, the
    same call on each) they are shared evenly between the hosts first.

    Compiled programs are kept on disk, see `hindrl_jax.base.compilation`.

    Args:
      env: the task.
      demonstrations: one table for all seeds, or one table per seed (with equal numbers of demonstrations).
      config: for example from `preset`; one for all seeds, or one per seed. They may differ in the fields of `config.SWEEPABLE`.
      seeds: non-negative integers. A seed gives the same run whatever the others are, up to floating-point rounding. But an `action_hold` of None is
        chosen by the demonstrations of all of them, with `stop_at` they all learn on until the last of them is done, and which episodes evaluations
        play, and so what is seen of a policy, depends on how long the clones of the others practise.
      report: called after compilation, after each round of practice, several times between evaluations, after each evaluation, and at the end.
        Where it returns True while the experiment practises or learns, that ends: what was found so far is returned as usual. Where it has a method
        `wait`, as `ProgressBar` does, that is called with "compiling" before this begins, since it takes 10 s to minutes. None shows a `ProgressBar`
        where a person watches, in a terminal or a notebook, and nothing elsewhere; `lambda result: None` shows nothing anywhere.
      restore: called before anything is computed with a result whose guidance, state and key are `jax.ShapeDtypeStruct`s. Where it returns
        what `report` was given at some time in an earlier call with the same arguments, the experiment goes on from there, and all that
        follows is the same, bit for bit; see `hindrl_jax.runs.checkpoints`. Where it returns None, the experiment begins. In environments that
        are stepped outside JAX the episodes under way are lost, so there what follows is another experiment, as good as the first.

    Returns:
      The finished experiment: for each seed the best policy that was seen, `returned`, and in `state` the last one. With several hosts, its agents
      are gathered on each of them, and the replay is not.

    Raises:
      UserError: if the config does not fit the environment, or the environment cannot be trained in, or the experiment does not fit into the
        memory.
      Diverged: if a loss or a value is not a finite number.
    """
    if report is None:
        with ProgressBar() as progress:
            return fit(env, demonstrations, config, seeds=seeds, report=progress if progress.is_watched else _no_report, restore=restore)
    keep_compiled_programs()
    check_trainable(env)
    check_seeds(seeds)
    tables = as_judged_by(env, demonstrations_per_seed(demonstrations, seeds, env))
    until_goal = tables.replace(lengths=steps_to_goal(tables)) if holds_goal(env) else tables
    configs = tuple(with_action_hold(config, until_goal) for config in configs_per_seed(config, seeds))
    config = configs[0]
    check_config(env, config)
    check_memory(env, config, len(seeds), tables.lengths.shape[1])
    if config.demo_reset_ratio == 0.0:
        tables = tables.replace(states=None)  # nobody needs them on the devices

    num_held = config.num_held
    tables = hold_demonstrations(tables, num_held, chunks=config.action_chunks, holds_goal=holds_goal(env))
    if config.quirks.misaligned_demo_actions and int(tables.lengths.min()) < 2:
        raise UserError("misaligned_demo_actions needs demonstrations of at least 2 steps: turn it off or record others")
    if hasattr(report, "wait"):
        report.wait("compiling")
    started = time.perf_counter()
    with contextlib.closing(programs_of(hold(env, num_held, chunks=config.action_chunks), configs, tables)) as programs:
        kept = nothing_kept(policy(programs.shapes["state"].agent, config, average=True).actor)
        result = Result(env=env, configs=configs, seeds=tuple(seeds), **programs.shapes, kept=kept, rows=[], compile_seconds=0.0)
        restored = restore(result)
        seeds_on_devices, tables = spread((np.asarray(seeds, np.uint32), tables), programs.mesh)
        if restored is None:
            result.guidance, result.state, result.key = jax.block_until_ready(programs.start(seeds_on_devices, tables))
        else:
            result = restored
        result.compile_seconds = time.perf_counter() - started
        report(result)
        _train(result, programs, report)
    report(result)
    return result


def _no_report(result: Result) -> None:
    """Nobody is told."""


def programs_of(env: Environment, configs: Sequence[TrainConfig], demonstrations: Episodes) -> Programs:
    """The programs of an experiment, by where its environment is stepped.

    Args:
      env: a task that `check_trainable` takes.
      configs: (S,) of the runs.
      demonstrations: leaves (S, ...).

    Raises:
      UserError: as `Programs`.
    """
    programs: Any = JaxPrograms if can_step(env) else HostPrograms
    return programs(env, configs, demonstrations)


def _train(result: Result, programs: Programs, report: Report) -> None:
    """Takes the experiment from where it is to its end, all but the last report."""
    config, begins = result.config, result.steps_done == 0
    started = time.perf_counter() - result.train_seconds
    ends = imitate(result, programs, report, started) if begins and config.imitation_steps > 0 else result.kept.all_confirmed
    result.practising = None
    if begins and config.learns_from_rollouts and not ends:
        result.state = jax.block_until_ready(programs.collect(result.state, result.guidance))
        result.env_steps = programs.steps_at_random
    while result.steps_done < config.num_steps and not ends:
        are_stuck = result.are_stuck  # at the latest evaluation, after which nothing was learnt yet
        if are_stuck.any():
            started += _reset_networks(result, programs, are_stuck)
        result.state, metrics = programs.learn(result.state, result.guidance)
        result.chunks.append(gather(metrics))
        if config.learns_from_rollouts:
            result.env_steps += programs.chunk * config.steps_per_iteration
            result.updates += programs.chunk * config.num_updates
        else:
            result.updates += programs.chunk
        check_finite(result)
        evaluations_done = len(result.rows) // len(result.seeds)
        if result.steps_done >= min(programs.steps_at_random + (evaluations_done + 1) * config.eval_every, config.num_steps):
            evaluate(result, programs, started)
        result.train_seconds = time.perf_counter() - started
        ends = asks_to_end(report(result)) or result.kept.all_confirmed
    if not result.rows:  # ended by `report` before the first evaluation
        evaluate(result, programs, started)
    choose_returned(result, programs)


def _reset_networks(result: Result, programs: Programs, are_stuck: np.ndarray) -> float:
    """Gives fresh networks to the runs whose agents are stuck (S,); returns the seconds in which the program was compiled, 0 but the first time."""
    began = time.perf_counter()
    programs.compile_reset(result.state)
    waited = time.perf_counter() - began
    result.compile_seconds += waited
    result.state = programs.reset_networks(result.state, are_stuck)
    return waited
