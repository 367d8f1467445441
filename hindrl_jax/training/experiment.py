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
from hindrl_jax.core.agent import Params, Policy, policy
from hindrl_jax.core.holding import hold, hold_demonstrations, in_control_steps, with_action_hold
from hindrl_jax.core.imitation import Attempts
from hindrl_jax.core.rollout import Evaluation
from hindrl_jax.training.checks import check_config, check_memory, check_seeds, check_trainable, configs_per_seed, demonstrations_per_seed
from hindrl_jax.training.devices import gather, spread
from hindrl_jax.training.host import HostPrograms
from hindrl_jax.training.judging import as_judged_by, steps_to_goal
from hindrl_jax.training.programs import FRESH_EPISODES, JaxPrograms, Programs
from hindrl_jax.training.progress import ProgressBar
from hindrl_jax.training.result import SAMPLED_SUCCESS, Result, Row
from hindrl_jax.training.selection import Moment, Trial, better, choose, keep, nothing_kept

Report = Callable[[Result], Any]
RISING = 1.02
"""Practice goes on while the mean worth of a round's attempts is more than so many times the best before."""


class Diverged(UserError):
    """A loss or a value is not a finite number."""


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
        chosen by the demonstrations of all of them, with `stop_at` they all learn on until the last of them is done, and clones practise for as long
        as that is of use to one of them.
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
    ends = _imitate(result, programs, report, started) if begins and config.imitation_steps > 0 else result.kept.all_confirmed
    if begins and config.learns_from_rollouts and not ends:
        result.state = jax.block_until_ready(programs.collect(result.state, result.guidance))
        result.env_steps = programs.steps_at_random
    while result.steps_done < config.num_steps and not ends:
        result.state, metrics = programs.learn(result.state, result.guidance)
        result.chunks.append(gather(metrics))
        if config.learns_from_rollouts:
            result.env_steps += programs.chunk * config.steps_per_iteration
            result.updates += programs.chunk * config.num_updates
        else:
            result.updates += programs.chunk
        _check_finite(result)
        evaluations_done = len(result.rows) // len(result.seeds)
        if result.steps_done >= min(programs.steps_at_random + (evaluations_done + 1) * config.eval_every, config.num_steps):
            _evaluate(result, programs, started)
        result.train_seconds = time.perf_counter() - started
        ends = _asks_to_end(report(result)) or result.kept.all_confirmed
    if not result.rows:  # ended by `report` before the first evaluation
        _evaluate(result, programs, started)
    _finish(result, programs)


def _imitate(result: Result, programs: Programs, report: Report, started: float) -> bool:
    """Clones the demonstrations, then practises for as long as that is of use. What comes of it are the first policies that are kept.

    Returns:
      Whether the experiment is to end.
    """
    config, practice = result.config, programs.no_practice()
    score, best = np.zeros(len(result.seeds)), None
    for index in range(config.practice_rounds + 1):
        result.state, clones = programs.imitate(result.state, result.guidance, practice)
        _check_clones(result, clones[-1])
        for clone in clones if index == 0 else clones[-1:]:
            policies = policy(result.state.agent.replace(imitation=clone), config, average=True, imitates=True)
            evaluation = _played(result, programs, policies, config.eval_episodes)
            best = evaluation if best is None else better(best, evaluation)[1]
            if index == 0:
                success = result.cloned_success = np.asarray(best.success).mean(axis=1)
            else:
                success = result.practised_success = np.asarray(evaluation.success).mean(axis=1)
            result.train_seconds = result.imitation_seconds = time.perf_counter() - started
            _keep(result, programs, policies, np.zeros(len(result.seeds)), evaluation, result.moment._replace(env_steps=result.practice_steps))
            if result.kept.all_confirmed:  # and so the run ends here
                result.rows += _rows(result, best, {}, result.practice_steps)
                return True
        if config.practice_rounds > 0 and _asks_to_end(report(result)):
            return True
        if index == config.practice_rounds or not success[result.kept.confirmed < 0].any():
            return False
        practice, attempts = programs.practise(result.state, result.guidance, practice)
        attempts, is_open = gather(attempts), result.kept.confirmed < 0
        steps = np.asarray(in_control_steps(attempts, result.env, config.num_held).length).sum(axis=(1, 2), dtype=np.int64)
        result.practice_steps = result.practice_steps + np.where(is_open, steps, 0)
        result.imitation_seconds = time.perf_counter() - started
        worth = _worth(attempts, result.configs)
        if not (is_open & (worth > RISING * score)).any():
            return False
        score = np.maximum(score, worth)
    return False


def _worth(attempts: Attempts, configs: Sequence[TrainConfig]) -> np.ndarray:
    """(S,) mean over the attempts (S, K, M) of gamma to the number of decisions before the goal, 0 for those that did not solve the task."""
    gammas = np.asarray([config.batch.gamma for config in configs])[:, None, None]
    return np.where(attempts.solved, gammas**attempts.delay, 0.0).mean(axis=(1, 2))


def _asks_to_end(answer: Any) -> bool:
    """Whether that is what a report has returned: not a tuple, say, of what several reporters return together."""
    return isinstance(answer, bool | np.bool_) and bool(answer)


def _check_clones(result: Result, clones: Params) -> None:
    finite = np.all([np.isfinite(leaf).all(axis=tuple(range(1, leaf.ndim))) for leaf in jax.tree.leaves(gather(clones))], axis=0)
    if not finite.all():
        raise Diverged(f"the clone of the demonstrations of seed {result.seeds[int(np.argmin(finite))]} is not finite: try a lower learning_rate")


def _evaluate(result: Result, programs: Programs, started: float) -> None:
    """Evaluates the present policies, notes it, and keeps those that are good."""
    present, num_episodes = policy(result.state.agent, result.config, average=True), result.config.eval_episodes
    noise: Any = np.zeros(len(result.seeds))
    evaluation = by_mean = _played(result, programs, present, num_episodes)
    averaged = {name: np.mean([chunk[name] for chunk in result.chunks], axis=0) for name in result.chunks[0]} if result.chunks else {}
    if result.config.learns_from_rollouts:  # cloning leaves the deviation of the actions as it happens to be
        sampled = _played(result, programs, _with_noise(present, np.ones_like(noise), programs), num_episodes)
        averaged[SAMPLED_SUCCESS] = np.asarray(sampled.success).mean(axis=1)
        noise, evaluation = better(by_mean, sampled)
    result.train_seconds = time.perf_counter() - started
    result.rows += _rows(result, by_mean, averaged)
    result.chunks.clear()
    _keep(result, programs, present, noise, evaluation)


def _keep(result: Result, programs: Programs, policies: Policy, noise: np.ndarray, evaluation: Evaluation, moment: Moment | None = None) -> None:
    """Keeps what is good of policies that were evaluated with some noise, and confirms those with which a run may end."""
    confirmed, stop_at = np.zeros(len(result.seeds), bool), result.config.stop_at
    if stop_at is not None:
        confirmed = (np.asarray(evaluation.success).mean(axis=1) >= stop_at) & (result.kept.confirmed < 0)
        if confirmed.any():
            again = _played(result, programs, _with_noise(policies, noise, programs), FRESH_EPISODES)
            confirmed &= np.asarray(again.success).mean(axis=1) >= stop_at
    result.kept = keep(result.kept, Trial(gather(policies.actor), noise, evaluation), confirmed, moment or result.moment)


def _with_noise(policies: Policy, noise: np.ndarray, programs: Programs) -> Policy:
    return policies.replace(noise=spread(noise.astype(np.float32), programs.mesh))


def _finish(result: Result, programs: Programs) -> None:
    """Chooses the policies that are returned."""
    scale, last_policy = result.state.agent.scale, policy(result.state.agent, result.config, average=True)

    def play(actor: Any, noise: np.ndarray) -> Evaluation:
        of_runs: dict[str, Any] = spread(dict(actor=actor, noise=noise.astype(np.float32)), programs.mesh)
        return _played(result, programs, Policy(scale=scale, **of_runs), FRESH_EPISODES)

    result.returned, last = choose(result.kept, gather(last_policy.actor), result.moment, play)
    result.final_success, result.final_length = (np.asarray(outcome).mean(axis=1) for outcome in (last.success, last.length))
    if jax.process_count() > 1:
        result.guidance, agent = gather((result.guidance, result.state.agent))
        result.state = result.state.replace(agent=agent)


def _played(result: Result, programs: Programs, policies: Policy, num_episodes: int) -> Evaluation:
    """What became of fresh episodes, numpy leaves (S, num_episodes), lengths in environment steps; they are counted."""
    result.key, evaluation = programs.evaluate(result.key, policies, result.guidance, num_episodes)
    evaluation = jax.device_get(in_control_steps(gather(evaluation), result.env, result.config.num_held))
    before = 0 if result.evaluation_steps is None else result.evaluation_steps
    result.evaluation_steps = before + np.asarray(evaluation.length).sum(axis=1, dtype=np.int64)
    return evaluation


def _check_finite(result: Result) -> None:
    """Ends an experiment that cannot be rescued: a number that is not finite spreads to all parameters within a few gradient steps."""
    for name, values in result.chunks[-1].items():
        if not np.isfinite(values).all():
            index = int(np.argmin(np.isfinite(values)))
            raise Diverged(
                f"{name} of seed {result.seeds[index]} is {values[index]} after {result.env_steps} environment steps and {result.updates} updates: "
                "try a lower learning_rate, or layer_norm"
            )


def _rows(result: Result, evaluation: Evaluation, metrics: dict[str, np.ndarray], env_steps: np.ndarray | None = None) -> list[Row]:
    """Of an evaluation; the environment steps are the experiment's, unless they are given, (S,)."""
    return [
        Row(
            seed=seed,
            env_steps=result.env_steps if env_steps is None else int(env_steps[index]),
            updates=result.updates,
            seconds=result.train_seconds,
            success=float(evaluation.success[index].mean()),
            episode_length=float(evaluation.length[index].mean()),
            metrics={name: float(values[index]) for name, values in metrics.items()},
        )
        for index, seed in enumerate(result.seeds)
    ]
