"""Reporters: what TensorBoard's own reader finds in the files, and what W&B is sent. No training: the rows are made up."""

import dataclasses
import json
import os
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest

import hindrl_jax as hindrl
from hindrl_jax.base import extras
from hindrl_jax.config import TrainConfig
from hindrl_jax.runs import writer as runs
from hindrl_jax.training.result import Result, Row, SeedSummary
from hindrl_jax.training.selection import Returned

ENV = hindrl.make("FixedGridPickAndPlace")
CONFIG = TrainConfig()
RETURNED = ("noise", "success", "length", "env_steps", "updates", "seconds")


def row(seed, steps, success, *, algo="hindrl"):
    env_steps = 0 if algo == "bc" else steps
    loss = {"critic/loss": 10.0 * seed + success}
    return Row(seed=seed, env_steps=env_steps, updates=steps // 10, seconds=steps / 4, success=success, episode_length=9.0, metrics=loss)


def result(rows, seeds=(3, 4), *, final=None, config=CONFIG):
    return Result(
        env=ENV,
        configs=(config,) * len(seeds),
        seeds=tuple(seeds),
        guidance=None,
        state=None,
        kept=None,
        rows=rows,
        compile_seconds=1.0,
        final_success=final and np.array(final),
        final_length=final and np.full(len(final), 42.0),
        evaluation_steps=final and np.full(len(final), 900),
        returned=final and Returned(actor=None, **{name: np.array(final) for name in RETURNED}),
    )


ROWS = [row(3, 100, 0.25), row(4, 100, 0.75), row(3, 200, 0.5), row(4, 200, 1.0)]


def read(folder):
    """Tag -> [(step, value)], as TensorBoard reads it."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(folder)).Reload()
    return {tag: [(event.step, event.value) for event in events.Scalars(tag)] for tag in events.Tags()["scalars"]}


def test_tensorboard_reads_each_seed_and_their_mean(tmp_path):
    report = hindrl.TensorBoardReporter(tmp_path)
    report(result([]))
    report(result(ROWS[:2]))
    # A run that is killed here has lost nothing.
    assert read(tmp_path / "tensorboard" / "seed_3")["evaluation/success"] == [(100, 0.25)]
    report(result(ROWS[:2]))  # between two evaluations
    report(result(ROWS))
    report(result(ROWS, final=[0.5, 0.75]))
    assert sorted(path.name for path in (tmp_path / "tensorboard").iterdir()) == ["mean", "seed_3", "seed_4"]
    assert read(tmp_path / "tensorboard" / "seed_4") == {
        "evaluation/success": [(100, 0.75), (200, 1.0)],
        "evaluation/episode_length": [(100, 9.0), (200, 9.0)],
        "critic/loss": [(100, 40.75), (200, 41.0)],
        "time/seconds": [(100, 25.0), (200, 50.0)],
        "time/updates": [(100, 10.0), (200, 20.0)],
        "returned/success": [(200, 0.75)],
        "returned/episode_length": [(200, 0.75)],
        "final/success": [(200, 0.75)],
        "final/episode_length": [(200, 42.0)],
    }
    mean = read(tmp_path / "tensorboard" / "mean")
    assert mean["evaluation/success"] == [(100, 0.5), (200, 0.75)]
    assert mean["critic/loss"] == [(100, 35.5), (200, 35.75)]  # (30.25 + 40.75) / 2, (30.5 + 41) / 2
    assert mean["final/success"] == [(200, 0.625)]


@pytest.mark.parametrize("seeds", [(3, 4), (3,)])
def test_a_reporter_starts_again_after_a_run_that_was_interrupted(tmp_path, seeds):
    report = hindrl.TensorBoardReporter(tmp_path)
    report(result(ROWS))
    again = [row for row in ROWS[:2] if row.seed in seeds]
    report(result(again, seeds))
    assert read(tmp_path / "tensorboard" / "seed_3")["evaluation/success"] == [(100, 0.25)]
    report(result(again, seeds, final=[0.5] * len(seeds)))
    assert read(tmp_path / "tensorboard" / "seed_3")["final/success"] == [(100, 0.5)]


def test_tensorboard_counts_the_updates_of_bc_and_needs_no_mean_of_one_seed(tmp_path):
    config = dataclasses.replace(CONFIG, algo="bc")
    hindrl.TensorBoardReporter(tmp_path)(result([row(3, 100, 0.25, algo="bc")], [3], config=config, final=[0.5]))
    assert [path.name for path in (tmp_path / "tensorboard").iterdir()] == ["seed_3"]
    assert read(tmp_path / "tensorboard" / "seed_3")["evaluation/success"] == [(10, 0.25)]


def test_a_new_run_replaces_the_events_of_an_earlier_one_and_no_others(tmp_path):
    hindrl.TensorBoardReporter(tmp_path)(result(ROWS, final=[0.5, 0.75]))
    foreign = tmp_path / "tensorboard" / "seed_4" / "events.out.tfevents.1.host"
    foreign.touch()
    report = hindrl.TensorBoardReporter(tmp_path)
    for _ in range(2):  # also by the same reporter
        report(result([row(3, 300, 0.125)], [3], final=[0.5]))
    assert sorted(path.name for path in (tmp_path / "tensorboard").iterdir()) == ["seed_3", "seed_4"]
    assert list((tmp_path / "tensorboard" / "seed_4").iterdir()) == [foreign]
    assert read(tmp_path / "tensorboard" / "seed_3")["evaluation/success"] == [(300, 0.125)]


def test_a_place_that_cannot_be_written_is_one_line(tmp_path):
    (tmp_path / "tensorboard").write_text("mine")
    with pytest.raises(hindrl.UserError, match=r"cannot write .*tensorboard"):
        hindrl.TensorBoardReporter(tmp_path)(result(ROWS[:2]))
    mixed = result([])
    mixed.configs = (CONFIG, dataclasses.replace(CONFIG, steps=7))
    with pytest.raises(hindrl.UserError, match="one config"):
        hindrl.TensorBoardReporter(tmp_path)(mixed)


@pytest.mark.parametrize(("flag", "module"), [("--tensorboard", "tensorboard.summary.writer.event_file_writer"), ("--wandb", "wandb.sdk")])
def test_a_missing_package_is_refused_before_anything_is_written(flag, module, tmp_path, monkeypatch, capsys):
    from hindrl_jax import cli

    package = module.partition(".")[0]
    for name in (package, module):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(SystemExit) as stop:
        cli.main(["train", flag, "--steps", "1", "--out", str(tmp_path / "run")])
    assert stop.value.code == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err == f"hindrl: {package} is not installed: run `{sys.executable} -m pip install {package}`, or go without {flag}\n"
    assert not (tmp_path / "run").exists()


def test_a_folder_of_that_name_is_not_the_package(tmp_path, monkeypatch):
    (tmp_path / "some_extra").mkdir()
    (tmp_path / "broken_extra").mkdir()
    (tmp_path / "broken_extra" / "writer.py").write_text("import what_it_needs")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(hindrl.UserError, match="some_extra is not installed"):
        extras.require("some_extra.writer", "go without")
    with pytest.raises(hindrl.UserError, match=r"broken_extra cannot be imported .*what_it_needs.*, or go without"):
        extras.require("broken_extra.writer", "go without")


class FakeRun:
    def __init__(self, arguments):
        self.arguments, self.logged, self.finished, self.metrics = arguments, [], False, []

    def define_metric(self, name, step_metric=None):
        self.metrics.append((name, step_metric))

    def log(self, values):
        self.logged.append(values)

    def finish(self):
        self.finished = True


@pytest.fixture
def wandb(monkeypatch):
    """What of the package is used, writing down what it is sent."""
    fake = SimpleNamespace(runs=[], mode="online", account=True, errors=SimpleNamespace(Error=RuntimeError), Settings=dict)

    def init(**arguments):
        if fake.account is None:
            raise RuntimeError("no\nnetwork")
        fake.runs.append(FakeRun(arguments))
        return fake.runs[-1]

    fake.init, fake.login = init, lambda *, prompt: fake.account and not prompt
    fake.setup = lambda: SimpleNamespace(settings=SimpleNamespace(mode=fake.mode))
    monkeypatch.setitem(sys.modules, "wandb", fake)
    monkeypatch.setitem(sys.modules, "wandb.sdk", SimpleNamespace())
    for name in ("WANDB_PROJECT", "WANDB_DIR"):
        monkeypatch.delenv(name, raising=False)
    return fake


def test_wandb_gets_a_run_for_each_seed(wandb, tmp_path):
    report = hindrl.WandbReporter(tmp_path / "mine")
    assert not wandb.runs
    report(result([]))
    report(result(ROWS, final=[0.5, 0.75]))
    assert [run.arguments["name"] for run in wandb.runs] == ["mine/seed_3", "mine/seed_4"]
    for seed, run in zip((3, 4), wandb.runs, strict=True):
        assert (run.arguments["group"], run.arguments["project"], run.arguments["dir"]) == ("mine", "hindrl_jax", tmp_path / "mine")
        assert (run.arguments["config"]["seed"], run.arguments["config"]["env"]) == (seed, "FixedGridPickAndPlace")
        assert run.arguments["config"]["config"]["algo"] == "hindrl"
        assert run.metrics == [("steps", None), ("*", "steps")]
        assert run.finished
    assert [(values["steps"], values.get("evaluation/success"), values.get("critic/loss")) for values in wandb.runs[1].logged] == [
        (100, 0.75, 40.75),
        (200, 1.0, 41.0),
        (200, None, None),
    ]
    assert wandb.runs[1].logged[-1]["final/success"] == 0.75


def test_wandb_without_an_account_or_network_is_one_line(wandb, tmp_path, monkeypatch):
    wandb.account = False
    with pytest.raises(hindrl.UserError, match="knows no account here: log in"):
        hindrl.WandbReporter(tmp_path)
    wandb.mode = "offline"
    report = hindrl.WandbReporter(tmp_path)
    wandb.account = None
    with pytest.raises(hindrl.UserError, match=r"does not start \(no network\)"):
        report(result([]))
    wandb.mode, wandb.account = "disabled", True
    monkeypatch.setenv("WANDB_PROJECT", "theirs")
    hindrl.WandbReporter(tmp_path / "nothing")(result([]))
    assert wandb.runs[0].arguments["project"] == "theirs"
    assert not (tmp_path / "nothing").exists()


def test_the_writer_of_a_run_tells_its_reporters(tmp_path):
    told = []

    class Reporter(hindrl.TensorBoardReporter):
        def _open(self, spec):
            assert not (tmp_path / "config.json").exists()  # a reporter that cannot start leaves nothing half-written
            told.append(("start", spec.seeds))

        def _write(self, seconds, steps, values):
            told.append((steps, [seed.get("evaluation/success", seed.get("final/success")) for seed in values]))

        def _close(self):
            told.append("close")

    spec = runs.RunSpec(env=ENV, config=CONFIG, demos="1", seeds=(3, 4))
    writer = runs.RunWriter(tmp_path, spec, overwrite=False, reporters=[Reporter])
    assert not told
    writer.start()
    writer.report(ROWS[:2])
    writer.report(ROWS)
    (reporter,) = writer.reporters
    summary = dict(env_steps_to_95=None, updates_to_95=None, seconds_to_95=None, episode_length=1.0)
    counted = ("returned", "evaluation", "cloned", "practi", "network")
    summary |= {field.name: 0 for field in dataclasses.fields(SeedSummary) if field.name.startswith(counted)}
    reporter.finish([SeedSummary(seed=seed, final_success=0.5, **summary) for seed in (3, 4)])
    assert told == [("start", (3, 4)), (100, [0.25, 0.75]), (200, [0.5, 1.0]), (200, [0.5, 0.5]), "close"]
    assert (tmp_path / "metrics.csv").read_text().count("\n") == 5


@pytest.mark.slow
def test_wandb_offline_for_real(tmp_path):
    """The real package, in a process of its own, since it leaves a service behind; without an account or network."""
    pytest.importorskip("wandb")
    out = tmp_path / "run"
    command = [sys.executable, "-m", "hindrl_jax", "train", "--algo", "bc", "--steps", "200", "--eval-every", "100", "--seeds", "2", "--wandb"]
    ran = subprocess.run([*command, "--out", str(out)], env=os.environ | {"WANDB_MODE": "offline"}, capture_output=True, text=True, timeout=300)
    assert (ran.returncode, ran.stderr) == (0, "")
    assert len(list((out / "wandb").glob("offline-run-*/run-*.wandb"))) == 2
    assert json.loads((out / "config.json").read_text())["seeds"] == [0, 1]
