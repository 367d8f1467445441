"""Ablation: the first life of the grid tasks' default recipe with one change at a time, on several tasks, with the same seeds for every change.

    OUT/TASK/LEVER/    an ordinary run's directory for each setting; OUT/TASK/default/ has no change, the baseline
    ablation.csv       a row for each setting
    ablation.md        the same for people: a table for each task
    ablation.png       the differences to the baseline

The tables are made from the directories alone, so they can be made again, and an ablation that was interrupted goes on where it was.
"""

from __future__ import annotations

import csv
import dataclasses
import functools
import itertools
import json
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from flax.traverse_util import flatten_dict

from hindrl_jax.base.environments import Environment
from hindrl_jax.base.errors import UserError, one_line
from hindrl_jax.base.files import disk_trouble
from hindrl_jax.base.types import Episodes
from hindrl_jax.config import TrainConfig
from hindrl_jax.plotting import curves as plots
from hindrl_jax.plotting.statistics import Interval, bootstrap
from hindrl_jax.runs.spec import CONFIG, METRICS, SUMMARY, RunSpec, read_spec
from hindrl_jax.runs.writer import RunWriter
from hindrl_jax.tasks.presets import preset
from hindrl_jax.tasks.registry import checked, make
from hindrl_jax.training.experiment import fit
from hindrl_jax.training.recording import record_demonstrations
from hindrl_jax.training.result import Result

TABLE, TEXT, PICTURE = "ablation.csv", "ablation.md", "ablation.png"
Group = Literal["baseline", "algorithm", "hindsight", "goals", "targets", "demonstrations", "critic", "actor", "inputs", "replay", "rollout"]


@dataclasses.dataclass(frozen=True)
class Lever:
    """One change to the default recipe."""

    name: str
    """In kebab case; the name of its directory."""
    group: Group
    """What part of the recipe it is about."""
    summary: str
    """One line: what it changes, and the paper that it is from, if any."""
    changes: tuple[tuple[str, Any], ...]
    """Fields of `TrainConfig`, as in "steps" or "batch.n_step", and their new values. A value may be a function of the unchanged config."""


def half_of_the_run(config: TrainConfig) -> int:
    """Environment steps after which the run is half over."""
    return config.steps // 2


BASELINE = Lever("default", "baseline", "the default recipe, without a second life of its agent", ())

LEVERS: tuple[Lever, ...] = (
    Lever("sac", "algorithm", "SAC in place of TQC", (("agent.base", "sac"),)),
    Lever("td3", "algorithm", "TD3 in place of TQC, with its delayed actor", (("agent.base", "td3"),)),
    Lever("ddpg", "algorithm", "DDPG in place of TQC, as DDPGfD and the HinDRL paper have it", (("agent.base", "ddpg"), ("agent.num_critics", 1))),
    Lever(
        "td3-preactivation",
        "algorithm",
        "as td3, with the mode before tanh kept small by a weight of 0.003 (HER)",
        (("agent.base", "td3"), ("agent.preactivation_weight", 0.003)),
    ),
    Lever(
        "ddpg-preactivation",
        "algorithm",
        "as ddpg, with the mode before tanh kept small by a weight of 0.003 (HER)",
        (("agent.base", "ddpg"), ("agent.num_critics", 1), ("agent.preactivation_weight", 0.003)),
    ),
    Lever("goals-final", "hindsight", "relabelled with the rollout's last goal (HER)", (("batch.hindrl_sampling_strategy", "final"),)),
    Lever("goals-future", "hindsight", "relabelled with goals later in the rollout (HER)", (("batch.hindrl_sampling_strategy", "future"),)),
    Lever("goals-episode", "hindsight", "relabelled with any goal of the rollout (HER)", (("batch.hindrl_sampling_strategy", "episode"),)),
    Lever(
        "goals-joint-union",
        "hindsight",
        "relabelled with goals of demonstrations and rollouts, half and half (HinDRL)",
        (("batch.hindrl_sampling_strategy", "joint_union"), ("batch.union_sampling_ratio", 0.5)),
    ),
    Lever("goals-random", "hindsight", "relabelled with any goal of any rollout (HER)", (("batch.hindrl_sampling_strategy", "random"),)),
    Lever(
        "goals-intersection",
        "hindsight",
        "relabelled with goals of the rollout that lie near a demonstrated one (HinDRL)",
        (("batch.hindrl_sampling_strategy", "joint_intersection"),),
    ),
    Lever(
        "goals-intersection-demo",
        "hindsight",
        "relabelled with demonstrated goals that the rollout came near (HinDRL)",
        (("batch.hindrl_sampling_strategy", "joint_intersection"), ("batch.intersection_goals", "demonstrations")),
    ),
    Lever("no-relabelling", "hindsight", "no relabelled rows (the thesis's TQCfD)", (("algo", "tqcfd"), ("batch.relabelled_per_original", 0.0))),
    Lever(
        "relabelled-4", "hindsight", "four relabelled rows for each original one, in place of 1/4 (thesis)", (("batch.relabelled_per_original", 4.0),)
    ),
    Lever(
        "relabelled-go-on",
        "hindsight",
        "reaching a relabelled goal does not end the return (thesis)",
        (("quirks.bootstrap_past_relabelled_goals", True),),
    ),
    Lever("strict-goal-test", "goals", "a goal is reached at distance < epsilon, not <= (thesis)", (("quirks.strict_goal_test", True),)),
    Lever("task-goal", "goals", "rollouts aim at the task's constant goal, not at the end of a demonstration", (("goal.behavioural_goals", "task"),)),
    Lever(
        "smooth",
        "goals",
        "demonstration goals filtered by epsilon (the thesis's Smooth HinDRL)",
        (("algo", "smooth-hindrl"), ("goal.epsilon_filtering", True)),
    ),
    Lever(
        "achieved-goals",
        "goals",
        "as goals-joint-union, and half of the rollouts, falling to none, aim at states reached earlier (thesis, chapter 6)",
        (("goal.achieved_goal_ratio", 0.5), ("goal.final_achieved_goal_ratio", 0.0), ("batch.hindrl_sampling_strategy", "joint_union")),
    ),
    Lever("n-step-1", "targets", "1-step returns in place of 5 (thesis)", (("batch.n_step", 1),)),
    Lever("n-step-3", "targets", "3-step returns in place of 5", (("batch.n_step", 3),)),
    Lever("gamma-0.99", "targets", "discount 0.99 in place of 0.98 (thesis)", (("batch.gamma", 0.99),)),
    Lever("clip-targets", "targets", "targets clipped to [0, 1] (HER)", (("agent.clip_targets", True),)),
    Lever(
        "bound-targets",
        "targets",
        "as clip-targets, and targets at least the return obtained (self-imitation learning)",
        (("batch.bound_by_obtained_return", True), ("agent.clip_targets", True)),
    ),
    Lever(
        "timeouts-terminal",
        "targets",
        "episodes cut by the horizon count as terminated (original code)",
        (("quirks.timeouts_are_terminal", True),),
    ),
    Lever("demo-rows-none", "demonstrations", "no demonstration rows in the batch, so no cloning either", (("batch.max_demo_ratio", 0.0),)),
    Lever("demo-rows-half", "demonstrations", "half of the batch are demonstration rows, not a quarter (RLPD)", (("batch.max_demo_ratio", 0.5),)),
    Lever(
        "demo-rows-fade",
        "demonstrations",
        "the share of demonstration rows falls to zero by the middle of the run (thesis)",
        (("batch.reach_zero", half_of_the_run),),
    ),
    Lever("bc-0", "demonstrations", "no cloning loss", (("agent.bc_weight", 0.0),)),
    Lever("bc-0.1", "demonstrations", "cloning loss with weight 0.1 in place of 0.01", (("agent.bc_weight", 0.1),)),
    Lever("bc-1", "demonstrations", "cloning loss with weight 1 in place of 0.01 (thesis)", (("agent.bc_weight", 1.0),)),
    Lever("bc-fades", "demonstrations", "the weight of the cloning loss falls to 0 along the run", (("agent.final_bc_weight", 0.0),)),
    Lever(
        "q-filter",
        "demonstrations",
        "as bc-0.1, where the critics prefer the demonstrated action (Nair et al.)",
        (("agent.q_filter", True), ("agent.bc_weight", 0.1)),
    ),
    Lever("value-relative", "demonstrations", "value in the actor's loss over its own size, row by row", (("agent.relative_value", True),)),
    Lever("bc-warm-start", "demonstrations", "500 gradient steps of cloning before the first of reinforcement learning", (("bc_warm_start", 500),)),
    Lever("bc-norm", "demonstrations", "cloning loss is the distance, not its square (original code)", (("quirks.bc_loss", "norm"),)),
    Lever("bc-sample", "demonstrations", "cloning loss of a sampled action, not of the mean one (original code)", (("quirks.bc_action", "sample"),)),
    Lever(
        "demo-resets-0.25",
        "demonstrations",
        "a quarter of all episodes begin in demonstrated states (Nair et al.)",
        (("demo_reset_ratio", 0.25),),
    ),
    Lever("demo-resets-0.5", "demonstrations", "half of all episodes begin in demonstrated states (Nair et al.)", (("demo_reset_ratio", 0.5),)),
    Lever(
        "demo-resets-reverse",
        "demonstrations",
        "half of all episodes begin in demonstrated states, the last ones first (RFCL)",
        (("demo_reset_ratio", 0.5), ("demo_reset_curriculum", 0.5)),
    ),
    Lever("layer-norm", "critic", "layer normalisation in the critics (RLPD)", (("agent.layer_norm", True),)),
    Lever("critics-1", "critic", "1 critic in place of 2", (("agent.num_critics", 1),)),
    Lever("critics-5", "critic", "5 critics in place of 2 (TQC)", (("agent.num_critics", 5),)),
    Lever("redq", "critic", "5 critics, of which 2 at random make the targets (REDQ)", (("agent.num_critics", 5), ("agent.num_target_critics", 2))),
    Lever("no-truncation", "critic", "no quantiles dropped from the targets", (("agent.top_quantiles_to_drop_per_net", 0),)),
    Lever("target-rate-0.005", "critic", "target critics follow at 0.005 in place of 0.02 (TQC)", (("agent.target_update_rate", 0.005),)),
    Lever(
        "preactivation",
        "actor",
        "the mode before tanh kept small by a weight of 0.003 on its squared length (HER)",
        (("agent.preactivation_weight", 0.003),),
    ),
    Lever("alpha-1", "actor", "the entropy coefficient starts at 1 in place of 0.002 (SAC)", (("agent.initial_alpha", 1.0),)),
    Lever("entropy-constant", "actor", "the target entropy stays at -1, it does not fall to -10", (("agent.final_target_entropy", None),)),
    Lever(
        "no-actor-average",
        "actor",
        "the actor itself is evaluated, not its running average",
        (("agent.actor_average_rate", 1.0), ("agent.actor_average_span", 0.0)),
    ),
    Lever(
        "actor-average-short", "actor", "the actor's average spans about 500 gradient steps, all along the run", (("agent.actor_average_span", 0.0),)
    ),
    Lever("inputs-raw", "inputs", "networks see inputs as they are (thesis)", (("agent.input_encoding", "raw"),)),
    Lever("inputs-standardised", "inputs", "networks see standardised inputs", (("agent.input_encoding", "standardised"),)),
    Lever(
        "prioritised",
        "replay",
        "rows drawn by their errors, those of demonstrations with a bonus, which leaves few of them (prioritised replay; DDPGfD)",
        (("priority.priority_exponent", 0.6), ("priority.demo_priority_bonus", 1.0)),
    ),
    Lever("batch-1024", "replay", "batches of 1,024 rows in place of 256", (("batch.batch_size", 1_024),)),
    Lever("random-truncation-0.02", "rollout", "training episodes are cut off after a step with probability 0.02", (("random_truncation", 0.02),)),
    Lever(
        "environments-64",
        "rollout",
        "64 environments in place of 16: four times as many environment steps for each gradient step",
        (("num_envs", 64), ("learning_starts", 6_400)),
    ),
    Lever("updates-8", "rollout", "8 gradient steps per vectorised environment step in place of 2", (("updates_per_iteration", 8),)),
)


@dataclasses.dataclass(frozen=True)
class AblationTask:
    """What the settings are trained on."""

    env: str
    """Name of the environment."""
    env_args: tuple[tuple[str, Any], ...]
    """Its arguments."""
    num_demos: int
    """Demonstrations recorded for each seed: equal seeds have equal ones."""

    def title(self) -> str:
        """What a reader calls it."""
        arguments = "".join(f", {name} {value}" for name, value in self.env_args)
        return f"{self.env}{arguments}, {self.num_demos} demonstration{'s' if self.num_demos > 1 else ''}"


ABLATION_TASKS: dict[str, AblationTask] = {
    "fixed-1": AblationTask("FixedGridPickAndPlace", (("num_objects", 2),), 1),
    "fixed-5": AblationTask("FixedGridPickAndPlace", (("num_objects", 2),), 5),
    "random-50": AblationTask("GridPickAndPlace", (("num_objects", 2),), 50),
}


def apply(config: TrainConfig, lever: Lever) -> TrainConfig:
    """The config with a lever's changes, all made at once.

    Raises:
      UserError: if the changed config is refused.
    """
    sections: dict[str, dict[str, Any]] = {"": {}}
    for field, value in lever.changes:
        section, _, name = field.rpartition(".")
        sections.setdefault(section, {})[name] = value(config) if callable(value) else value
    outermost = sections.pop("")

    def changed() -> TrainConfig:
        parts = {section: dataclasses.replace(getattr(config, section), **values) for section, values in sections.items()}
        return dataclasses.replace(config, **outermost, **parts)

    return checked(changed)


@dataclasses.dataclass(frozen=True)
class Setting:
    """A lever on a task: one run with all its seeds."""

    task: str
    """A key of `ABLATION_TASKS`."""
    lever: Lever
    path: Path
    """The run's directory."""
    spec: RunSpec


def settings_of(out: Path, *, tasks: Iterable[str], levers: Iterable[Lever], seeds: tuple[int, ...], steps: int | None = None) -> list[Setting]:
    """The settings of all tasks and levers, task by task, each with the baseline first.

    Args:
      out: the ablation's directory.
      tasks: keys of `ABLATION_TASKS`.
      levers: which of `LEVERS`.
      seeds: the same for all settings.
      steps: environment steps of each run; None takes those of the recipe until the agent begins anew.

    Raises:
      UserError: if a config is refused.
    """
    settings = []
    for task, lever in itertools.product(tasks, (BASELINE, *levers)):
        chosen = ABLATION_TASKS[task]
        config = _first_life(preset("hindrl", env=chosen.env))
        if steps is not None:
            config = checked(functools.partial(dataclasses.replace, config, steps=steps))
        spec = RunSpec(env=make(chosen.env, **dict(chosen.env_args)), config=apply(config, lever), demos=str(chosen.num_demos), seeds=seeds)
        settings.append(Setting(task=task, lever=lever, path=out / task / lever.name, spec=spec))
    return settings


def _first_life(config: TrainConfig) -> TrainConfig:
    """The recipe until its agent begins anew: what a change does shows there, and a second life would hide it."""
    if not config.agent_resets:
        return config
    return dataclasses.replace(config, steps=round(config.steps * config.agent_resets[0]), agent_resets=())


def is_finished(setting: Setting) -> bool:
    """Whether the directory holds the finished run of just this setting.

    Raises:
      UserError: if it holds a configuration that cannot be read.
    """
    return all((setting.path / name).exists() for name in (CONFIG, SUMMARY)) and read_spec(setting.path) == setting.spec


def check_can_train(settings: Iterable[Setting], *, overwrite: bool) -> None:
    """Makes sure, before anything is trained, that no setting stands in the way of what is there.

    An interrupted run of the same setting does not: it is trained again.

    Raises:
      UserError: if a directory holds something else and `overwrite` is off, or cannot be written.
    """
    for setting in settings:
        if overwrite or not (setting.path / CONFIG).exists():
            RunWriter(setting.path, setting.spec, overwrite=overwrite)
            continue
        there, asked = (flatten_dict(spec.to_json(), sep=".") for spec in (read_spec(setting.path), setting.spec))
        different = [name for name in asked | there if name not in asked or name not in there or asked[name] != there[name]]
        if different:
            raise UserError(
                f"{setting.path} holds a run of other options ({', '.join(different)}): choose another --out, or replace it with --overwrite"
            )


def train(setting: Setting, *, report: Callable[[Result], None] = lambda result: None) -> None:
    """Trains a setting and writes its directory, in place of what is there.

    Raises:
      UserError: if the setting cannot be trained, or the directory cannot be written.
    """
    spec = setting.spec
    demonstrations = _demonstrations(spec.env, int(spec.demos), spec.seeds)
    writer = RunWriter(setting.path, spec, overwrite=True)

    def write_and_report(result: Result) -> None:
        if not writer.started:
            writer.start()
        writer.report(result.rows)
        report(result)

    writer.finish(fit(spec.env, demonstrations, spec.config, seeds=spec.seeds, report=write_and_report), film=False)


@functools.lru_cache(maxsize=1)
def _demonstrations(env: Environment, num_demos: int, seeds: tuple[int, ...]) -> tuple[Episodes, ...]:
    """One table per seed, kept for the next setting of the same task."""
    return tuple(record_demonstrations(env, num_demos, seed=seed) for seed in seeds)


# ------------------------------------------------------------------------------------------------------------------------------- outcomes


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What became of a setting. Intervals are 95% bootstrap intervals over its seeds."""

    setting: Setting
    seeds_reaching_95: int
    """Seeds of which an evaluation along the run was at 95% or more."""
    steps_to_95: Interval
    """Median of the environment steps to the first such evaluation; a seed without one counts as infinite."""
    final_success: Interval
    """Mean of the final policies' success in fresh episodes."""
    mean_success: Interval
    """Mean over seeds of the success along the run: the area under the curve of its evaluations, see `success_along`."""
    difference: Interval
    """The baseline's `mean_success` subtracted seed by seed; 0 for the baseline."""
    seconds_per_seed: float
    """Wall-clock training time of the run, evaluations included and compilation not, over the number of its seeds."""
    relative_cost: float
    """That time per gradient step, rollouts and evaluations included, over the baseline's."""

    def verdict(self) -> Literal["better", "worse", "open"]:
        """Whether the interval of the difference says what the lever does."""
        if not self.difference.excludes(0.0):
            return "open"
        return "better" if self.difference.estimate > 0.0 else "worse"


@dataclasses.dataclass(frozen=True)
class _Measured:
    """A finished run as its files have it; arrays (S,), in order of the seeds."""

    steps_to_95: np.ndarray
    final_success: np.ndarray
    success_along: np.ndarray
    seconds: float
    updates: int


def success_along(env_steps: Sequence[float], success: Sequence[float]) -> float:
    """Mean success along a run: the area under its evaluations, joined by straight lines from 0 at step 0, over its length.

    Args:
      env_steps: (evaluations,) environment steps, increasing.
      success: (evaluations,) in [0, 1].
    """
    steps = np.asarray([0.0, *env_steps], np.float64)
    return float(np.trapezoid([0.0, *success], steps) / steps[-1])


def outcomes_of(settings: Iterable[Setting]) -> list[Outcome]:
    """The outcomes of those settings that are finished, in their order. A task whose baseline is not finished is left out.

    Raises:
      UserError: if a run's files cannot be read.
    """
    outcomes = []
    for _, of_task in itertools.groupby(settings, key=lambda setting: setting.task):
        finished = [setting for setting in of_task if is_finished(setting)]
        if finished and finished[0].lever == BASELINE:
            baseline = _read(finished[0])
            outcomes += [_outcome(setting, _read(setting), baseline) for setting in finished]
    return outcomes


def _read(setting: Setting) -> _Measured:
    try:
        summary = json.loads((setting.path / SUMMARY).read_text())
        rows = list(csv.DictReader((setting.path / METRICS).read_text().splitlines()))
        of_seed = {seed: [row for row in rows if int(row["seed"]) == seed] for seed in setting.spec.seeds}
        return _Measured(
            steps_to_95=np.asarray([np.inf if seed["env_steps_to_95"] is None else seed["env_steps_to_95"] for seed in summary["seeds"]]),
            final_success=np.asarray([seed["final_success"] for seed in summary["seeds"]]),
            success_along=np.asarray(
                [success_along([float(row["env_steps"]) for row in run], [float(row["success"]) for row in run]) for run in of_seed.values()]
            ),
            seconds=summary["train_seconds"],
            updates=int(rows[-1]["updates"]),
        )
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise UserError(f"{setting.path} is damaged ({one_line(error)}): remove it and start again") from error


def _outcome(setting: Setting, run: _Measured, baseline: _Measured) -> Outcome:
    return Outcome(
        setting=setting,
        seeds_reaching_95=int(np.isfinite(run.steps_to_95).sum()),
        steps_to_95=bootstrap(run.steps_to_95, np.median),
        final_success=bootstrap(run.final_success),
        mean_success=bootstrap(run.success_along),
        difference=bootstrap(run.success_along - baseline.success_along),
        seconds_per_seed=run.seconds / len(run.final_success),
        relative_cost=(run.seconds / run.updates) / (baseline.seconds / baseline.updates),
    )


# --------------------------------------------------------------------------------------------------------------------------------- tables


def write_tables(out: Path, outcomes: Sequence[Outcome]) -> None:
    """Writes `ablation.csv`, `ablation.md` and `ablation.png` from at least one outcome.

    Raises:
      UserError: if they cannot be written.
    """
    with disk_trouble(out):
        with (out / TABLE).open("w", newline="") as file:
            rows = [_csv_row(outcome) for outcome in outcomes]
            writer = csv.DictWriter(file, list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)
        (out / TEXT).write_text(_as_text(outcomes))
        plots.save_ablation(outcomes, out / PICTURE)


def _csv_row(outcome: Outcome) -> dict[str, Any]:
    """Success as a share, steps `inf` where not reached."""
    spec = outcome.setting.spec
    row: dict[str, Any] = {
        "task": outcome.setting.task,
        "lever": outcome.setting.lever.name,
        "group": outcome.setting.lever.group,
        "seeds": len(spec.seeds),
        "steps": spec.config.steps,
        "seeds_reaching_95": outcome.seeds_reaching_95,
    }
    for name, field in (("median_steps_to_95", "steps_to_95"), *((name, name) for name in ("final_success", "mean_success", "difference"))):
        interval = getattr(outcome, field)
        row |= {name: f"{interval.estimate:.6g}", f"{name}_low": f"{interval.low:.6g}", f"{name}_high": f"{interval.high:.6g}"}
    return row | {"seconds_per_seed": f"{outcome.seconds_per_seed:.6g}", "relative_cost": f"{outcome.relative_cost:.6g}"}


_EXPLANATION = """# Ablation

The default recipe, without a second life of its agent, with one change at a time, {seeds} seeds from {first}, {steps:,} environment steps each. Every
change is trained with the same seeds, which have the same demonstrations. In brackets: 95% bootstrap intervals over the seeds, somewhat too narrow
with 16 seeds and much too narrow with fewer than 8 or so. They describe single comparisons: of changes without any effect, one in twenty or more
shows a difference by chance.

- **95%**: seeds of which an evaluation along the run reached 95% success.
- **steps to 95%**: environment steps to the first such evaluation, median over all seeds; > and the length of the run where most never did.
- **final**: success of the final policy in fresh episodes, mean over seeds, in %.
- **along**: success along the whole run, mean over its steps and over seeds, in %. It sees both speed and the level that is reached.
- **difference**: the default's "along" subtracted seed by seed, in points; bold where the interval leaves out 0.
- **s/seed**: seconds of training per seed, all seeds side by side, without compilation.
- **cost**: seconds per gradient step, rollouts and evaluations included, relative to the default's. Times were
  measured once, along the way, and mean something only where the machine had nothing else to do.
"""


def _as_text(outcomes: Sequence[Outcome]) -> str:
    spec = outcomes[0].setting.spec
    lines = [_EXPLANATION.format(seeds=len(spec.seeds), first=spec.seeds[0], steps=spec.config.steps)]
    for task, of_task in itertools.groupby(outcomes, key=lambda outcome: outcome.setting.task):
        lines += [f"## {task}: {ABLATION_TASKS[task].title()}", ""]
        lines += ["| change | 95% | steps to 95% | final | along | difference | s/seed | cost |", "|---|---|---|---|---|---|---|---|"]
        for group, of_group in itertools.groupby(sorted(of_task, key=_group_order), key=lambda outcome: outcome.setting.lever.group):
            if group != BASELINE.group:
                lines.append(f"| *{group}* | | | | | | | |")
            lines += [_text_row(outcome) for outcome in of_group]
        lines.append("")
    lines += ["## The changes", "", "| change | what it is |", "|---|---|"]
    levers = dict.fromkeys(outcome.setting.lever for outcome in sorted(outcomes, key=_group_order))
    lines += [f"| {lever.name} | {lever.summary} |" for lever in levers]
    return "\n".join(lines) + "\n"


def _group_order(outcome: Outcome) -> int:
    return get_args(Group).index(outcome.setting.lever.group)


def _text_row(outcome: Outcome) -> str:
    steps, limit = outcome.steps_to_95, outcome.setting.spec.config.steps
    difference = f"{100 * outcome.difference.estimate:+.1f} [{100 * outcome.difference.low:+.1f}, {100 * outcome.difference.high:+.1f}]"
    if outcome.setting.lever == BASELINE:
        difference = ""
    elif outcome.verdict() != "open":
        difference = f"**{difference}**"
    cells = (
        outcome.setting.lever.name,
        f"{outcome.seeds_reaching_95}/{len(outcome.setting.spec.seeds)}",
        f"{thousands(steps.estimate, limit)} [{thousands(steps.low, limit)}, {thousands(steps.high, limit)}]",
        _percent(outcome.final_success),
        _percent(outcome.mean_success),
        difference,
        f"{outcome.seconds_per_seed:.1f}",
        f"{outcome.relative_cost:.2f}",
    )
    return f"| {' | '.join(cells)} |"


def thousands(steps: float, limit: int) -> str:
    """Steps in thousands; beyond the limit, the length of the run, if they were not enough."""
    return f"{steps / 1000:.0f}k" if np.isfinite(steps) else f">{limit / 1000:.0f}k"


def _percent(share: Interval) -> str:
    return f"{100 * share.estimate:.1f} [{100 * share.low:.1f}, {100 * share.high:.1f}]"
