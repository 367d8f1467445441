"""The policies of a run that are worth keeping, and which of them is returned.

An evaluation is noisy, and learning goes up and down: neither the last policy nor the one of the best evaluation is the best that a run has found. So
the policies of the best evaluations are kept. In the end they and the last one play fresh episodes, which decides; and what is reported of the
one that is returned comes from other episodes, so that the choice does not flatter it.

A policy that has learnt by sampling its actions may stand still, or go to and fro for ever, where it takes the mean ones: the noise always carried it
on. Another one needs the precision of the mean. So each is played both ways, and kept as what it does better.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
from flax import struct

from hindrl_jax.core.rollout import Evaluation

NUM_KEPT = 4
"""Policies that are kept along a run."""
CHOICE_ROUNDS = 2
"""Fresh evaluations of each of them, and of the last one, which decide in the end."""
Play = Callable[[Any, np.ndarray], Evaluation]
"""(parameters of S actors, noise (S,) of their actions) -> what became of fresh episodes, numpy leaves (S, episodes); other ones at each call."""


class Moment(NamedTuple):
    """How far an experiment is."""

    env_steps: int | np.ndarray
    """Of all runs, or (S,) of each."""
    updates: int
    seconds: float


class Kept(struct.PyTreeNode, kw_only=True):
    """The policies of the best evaluations so far, numpy leaves. S runs, K policies of each, in no order."""

    actor: Any  # parameters (S, K, ...)
    noise: np.ndarray  # (S, K) of the actions, 0 for the mean ones, 1 for sampled ones
    success: np.ndarray  # (S, K) of their evaluations; -1 where there is none yet
    length: np.ndarray  # (S, K) mean length of the episodes, in environment steps
    env_steps: np.ndarray  # (S, K) int, environment steps when they were evaluated
    updates: np.ndarray  # (S, K) int, gradient steps
    seconds: np.ndarray  # (S, K) wall-clock training time of the whole experiment
    confirmed: np.ndarray  # (S,) int, which of them ended its run (`TrainConfig.stop_at`); -1 for none

    @property
    def all_confirmed(self) -> bool:
        """Whether every run has a policy with which it may end."""
        return bool((self.confirmed >= 0).all())


def nothing_kept(actor: Any) -> Kept:
    """Before the first evaluation; `actor`: shapes (S, ...)."""
    num_runs = jax.tree.leaves(actor)[0].shape[0]
    shape = (num_runs, NUM_KEPT)
    return Kept(
        actor=jax.tree.map(lambda leaf: np.zeros((*shape, *leaf.shape[1:]), leaf.dtype), actor),
        noise=np.zeros(shape),
        success=np.full(shape, -1.0),
        length=np.zeros(shape),
        env_steps=np.zeros(shape, np.int64),
        updates=np.zeros(shape, np.int64),
        seconds=np.zeros(shape),
        confirmed=np.full(num_runs, -1),
    )


class Trial(NamedTuple):
    """What S policies were seen to do."""

    actor: Any
    """Parameters, numpy (S, ...)."""
    noise: np.ndarray
    """(S,) of the actions."""
    evaluation: Evaluation
    """Numpy (S, episodes)."""


def better(mean: Evaluation, sampled: Evaluation) -> tuple[np.ndarray, Evaluation]:
    """For each of S policies what it does better, with its mean actions or with sampled ones: the noise (S,), and what became of those episodes.

    Args:
      mean, sampled: numpy (S, episodes).
    """
    is_better = np.asarray(sampled.success).mean(axis=1) > np.asarray(mean.success).mean(axis=1)
    chosen: Any = jax.tree.map(lambda one, other: np.where(is_better[:, None], other, one), mean, sampled)
    return is_better.astype(float), chosen


def keep(kept: Kept, trial: Trial, confirmed: np.ndarray, moment: Moment, *, among: np.ndarray | bool = True) -> Kept:
    """Keeps each run's policy in place of the worst one kept, if it is as good or confirmed. Runs that have one confirmed are over.

    Args:
      kept: so far.
      trial: of the present policies.
      confirmed: (S,) bool, whose policy ends its run.
      moment: when.
      among: (S,) bool, whose policy may be kept.
    """
    runs, success, length = np.arange(len(confirmed)), trial.evaluation.success.mean(axis=1), trial.evaluation.length.mean(axis=1)
    worst = np.lexsort((-kept.length, kept.success), axis=1)[:, 0]
    than = kept.success[runs, worst], kept.length[runs, worst]
    as_good = (success > than[0]) | ((success == than[0]) & (length <= than[1]))
    taken = among & (kept.confirmed < 0) & (as_good | confirmed)
    where = runs[taken], worst[taken]

    def replaced(before: np.ndarray, values: Any) -> np.ndarray:
        after = before.copy()
        after[where] = np.broadcast_to(values, (len(runs), *before.shape[2:]))[taken]
        return after

    return Kept(
        actor=jax.tree.map(replaced, kept.actor, trial.actor),
        noise=replaced(kept.noise, trial.noise),
        success=replaced(kept.success, success),
        length=replaced(kept.length, length),
        env_steps=replaced(kept.env_steps, moment.env_steps),
        updates=replaced(kept.updates, moment.updates),
        seconds=replaced(kept.seconds, moment.seconds),
        confirmed=np.where(taken & confirmed, worst, kept.confirmed),
    )


class Returned(struct.PyTreeNode, kw_only=True):
    """The policy that each of S runs returns, numpy leaves."""

    actor: Any  # parameters (S, ...)
    noise: np.ndarray  # (S,) of its actions, 0 for the mean ones, 1 for sampled ones
    success: np.ndarray  # (S,) share of fresh episodes that it solves, others than those that chose it
    length: np.ndarray  # (S,) mean length of those episodes, in environment steps
    env_steps: np.ndarray  # (S,) int, when it was evaluated
    updates: np.ndarray  # (S,) int
    seconds: np.ndarray  # (S,) wall-clock training time of the whole experiment


def choose(kept: Kept, last: Any, now: Moment, play: Play) -> tuple[Returned, Evaluation]:
    """Lets the kept policies and the last ones play, and returns each run's best, and what became of the episodes of the last one's mean actions.

    A confirmed policy is chosen already. Of equals the one that takes fewer steps is chosen.

    Args:
      kept: of S runs.
      last: parameters of the last policies, numpy (S, ...).
      now: of the last policies.
      play: plays fresh episodes with S policies.
    """
    runs = np.arange(len(kept.confirmed))
    candidates = [jax.tree.map(lambda leaf, k=k: leaf[:, k], kept.actor) for k in range(NUM_KEPT)] + [last]
    noises = [*kept.noise.T, np.zeros(len(runs))]
    if kept.all_confirmed:
        chosen = kept.confirmed
    else:
        scores = np.full((len(runs), NUM_KEPT + 1), -np.inf)
        for index, there in enumerate([*(kept.success >= 0.0).T, np.ones(len(runs), bool)]):
            if there.any():
                scores[:, index] = np.where(there, _score(candidates[index], noises[index], play), -np.inf)
        chosen = np.where(kept.confirmed >= 0, kept.confirmed, np.argmax(scores, axis=1))

    def of_chosen(values: np.ndarray, value_now: float | np.ndarray) -> np.ndarray:
        now_of_each = np.broadcast_to(value_now, len(values)).astype(values.dtype)
        return np.concatenate([values, now_of_each[:, None]], axis=1)[runs, chosen]

    actor = jax.tree.map(lambda *leaves: np.stack(leaves, axis=1)[runs, chosen], *candidates)
    noise = np.stack(noises, axis=1)[runs, chosen]
    fresh, fresh_of_last = play(actor, noise), play(last, np.zeros(len(runs)))
    returned = Returned(
        actor=actor,
        noise=noise,
        success=np.asarray(fresh.success).mean(axis=1),
        length=np.asarray(fresh.length).mean(axis=1),
        env_steps=of_chosen(kept.env_steps, now.env_steps),
        updates=of_chosen(kept.updates, now.updates),
        seconds=of_chosen(kept.seconds, now.seconds),
    )
    return returned, fresh_of_last


def _score(actor: Any, noise: np.ndarray, play: Play) -> np.ndarray:
    """(S,) successful episodes, and between equal numbers of them the fewer steps."""
    rounds = [play(actor, noise) for _ in range(CHOICE_ROUNDS)]
    success, length = (np.concatenate([getattr(evaluation, name) for evaluation in rounds], axis=1) for name in ("success", "length"))
    return success.sum(axis=1) - length.mean(axis=1) / (1.0 + length.max())
