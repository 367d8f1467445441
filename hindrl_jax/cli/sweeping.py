"""`hindrl sweep`."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from rich import box
from rich.table import Table

from hindrl_jax.base.errors import UserError
from hindrl_jax.cli.common import console, peek
from hindrl_jax.cli.hosts import joined_hosts
from hindrl_jax.cli.running import check_unfinished, checkpoints_of, default_out, reporters_of, run, speed_line
from hindrl_jax.cli.train_options import SweepOptions, parse_resume, parse_train
from hindrl_jax.config import SWEEPABLE, TrainConfig, without_effect
from hindrl_jax.runs.spec import SWEEP
from hindrl_jax.runs.sweep import SweepWriter, read_sweep
from hindrl_jax.runs.writer import summarise
from hindrl_jax.tasks.registry import checked, did_you_mean


def sweep(arguments: list[str]) -> None:
    """Train with several values of hyperparameters, side by side."""
    if peek(arguments, "resume") is not None:
        options = parse_resume(arguments, "hindrl sweep")
        out, (spec, settings) = options.resume, read_sweep(options.resume)
        check_unfinished(out, SWEEP, f"look at {out / SWEEP}")
        writer = SweepWriter(out, spec, settings, resume=True, reporters=reporters_of(options, out))
    else:
        spec, options = parse_train(arguments, "hindrl sweep", sweep.__doc__, SweepOptions)
        settings = list(_grid(options.over, spec.config))
        out = options.out or default_out(spec, "sweep")
        writer = checked(lambda: SweepWriter(out, spec, settings, overwrite=options.overwrite, reporters=reporters_of(options)))
    with contextlib.closing(writer), joined_hosts(options) as writes:
        configs = [setting.spec.config for setting in writer.runs]
        result = run(spec, configs, writer if writes else None, checkpoints_of(out, options), options.render_every)
        if writes:
            console.print(_sweep_table(writer.finish(result), list(settings[0])))
            console.print(speed_line(summarise(result)))
            console.print(f"wrote {out}: sweep.csv, sweep.png, and a run's directory for each setting")


def _grid(over: Sequence[str], config: TrainConfig) -> Iterator[dict[str, float]]:
    """All combinations of the values of --over, in order."""
    values: dict[str, list[float]] = {}
    for given in over:
        name, _, listed = given.partition("=")
        name = name.strip().lstrip("-").replace("-", "_")
        if name not in SWEEPABLE:
            raise UserError(f"--over {given}: {name!r} cannot be swept{did_you_mean(name, SWEEPABLE)}; choose one of {', '.join(SWEEPABLE)}")
        if name in values:
            raise UserError(f"--over {given}: {name} is given twice; list all its values in one --over")
        try:
            values[name] = [float(value) for value in listed.split(",")]
        except ValueError:
            raise UserError(f"--over {given} is not a field and its values: write for example --over {name}=0.1,0.2") from None
        if len(set(map(np.float32, values[name]))) < len(values[name]):
            raise UserError(f"--over {given}: a value is listed twice (values are rounded to float32)")
        reason = without_effect(config, name)
        if reason:
            raise UserError(f"--over {given} would change nothing: {reason}")
    if not values:
        raise UserError("--over is missing: say what to sweep, for example --over learning_rate=1e-4,3e-4,1e-3")
    return (dict(zip(values, combination, strict=True)) for combination in itertools.product(*values.values()))


def _sweep_table(rows: Sequence[dict[str, Any]], swept: Sequence[str]) -> Table:
    unit = next(name for name in rows[0] if name.startswith("median_")).split("_")[1]
    table = Table(*swept, "95% reached", f"median {unit}", "mean returned", "worst", box=box.SIMPLE_HEAD)
    for row in rows:
        median = row[f"median_{unit}_to_95"]
        table.add_row(
            *(f"{row[name]:g}" for name in swept),
            f"{row['seeds_reaching_95']} of {row['seeds']}",
            "never" if median is None else f"{median:,.0f}",
            f"{row['mean_returned_success']:.0%}",
            f"{row['worst_returned_success']:.0%}",
        )
    return table
