"""`hindrl train`."""

from __future__ import annotations

import contextlib
import shlex
from typing import Any

from rich import box
from rich.table import Table

from hindrl_jax.cli.common import console, peek
from hindrl_jax.cli.hosts import joined_hosts
from hindrl_jax.cli.running import check_unfinished, checkpoints_of, default_out, reporters_of, run, speed_line
from hindrl_jax.cli.train_options import parse_resume, parse_train
from hindrl_jax.config import TrainConfig
from hindrl_jax.runs.spec import SUMMARY, read_spec
from hindrl_jax.runs.writer import RunWriter


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
        result = run(spec, [spec.config], writer if writes else None, checkpoints_of(out, options))
        if writes:
            summary = writer.finish(result)
            console.print(_summary_table(summary, spec.config))
            console.print(speed_line(summary))
            console.print(f"wrote {out}: {', '.join(writer.files())}")


def _summary_table(summary: dict[str, Any], config: TrainConfig) -> Table:
    """A line for each seed: the policy that was kept and whether it plays mean or sampled actions, the last one, and when 95% was reached first."""
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
