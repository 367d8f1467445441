"""`hindrl train`."""

from __future__ import annotations

import contextlib
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich import box
from rich.table import Table

from hindrl_jax.base.environments import Restorable, can_step
from hindrl_jax.cli.common import console, peek, print_table
from hindrl_jax.cli.hosts import joined_hosts
from hindrl_jax.cli.running import check_unfinished, checkpoints_of, default_out, reporters_of, run, speed_line
from hindrl_jax.cli.train_options import is_number, parse_resume, parse_train
from hindrl_jax.config import TrainConfig
from hindrl_jax.runs.spec import FROM_PYTHON, SUMMARY, RunSpec, read_spec
from hindrl_jax.runs.writer import RunWriter
from hindrl_jax.training.result import SOLVED, Row

_TABLE_WIDTH = 92  # characters
_GOOD = 0.8  # mean success of the returned policies from which on nobody needs advice


def train(arguments: list[str]) -> None:
    """Train policies from demonstrations."""
    if peek(arguments, "resume") is not None:
        options = parse_resume(arguments, "hindrl train")
        out, spec = options.resume, read_spec(options.resume)
        check_unfinished(out, SUMMARY, f"look at it with `hindrl eval {shlex.quote(str(out))}`")
        writer = RunWriter(out, spec, resume=True, reporters=reporters_of(options, out))
    else:
        spec, options = parse_train(arguments, "hindrl train", train.__doc__)
        out = options.out or default_out(spec)
        writer = RunWriter(out, spec, overwrite=options.overwrite, reporters=reporters_of(options))
    with contextlib.closing(writer), joined_hosts(options) as writes:
        result = run(spec, [spec.config], writer if writes else None, checkpoints_of(out, options), options.render_every)
        if writes:
            summary = writer.finish(result)
            print_table(_summary_table(summary, spec.config), least_width=_TABLE_WIDTH)
            for line in said_of_clones(summary["seeds"]) + said_of_never(summary["seeds"], result.rows):
                console.print(line)
            console.print(speed_line(summary))
            console.print(f"wrote {out}: {', '.join(writer.files())}")
            for line in advice(writer.spec, summary["seeds"], out):
                console.print(line)


def _summary_table(summary: dict[str, Any], config: TrainConfig) -> Table:
    """A line for each seed: the policy that was kept and whether it plays mean or sampled actions, the last one, and when mean actions solved 95%."""
    cloning = not config.learns_from_rollouts  # and so takes no environment steps
    unit, updates, actions = ("updates", [], []) if cloning else ("env_steps", ["updates"], ["actions"])
    moment = "at update" if cloning else "at step"
    table = Table("seed", "kept", "length", *actions, moment, "last", f"95% {moment}", *updates, "seconds", box=box.SIMPLE_HEAD)
    for column in table.columns:
        column.justify = "right"
    for seed in summary["seeds"]:
        cells = [str(seed["seed"]), f"{seed['returned_success']:.0%}", f"{seed['returned_length']:.1f}"]
        cells += ["sampled" if seed["returned_noise"] else "mean"] * len(actions)
        cells += [f"{seed[f'returned_{unit}']:,}", f"{seed['final_success']:.0%}"]
        if seed["updates_to_95"] is None:
            cells.append("never")
        else:
            cells.append(f"{seed[f'{unit}_to_95']:,}")
            cells += [f"{seed['updates_to_95']:,}"] * len(updates)
            cells.append(f"{seed['seconds_to_95']:.1f}")
        table.add_row(*cells)
    return table


def said_of_clones(seeds: Sequence[Mapping[str, Any]]) -> list[str]:
    """That some of the returned policies are clones of the demonstrations, if they are; one line, or none."""
    clones = [str(seed["seed"]) for seed in seeds if _is_clone(seed)]
    if not clones:
        return []
    practised = any(seed["returned_env_steps"] for seed in seeds if _is_clone(seed))
    when, practice = ("", ", and its steps are those of its practice") if practised else (" at step 0", "")
    which = "" if len(clones) == len(seeds) else f" of seed{'s' if len(clones) > 1 else ''} {', '.join(clones)}"
    return [f"what was kept{when}{which} is the clone of the demonstrations{practice}"]


def _is_clone(seed: Mapping[str, Any]) -> bool:
    """Whether the policy that a seed returns was made before learning began."""
    return bool(seed["returned_updates"] == 0)


def said_of_never(seeds: Sequence[Mapping[str, Any]], rows: Sequence[Row]) -> list[str]:
    """What "never" means where the returned policy is good all the same: the column counts mean actions, and sampled ones may solve more.

    Args:
      seeds: those of `summary.json`.
      rows: all evaluations of all of them.

    Returns:
      One line, or none where no seed needs it, as with bc, whose actions are never sampled.
    """
    reached: dict[int, str] = {}
    for seed in seeds:
        if seed["updates_to_95"] is None and seed["returned_success"] >= SOLVED and not _is_clone(seed):
            own = [row for row in rows if row.seed == seed["seed"] and row.sampled_success is not None]
            first = next((row for row in own if row.sampled_success >= SOLVED), None)
            if own:
                reached[seed["seed"]] = "not" if first is None else f"at {first.env_steps:,}"
    if not reached:
        return []
    sampled = ", ".join(f"seed {seed} {when}" for seed, when in reached.items())
    return [f'"never" counts evaluations along the run with mean actions only; with sampled actions 95% was reached: {sampled}']


def advice(spec: RunSpec, seeds: Sequence[Mapping[str, Any]], out: Path) -> list[str]:
    """What to try after a run that solved nothing, or little of what was asked for; no lines after a good one.

    Args:
      spec: what was trained.
      seeds: those of `summary.json`.
      out: the run's directory.
    """
    success = float(np.mean([seed["returned_success"] for seed in seeds]))
    if success == 0.0:
        return _nothing_solved(spec)
    return _little_solved(spec, success, out) if success < min(_GOOD, spec.config.stop_at or _GOOD) else []


def _nothing_solved(spec: RunSpec) -> list[str]:
    few = is_number(spec.demos) and int(spec.demos) < 10
    lines = ["no episode was solved. What to try, in this order:"]
    file = "FILE" if is_number(spec.demos) or spec.demos == FROM_PYTHON else spec.demos
    lines.append(f"`hindrl demos info {file}`: the demonstrations are solved, and epsilon is above 0 where the goal is continuous (--epsilon-steps)")
    if spec.config.algo != "bc":
        lines.append("`--algo bc` with many demonstrations: where it solves nothing either, the observation lacks what the expert acts on")
    lines.append(f"a longer run: --steps {2 * spec.config.num_steps}; and other seeds: --seeds 4")
    if few:
        lines.append(f"more demonstrations: --demos {10 * int(spec.demos)}")
    can_reset = can_step(spec.env) and isinstance(spec.env, Restorable)
    if spec.config.algo != "bc" and not spec.config.demo_reset_ratio and can_reset:
        lines.append("begin half of the training episodes in demonstrated states: --demo-reset-ratio 0.5")
    return [lines[0], *(f"  {number}. {line}" for number, line in enumerate(lines[1:], 1))]


def _little_solved(spec: RunSpec, success: float, out: Path) -> list[str]:
    number = int(spec.demos) if is_number(spec.demos) else None
    more = "" if number is None else f" (--demos {number * (10 if number < 10 else 2)})"
    seeds = " and more seeds (--seeds 4)" if len(spec.seeds) == 1 else ""
    return [
        f"{success:.0%} of the episodes were solved. What may help: a longer run (--steps {2 * spec.config.num_steps}){seeds};",
        f"more demonstrations{more}, above all of starts where it fails: `hindrl render {shlex.quote(str(out))} --episodes 5` films five",
    ]
