"""Outcomes of cells, their tables and their picture: directories written by hand, so that every figure is known."""

import csv
import dataclasses
import json

import numpy as np
import pytest
from PIL import Image
from tiny import CONFIG as TINY
from tiny import ENV

from hindrl_jax.base.errors import UserError
from hindrl_jax.plotting.statistics import Interval
from hindrl_jax.reproduction.cells import Cell
from hindrl_jax.reproduction.outcomes import outcomes_of, success_along
from hindrl_jax.reproduction.picture import save_differences
from hindrl_jax.reproduction.tables import markdown, thousands, write_csv
from hindrl_jax.runs.spec import RunSpec

CONFIG = dataclasses.replace(TINY, steps=80)


def test_success_along_a_run_is_the_area_under_its_evaluations():
    # From 0 to 100 it rises to 0.5: area 25. From 100 to 200 it stays: 50. From 200 to 250 it rises to 1: 37.5. In all 112.5 of 250.
    assert success_along([100, 200, 250], [0.5, 0.5, 1.0]) == pytest.approx(112.5 / 250)


def write_run(cell, *, curves, final, seconds):
    """The files of a finished run, with success `curves` (S, 2) at 40 and 80 steps."""
    cell.path.mkdir(parents=True)
    (cell.path / "config.json").write_text(json.dumps(cell.spec.to_json()))
    rows = ["seed,env_steps,updates,seconds,success"]
    for index, env_steps in enumerate((40, 80)):
        rows += [f"{seed},{env_steps},{env_steps // 4},1.0,{curve[index]}" for seed, curve in zip(cell.spec.seeds, curves, strict=True)]
    (cell.path / "metrics.csv").write_text("\n".join(rows) + "\n")
    seeds = [{"returned_success": value} for value in final]
    (cell.path / "summary.json").write_text(json.dumps({"seeds": seeds, "train_seconds": seconds}))


@pytest.fixture
def by_hand(tmp_path):
    """Cells whose outcomes can be worked out: the baseline, one worse, one better, one that is not there."""
    cells = [
        Cell(task="small", group=group, name=name, path=tmp_path / name, spec=RunSpec(env=ENV, config=CONFIG, demos="1", seeds=(7, 8)))
        for group, name in (("baseline", "default"), ("targets", "worse"), ("critic", "better"), ("critic", "absent"))
    ]
    write_run(cells[0], curves=[(0.4, 0.8), (0.0, 0.96)], final=[0.9, 1.0], seconds=10.0)
    write_run(cells[1], curves=[(0.0, 0.4), (0.0, 0.16)], final=[0.5, 0.5], seconds=30.0)
    write_run(cells[2], curves=[(0.96, 1.0), (1.0, 1.0)], final=[1.0, 1.0], seconds=5.0)
    return cells


def test_outcomes_by_hand(by_hand):
    baseline, worse, better = outcomes_of(by_hand)
    # Along the run, seed by seed: (0.5 * 0.4 * 40 + 0.5 * (0.4 + 0.8) * 40) / 80 = 0.4, and 0.5 * 0.96 * 40 / 80 = 0.24.
    assert baseline.mean_success == Interval(pytest.approx(0.32), pytest.approx(0.24), pytest.approx(0.4))
    assert baseline.difference == Interval(0.0, 0.0, 0.0)
    assert baseline.steps_to_95 == Interval(np.inf, 80.0, np.inf)
    assert (baseline.seeds_reaching_95, baseline.seconds_per_seed, baseline.relative_cost, baseline.verdict()) == (1, 5.0, 1.0, "open")
    # 0.1 and 0.04, so 0.3 and 0.2 less than the baseline's.
    assert worse.difference == Interval(pytest.approx(-0.25), pytest.approx(-0.3), pytest.approx(-0.2))
    assert worse.returned_success == Interval(0.5, 0.5, 0.5)
    assert (worse.seeds_reaching_95, worse.relative_cost, worse.verdict()) == (0, 3.0, "worse")
    assert better.steps_to_95 == Interval(40.0, 40.0, 40.0)
    assert (better.seeds_reaching_95, better.relative_cost, better.verdict()) == (2, 0.5, "better")


def test_without_its_baseline_a_task_has_no_outcomes(by_hand):
    (by_hand[0].path / "summary.json").unlink()
    assert outcomes_of(by_hand) == []


def test_damaged_runs_are_refused(by_hand):
    (by_hand[1].path / "metrics.csv").write_text("seed,env_steps\n7,40\n")
    with pytest.raises(UserError, match="is damaged"):
        outcomes_of(by_hand)


def test_csv_by_hand(by_hand, tmp_path):
    write_csv(tmp_path / "table.csv", outcomes_of(by_hand), row_name="change")
    rows = list(csv.DictReader((tmp_path / "table.csv").read_text().splitlines()))
    assert [(row["task"], row["group"], row["change"], row["seeds_reaching_95"], row["median_steps_to_95"]) for row in rows] == [
        ("small", "baseline", "default", "1", "inf"),
        ("small", "targets", "worse", "0", "inf"),
        ("small", "critic", "better", "2", "40"),
    ]
    assert [rows[1][name] for name in ("difference", "difference_low", "difference_high", "relative_cost")] == ["-0.25", "-0.3", "-0.2", "3"]


def test_markdown_by_hand(by_hand):
    assert markdown(outcomes_of(by_hand), row_name="change", title=lambda task: f"the {task} one") == [
        "## small: the small one",
        "",
        "| change | 95% | steps to 95% | returned | along | difference | s/seed | cost |",
        "|---|---|---|---|---|---|---|---|",
        "| default | 1/2 | >0.08k [0.08k, >0.08k] | 95.0 [90.0, 100.0] | 32.0 [24.0, 40.0] |  | 5.0 | 1.00 |",
        "| *targets* | | | | | | | |",
        "| worse | 0/2 | >0.08k [>0.08k, >0.08k] | 50.0 [50.0, 50.0] | 7.0 [4.0, 10.0] | **-25.0 [-30.0, -20.0]** | 15.0 | 3.00 |",
        "| *critic* | | | | | | | |",
        "| better | 2/2 | 0.04k [0.04k, 0.04k] | 100.0 [100.0, 100.0] | 74.0 [73.0, 75.0] | **+42.0 [+33.0, +51.0]** | 2.5 | 0.50 |",
        "",
    ]


def test_the_picture_has_a_panel_for_each_task(by_hand, tmp_path):
    widths = []
    for number in (1, 2):
        outcomes = [
            dataclasses.replace(outcome, cell=dataclasses.replace(outcome.cell, task=f"task {task}"))
            for task in range(number)
            for outcome in outcomes_of(by_hand)
        ]
        save_differences(outcomes, tmp_path / "differences.png", title="Changes")
        with Image.open(tmp_path / "differences.png") as picture:
            widths.append(picture.size[0])
            assert min(picture.size) > 200
    assert widths[1] > 1.4 * widths[0]


@pytest.mark.parametrize(("steps", "said"), [(62_400.0, "62k"), (9_400.0, "9.4k"), (500.0, "0.5k"), (np.inf, ">300k")])
def test_steps_that_were_not_enough_are_said_to_be_more(steps, said):
    assert thousands(steps, 300_000) == said
