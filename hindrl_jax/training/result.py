"""What an experiment leaves: evaluations, summaries, and the state of all its runs."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from hindrl_jax.base.environments import Environment
from hindrl_jax.base.types import Array
from hindrl_jax.config import TrainConfig
from hindrl_jax.core.guidance import Guidance
from hindrl_jax.core.train import TrainState
from hindrl_jax.training.resetting import resets
from hindrl_jax.training.selection import Kept, Moment, Returned

SAMPLED_SUCCESS = "evaluation/sampled_success"
"""The metric that `Row.sampled_success` reads."""

SOLVED = 0.95
"""Share of an evaluation's episodes from which on a task counts as learned."""


@dataclasses.dataclass(frozen=True)
class Row:
    """One evaluation of one seed."""

    seed: int
    env_steps: int
    updates: int
    seconds: float
    """Wall-clock training time of the whole run up to here, evaluations included, compilation not."""
    success: float
    """Share of the evaluation's episodes that the policy solved with its mean actions."""
    episode_length: float
    """Mean number of steps of those episodes."""
    metrics: dict[str, float]
    """Losses and values, averaged over the gradient steps since the last evaluation."""

    @property
    def sampled_success(self) -> float | None:
        """The share that the same policy solves with actions that it samples; None where only the mean action was played."""
        return self.metrics.get(SAMPLED_SUCCESS)

    @property
    def best_success(self) -> float:
        """The larger of the two."""
        return max(self.success, self.sampled_success or 0.0)


@dataclasses.dataclass(frozen=True)
class SeedSummary:
    """What became of one seed. The threshold of 95% is that of the mean actions in evaluations along the run; None where they never reached it."""

    seed: int
    returned_success: float
    """Share of 100 fresh episodes, others than those that chose it, that the returned policy solves: the best that the run has seen."""
    returned_length: float
    """Mean length of those episodes."""
    returned_noise: float
    """Of its actions: 0 where it plays the mean ones, 1 where it samples them, whichever was seen to solve more."""
    returned_env_steps: int
    """Environment steps after which the returned policy was seen; of a clone, those of its practice."""
    returned_updates: int
    returned_seconds: float
    final_success: float
    """Share of 100 fresh episodes that the last policy solves with its mean actions."""
    env_steps_to_95: int | None
    updates_to_95: int | None
    seconds_to_95: float | None
    """Wall-clock time of the whole run, all its seeds side by side."""
    episode_length: float
    """Mean length of the 100 fresh episodes of the last policy."""
    cloned_success: float | None
    """Share of an evaluation's episodes that the policy cloned at the start solves (`TrainConfig.imitation_steps`), the most of three; None where
    there is none. Where that one is returned, `returned_updates` is 0."""
    practised_success: float | None
    """The share that it solves in an evaluation after the last round of practice that was cloned (`TrainConfig.practice_rounds`); None where there
    was none. The clone of an earlier round may be better, and the one that is returned."""
    practice_steps: int
    """Environment steps of all its practice; `env_steps` does not count them."""
    network_resets: int
    """How often its agent was stuck, and a fresh one went on (`TrainConfig.network_resets`)."""
    evaluation_steps: int
    """Environment steps that evaluations and the choice of the returned policy took; `env_steps` does not count them."""


@dataclasses.dataclass(frozen=True)
class Practising:
    """How far the clones of S runs have practised."""

    rounds: int
    """Rounds so far."""
    goes_on: np.ndarray
    """(S,) bool, whose clone still does."""
    score: np.ndarray
    """(S,) the largest mean worth of a round's attempts."""
    patience: np.ndarray
    """(S,) int, the rounds after which it ends if none is worth more."""
    success: np.ndarray
    """(S,) of the best evaluation of a clone."""
    length: np.ndarray
    """(S,) mean length of its episodes."""


@dataclasses.dataclass
class Result:
    """An experiment, finished or under way: S runs side by side."""

    env: Environment
    configs: tuple[TrainConfig, ...]
    """(S,) the config of each run."""
    seeds: tuple[int, ...]
    """(S,) the seed of each run."""
    guidance: Guidance
    """Leaves (S, ...)."""
    state: TrainState
    """Leaves (S, ...); the last policies' parameters are `state.agent.average_actor`. While the run is under way the next chunk consumes it."""
    kept: Kept
    """The policies of the best evaluations so far."""
    rows: list[Row]
    """In order of time, S rows per evaluation, in order of the runs."""
    compile_seconds: float
    train_seconds: float = 0.0
    """Wall-clock time so far, evaluations included, compilation not."""
    imitation_seconds: float = 0.0
    """Those of them before learning began: cloning, practice and their evaluations."""
    env_steps: int = 0
    """Environment steps of each run so far."""
    updates: int = 0
    """Gradient steps of each run so far."""
    evaluation_steps: np.ndarray | None = None
    """(S,) int, environment steps that evaluations took so far; None before the first."""
    cloned_success: np.ndarray | None = None
    """(S,) share of an evaluation's episodes that the policies cloned at the start solve, the most of three; None where there are none."""
    practised_success: np.ndarray | None = None
    """(S,) the share that they solve in an evaluation after the latest round of practice that was cloned, and `cloned_success` of those that have not
    practised; None where none has."""
    practice_steps: np.ndarray | None = None
    """(S,) int, environment steps of that practice, which `env_steps` does not count; zeros where none are given."""
    practising: Practising | None = None
    """Where clones are practising: how far."""
    returned: Returned | None = None
    """The best policy of each run; None while the experiment is under way."""
    final_success: np.ndarray | None = None
    """(S,) share of 100 fresh episodes that the last policies solve; None while the experiment is under way."""
    final_length: np.ndarray | None = None
    """(S,) mean length of those episodes, in environment steps."""
    key: Array | None = None
    """(S,) keys of the evaluations to come."""
    chunks: list[dict[str, np.ndarray]] = dataclasses.field(default_factory=list)
    """Metrics, leaves (S,), of the chunks since the last evaluation."""

    def __post_init__(self) -> None:
        if self.practice_steps is None:
            self.practice_steps = np.zeros(len(self.seeds), np.int64)

    @property
    def config(self) -> TrainConfig:
        """The config of the first run; of all runs, unless `fit` was given several configs."""
        return self.configs[0]

    @property
    def steps_done(self) -> int:
        """What `TrainConfig.steps` counts: environment steps of each run so far; for behaviour cloning, gradient steps."""
        return self.env_steps if self.config.learns_from_rollouts else self.updates

    @property
    def steps_unit(self) -> str:
        """In a word, what `steps_done` counts."""
        return "steps" if self.config.learns_from_rollouts else "updates"

    @property
    def moment(self) -> Moment:
        """How far the experiment is."""
        return Moment(self.env_steps, self.updates, self.train_seconds)

    @property
    def resets(self) -> list[list[int]]:
        """The environment steps at which each run was stuck and went on with a fresh agent, S lists; see `TrainConfig.network_resets`."""
        config, num_runs = self.config, len(self.seeds)
        if not config.network_resets:
            return [[] for _ in self.seeds]
        of_runs, goes_on = [], self.final_success is None
        for index in range(num_runs):
            rows = [] if self._ends_with_a_clone(index) else self.rows[index::num_runs]
            steps, success = [row.env_steps for row in rows], [row.best_success for row in rows]
            found = resets(steps, success, of=config.num_steps, num_episodes=config.eval_episodes, enough=config.stop_at or SOLVED)
            of_runs.append([at for at in found if goes_on or at < self.env_steps])  # where an experiment has ended, nothing was begun
        return of_runs

    def _ends_with_a_clone(self, index: int) -> bool:
        """Whether a run is over because its clone was confirmed; what it learns beside those that go on matters to nobody."""
        slot = self.kept.confirmed[index]
        return bool(slot >= 0 and self.kept.updates[index, slot] == 0)

    @property
    def are_stuck(self) -> np.ndarray:
        """(S,) bool, which agents are, according to an evaluation at the present step; none where there was none."""
        if not self.rows or self.rows[-1].env_steps != self.env_steps:  # spares looking through all evaluations at each chunk
            return np.zeros(len(self.seeds), bool)
        return np.asarray([self.env_steps in steps for steps in self.resets])

    def latest_success(self) -> float | None:
        """Success of the newest evaluation, averaged over runs; None before the first."""
        newest = self.rows[-len(self.seeds) :]
        return float(np.mean([row.success for row in newest])) if newest else None

    def summaries(self) -> list[SeedSummary]:
        """One summary per run of a finished experiment."""
        return [self._summary(index, seed, len(resets)) for index, (seed, resets) in enumerate(zip(self.seeds, self.resets, strict=True))]

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
            kept=jax.tree.map(lambda leaf: leaf[runs], self.kept),
            returned=jax.tree.map(lambda leaf: leaf[runs], self.returned),
            cloned_success=None if self.cloned_success is None else self.cloned_success[runs],
            practised_success=None if self.practised_success is None else self.practised_success[runs],
            practice_steps=self.practice_steps[runs],
            evaluation_steps=self.evaluation_steps[runs],
            final_success=self.final_success[runs],
            final_length=self.final_length[runs],
        )

    def _summary(self, index: int, seed: int, network_resets: int) -> SeedSummary:
        rows = self.rows[index :: len(self.seeds)]
        first = next((row for row in rows if row.success >= SOLVED), None)
        return SeedSummary(
            seed=seed,
            returned_success=float(self.returned.success[index]),
            returned_length=float(self.returned.length[index]),
            returned_noise=float(self.returned.noise[index]),
            returned_env_steps=int(self.returned.env_steps[index]),
            returned_updates=int(self.returned.updates[index]),
            returned_seconds=float(self.returned.seconds[index]),
            final_success=float(self.final_success[index]),
            env_steps_to_95=None if first is None else first.env_steps,
            updates_to_95=None if first is None else first.updates,
            seconds_to_95=None if first is None else first.seconds,
            episode_length=float(self.final_length[index]),
            cloned_success=None if self.cloned_success is None else float(self.cloned_success[index]),
            practised_success=None if self.practised_success is None or not self.practice_steps[index] else float(self.practised_success[index]),
            practice_steps=int(self.practice_steps[index]),
            network_resets=network_resets,
            evaluation_steps=int(self.evaluation_steps[index]),
        )


Report = Callable[[Result], Any]
"""What `fit` calls along a run, see there."""


def asks_to_end(answer: Any) -> bool:
    """Whether that is what a report has returned: not a tuple, say, of what several reporters return together."""
    return isinstance(answer, bool | np.bool_) and bool(answer)
