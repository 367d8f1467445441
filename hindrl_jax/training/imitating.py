"""The beginning of a run: the demonstrations are cloned, and the clones practise, see `core.imitation`."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

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
        everybody, nothing = np.ones(len(result.seeds), bool), np.zeros(len(result.seeds))
        patience = np.full(len(result.seeds), PATIENCE)
        result.practising = Practising(0, goes_on=everybody, score=nothing, patience=patience, success=-np.ones(len(result.seeds)), length=nothing)
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
    result.practising = None
    return False


def _clone(result: Result, programs: Programs, practice: Practice, started: float) -> None:
    """Clones for those who practise, looks at the clones, the first time at all parts of the cloning, and goes on with the best."""
    progress, is_first = result.practising, result.practising.rounds == 0
    before = jax.tree.map(np.array, gather(result.state.agent.imitation))  # a copy, as the state is donated
    result.state, clones = programs.imitate(result.state, result.guidance, practice)
    _check_finite(result, clones[-1])
    clones, successes = clones if is_first else clones[-1:], []
    for clone in clones:
        policies = policy(result.state.agent.replace(imitation=clone), result.config, average=True, imitates=True)
        evaluation = played(result, programs, policies, result.config.eval_episodes)
        success, length = (np.asarray(values).mean(axis=1) for values in (evaluation.success, evaluation.length))
        successes.append(success)
        is_better = progress.goes_on & (success > progress.success)
        progress.success, progress.length = np.where(is_better, success, progress.success), np.where(is_better, length, progress.length)
        if is_first:
            result.cloned_success = progress.success
        else:
            latest = result.cloned_success if result.practised_success is None else result.practised_success
            result.practised_success = np.where(progress.goes_on, success, latest)
        result.train_seconds = result.imitation_seconds = time.perf_counter() - started
        moment = result.moment._replace(env_steps=result.practice_steps)
        keep_good(result, programs, policies, np.zeros(len(result.seeds)), evaluation, moment, among=progress.goes_on)
        if result.kept.all_confirmed:  # and so the run ends here
            best: dict[str, Any] = dict(success=progress.success[:, None], length=progress.length[:, None])
            result.rows += as_rows(result, Evaluation(**best), {}, result.practice_steps)
            return
    imitation = _where(progress.goes_on, _best_of(gather(clones), successes), before)
    result.state = result.state.replace(agent=result.state.agent.replace(imitation=spread(imitation, programs.mesh)))


def _practise(result: Result, programs: Programs, started: float) -> Practice | None:
    """A round of practice of those to whom it may be of use; None if there are none, or to whom it was of no use again."""
    progress = result.practising
    success = result.cloned_success if result.practised_success is None else result.practised_success
    progress.goes_on = progress.goes_on & (result.kept.confirmed < 0) & (success >= PRACTISABLE)
    if not progress.goes_on.any():
        return None
    practice, attempts = programs.practise(result.state, result.guidance, programs.no_practice(progress.rounds))
    progress.rounds += 1
    attempts = gather(attempts)
    steps = np.asarray(in_control_steps(attempts, result.env, result.config.num_held).length).sum(axis=(1, 2), dtype=np.int64)
    result.practice_steps = result.practice_steps + np.where(progress.goes_on, steps, 0)
    result.imitation_seconds = time.perf_counter() - started
    worth = _worth(attempts, result.configs)
    progress.patience = np.where(worth > RISING * progress.score, PATIENCE, progress.patience - 1)
    progress.score = np.maximum(progress.score, worth)
    progress.goes_on = progress.goes_on & (progress.patience > 0)
    return practice if progress.goes_on.any() else None


def _best_of(clones: Sequence[Params], successes: Sequence[np.ndarray]) -> Params:
    """Each run's clone, numpy leaves (S, ...), that has the most success (S,), and of equals the later one."""
    best = len(clones) - 1 - np.argmax(successes[::-1], axis=0)
    return jax.tree.map(lambda *leaves: np.stack(leaves)[best, np.arange(len(best))], *clones)


def _where(chosen: np.ndarray, one: Any, other: Any) -> Any:
    """Of each of S runs the one value where it is `chosen` (S,), else the other; numpy leaves (S, ...)."""
    return jax.tree.map(lambda one, other: np.where(np.expand_dims(chosen, tuple(range(1, one.ndim))), one, other), one, other)


def _worth(attempts: Attempts, configs: Sequence[TrainConfig]) -> np.ndarray:
    """(S,) mean over the attempts (S, K, M) of gamma to the number of decisions before the goal, 0 for those that did not solve the task."""
    gammas = np.asarray([config.batch.gamma for config in configs])[:, None, None]
    return np.where(attempts.solved, gammas**attempts.delay, 0.0).mean(axis=(1, 2))


def _check_finite(result: Result, clones: Params) -> None:
    finite = np.all([np.isfinite(leaf).all(axis=tuple(range(1, leaf.ndim))) for leaf in jax.tree.leaves(gather(clones))], axis=0)
    if not finite.all():
        raise Diverged(f"the clone of the demonstrations of seed {result.seeds[int(np.argmin(finite))]} is not finite: try a lower learning_rate")
