"""Going on after a stop: bit for bit, from complete checkpoints only, and never at the cost of the last good one."""

import contextlib
import dataclasses
import gc
import json
import resource
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import time
from types import SimpleNamespace

import jax
import numpy as np
import pytest
import tiny
from jax.experimental.compilation_cache import compilation_cache
from tiny import ENV

import hindrl_jax as hindrl
from hindrl_jax import cli
from hindrl_jax.reporting.progress import ProgressBar
from hindrl_jax.runs.checkpoints import Checkpoints
from hindrl_jax.runs.spec import RunSpec
from hindrl_jax.runs.writer import RunWriter
from hindrl_jax.training import devices, experiment

CONFIG = dataclasses.replace(tiny.CONFIG, steps=84)
CLONING = dataclasses.replace(CONFIG, algo="bc", steps=60)
SEEDS = (3, 4)

pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # Orbax drops its other tasks when one fails


class Killed(Exception):
    pass


@pytest.fixture(scope="module", autouse=True)
def compile_once(tmp_path_factory):
    """The same few programs are needed again and again."""
    changed = {
        "jax_compilation_cache_dir": str(tmp_path_factory.mktemp("compiled")),
        "jax_persistent_cache_min_compile_time_secs": 0.0,
        "jax_persistent_cache_min_entry_size_bytes": 0,
    }
    before = {name: getattr(jax.config, name) for name in changed}
    for name, value in changed.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()
    yield
    for name, value in before.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()


@pytest.fixture(autouse=True)
def unfinished_tasks_end_with_their_test():
    yield
    gc.collect()


@pytest.fixture(scope="module")
def demonstrations():
    return hindrl.record_demonstrations(ENV, 2)


def fit(demonstrations, config=CONFIG, *, checkpoints=None, kill_at=None):
    """Trains; with checkpoints, goes on from the newest; is killed before anything of the `kill_at`-th report is saved."""
    reports = 0

    def report(result):
        nonlocal reports
        reports += 1
        if reports == kill_at:
            raise Killed
        if checkpoints is not None:
            checkpoints.save_when_due(result)

    restore = {} if checkpoints is None else {"restore": checkpoints.restore}
    return hindrl.fit(ENV, demonstrations, config, seeds=SEEDS, report=report, **restore)


@pytest.fixture(scope="module")
def begun(demonstrations):
    """What `fit` hands to `restore`."""
    given = []

    def restore(begun):
        given.append(begun)
        raise Killed

    with pytest.raises(Killed):
        hindrl.fit(ENV, demonstrations, CONFIG, seeds=SEEDS, restore=restore)
    return given[0]


@pytest.fixture(scope="module")
def stopped_run(tmp_path_factory, demonstrations):
    folder = tmp_path_factory.mktemp("stopped")
    with pytest.raises(Killed):
        fit(demonstrations, checkpoints=Checkpoints(folder, seconds=0), kill_at=4)
    return folder


@pytest.fixture
def stopped(stopped_run, tmp_path):
    """The folder of checkpoints of an experiment that was killed, in which one is complete."""
    return shutil.copytree(stopped_run, tmp_path / "stopped")


def outcome(result):
    """What came of a run, but for times."""
    return result.final_success, result.evaluation_steps, result.kept.replace(seconds=0.0), result.returned.replace(seconds=0.0)


def assert_same(result, expected):
    leaves, expected_leaves = (jax.tree.leaves_with_path((r.guidance, r.state, r.key)) for r in (result, expected))
    for (path, leaf), (_, other) in zip(leaves, expected_leaves, strict=True):
        assert leaf.dtype == other.dtype, jax.tree_util.keystr(path)
        assert leaf.sharding.is_equivalent_to(other.sharding, leaf.ndim), jax.tree_util.keystr(path)
        if jax.numpy.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            leaf, other = jax.random.key_data(leaf), jax.random.key_data(other)
        np.testing.assert_array_equal(leaf, other, err_msg=jax.tree_util.keystr(path))
    jax.tree.map(np.testing.assert_array_equal, *(outcome(r) for r in (result, expected)))
    assert [dataclasses.replace(row, seconds=0.0) for row in result.rows] == [dataclasses.replace(row, seconds=0.0) for row in expected.rows]


@pytest.mark.parametrize("config", [CONFIG, CLONING], ids=["hindrl", "bc"])
def test_a_run_killed_again_and_again_ends_as_if_it_never_was(tmp_path, demonstrations, config):
    # Reports: 1 is before anything happened, then one for each chunk of 2 steps, so there are evaluations between and right before the kills.
    for at in (4, 12):
        with pytest.raises(Killed):
            fit(demonstrations, config, checkpoints=Checkpoints(tmp_path, seconds=0), kill_at=at)
    checkpoints = Checkpoints(tmp_path, seconds=0)
    resumed = fit(demonstrations, config, checkpoints=checkpoints)
    assert_same(resumed, fit(demonstrations, config))
    assert [path.name for path in tmp_path.iterdir()] == [str(checkpoints.steps)]  # only the newest is kept
    assert 0 < resumed.rows[0].seconds < resumed.rows[-1].seconds <= resumed.train_seconds


def test_half_a_checkpoint_is_never_read(stopped, begun):
    (complete,) = stopped.iterdir()
    partial = stopped / "1000.orbax-checkpoint-tmp"  # as Orbax names what it has not finished
    shutil.copytree(complete, partial)
    assert Checkpoints(stopped).restore(begun).steps_done == int(complete.name)
    shutil.rmtree(complete)
    assert Checkpoints(stopped).restore(begun) is None


@pytest.mark.parametrize("victim", ["arrays/manifest.ocdbt", "progress/metadata", "arrays/_METADATA"])
def test_a_damaged_checkpoint_is_one_line(stopped, begun, victim):
    (complete,) = stopped.iterdir()
    (complete / victim).write_bytes(b"\0damaged")
    with pytest.raises(hindrl.UserError, match=r"is damaged .*: remove it to begin again"):
        Checkpoints(stopped).restore(begun)


def test_what_answers_after_a_damaged_checkpoint_was_given_up_is_not_reported(stopped, begun, monkeypatch):
    reported, late, another = [], *(SimpleNamespace(exc_value=RuntimeError(said)) for said in ("Event loop is closed", "something else"))
    monkeypatch.setattr(sys, "unraisablehook", reported.append)
    (complete,) = stopped.iterdir()
    assert Checkpoints(stopped).restore(begun) is not None
    assert sys.unraisablehook == reported.append
    (complete / "arrays" / "manifest.ocdbt").write_bytes(b"damaged")
    with pytest.raises(hindrl.UserError):
        Checkpoints(stopped).restore(begun)
    sys.unraisablehook(late)
    sys.unraisablehook(another)
    assert reported == [another]


def test_another_experiment_is_refused_by_the_array_that_differs(stopped, begun):
    bias = begun.state.replace(env_steps=jax.ShapeDtypeStruct((5,), np.int32, sharding=begun.state.env_steps.sharding))
    with pytest.raises(hindrl.UserError, match=r"int32\[2\] as state.env_steps, and int32\[5\] is needed"):
        Checkpoints(stopped).restore(dataclasses.replace(begun, state=bias))
    with pytest.raises(hindrl.UserError, match=r"holds key.* as key, and nothing is needed|holds uint32\[2,2\] as key, and nothing is needed"):
        Checkpoints(stopped).restore(dataclasses.replace(begun, key=None))


def test_another_layout_is_refused(stopped, begun, monkeypatch):
    monkeypatch.setattr("hindrl_jax.runs.checkpoints.LAYOUT", 4)
    with pytest.raises(hindrl.UserError, match="has layout 3, and this version of hindrl_jax reads 4"):
        Checkpoints(stopped).restore(begun)


def test_a_full_disk_leaves_the_checkpoint_before(stopped, begun):
    checkpoints = Checkpoints(stopped)
    result = checkpoints.restore(begun)
    before, steps = resource.getrlimit(resource.RLIMIT_FSIZE), result.env_steps
    result.env_steps += 2
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (1_000, before[1]))  # no file may grow beyond 1,000 bytes
        with pytest.raises(hindrl.UserError, match=f"cannot write a checkpoint to .*free some space; the checkpoint of step {steps} is intact"):
            checkpoints.save(result)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert [path.name for path in stopped.iterdir()] == [str(steps)]
    assert Checkpoints(stopped).restore(begun).env_steps == steps
    checkpoints.save(result)
    assert Checkpoints(stopped).restore(begun).env_steps == steps + 2


def test_a_folder_is_removed_although_a_thread_still_writes_into_it(stopped, begun):
    """As those of the library do for a moment after they failed."""
    late = stopped / "unfinished"
    late.mkdir()

    checkpoints = Checkpoints(stopped)
    result = checkpoints.restore(begun)
    result.env_steps += 2
    until = time.monotonic() + 3

    def write():
        while time.monotonic() < until:
            with contextlib.suppress(FileNotFoundError):
                (late / str(time.monotonic_ns())).write_bytes(b"late")

    writer = threading.Thread(target=write)
    writer.start()
    checkpoints.save(result)
    writer.join()
    assert [path.name for path in stopped.iterdir()] == [str(result.env_steps)]


def test_nothing_is_saved_of_what_is_not_worth_it(stopped, begun):
    checkpoints = Checkpoints(stopped)
    result = checkpoints.restore(begun)
    steps = result.env_steps
    result.env_steps += 2
    spoilt = jax.tree.map(lambda leaf: leaf * np.nan, result.state.agent.actor)
    checkpoints.save(dataclasses.replace(result, state=result.state.replace(agent=result.state.agent.replace(actor=spoilt))))
    checkpoints.save(dataclasses.replace(result, final_success=np.ones(2)))
    assert Checkpoints(stopped).restore(begun).env_steps == steps
    Checkpoints(stopped, seconds=1_000).save_when_due(result)
    assert Checkpoints(stopped).restore(begun).env_steps == steps


def test_demonstrations_are_kept_next_to_the_checkpoints(tmp_path, demonstrations):
    checkpoints = Checkpoints(tmp_path)
    assert not checkpoints.has_demonstrations
    checkpoints.save_demonstrations([demonstrations, demonstrations.replace(rewards=demonstrations.rewards + 1)])
    first, second = Checkpoints(tmp_path).load_demonstrations()
    jax.tree.map(np.testing.assert_array_equal, first, demonstrations)
    np.testing.assert_array_equal(second.rewards, demonstrations.rewards + 1)
    checkpoints.save_demonstrations([demonstrations.replace(states=None)])
    assert checkpoints.load_demonstrations()[0].states is None
    (tmp_path / "demonstrations.npz").write_bytes(b"damaged")
    with pytest.raises(hindrl.UserError, match="is damaged"):
        checkpoints.load_demonstrations()


def test_a_loss_that_is_not_finite_stops_the_run(demonstrations):
    hopeless = dataclasses.replace(CONFIG, agent=dataclasses.replace(CONFIG.agent, learning_rate=1e38))
    with pytest.raises(experiment.Diverged, match=r"of seed 3 is (nan|inf) after \d+ environment steps and \d+ updates: try a lower learning_rate"):
        fit(demonstrations, hopeless)


def test_a_replay_that_does_not_fit_is_refused_before_it_is_made(demonstrations):
    with pytest.raises(hindrl.UserError, match=r"2 runs side by side take [\d,.]+ GiB of memory, 100% of it for the replay.*: lower buffer_size or"):
        fit(demonstrations, dataclasses.replace(CONFIG, buffer_size=2 * 10**9))


def test_memory_is_what_the_container_allows(tmp_path, monkeypatch):
    for name, content in {"memory.max": "1000", "memory.current": "700", "memory.stat": "anon 600\ninactive_file 50\n"}.items():
        (tmp_path / name).write_text(content)
    monkeypatch.setattr(devices, "Path", lambda path: tmp_path)
    assert devices._free_host_memory() == 350
    (tmp_path / "memory.max").write_text("max\n")
    assert devices._free_host_memory() > 10**6


def test_a_directory_is_written_by_one_process_at_a_time(tmp_path):
    spec = RunSpec(env=ENV, config=CONFIG, demos="2", seeds=SEEDS)
    first = RunWriter(tmp_path, spec)
    second = RunWriter(tmp_path, spec)  # both were started before either had written anything
    first.start()
    with pytest.raises(hindrl.UserError, match="another process is writing"):
        second.start()
    with pytest.raises(hindrl.UserError, match="another process is writing"):
        RunWriter(tmp_path, spec, overwrite=True)
    with pytest.raises(hindrl.UserError, match="another process is writing"):
        RunWriter(tmp_path, spec, resume=True)


# ------------------------------------------------------------------------------------------------------------- the command, as a process

TRAIN = shlex.split(
    "--env FixedGridPickAndPlace --size 4 --random-box-size 1 --horizon 20 --num-envs 2 --learning-starts 40 --eval-episodes 4 --seeds 2 "
    "--updates-per-iteration 1 --batch-size 8 --net-arch 4 --num-quantiles 3 --top-quantiles-to-drop-per-net 1 --buffer-size 2000"
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


def test_sigterm_ends_a_run_that_can_be_resumed(tmp_path):
    steps = ("--steps", 100_000, "--eval-every", 4_000)
    stopped = start(*TRAIN, *steps, "--out", tmp_path / "run")
    metrics = tmp_path / "run" / "metrics.csv"
    while not metrics.exists():
        assert stopped.poll() is None, stopped.communicate()
        time.sleep(0.05)
    refused = subprocess.run(
        [sys.executable, "-c", "from hindrl_jax.cli import main; main()", "train", "--resume", tmp_path / "run"], capture_output=True, text=True
    )
    assert (refused.returncode, refused.stderr.count("\n")) == (2, 1)
    assert "another process is writing" in refused.stderr
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
    train = (*TRAIN, "--steps", 6_000, "--eval-every", 2_000)
    run(*train, "--out", tmp_path / "first")  # fills the cache of compiled programs, so that the next one takes as long as those after it
    started = time.perf_counter()
    run(*train, "--out", tmp_path / "whole", "--checkpoint-every", 0.001)
    duration, random = time.perf_counter() - started, np.random.default_rng(0)
    stopped_within = 0
    for index in range(20):
        out = tmp_path / str(index)
        killed = start(*train, "--out", out, "--checkpoint-every", 0.001)
        time.sleep(random.uniform(0.0, duration))
        killed.kill()
        killed.communicate()
        if not (out / "config.json").exists():  # before anything was written there is nothing to resume
            run(*train, "--out", out)
        elif (out / "checkpoint").exists() or not (out / "summary.json").exists():
            stopped_within += "going on" in run("--resume", out)
        assert_same_run(out, tmp_path / "whole")
    assert stopped_within >= 5
