"""From settings to runs: the recipe that a cell is trained with, how much of it a scale leaves, and how long that takes."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Literal

from hindrl_jax.config import TrainConfig
from hindrl_jax.core.holding import FEWEST_DECISIONS
from hindrl_jax.reproduction.cells import Cell, Changes, changed
from hindrl_jax.reproduction.thesis import TASKS, Setting
from hindrl_jax.runs.spec import RunSpec
from hindrl_jax.tasks.presets import original_rules, preset
from hindrl_jax.tasks.registry import make, task

Recipe = Literal["default", "thesis", "original"]
ScaleName = Literal["quick", "short", "laptop", "full"]
RECIPE_NAMES: dict[Recipe, str] = {"default": "our recipe", "thesis": "the thesis's text", "original": "the original code"}
FIRST_SEED = 5_000
"""On seeds from here on, the recipe was not made."""


@dataclasses.dataclass(frozen=True)
class Scale:
    """How much of a recipe is run."""

    summary: str
    """What it shortens."""
    seeds: dict[Recipe, int]
    seeds_on_reach: int | None = None
    """Fewer for our recipe on the arm, whose cells take longer."""
    cloning: Changes = ()
    """Changes to the recipe of bc."""
    ours: Changes = ()
    """Changes to our recipe, of the other algorithms."""
    theirs: Changes = ()
    """Changes to the thesis's and the original code's."""
    theirs_for_claims_only: bool = False
    """Whether, of these two, only the cells that a claim needs are run."""
    settles_claims: bool = True
    """Whether its runs are long enough to say anything of a claim."""


SCALES: dict[ScaleName, Scale] = {
    "quick": Scale(
        "A check that everything runs, not a measurement: 2 seeds; 16,000 environment steps of our recipe in place of 100,000; of the other two "
        "5,000, with batches of 256 and 1,000 random steps; 1,000 gradient steps of cloning; 20 episodes for each evaluation.",
        seeds={"default": 2, "thesis": 2, "original": 2},
        cloning=(("steps", 1_000), ("eval_every", 500), ("eval_episodes", 20)),
        ours=(("steps", 16_000), ("eval_every", 2_000), ("eval_episodes", 20)),
        theirs=(("steps", 5_000), ("eval_every", 1_000), ("eval_episodes", 20), ("learning_starts", 1_000), ("batch.batch_size", 256)),
        settles_claims=False,
    ),
    "short": Scale(
        "4 seeds; 40,000 environment steps of our recipe in place of 100,000, cloning in full; of the other two 50,000 in place of 300,000, with "
        "batches of 256, and only where a claim needs the cell.",
        seeds={"default": 4, "thesis": 4, "original": 4},
        ours=(("steps", 40_000),),
        theirs=(("steps", 50_000), ("batch.batch_size", 256)),
        theirs_for_claims_only=True,
    ),
    "laptop": Scale(
        "Our recipe in full, 32 seeds on the grid and 8 on the arm. The thesis's and the original code's with batches of 512 in place of 4,096 and "
        "12,000, for 200,000 environment steps, which is what the thesis's figures show, 4 seeds, and only where a claim needs the cell.",
        seeds={"default": 32, "thesis": 4, "original": 4},
        seeds_on_reach=8,
        theirs=(("steps", 200_000), ("eval_every", 10_000), ("batch.batch_size", 512)),
        theirs_for_claims_only=True,
    ),
    "full": Scale(
        "Nothing: the hyperparameters of the appendix, 300,000 environment steps. 32 seeds of our recipe (8 on the arm), 8 of the others.",
        seeds={"default": 32, "thesis": 8, "original": 8},
        seeds_on_reach=8,
    ),
}


def cells_of(
    out: Path, settings: Iterable[Setting], *, recipe: Recipe, scale: ScaleName, num_seeds: int | None = None, first_seed: int = FIRST_SEED
) -> dict[Setting, Cell]:
    """The cell of each setting, in `out`/cells/SCALE/RECIPE/TASK/NAME.

    Settings that come to the same run, such as a cloning weight that the recipe has anyway, share a cell.

    Args:
      out: the directory of the report.
      settings: which.
      recipe: what they are trained with.
      scale: how much of it.
      num_seeds: None leaves it to the scale.
      first_seed: the others follow it.

    Raises:
      UserError: if a config is refused.
    """
    cells = {}
    for setting in settings:
        spec = spec_of(setting, recipe=recipe, scale=scale, num_seeds=num_seeds, first_seed=first_seed)
        plain = setting if spec.config == _config(dataclasses.replace(setting, bc_weight=None), recipe, scale) else None
        name = setting.algo if setting.bc_weight is None or plain else f"{setting.algo}-bc-{setting.bc_weight:g}"
        path = out / "cells" / scale / recipe / setting.task / name
        cells[setting] = Cell(task=setting.task, group=recipe, name=name, path=path, spec=spec)
    return cells


def spec_of(setting: Setting, *, recipe: Recipe, scale: ScaleName, num_seeds: int | None = None, first_seed: int = FIRST_SEED) -> RunSpec:
    """What the run of a setting is asked to do.

    Raises:
      UserError: if a config is refused.
    """
    of_task, of_scale = TASKS[setting.task], SCALES[scale]
    if num_seeds is None:
        on_reach = recipe == "default" and setting.task.startswith("reach") and of_scale.seeds_on_reach
        num_seeds = on_reach or of_scale.seeds[recipe]
    rules = original_rules(task(of_task.env).environment) if recipe == "original" else {}
    return RunSpec(
        env=make(of_task.env, **dict(of_task.env_args), **rules),
        config=_config(setting, recipe, scale),
        demos=str(of_task.num_demos),
        seeds=tuple(range(first_seed, first_seed + num_seeds)),
    )


def _config(setting: Setting, recipe: Recipe, scale: ScaleName) -> TrainConfig:
    config, of_scale = preset(setting.algo, recipe, env=TASKS[setting.task].env), SCALES[scale]
    if setting.algo == "bc":
        return changed(config, of_scale.cloning)
    weight: Changes = () if setting.bc_weight is None else (("agent.bc_weight", setting.bc_weight),)
    # The thesis compares methods: what one agent learns by reinforcement, not a clone that a run of ours returns where that is better, nor what a
    # second agent makes of the replay of one that is stuck.
    ours = of_scale.ours if recipe == "default" else of_scale.theirs
    return changed(config, (*ours, *weight, ("imitation_steps", 0), ("practice_rounds", 0), ("network_resets", False)))


SHARE_OF_HORIZON = 0.9
"""What a demonstration takes of its horizon, for how long a run will hold its actions, and so how many steps it will take."""
COMPILATION, GRADIENT_STEP, BATCH_ROW, OF_CLONING = 14.0, 1.0e-3, 11e-6, 0.2
"""Seconds, of one core of an AMD EPYC: to compile a cell; of a gradient step, and of each row of its batch, rollouts and evaluations included;
and the share of these that a step of cloning takes. What docs/performance.md and docs/earlier-results.md measured, roughly."""


def seconds_of(spec: RunSpec, *, cores: int) -> float:
    """About how long a cell takes, from the stated times of single steps."""
    config = spec.config
    if config.action_hold is None:
        length = int(SHARE_OF_HORIZON * spec.env.horizon)
        config = dataclasses.replace(config, action_hold=max(1, length // FEWEST_DECISIONS))
    if config.learns_from_rollouts:
        updates, share = config.num_steps * config.num_updates / config.steps_per_iteration, 1.0
    else:
        updates, share = config.num_steps, OF_CLONING
    at_once = min(cores, len(spec.seeds))
    return COMPILATION + len(spec.seeds) / at_once * updates * share * (GRADIENT_STEP + BATCH_ROW * config.batch.batch_size)


def num_cores() -> int:
    """Those that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
