"""Archives of NumPy arrays: their layout, those of somebody else, and damaged ones."""

import json

import numpy as np
import pytest
from foreign_files import archive, refusal

from hindrl_jax.base.errors import UserError
from hindrl_jax.demonstrations.convert import read, write
from hindrl_jax.demonstrations.foreign import Interpretation
from hindrl_jax.demonstrations.hdf5 import read_recording


def test_layout_of_the_archive(recorded, tmp_path):
    write(str(tmp_path / "demos.npz"), read_recording(recorded))
    demos = read_recording(recorded).demonstrations
    with np.load(tmp_path / "demos.npz", allow_pickle=False) as archive:
        assert archive["lengths"].tolist() == [len(demo) for demo in demos]
        assert archive["terminated"].tolist() == [True, True]
        for name, field, row in (("observations", "observations", -1), ("actions", "actions", 0), ("states", "states", 3)):
            np.testing.assert_array_equal(archive[name], np.concatenate([getattr(demo, field) for demo in demos]))
            np.testing.assert_array_equal(archive[name][row], getattr(demos[row if row < 0 else 0], field)[row])
        np.testing.assert_array_equal(archive["desired_goals"], [demo.desired_goal for demo in demos])
        assert json.loads(str(archive["about"]))["env_name"] == "FixedGridPickAndPlace"


def test_archive_of_somebody_else(tmp_path):
    first, second = read(archive(tmp_path / "a.npz")).demonstrations
    assert first.observations.tolist() == [[0, 1], [2, 3]]
    assert second.observations.tolist() == [[4, 5], [6, 7], [8, 9]]
    assert (second.achieved_goals.tolist(), second.desired_goal.tolist()) == ([[2], [3], [4]], [4])
    assert (second.rewards.tolist(), second.terminated, second.states) == ([0, 1], True, None)
    about = json.dumps({"env_name": "Line"})
    changed = archive(tmp_path / "b.npz", terminated=[True, False], desired_goals=[[7], [8]], rewards=[1, 2, 3], about=about)
    recording = read(changed)
    assert recording.env_name == "Line"
    assert [demo.terminated for demo in recording.demonstrations] == [True, False]
    assert [demo.desired_goal.tolist() for demo in recording.demonstrations] == [[7], [8]]
    assert recording.demonstrations[1].rewards.tolist() == [2, 3]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"lengths": None}, "no array 'lengths'"),
        ({"lengths": [1, 0]}, "at least 1"),
        ({"lengths": [1, 3]}, "observations has shape (5, 2), expected (6, any)"),
        ({"actions": np.full((3, 1), 2.0)}, "actions go from 2 to 2"),
        ({"rewards": [0, np.nan, 0]}, "rewards is not finite in row 0; put others in their place with --sparse-rewards"),
        ({"achieved_goals": None}, "--achieved-goal-keys"),
        ({"about": "[]"}, "about"),
        ({"about": json.dumps({"format_version": 1})}, "damaged"),
        ({"observations": np.array([None] * 5)}, "not an archive"),
    ],
)
def test_archives_that_do_not_fit(tmp_path, changes, words):
    message = refusal(lambda: read(archive(tmp_path / "a.npz", **changes)))
    assert words in message, message


@pytest.mark.parametrize("about", [{"names": ["a"]}, {"names": ["a", "a"]}, {"names": "ab"}, {"env_kwargs": [1]}, {"env_name": 3}])
def test_what_an_archive_says_about_itself_is_checked(tmp_path, about):
    given = dict(lengths=[1, 1], observations=np.zeros((4, 1)), achieved_goals=np.zeros((4, 1)), actions=np.zeros((2, 1)))
    np.savez(tmp_path / "demos.npz", about=json.dumps(about), **given)
    with pytest.raises(UserError, match="about"):
        read(str(tmp_path / "demos.npz"), Interpretation(solved="all"))


def test_every_damaged_byte_of_an_archive_is_one_line(tmp_path):
    path, rng = tmp_path / "demos.npz", np.random.default_rng(0)
    np.savez_compressed(path, lengths=[2], observations=np.arange(6.0).reshape(3, 2), actions=np.zeros((2, 1)), achieved_goals=np.zeros((3, 1)))
    intact, refused = path.read_bytes(), 0
    for _ in range(150):
        damaged = bytearray(intact)
        damaged[rng.integers(len(damaged))] = rng.integers(256)
        path.write_bytes(damaged)
        try:
            read(str(path), Interpretation(solved="all"))
        except UserError:
            refused += 1
    assert refused > 50
    np.save(tmp_path / "alone.npy", np.zeros(3))
    (tmp_path / "alone.npy").rename(path)
    with pytest.raises(UserError, match="is not an archive"):
        read(str(path), Interpretation(solved="all"))


def test_what_is_no_archive(tmp_path):
    (tmp_path / "a.npz").write_text("not an archive")
    assert "not an archive" in refusal(lambda: read(str(tmp_path / "a.npz")))
    assert "no such file" in refusal(lambda: read(str(tmp_path / "b.npz")))
