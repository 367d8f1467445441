"""How a run is judged: evaluations along it, what is good enough to be kept, what ends it, and in the end the choice of what is returned."""

from __future__ import annotations

import time
from typing import Any

import jax
import numpy as np

from hindrl_jax.base.errors import UserError
from hindrl_jax.core.agent import Policy, policy
from hindrl_jax.core.holding import in_control_steps
from hindrl_jax.core.rollout import Evaluation
from hindrl_jax.training.devices import gather, spread
from hindrl_jax.training.programs import FRESH_EPISODES, Programs
from hindrl_jax.training.result import SAMPLED_SUCCESS, Result, Row
from hindrl_jax.training.selection import Moment, Trial, better, choose, keep


class Diverged(UserError):
    """A loss or a value is not a finite number."""


def evaluate(result: Result, programs: Programs, started: float) -> None:
    """Evaluates the present policies, notes it, and keeps those that are good."""
    present, num_episodes = policy(result.state.agent, result.config, average=True), result.config.eval_episodes
    noise: Any = np.zeros(len(result.seeds))
    evaluation = by_mean = played(result, programs, present, num_episodes)
    averaged = {name: np.mean([chunk[name] for chunk in result.chunks], axis=0) for name in result.chunks[0]} if result.chunks else {}
    if result.config.learns_from_rollouts:  # cloning leaves the deviation of the actions as it happens to be
        sampled = played(result, programs, _with_noise(present, np.ones_like(noise), programs), num_episodes)
        averaged[SAMPLED_SUCCESS] = np.asarray(sampled.success).mean(axis=1)
        noise, evaluation = better(by_mean, sampled)
    result.train_seconds = time.perf_counter() - started
    result.rows += as_rows(result, by_mean, averaged)
    result.chunks.clear()
    keep_good(result, programs, present, noise, evaluation)


def played(result: Result, programs: Programs, policies: Policy, num_episodes: int) -> Evaluation:
    """What became of fresh episodes, numpy leaves (S, num_episodes), lengths in environment steps; they are counted."""
    result.key, evaluation = programs.evaluate(result.key, policies, result.guidance, num_episodes)
    evaluation = jax.device_get(in_control_steps(gather(evaluation), result.env, result.config.num_held))
    before = 0 if result.evaluation_steps is None else result.evaluation_steps
    result.evaluation_steps = before + np.asarray(evaluation.length).sum(axis=1, dtype=np.int64)
    return evaluation


def keep_good(
    result: Result,
    programs: Programs,
    policies: Policy,
    noise: np.ndarray,
    evaluation: Evaluation,
    moment: Moment | None = None,
    *,
    among: np.ndarray | bool = True,
) -> None:
    """Keeps what is good of policies that were evaluated with some noise, and confirms those with which a run may end; of the runs `among` them."""
    confirmed, stop_at = np.zeros(len(result.seeds), bool), result.config.stop_at
    if stop_at is not None:
        confirmed = (np.asarray(evaluation.success).mean(axis=1) >= stop_at) & among & (result.kept.confirmed < 0)
        if confirmed.any():
            again = played(result, programs, _with_noise(policies, noise, programs), FRESH_EPISODES)
            confirmed &= np.asarray(again.success).mean(axis=1) >= stop_at
    result.kept = keep(result.kept, Trial(gather(policies.actor), noise, evaluation), confirmed, moment or result.moment, among=among)


def choose_returned(result: Result, programs: Programs) -> None:
    """Chooses the policies that are returned."""
    scale, last_policy = result.state.agent.scale, policy(result.state.agent, result.config, average=True)

    def play(actor: Any, noise: np.ndarray) -> Evaluation:
        of_runs: dict[str, Any] = spread(dict(actor=actor, noise=noise.astype(np.float32)), programs.mesh)
        return played(result, programs, Policy(scale=scale, **of_runs), FRESH_EPISODES)

    result.returned, last = choose(result.kept, gather(last_policy.actor), result.moment, play)
    result.final_success, result.final_length = (np.asarray(outcome).mean(axis=1) for outcome in (last.success, last.length))
    if jax.process_count() > 1:
        result.guidance, agent = gather((result.guidance, result.state.agent))
        result.state = result.state.replace(agent=agent)


def as_rows(result: Result, evaluation: Evaluation, metrics: dict[str, np.ndarray], env_steps: np.ndarray | None = None) -> list[Row]:
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


def _with_noise(policies: Policy, noise: np.ndarray, programs: Programs) -> Policy:
    return policies.replace(noise=spread(noise.astype(np.float32), programs.mesh))


def check_finite(result: Result) -> None:
    """Ends an experiment that cannot be rescued: a number that is not finite spreads to all parameters within a few gradient steps."""
    for name, values in result.chunks[-1].items():
        if not np.isfinite(values).all():
            index = int(np.argmin(np.isfinite(values)))
            raise Diverged(
                f"{name} of seed {result.seeds[index]} is {values[index]} after {result.env_steps} environment steps and {result.updates} updates: "
                "try a lower learning_rate, or layer_norm"
            )
