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
from hindrl_jax.core.imitation import Attempts
from hindrl_jax.training.devices import gather, spread
from hindrl_jax.training.evaluating import Diverged, as_rows, keep_good, played
from hindrl_jax.training.programs import Programs
from hindrl_jax.training.result import Report, Result, asks_to_end
from hindrl_jax.training.selection import better

PRACTISABLE = 0.2
"""A clone practises if it solves at least this share of an evaluation's episodes: what is hardly ever solved is learnt sooner by reinforcement."""
RISING, PATIENCE = 1.02, 2
"""It ends with the second round running whose attempts' mean worth is not more than 1.02 times the best before."""


def imitate(result: Result, programs: Programs, report: Report, started: float) -> bool:
    """Clones the demonstrations, then lets the best clone of each run practise for as long as that is of use to it.

    What comes of it are the first policies that are kept.

    Returns:
      Whether the experiment is to end.
    """
    config, practice = result.config, programs.no_practice()
    practises, score, patience = np.ones(len(result.seeds), bool), np.zeros(len(result.seeds)), np.full(len(result.seeds), PATIENCE)
    imitation = latest = best = None
    for index in range(config.practice_rounds + 1):
        result.state, clones = programs.imitate(result.state, result.guidance, practice)
        _check_finite(result, clones[-1])
        clones, successes = clones if index == 0 else clones[-1:], []
        for clone in clones:
            policies = policy(result.state.agent.replace(imitation=clone), config, average=True, imitates=True)
            evaluation = played(result, programs, policies, config.eval_episodes)
            successes.append(np.asarray(evaluation.success).mean(axis=1))
            latest = _where(practises, evaluation, latest)
            best = latest if best is None else better(best, latest)[1]
            if index == 0:
                latest = best
                result.cloned_success = np.asarray(best.success).mean(axis=1)
            else:
                result.practised_success = np.asarray(latest.success).mean(axis=1)
            result.train_seconds = result.imitation_seconds = time.perf_counter() - started
            moment = result.moment._replace(env_steps=result.practice_steps)
            keep_good(result, programs, policies, np.zeros(len(result.seeds)), evaluation, moment, among=practises)
            if result.kept.all_confirmed:  # and so the run ends here
                result.rows += as_rows(result, best, {}, result.practice_steps)
                return True
        imitation = _where(practises, _best_of(gather(clones), successes), imitation)  # of those that no longer practise it stays
        result.state = result.state.replace(agent=result.state.agent.replace(imitation=spread(imitation, programs.mesh)))
        if config.practice_rounds > 0 and asks_to_end(report(result)):
            return True
        practises &= (result.kept.confirmed < 0) & (np.asarray(latest.success).mean(axis=1) >= PRACTISABLE)
        if index == config.practice_rounds or not practises.any():
            return False
        practice, attempts = programs.practise(result.state, result.guidance, practice)
        attempts = gather(attempts)
        steps = np.asarray(in_control_steps(attempts, result.env, config.num_held).length).sum(axis=(1, 2), dtype=np.int64)
        result.practice_steps = result.practice_steps + np.where(practises, steps, 0)
        result.imitation_seconds = time.perf_counter() - started
        worth = _worth(attempts, result.configs)
        patience = np.where(worth > RISING * score, PATIENCE, patience - 1)
        practises &= patience > 0
        if not practises.any():
            return False
        score = np.maximum(score, worth)
    return False


def _best_of(clones: Sequence[Params], successes: Sequence[np.ndarray]) -> Params:
    """Each run's clone, numpy leaves (S, ...), that has the most success (S,), and of equals the later one."""
    best = len(clones) - 1 - np.argmax(successes[::-1], axis=0)
    return jax.tree.map(lambda *leaves: np.stack(leaves)[best, np.arange(len(best))], *clones)


def _where(chosen: np.ndarray, one: Any, other: Any) -> Any:
    """Of each of S runs the one value where it is `chosen` (S,), else the other; numpy leaves (S, ...). No other is no choice."""
    if other is None:
        return one
    return jax.tree.map(lambda one, other: np.where(np.expand_dims(chosen, tuple(range(1, one.ndim))), one, other), one, other)


def _worth(attempts: Attempts, configs: Sequence[TrainConfig]) -> np.ndarray:
    """(S,) mean over the attempts (S, K, M) of gamma to the number of decisions before the goal, 0 for those that did not solve the task."""
    gammas = np.asarray([config.batch.gamma for config in configs])[:, None, None]
    return np.where(attempts.solved, gammas**attempts.delay, 0.0).mean(axis=(1, 2))


def _check_finite(result: Result, clones: Params) -> None:
    finite = np.all([np.isfinite(leaf).all(axis=tuple(range(1, leaf.ndim))) for leaf in jax.tree.leaves(gather(clones))], axis=0)
    if not finite.all():
        raise Diverged(f"the clone of the demonstrations of seed {result.seeds[int(np.argmin(finite))]} is not finite: try a lower learning_rate")
