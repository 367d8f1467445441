"""The benchmark of other people's tasks: what it makes of its cells, and that it goes on where it was interrupted."""

import json
import subprocess
import sys

import numpy as np
import pytest

from benchmarks import time_to_solve
from benchmarks.peers import episodes


def cell(learner, seed, *held, num_demos=20, task="FetchPush"):
    points = [{"steps": 1000 * (i + 1), "seconds": 60.0 * (i + 1), "reached": (1 + value) / 2, "held": value} for i, value in enumerate(held)]
    return {"task": task, "learner": learner, "num_demos": num_demos, "seed": seed, "points": points}


def test_the_table_has_a_line_for_each_task_and_learner():
    rows = [cell("sb3", 0, 0.1, 0.2, num_demos=0), cell("hindrl", 1, 0.5, 1.0, 0.9), cell("hindrl", 0, 0.96), cell("hindrl", 0, task="FetchReach")]
    header, _, *lines = time_to_solve.table(rows).splitlines()
    assert "minutes to it, median" in header
    assert lines == [
        "| FetchReach | `hindrl` | 20 | 0/1 |  |  | 0% (0%) | 0% |  |",
        "| FetchPush | `hindrl` | 20 | 2/2 | 1,500 | 1.5 | 98% (96%) | 96% | 1,000 / 1 3,000 / 3 |",
        "| FetchPush | `sb3` | 0 | 0/1 |  |  | 20% (20%) | 60% | 2,000 / 2 |",
    ]


@pytest.mark.parametrize(
    ("held", "seconds", "kept"),
    [
        ([0.1, 0.2], 1000, 2),  # the worker ends by itself
        ([0.96, 0.1, 0.97, 0.95, 1.0], 1000, 4),  # solved twice in a row
        ([0.1, 0.2, 0.3], 125, 2),  # the third comes after two minutes and a bit
    ],
)
def test_a_cell_ends_when_it_is_solved_or_its_time_is_over(held, seconds, kept):
    lines = "\n".join(json.dumps(point) for point in cell("hindrl", 0, *held)["points"])
    with subprocess.Popen([sys.executable, "-c", f"print({lines!r})"], stdout=subprocess.PIPE, text=True) as process:
        points = time_to_solve.read_points(process, seconds)
    assert [point["held"] for point in points] == held[:kept]


def test_cells_that_are_there_are_not_run_again(tmp_path, monkeypatch, capsys):
    ran = []

    def run(cell_, given):
        ran.append(cell_.name)
        return cell(cell_.learner, cell_.seed, 1.0) | time_to_solve.settings(cell_, given)

    monkeypatch.setattr(time_to_solve, "run", run)
    monkeypatch.setattr(time_to_solve, "plot", lambda rows, path: None)
    given = ["--tasks", "FetchPush", "--learners", "hindrl", "sb3", "--out", str(tmp_path), "--peers", str(tmp_path / "none")]
    for seeds in ("1", "2"):
        monkeypatch.setattr(sys, "argv", ["time_to_solve", *given, "--seeds", seeds])
        time_to_solve.main()
    assert ran == ["FetchPush_hindrl_20_0", "FetchPush_hindrl_20_1"]
    assert "FetchPush_sb3_0_0: left out" in capsys.readouterr().out
    assert "2/2" in (tmp_path / "time_to_solve.md").read_text()
    monkeypatch.setattr(sys, "argv", ["time_to_solve", *given, "--seeds", "1", "--minutes", "1"])
    with pytest.raises(SystemExit, match=r"FetchPush_hindrl_20_0\.json was run with --minutes 15\.0, not 1\.0: choose another --out"):
        time_to_solve.main()


@pytest.mark.parametrize(("after", "stopped"), [("time.sleep(60)", True), ("", False), ("sys.exit(3)", None)])
def test_a_worker_that_hangs_is_stopped_and_one_that_fails_ends_the_benchmark(after, stopped, tmp_path, monkeypatch):
    (point,) = cell("sb3", 0, 0.5)["points"]
    worker = tmp_path / "worker.py"
    worker.write_text(f"import sys, time\nprint({json.dumps(point | {'seconds': 0.0})!r}, flush=True)\n{after}\n")
    (tmp_path / "peers").mkdir()
    worker.rename(tmp_path / "peers" / "solve_sb3.py")
    monkeypatch.setattr(time_to_solve, "FOLDER", tmp_path)
    given = time_to_solve.arguments(["--minutes", "0.05", "--out", str(tmp_path), "--peers", sys.executable])
    asked = time_to_solve.Cell("FetchPush", "sb3", 0, 0)
    if stopped is None:
        with pytest.raises(SystemExit, match="FetchPush_sb3_0_0 failed"):
            time_to_solve.run(asked, given)
        return
    row = time_to_solve.run(asked, given)
    assert (row["stopped"], row["points"], row["steps"]) == (stopped, [point | {"seconds": 0.0}], 75_000)


class Counting:
    """Solved at the steps that the seed says, of three."""

    def reset(self, *, seed):
        self.solved, self.step_number = {0: (), 1: (1,), 2: (2, 3)}[seed], 0
        return {}, {}

    def step(self, action):
        self.step_number += 1
        return {}, 0.0, False, self.step_number == 3, {"is_success": self.step_number in self.solved}


def test_an_episode_is_reached_at_any_step_and_held_at_the_last():
    found = episodes.outcomes(lambda observation: np.zeros(1), Counting(), range(3))
    assert found == {"reached": pytest.approx(2 / 3), "held": pytest.approx(1 / 3)}
