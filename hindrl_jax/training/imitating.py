"""The beginning of a run: the demonstrations are cloned, and the clones practise, see `core.imitation`."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hindrl_jax.base.types import tree_where
from hindrl_jax.config import TrainConfig
from hindrl_jax.core.agent import Params, policy
from hindrl_jax.core.holding import in_control_steps
from hindrl_jax.core.imitation import Attempts, Practice
from hindrl_jax.core.rollout import Evaluation
from hindrl_jax.training.devices import gather, spread
from hindrl_jax.training.evaluating import Diverged, as_rows, keep_good, played
from hindrl_jax.training.programs import Programs
from hindrl_jax.training.result import Practising, Report, Result, asks_to_end

PRACTISABLE = 0.2
"""A clone practises if it solves at least this share of an evaluation's episodes: what is hardly ever solved is learnt sooner by reinforcement."""
RISING, PATIENCE = 1.02, 2
"""It ends with the second round running whose attempts' mean worth is not more than 1.02 times the best before."""


def imitate(result: Result, programs: Programs, report: Report, started: float) -> bool:
    """Clones the demonstrations, then lets the best clone of each run practise for as long as that is of use to it.

    What comes of it are the first policies that are kept. After each round `result` and `result.practising` are all that it takes to go on.

    Returns:
      Whether the experiment is to end.
    """
    config = result.config
    if result.practising is None:
        result.practising = _not_yet(len(result.seeds))
        _clone(result, programs, programs.no_practice(), started)
        if result.kept.all_confirmed or (config.practice_rounds > 0 and asks_to_end(report(result))):
            return True
    while result.practising.rounds < config.practice_rounds:
        practice = _practise(result, programs, started)
        if practice is None:
            break
        _clone(result, programs, practice, started)
        if result.kept.all_confirmed or asks_to_end(report(result)):
            return True
    return False


def _not_yet(num_runs: int) -> Practising:
    """Before the first clone."""
    nothing, everybody = np.zeros(num_runs), np.ones(num_runs, bool)
    return Practising(rounds=0, goes_on=everybody, score=nothing, patience=np.full(num_runs, PATIENCE), success=nothing - 1.0, length=nothing)


def _clone(result: Result, programs: Programs, practice: Practice, started: float) -> None:
    """Clones demonstrations and practice, evaluates the clones of those runs that practise, and goes on with them.

    The first time, when there are demonstrations alone, clones are evaluated after each part of the gradient steps, and the best one goes on.
    """
    before = jax.tree.map(np.array, gather(result.state.agent.imitation))  # a copy, as the state is donated
    result.state, clones = programs.imitate(result.state, result.guidance, practice)
    _check_finite(result, clones[-1])
    goes_on, is_first = result.practising.goes_on, result.practising.rounds == 0
    clones, successes = clones if is_first else clones[-1:], []
    for clone in clones:
        policies = policy(result.state.agent.replace(imitation=clone), result.config, average=True, imitates=True)
        evaluation = played(result, programs, policies, result.config.eval_episodes)
        success, length = (np.asarray(values).mean(axis=1) for values in (evaluation.success, evaluation.length))
        successes.append(success)
        best = result.practising
        is_better = goes_on & (success > best.success)
        success_of_best, length_of_best = np.where(is_better, success, best.success), np.where(is_better, length, best.length)
        result.practising = dataclasses.replace(best, success=success_of_best, length=length_of_best)
        if is_first:
            result.cloned_success = success_of_best
        else:
            result.practised_success = np.where(goes_on, success, _latest_success(result))
        result.train_seconds = result.imitation_seconds = time.perf_counter() - started
        moment = result.moment._replace(env_steps=result.practice_steps)
        keep_good(result, programs, policies, np.zeros(len(result.seeds)), evaluation, moment, among=goes_on)
        if result.kept.all_confirmed:  # and so the run ends here
            found: dict[str, Any] = dict(success=success_of_best[:, None], length=length_of_best[:, None])
            result.rows += as_rows(result, Evaluation(**found), {}, result.practice_steps)
            return
    imitation = jax.device_get(tree_where(jnp.asarray(goes_on), _best_of(gather(clones), successes), before))
    result.state = result.state.replace(agent=result.state.agent.replace(imitation=spread(imitation, programs.mesh)))


def _practise(result: Result, programs: Programs, started: float) -> Practice | None:
    """A round of practice of those runs to which it may be of use; None where there are none, or where none is to practise on after it."""
    practising = result.practising
    goes_on = practising.goes_on & (result.kept.confirmed < 0) & (_latest_success(result) >= PRACTISABLE)
    result.practising = practising = dataclasses.replace(practising, goes_on=goes_on)
    if not goes_on.any():
        return None
    practice, attempts = programs.practise(result.state, result.guidance, programs.no_practice(practising.rounds))
    attempts = gather(attempts)
    steps = np.asarray(in_control_steps(attempts, result.env, result.config.num_held).length).sum(axis=(1, 2), dtype=np.int64)
    result.practice_steps = result.practice_steps + np.where(goes_on, steps, 0)
    result.imitation_seconds = time.perf_counter() - started
    result.practising = _after_a_round(practising, _worth(attempts, result.configs))
    return practice if result.practising.goes_on.any() else None


def _latest_success(result: Result) -> np.ndarray:
    """(S,) of the clones, in their latest evaluation; of the first ones the best."""
    return result.cloned_success if result.practised_success is None else result.practised_success


def _after_a_round(practising: Practising, worth: np.ndarray) -> Practising:
    """What becomes of practice whose attempts were worth so much (S,) in a round, see `RISING`."""
    patience = np.where(worth > RISING * practising.score, PATIENCE, practising.patience - 1)
    goes_on, score = practising.goes_on & (patience > 0), np.maximum(practising.score, worth)
    return dataclasses.replace(practising, rounds=practising.rounds + 1, goes_on=goes_on, score=score, patience=patience)


def _best_of(clones: Sequence[Params], successes: Sequence[np.ndarray]) -> Params:
    """Each run's clone, numpy leaves (S, ...), that has the most success (S,), and of equals the later one."""
    best = len(clones) - 1 - np.argmax(successes[::-1], axis=0)
    return jax.tree.map(lambda *leaves: np.stack(leaves)[best, np.arange(len(best))], *clones)


def _worth(attempts: Attempts, configs: Sequence[TrainConfig]) -> np.ndarray:
    """(S,) mean over the attempts (S, K, M) of gamma to the number of decisions before the goal, 0 for those that did not solve the task."""
    gammas = np.asarray([config.batch.gamma for config in configs])[:, None, None]
    return np.where(attempts.solved, gammas**attempts.delay, 0.0).mean(axis=(1, 2))


def _check_finite(result: Result, clones: Params) -> None:
    finite = np.all([np.isfinite(leaf).all(axis=tuple(range(1, leaf.ndim))) for leaf in jax.tree.leaves(gather(clones))], axis=0)
    if not finite.all():
        raise Diverged(f"the clone of the demonstrations of seed {result.seeds[int(np.argmin(finite))]} is not finite: try a lower learning_rate")
