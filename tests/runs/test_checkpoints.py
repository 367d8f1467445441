"""Going on after a stop: bit for bit, from complete checkpoints only, and never at the cost of the last good one."""

import contextlib
import dataclasses
import resource
import shutil
import sys
import threading
import time
from types import SimpleNamespace

import jax
import numpy as np
import pytest
import tiny
from tiny import ENV

import hindrl_jax as hindrl
from hindrl_jax.runs.checkpoints import Checkpoints
from hindrl_jax.runs.spec import RunSpec
from hindrl_jax.runs.writer import RunWriter
from hindrl_jax.training import devices
from hindrl_jax.training.evaluating import Diverged

# Evaluated after every second chunk, with the programs of `tiny`.
CONFIG = dataclasses.replace(tiny.CONFIG, eval_every=4)
CLONING = dataclasses.replace(CONFIG, algo="bc", steps=20)
SEEDS = (3, 4)

pytestmark = [
    pytest.mark.usefixtures("unfinished_tasks_end_with_their_test"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),  # Orbax drops its other tasks when one fails
]


class Killed(Exception):
    pass


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


def assert_ends_as_if_never_killed(folder, demonstrations, config, kill_at):
    """After one more kill, which is at this report."""
    with pytest.raises(Killed):
        fit(demonstrations, config, checkpoints=Checkpoints(folder, seconds=0), kill_at=kill_at)
    checkpoints = Checkpoints(folder, seconds=0)
    resumed = fit(demonstrations, config, checkpoints=checkpoints)
    assert_same(resumed, fit(demonstrations, config))
    (left,) = folder.iterdir()  # only the newest is kept
    assert checkpoints.newest == f"of step {left.name}"
    assert 0 < resumed.rows[0].seconds < resumed.rows[-1].seconds <= resumed.train_seconds


def test_a_run_killed_again_and_again_ends_as_if_it_never_was(stopped, demonstrations):
    # Report 1 is of where a run begins or goes on, here at step 44 with an evaluation, then there is one for each chunk of 2 steps: there are
    # evaluations between the kills, and one right before the second.
    assert_ends_as_if_never_killed(stopped, demonstrations, CONFIG, kill_at=6)


def test_cloning_that_was_killed_ends_as_if_it_never_was(tmp_path, demonstrations):
    assert_ends_as_if_never_killed(tmp_path, demonstrations, CLONING, kill_at=10)  # of 20 updates, an evaluation after every fourth


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
    with pytest.raises(Diverged, match=r"of seed 3 is (nan|inf) after \d+ environment steps and \d+ updates: try a lower learning_rate"):
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
