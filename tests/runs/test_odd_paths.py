"""Directories with any legal name: a run there is written, stopped and resumed, or refused before it starts."""

import os
from pathlib import Path

import jax
import numpy as np
import pytest
import tiny
from commands import TINY, refusal
from tiny import ENV

import hindrl_jax as hindrl
from hindrl_jax import cli
from hindrl_jax.runs.checkpoints import Checkpoints
from hindrl_jax.runs.reader import load_run

FEW = ("run [0] *?{a} 100%s", "a\\b 'q\" ~ $HOME ü 走る 🤖\ntwo", "n" * 250)
NAMES = (
    *FEW,
    *("run [0]", "[a-z]", "*", "?", "{a,b}", "~", "~user", "$HOME", "%s%d%", "a\\b", "ein Lauf mit Ümläuten", "走る", "🤖", "'quoted\"", "a#b?c=d&e"),
    *("two\nlines", "tab\t", " ", ".hidden", "-o", "a:b", "file:x", "n" * 250, "deep/" + "d" * 200 + "/[x]", "<b>bold</b>", "ocdbt.process_0"),
)


class Killed(Exception):
    pass


@pytest.mark.parametrize("names", [FEW, pytest.param(NAMES, marks=pytest.mark.slow)], ids=["few", "all"])
def test_checkpoints_are_read_back_wherever_they_lie(tmp_path, names):
    """All of them saved at the same moment of one training."""
    kept = [Checkpoints(tmp_path / str(index) / name / "checkpoint", seconds=0) for index, name in enumerate(names)]
    arrays, begun = {}, []

    def report(result):
        if result.steps_done:
            for checkpoints in kept:
                checkpoints.save(result)
            arrays.update(jax.device_get(jax.tree.map(np.asarray, result.state.agent.actor)))
            raise Killed

    def restore(result):
        begun.append(result)

    with pytest.raises(Killed):
        hindrl.fit(ENV, hindrl.record_demonstrations(ENV, 1), tiny.CONFIG, report=report, restore=restore)
    for checkpoints, name in zip(kept, names, strict=True):
        restored = Checkpoints(checkpoints.folder).restore(begun[0])
        assert restored is not None, name
        jax.tree.map(np.testing.assert_array_equal, restored.state.agent.actor, arrays)


@pytest.mark.slow
def test_a_run_is_stopped_and_resumed_where_the_name_is_odd(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    out, save = Path("run [0] *{a} 100%s ü\\n"), Checkpoints.save_when_due

    def save_and_stop(self, result):
        self.save(result)
        if self.steps is not None:
            raise Killed

    monkeypatch.setattr(Checkpoints, "save_when_due", save_and_stop)
    with pytest.raises(Killed):
        cli.main(["train", "--out", str(out), *TINY])
    monkeypatch.setattr(Checkpoints, "save_when_due", save)
    capsys.readouterr()
    cli.main(["train", "--resume", str(out)])
    assert "going on at step " in capsys.readouterr().out
    assert load_run(out).spec.seeds == (0,)
    cli.main(["compare", str(out), str(out)])
    assert [path.name for path in tmp_path.iterdir()] == [out.name]


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("n" * 256, "longer than 255 bytes"),
        ("ü" * 128, "longer than 255 bytes"),
        ("d" * 200 + "/" + ("d" * 200 + "/") * 20 + "x", "it is longer than"),
    ],
)
def test_a_name_that_the_disk_does_not_take_is_refused_before_anything_is_done(tmp_path, capsys, name, message):
    assert message in refusal(capsys, "train", "--out", tmp_path / name)
    assert message in refusal(capsys, "sweep", "--over", "gamma=0.9,0.95", "--out", tmp_path / name)
    assert "does not exist" in refusal(capsys, "eval", tmp_path / name)
    assert "does not exist" in refusal(capsys, "train", "--resume", tmp_path / name)
    assert "no such file" in refusal(capsys, "demos", "info", tmp_path / f"{name}.hdf5")
    assert "longer than" in refusal(capsys, "demos", "record", "--demos", "1", "--out", tmp_path / f"{name}.hdf5")
    assert "there is no folder" in refusal(capsys, "compare", tmp_path, "--csv", tmp_path / name / "x.csv")
    assert list(tmp_path.iterdir()) == []


def test_a_name_that_is_not_utf_8_is_refused(tmp_path, capsys):
    assert "is not UTF-8" in refusal(capsys, "train", "--out", tmp_path / os.fsdecode(b"\xff"))
    assert list(tmp_path.iterdir()) == []


def test_a_demonstrations_file_may_have_the_longest_name(tmp_path):
    path = tmp_path / ("n" * 250 + ".hdf5")
    cli.main(["demos", "record", "--demos", "1", "--out", str(path)])
    assert [found.name for found in tmp_path.iterdir()] == [path.name]
