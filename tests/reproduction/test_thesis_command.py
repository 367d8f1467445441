"""`hindrl reproduce table-5.1` and the like, with small tasks and short runs in place of the real ones."""

import csv
import dataclasses
import json
import shutil

import pytest
from commands import refusal
from made_up_runs import write_run

from hindrl_jax import cli
from hindrl_jax.cli import reproduction
from hindrl_jax.reproduction import cells, scales, thesis
from hindrl_jax.reproduction.cells import Task
from hindrl_jax.reproduction.scales import Scale
from hindrl_jax.training.evaluating import Diverged

SMALL = Task("FixedGridPickAndPlace", (("num_objects", 1), ("size", 4), ("random_box_size", 1), ("horizon", 20)), 1)
NETWORK = (("agent.net_arch", (4,)), ("eval_every", 20), ("eval_episodes", 100))
RUN = (("steps", 80), ("num_envs", 2), ("updates_per_iteration", 1), ("learning_starts", 40), ("buffer_size", 200), ("batch.batch_size", 8))
# As in test_ablation.py, so that programs are shared.
SHARED = (("agent.num_quantiles", 3), ("agent.top_quantiles_to_drop_per_net", 1), ("batch.n_step", 2))
TINY = Scale(
    "Everything.",
    seeds={"default": 2, "thesis": 2, "original": 2},
    cloning=(("steps", 40), ("batch.batch_size", 8), *NETWORK),
    ours=(*RUN, *NETWORK, *SHARED),
    theirs=(*RUN, *NETWORK, ("batch.reach_zero", None)),
)


@pytest.fixture(scope="module", autouse=True)
def tiny():
    """One small task in place of the fixed grid's three."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(cli.COMMANDS, "reproduce", reproduction.COMMANDS)
        patch.setitem(scales.SCALES, "quick", TINY)
        for name in ("fixed-5", "fixed-2", "fixed-1"):
            patch.setitem(thesis.TASKS, name, dataclasses.replace(SMALL, num_demos=int(name[-1])))
        yield


def run(out, *arguments, name="figure-5.2"):
    cli.main(["reproduce", name, "--out", str(out), *arguments])


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """Figure 5.2: TQCfD and HinDRL on the fixed grid."""
    out = tmp_path_factory.mktemp("thesis") / "out"
    run(out)
    return out


def metrics_of(folder):
    """What was measured, but for times."""
    rows = list(csv.DictReader((folder / "metrics.csv").read_text().splitlines()))
    return [{name: value for name, value in row.items() if name != "seconds"} for row in rows]


def test_it_trains_each_cell_and_reports(finished):
    assert sorted(str(path.relative_to(finished)) for path in finished.glob("cells/*/*/*/*")) == [
        "cells/quick/default/fixed-1/hindrl",
        "cells/quick/default/fixed-1/tqcfd",
    ]
    assert sorted(path.name for path in finished.glob("*.*")) == [
        *("cells.csv", "claims.csv", "figure-5.2-default.png"),
        *("pairs.csv", "profiles-default.png", "report.md"),
    ]
    assert "Finished cells: 2." in (finished / "report.md").read_text()
    assert len(list(csv.DictReader((finished / "cells.csv").read_text().splitlines()))) == 4


def test_it_says_how_long_it_will_take_and_keeps_what_is_finished(finished, capsys, monkeypatch):
    monkeypatch.setattr(reproduction, "num_cores", lambda: 2)
    before = {path: path.stat().st_mtime_ns for path in finished.glob("cells/**/*.*")}
    capsys.readouterr()
    run(finished)
    printed = capsys.readouterr().out
    assert "quick: Everything." in printed
    assert "0 cells to train, 2 finished before; about 0 min on 2 cores" in printed
    assert {path: path.stat().st_mtime_ns for path in finished.glob("cells/**/*.*")} == before


def test_tables_share_cells_with_figures(finished, capsys, monkeypatch):
    trained = []
    monkeypatch.setattr(reproduction, "_train_all", lambda to_train, say, *, weight: trained.extend(to_train))
    run(finished, name="table-5.2")
    assert [(cell.task, cell.name) for cell in trained] == [
        *((f"fixed-{number}", algo) for number in (5, 2) for algo in ("bc", "tqcfd", "hindrl")),
        ("fixed-1", "bc"),
    ]


def test_cells_of_another_machine_are_taken_as_they_are(finished, tmp_path, capsys):
    shutil.copytree(finished / "cells" / "quick" / "default" / "fixed-1", tmp_path / "cells" / "quick" / "default" / "fixed-1")
    capsys.readouterr()
    run(tmp_path)
    assert "0 cells to train, 2 finished before" in capsys.readouterr().out
    assert (tmp_path / "claims.csv").read_text() == (finished / "claims.csv").read_text()


class Killed(BaseException):
    """As if the process ended here: nothing in the project catches it."""


def test_a_cell_that_was_killed_goes_on_at_its_checkpoint_and_ends_as_if_it_had_not_been(finished, tmp_path, monkeypatch):
    whole = finished / "cells" / "quick" / "default" / "fixed-1" / "hindrl"
    monkeypatch.setattr(cells, "SECONDS_BETWEEN_CHECKPOINTS", 0.0)
    folder = tmp_path / "hindrl"
    settings = (thesis.Setting("fixed-1", "hindrl"),)
    (cell,) = scales.cells_of(finished, settings, recipe="default", scale="quick").values()
    cell = dataclasses.replace(cell, path=folder)
    seen = []

    def kill(result):
        seen.append(result.steps_done)
        if result.steps_done >= 60:
            raise Killed

    with pytest.raises(Killed):
        cells.train(cell, report=kill)
    assert list((folder / "checkpoint").glob("*"))
    assert not cells.is_finished(cell)
    (folder / ".lock").unlink(missing_ok=True)  # which the end of a process releases
    with (folder / "metrics.csv").open("a") as file:
        file.write("half a li")
    went_on = []
    cells.train(cell, report=lambda result: went_on.append(result.steps_done))
    assert went_on[0] == seen[-1]
    assert cells.is_finished(cell)
    assert not (folder / "checkpoint").exists()
    assert metrics_of(folder) == metrics_of(whole)
    successes = [[seed["returned_success"] for seed in json.loads((path / "summary.json").read_text())["seeds"]] for path in (folder, whole)]
    assert successes[0] == successes[1]


def test_a_cell_that_diverges_is_left_out_and_the_others_are_trained(tmp_path, capsys, monkeypatch):
    def train(cell, *, report):
        if cell.name == "tqcfd":
            raise Diverged("critic/loss of seed 5000 is nan")
        write_run(cell, [[1.0, 1.0]], returned=[1.0, 1.0])

    monkeypatch.setattr(cells, "train", train)
    run(tmp_path)
    printed = capsys.readouterr().out
    assert "fixed-1 tqcfd: left out: critic/loss of seed 5000 is nan   " in printed
    assert "s of CPU   1 left" in printed
    assert "Finished cells: 1." in (tmp_path / "report.md").read_text()


def test_the_report_alone_trains_nothing(tmp_path, capsys):
    run(tmp_path / "out", "--report-only")
    assert not (tmp_path / "out" / "cells").exists()
    assert "wrote" in capsys.readouterr().out


@pytest.mark.slow  # compiles another agent, 20 s
def test_the_original_can_be_trained(tmp_path):
    run(tmp_path, "--recipe", "original")
    assert len(list(tmp_path.glob("cells/quick/original/fixed-1/*/summary.json"))) == 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["table-5.4"], "'table-5.4' is not a command of 'hindrl reproduce' (did you mean 'table-5.2'?)"),
        (["figure-5.2", "--recipe", "ours"], "--recipe ours is not usable: choose one of default, "),
        (["figure-5.2", "--scale", "huge"], "--scale huge is not usable: choose one of quick, "),
        (["figure-5.2", "--seeds", "0"], "--seeds 0 is too few"),
        (["figure-5.2", "--seed", "-1"], "--seed -1 is not usable"),
    ],
)
def test_bad_input_is_one_line_and_writes_nothing(arguments, message, tmp_path, capsys):
    said = refusal(capsys, "reproduce", *arguments, "--out", tmp_path / "out")
    assert message.split(" (did")[0] in said
    assert not (tmp_path / "out").exists()


def test_runs_of_other_options_are_refused(finished, capsys):
    for other in (("--seeds", "3"), ("--seed", "9")):
        said = refusal(capsys, "reproduce", "figure-5.2", *other, "--out", finished)
        assert "holds a run of other options (seeds): choose another --out" in said
