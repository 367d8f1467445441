"""Absurd sizes are refused before anything is computed and any memory is taken, in one line that says what is too much."""

import time

import pytest
from commands import TINY, refusal

from hindrl_jax.cli import running


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--seeds 100000000", "at most 65536"),
        ("--seeds 60000", "60000 runs side by side take"),
        ("--steps 3000000000", "at most 2147483647"),
        ("--steps 2147483647", "more than 2147483647 of either are not counted: lower steps"),
        ("--updates-per-iteration 2000000000", "lower steps"),
        ("--size 1000000000000", "at most 2147483647"),
        ("--size 100000", "at most 32768"),
        ("--num-objects 100000", "at most 100"),
        ("--env ParameterizedReach --num-waypoints 1000000", "at most 1000"),
        ("--horizon 2000000000", "of it for the demonstrations"),
        ("--horizon 30000000000", "at most 2147483647"),
        ("--batch-size 2000000000", "of it for the batches"),
        ("--n-step 1000000000", "of it for the batches"),
        ("--buffer-size 2000000000 --seeds 100", "of it for the replay"),
        ("--net-arch 2000000 2000000", "of it for the networks"),
        ("--num-critics 100000000", "of it for the networks"),
        ("--num-envs 2000000000 --n-step 1 --updates-per-iteration 1 --batch-size 8 --steps 10", "GiB are free"),
        ("--eval-episodes 2000000000", "of it for the evaluations"),
        ("--demos 1000000000", "record at most 100000"),
        ("--demos 99999999999999999999999999", "record at most 100000"),
        ("--algo bc --batch-size 2000000000", "of it for the batches"),
    ],
)
def test_training(arguments, message, tmp_path, capsys, monkeypatch):
    def begins(*_args, **_kwargs):
        raise AssertionError("it begins")

    for name in ("fit", "record_demonstrations"):
        monkeypatch.setattr(running, name, begins)
    refusal(capsys, "train", "--demos", "0", "--out", tmp_path / "run")  # JAX has started
    started = time.process_time()
    assert message in refusal(capsys, "train", "--out", tmp_path / "run", *arguments.split())
    assert time.process_time() - started < 1.0
    assert list(tmp_path.iterdir()) == []


def test_other_commands(run, tmp_path, capsys):
    assert "film 1 to 1000000" in refusal(capsys, "render", run, "--episodes", "100000000")
    assert "play 1 to 1000000" in refusal(capsys, "eval", run, "--episodes", "1000000000")
    out = tmp_path / "x.hdf5"
    assert "record at most 100000" in refusal(capsys, "demos", "record", "--demos", "100000000", "--out", out)
    assert "episodes of 2000000000 steps side by side take" in refusal(
        capsys, "demos", "record", "--demos", "1", "--horizon", "2000000000", "--out", out
    )
    assert "at most 65536" in refusal(capsys, "reproduce", "ablation", "--seeds", "100000000", "--out", tmp_path / "ablation")
    gamma = ",".join(str(0.5 + number / 1e5) for number in range(3000))
    assert "runs side by side take" in refusal(capsys, "sweep", "--over", f"gamma={gamma}", "--seeds", "100", "--out", tmp_path / "sweep")
    assert list(tmp_path.iterdir()) == []


def test_what_is_small_is_not_refused(tmp_path, monkeypatch):
    class Begins(Exception):
        pass

    def begins(*_args, **_kwargs):
        raise Begins

    monkeypatch.setattr(running, "record_demonstrations", begins)
    for arguments in ((), TINY, ("--preset", "thesis"), ("--preset", "original", "--env", "ParameterizedReach")):
        with pytest.raises(Begins):
            running.run(*_asked(["--out", str(tmp_path), *arguments]), None, None)


def _asked(arguments):
    from hindrl_jax.cli.train_options import parse_train

    spec, _ = parse_train(arguments)
    return spec, [spec.config]
