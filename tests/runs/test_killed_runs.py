"""The command, killed and resumed: processes that are ended by signals, and what comes of them afterwards."""

import json
import re
import shlex
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from commands import refusal

import hindrl_jax as hindrl
from hindrl_jax import cli
from hindrl_jax.training.progress import ProgressBar

pytestmark = [
    pytest.mark.usefixtures("unfinished_tasks_end_with_their_test"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]

TRAIN = shlex.split(
    "--env FixedGridPickAndPlace --size 4 --random-box-size 1 --horizon 20 --num-envs 2 --learning-starts 40 --eval-episodes 4 --seeds 2 "
    "--updates-per-iteration 1 --batch-size 8 --net-arch 4 --num-quantiles 3 --top-quantiles-to-drop-per-net 1 --buffer-size 2000 "
    "--imitation-steps 0"
)


def start(*arguments):
    command = [sys.executable, "-c", "from hindrl_jax.cli import main; main()", "train", *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def run(*arguments):
    process = start(*arguments)
    printed, _ = process.communicate()
    assert process.returncode == 0, printed
    return printed


def parameters(path):
    with np.load(path / "parameters.npz") as archive:
        return {name: archive[name] for name in archive.files}


def assert_same_run(path, expected):
    found, wanted = parameters(path), parameters(expected)
    assert found.keys() == wanted.keys()
    for name in wanted:
        np.testing.assert_array_equal(found[name], wanted[name], err_msg=name)
    rows = [[line.split(",") for line in (p / "metrics.csv").read_text().splitlines()] for p in (path, expected)]
    seconds = rows[0][0].index("seconds")
    assert [row[:seconds] + row[seconds + 1 :] for row in rows[0]] == [row[:seconds] + row[seconds + 1 :] for row in rows[1]]
    assert not (path / "checkpoint").exists()


def test_sigterm_ends_a_run_that_can_be_resumed(tmp_path, capsys):
    steps = ("--steps", 100_000, "--eval-every", 4_000)
    stopped = start(*TRAIN, *steps, "--out", tmp_path / "run")
    metrics = tmp_path / "run" / "metrics.csv"
    while not metrics.exists():
        assert stopped.poll() is None, stopped.communicate()
        time.sleep(0.05)
    assert "another process is writing" in refusal(capsys, "train", "--resume", tmp_path / "run")
    stopped.send_signal(signal.SIGTERM)
    printed, _ = stopped.communicate()
    assert stopped.returncode == 128 + signal.SIGTERM, printed
    assert f"go on with `hindrl train --resume {tmp_path / 'run'}`" in printed
    (folder,) = (path for path in (tmp_path / "run" / "checkpoint").iterdir() if path.is_dir())
    # The end would take a while, so the run is made to end soon after; the whole one is not wanted here but in the test of kills.
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    config["config"]["steps"] = int(folder.name) + 1_000
    (tmp_path / "run" / "config.json").write_text(json.dumps(config))
    printed = run("--resume", tmp_path / "run")
    assert f"going on at step {int(folder.name):,}" in printed
    assert hindrl.load_run(tmp_path / "run").spec.seeds == (0, 1)


def test_a_sweep_that_was_stopped_is_resumed(tmp_path, monkeypatch):
    """In process: SIGTERM as soon as there is an evaluation; the whole sweep is trained beside it."""
    arguments = ["sweep", "--over", "learning_rate=1e-3,2e-3", *TRAIN, "--steps", "120", "--eval-every", "20", "--out"]
    cli.main([*arguments, str(tmp_path / "whole")])
    out = tmp_path / "sweep"
    show = ProgressBar.__call__

    def show_and_stop(bar, result):
        show(bar, result)
        if result.rows:
            signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(ProgressBar, "__call__", show_and_stop)
    with pytest.raises(SystemExit) as stop:
        cli.main([*arguments, str(out)])
    assert stop.value.code == 128 + signal.SIGTERM
    assert not (out / "sweep.csv").exists()
    monkeypatch.undo()
    cli.main(["sweep", "--resume", str(out)])
    for folder in ("learning_rate=0.001", "learning_rate=0.002"):
        assert_same_run(out / folder, tmp_path / "whole" / folder)
    assert (out / "sweep.csv").read_text() == (tmp_path / "whole" / "sweep.csv").read_text()
    assert not (out / "checkpoint").exists()
    with pytest.raises(SystemExit):  # it is finished
        cli.main(["sweep", "--resume", str(out)])


@pytest.mark.slow
def test_twenty_runs_killed_at_random_moments_end_as_if_they_never_were(tmp_path):
    """Half of them at any moment between start and end, most of which is compilation, and half of them while they learn."""
    train = (*TRAIN, "--steps", 6_000, "--eval-every", 2_000)
    run(*train, "--out", tmp_path / "first")  # fills the cache of compiled programs, so that the next one takes as long as those after it
    started = time.perf_counter()
    run(*train, "--out", tmp_path / "whole", "--checkpoint-every", 0.001)
    duration, random = time.perf_counter() - started, np.random.default_rng(0)
    learning = json.loads((tmp_path / "whole" / "summary.json").read_text())["train_seconds"]
    came_back = []
    for index in range(20):
        out = tmp_path / f"{index} [0] 100%s {{a}}"
        killed = start(*train, "--out", out, "--checkpoint-every", 0.001)
        if index % 2:
            while not (out / "config.json").exists():  # it is written when learning begins
                assert killed.poll() is None, killed.communicate()
                time.sleep(0.01)
        time.sleep(random.uniform(0.0, learning if index % 2 else duration))
        killed.kill()
        killed.communicate()
        if not (out / "config.json").exists():  # before anything was written there is nothing to resume
            run(*train, "--out", out)
        elif (out / "checkpoint").exists() or not (out / "summary.json").exists():
            came_back += re.findall(r"going on at step ([\d,]+)", run("--resume", out))
        assert_same_run(out, tmp_path / "whole")
    assert len(came_back) >= 5
    assert len(set(came_back)) >= 4  # at different moments
    print(f"20 of 20 are equal, {len(came_back)} of them resumed, at steps {', '.join(came_back)}")
