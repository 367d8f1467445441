"""The report on the thesis, made from the directories of finished cells alone, so that it can be made again, or from another machine's cells.

    OUT/report.md           for people: the verdict of each claim, and each table and figure beside the thesis's
    OUT/claims.csv          a row for each part of a claim and each recipe
    OUT/pairs.csv           a row for each pair of cells that a claim compares, each measure and each recipe
    OUT/cells.csv           a row for each seed of each finished cell
    OUT/profiles-RECIPE.png the performance profiles of the three tables
    OUT/figure-5.1-RECIPE.png, ...
    OUT/cells/SCALE/RECIPE/TASK/NAME/    the runs

A cell that was not run is empty, and no figure is made up.
"""

from __future__ import annotations

import csv
import dataclasses
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, get_args

import numpy as np

from hindrl_jax.base.files import disk_trouble
from hindrl_jax.plotting.statistics import Interval, interquartile_mean, stratified_bootstrap
from hindrl_jax.reproduction import measures
from hindrl_jax.reproduction.cells import is_finished
from hindrl_jax.reproduction.claims import CLAIMS, Claim, Judged, Runs, finding_of, judge, verdict
from hindrl_jax.reproduction.comparisons import IN_WORDS, Compared, compare, pairs
from hindrl_jax.reproduction.scales import RECIPE_NAMES, SCALES, Recipe, ScaleName, cells_of
from hindrl_jax.reproduction.tables import thousands
from hindrl_jax.reproduction.thesis import ALGORITHM_NAMES, ARTIFACTS, TASKS, Artifact, Setting, settings_of
from hindrl_jax.reproduction.thesis_pictures import draw, draw_profiles
from hindrl_jax.runs.recorded import RecordedRun, read_recorded

TEXT, CLAIMS_TABLE, PAIRS_TABLE, CELLS_TABLE = "report.md", "claims.csv", "pairs.csv", "cells.csv"
Readings = Mapping[Recipe, Runs]
"""The finished runs of each recipe."""
Comparisons = Mapping[Recipe, list[Compared]]
"""Pairs of cells by all measures, under each recipe."""
PROFILES = "profiles"
"""What the names of their pictures begin with."""


def read(out: Path, scale: ScaleName) -> Readings:
    """All cells of a scale that are finished, whatever their seeds.

    Raises:
      UserError: if a run's files cannot be read.
    """
    settings = settings_of(tuple(ARTIFACTS))
    readings: dict[Recipe, Runs] = {}
    for recipe in get_args(Recipe):
        cells = cells_of(out, settings, recipe=recipe, scale=scale)
        readings[recipe] = {setting: read_recorded(cell.path) for setting, cell in cells.items() if is_finished(cell, any_seeds=True)}
    return readings


def write(out: Path, scale: ScaleName) -> list[str]:
    """Writes the report; returns the names of its files.

    Raises:
      UserError: if a run's files cannot be read, or the report cannot be written.
    """
    readings = read(out, scale)
    settles = SCALES[scale].settles_claims
    judged = {
        claim.letter: {recipe: [judge(part, runs, settles=settles) for part in claim.parts] for recipe, runs in readings.items()} for claim in CLAIMS
    }
    compared = {recipe: [one for pair in pairs() for one in compare(pair, runs, settles=settles)] for recipe, runs in readings.items()}
    with disk_trouble(out):
        out.mkdir(parents=True, exist_ok=True)
        pictures = _draw_all(out, readings, scale)
        _write_csv(out / CELLS_TABLE, _CELL_COLUMNS, _cell_rows(readings, scale))
        _write_csv(out / CLAIMS_TABLE, _CLAIM_COLUMNS, _claim_rows(judged))
        _write_csv(out / PAIRS_TABLE, _PAIR_COLUMNS, _pair_rows(compared))
        (out / TEXT).write_text("\n".join(markdown(readings, judged, compared, scale=scale, pictures=pictures)) + "\n")
    return [TEXT, CLAIMS_TABLE, PAIRS_TABLE, CELLS_TABLE, *pictures]


def _draw_all(out: Path, readings: Readings, scale: ScaleName) -> list[str]:
    names = []
    for name, artifact in ARTIFACTS.items():
        for recipe, runs in readings.items():
            if artifact.panels and set(artifact.settings) & set(runs):
                names.append(f"{name}-{recipe}.png")
                draw(artifact, runs, out / names[-1], recipe=f"{RECIPE_NAMES[recipe]}, scale {scale}")
    tables = [artifact for artifact in ARTIFACTS.values() if artifact.rows == "demonstrations" and not artifact.panels]
    for recipe, runs in readings.items():
        if any(set(table.settings) & set(runs) for table in tables):
            names.append(f"{PROFILES}-{recipe}.png")
            draw_profiles(tables, runs, out / names[-1], recipe=f"{RECIPE_NAMES[recipe]}, scale {scale}")
    return names


_OF_CLAIMS = """A claim holds under a recipe where the whole 95% interval of each of its parts lies where it says, does not hold where none of one
part's does, and is open in between. The thesis's text decides, our recipe where that is not run or open; where a claim does not hold there, the
original code's run says whether its quirks made it. Cells of fewer than 4 seeds settle no comparison, and intervals of fewer than 8 are much too
narrow.
"""
_OF_TABLES = """Each cell: success of the returned policies in 100 fresh episodes, interquartile mean over seeds and its 95% bootstrap interval, in %;
that of the best seed; seeds of which an evaluation along the run reached 95%; environment steps (BC: gradient steps) to it, median over all seeds.
Beside it, what the thesis has. An empty cell was not run.
"""
_OF_PAIRS = """The chance that a seed of the first cell is better than one of the second, where equal ones count half (Mann and Whitney's U),
with its 95% interval; open where that holds 1/2, or where a cell has fewer than 4 seeds to measure. Steps of an episode are compared for those seeds
alone whose last evaluation is at 95%; an empty entry has no seed to measure, or no environment steps.
"""
_OF_TIMES = """Minutes of training, all seeds of a cell side by side, evaluations included and compilation not, by the clock: where the machine had
other work, they say how busy it was. Steps are environment steps, BC's gradient steps.
"""
_OF_PROFILES = """The share of a table's runs, all its rows with equal weight, whose returned policies solve more than x of 100 fresh episodes. The
higher line is better; where two lines cross, neither is.
"""


def markdown(
    readings: Readings,
    judged: Mapping[str, Mapping[Recipe, list[Judged]]],
    compared: Comparisons,
    *,
    scale: ScaleName,
    pictures: Iterable[str] = (),
) -> list[str]:
    """The lines of the report.

    Args:
      readings: the finished runs.
      judged: the parts of each claim, by its letter and recipe.
      compared: pairs of cells.
      scale: of all of them.
      pictures: names of files; those of a figure begin with its name.
    """
    number = sum(len({run.path for run in runs.values()}) for runs in readings.values())
    lines = ["# The thesis, reproduced", "", f"Scale `{scale}`: {SCALES[scale].summary} Finished cells: {number}.", ""]
    lines += ["## Claims", "", _OF_CLAIMS]
    lines += [] if SCALES[scale].settles_claims else ["**Runs of this scale are too short to settle a claim: all of them are open.**", ""]
    lines += [f"| claim | verdict | {' | '.join(RECIPE_NAMES.values())} |", "|---|---|---|---|---|"]
    lines += [_claim_line(claim, judged[claim.letter]) for claim in CLAIMS]
    lines += ["", "The parts of the claims:", ""]
    lines += [f"- ({claim.letter}) {part.what}; true if {_between(part.true_between)}" for claim in CLAIMS for part in claim.parts]
    lines += ["", *_pair_lines(compared), "## Tables and figures", "", _OF_TABLES]
    for name, artifact in ARTIFACTS.items():
        there = {recipe: runs for recipe, runs in readings.items() if set(artifact.settings) & set(runs)}
        if there:
            lines += [f"### {name.replace('-', ' ').capitalize()}: {artifact.title}", ""]
            lines += [artifact.remark, ""] if artifact.remark else []
            lines += [line for recipe, runs in there.items() if not artifact.panels for line in _table(artifact, runs, RECIPE_NAMES[recipe])]
            lines += [f"![{artifact.title}]({picture})\n" for picture in pictures if picture.startswith(f"{name}-")]
    profiles = [picture for picture in pictures if picture.startswith(PROFILES)]
    if profiles:
        lines += ["### Performance profiles", "", _OF_PROFILES, *(f"![Performance profiles]({picture})\n" for picture in profiles)]
    return [*lines, *_time_lines(readings)]


def _time_lines(readings: Readings) -> list[str]:
    """What each cell took."""
    lines = ["## Time", "", _OF_TIMES, "| recipe | cell | seeds | steps | evaluations | minutes |", "|---|---|---|---|---|---|"]
    for recipe, runs in readings.items():
        for run in {run.path: run for run in runs.values()}.values():
            cell, seeds, steps = "/".join(run.path.parts[-2:]), run.spec.seeds, run.spec.config.num_steps
            lines.append(f"| {recipe} | {cell} | {seeds[0]}-{seeds[-1]} | {steps:,} | {len(run.success)} | {run.train_seconds / 60:.1f} |")
    return [*lines, ""] if len(lines) > 5 else []


def _pair_lines(compared: Comparisons) -> list[str]:
    """A table for each recipe that has a pair."""
    lines = []
    for recipe, ones in compared.items():
        rows = [(pair, {one.measure: one for one in ones if one.pair == pair}) for pair in pairs()]
        rows = [(pair, found) for pair, found in rows if found]
        if rows:
            lines += [f"With {RECIPE_NAMES[recipe]}:", "", f"| pair | claims | {' | '.join(IN_WORDS.values())} |", "|---|---|---|---|---|"]
            lines += [f"| {pair.title()} | {pair.claims} | {' | '.join(_said(found.get(name)) for name in IN_WORDS)} |" for pair, found in rows]
            lines.append("")
    return ["## Pairs that claims compare", "", _OF_PAIRS, *lines] if lines else []


def _said(compared: Compared | None) -> str:
    if compared is None:
        return ""
    return f"{'open' if compared.said == 'open' else f'the {compared.said}'}: {_short(compared.chance)}"


def _claim_line(claim: Claim, judged: Mapping[Recipe, list[Judged]]) -> str:
    findings = {recipe: finding_of(of_recipe) for recipe, of_recipe in judged.items()}
    said = [f"{findings[recipe]}{_estimates(of_recipe)}" if findings[recipe] != "not run" else "" for recipe, of_recipe in judged.items()]
    return f"| ({claim.letter}) {claim.text} | **{verdict(findings)}** | {' | '.join(said)} |"


def _estimates(judged: Iterable[Judged]) -> str:
    return "".join(": " * (not index) + "; " * bool(index) + _short(one.interval) for index, one in enumerate(judged))


def _short(interval: Interval | None) -> str:
    if interval is None:
        return "not measurable"
    around = "no interval" if np.isinf(interval.high) else f"[{interval.low:.2f}, {interval.high:.2f}]"
    return f"{interval.estimate:.2f} {around}"


def _between(ends: tuple[float, float]) -> str:
    low, high = ends
    if np.isinf(high):
        return f"above {low:.3g}"
    return f"below {high:.3g}" if np.isinf(low) else f"between {low:.3g} and {high:.3g}"


def _table(artifact: Artifact, runs: Runs, recipe: str) -> list[str]:
    """A row for each number of demonstrations, or weight; for each algorithm the thesis's figure and ours."""
    algorithms = list(dict.fromkeys(setting.algo for setting in artifact.settings))
    published = dict(artifact.published)
    heads = [f"{ALGORITHM_NAMES[algo]}, {whose}" for algo in algorithms for whose in ("thesis", "here")]
    lines = [f"With {recipe}:", "", f"| {artifact.rows.replace('_', ' ')} | {' | '.join(heads)} |", "|---" * (len(heads) + 1) + "|"]
    rows: dict[str, dict[str, Setting]] = {}
    for setting in artifact.settings:
        row = str(TASKS[setting.task].num_demos) if artifact.rows == "demonstrations" else f"{setting.bc_weight:g}"
        rows.setdefault(row, {})[setting.algo] = setting
    for row, of_row in rows.items():
        filled = [entry for algo in algorithms for entry in (published.get(of_row[algo], ""), cell_text(runs.get(of_row[algo])))]
        lines.append(f"| {row} | {' | '.join(filled)} |")
    return [*lines, ""]


def cell_text(run: RecordedRun | None) -> str:
    """A run in a cell of a table; nothing for one that is not there."""
    if run is None:
        return ""
    success, steps = measures.success(run), measures.steps(run)
    interval = stratified_bootstrap([success], lambda groups: interquartile_mean(groups[0]))
    around = "" if len(success) < 2 else f" [{100 * interval.low:.0f}, {100 * interval.high:.0f}]"
    return (
        f"{100 * interval.estimate:.0f}{around}; best {100 * success.max():.0f}; {np.isfinite(steps).sum()}/{len(steps)}; "
        f"{thousands(float(np.median(steps)), run.spec.config.num_steps)}"
    )


_OF_CELL = ("scale", "recipe", "task", "demonstrations", "algorithm", "bc_weight", "batch_size", "steps")
_CELL_COLUMNS = (*_OF_CELL, "seed", "success", "steps_to_95", "last_success", "last_episode_length", "seconds_per_seed", "path")


def _cell_rows(readings: Readings, scale: ScaleName) -> list[dict[str, Any]]:
    rows = []
    for recipe, runs in readings.items():
        for setting, run in {run.path: (setting, run) for setting, run in runs.items()}.values():
            config, steps = run.spec.config, measures.steps(run)
            of_cell: tuple[Any, ...] = (scale, recipe, setting.task, run.spec.demos, setting.algo, config.agent.bc_weight, config.batch.batch_size)
            for index, seed in enumerate(run.spec.seeds):
                last = (run.success[-1, index], run.metrics["episode_length"][-1, index])
                numbers = (run.returned_success[index], steps[index], *last, run.train_seconds / len(run.spec.seeds))
                values = (*of_cell, config.num_steps, seed, *(f"{number:.6g}" for number in numbers), "/".join(run.path.parts[-5:]))
                rows.append(dict(zip(_CELL_COLUMNS, values, strict=True)))
    return rows


_CLAIM_COLUMNS = ("claim", "part", "recipe", "estimate", "low", "high", "finding", "verdict")


def _claim_rows(judged: Mapping[str, Mapping[Recipe, list[Judged]]]) -> list[dict[str, Any]]:
    rows = []
    for letter, by_recipe in judged.items():
        said = verdict({recipe: finding_of(of_recipe) for recipe, of_recipe in by_recipe.items()})
        for recipe, of_recipe in by_recipe.items():
            for one in of_recipe:
                numbers = ("", "", "") if one.interval is None else tuple(f"{number:.6g}" for number in dataclasses.astuple(one.interval))
                rows.append(dict(zip(_CLAIM_COLUMNS, (letter, one.part.what, recipe, *numbers, one.finding, said), strict=True)))
    return rows


_PAIR_COLUMNS = ("claims", "first", "second", "measure", "recipe", "chance", "low", "high", "better")


def _pair_rows(compared: Comparisons) -> list[dict[str, Any]]:
    found = [(recipe, one) for pair in pairs() for recipe, ones in compared.items() for one in ones if one.pair == pair]
    rows = []
    for recipe, one in found:
        names = (f"{setting.task} {setting.algo}" for setting in (one.pair.first, one.pair.second))
        numbers = (f"{number:.6g}" for number in dataclasses.astuple(one.chance))
        rows.append(dict(zip(_PAIR_COLUMNS, (one.pair.claims, *names, one.measure, recipe, *numbers, one.said), strict=True)))
    return rows


def _write_csv(path: Path, columns: tuple[str, ...], rows: list[dict[str, Any]]) -> None:
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(rows)
