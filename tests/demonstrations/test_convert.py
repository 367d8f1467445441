"""Conversions there and back, and the commands that take files of any tool."""

import numpy as np
import pytest
from commands import refusal as command_refusal
from foreign_files import KEYS, ROBOMIMIC_FILE, archive, assert_same_episodes

from hindrl_jax import cli
from hindrl_jax.demonstrations.convert import load, read, write
from hindrl_jax.demonstrations.hdf5 import load_demonstrations, read_recording


@pytest.mark.parametrize("through", ["demos.npz", "minari:there-v0"])
def test_round_trip_gives_back_the_same_bytes(recorded, through, tmp_path, env):
    through = through if through.startswith("minari:") else str(tmp_path / through)
    write(through, read(str(recorded)))
    assert_same_episodes(load(through, env), load_demonstrations(recorded, env))
    write(str(tmp_path / "back.hdf5"), read(through))
    assert (tmp_path / "back.hdf5").read_bytes() == recorded.read_bytes()


def test_refusals_write_nothing(recorded, tmp_path, capsys):
    ours, other = tmp_path / "ours.hdf5", tmp_path / "other.npz"
    other.write_text("mine")
    convert = ("demos", "convert")
    assert "exists already" in command_refusal(capsys, *convert, recorded, other)
    assert "does not say a format" in command_refusal(capsys, *convert, recorded, tmp_path / "demos")
    assert "leave out --env" in command_refusal(capsys, *convert, recorded, ours, "--env", "GridPickAndPlace")
    assert "leave out --env" in command_refusal(capsys, *convert, ROBOMIMIC_FILE, ours, "--env", "GridPickAndPlace", "--observation-keys", *KEYS)
    assert "leave out the options" in command_refusal(capsys, *convert, recorded, ours, "--solved", "all")
    assert "not converted from a robomimic file" in command_refusal(capsys, *convert, recorded, ours, "--restore")
    assert "no such file" in command_refusal(capsys, *convert, tmp_path / "missing.hdf5", ours)
    assert "--observation-keys" in command_refusal(capsys, *convert, ROBOMIMIC_FILE, ours)
    assert [path.name for path in tmp_path.iterdir()] == ["other.npz"]
    assert other.read_text() == "mine"


def test_environment_named_on_the_command_line(recorded, tmp_path):
    """For a file that does not say which of our environments it is of; the goals are then derived, and the environment's options are flags."""
    recording = read_recording(recorded)
    arrays = dict(
        lengths=[len(demo) for demo in recording.demonstrations],
        observations=np.concatenate([demo.observations for demo in recording.demonstrations]),
        actions=np.concatenate([demo.actions for demo in recording.demonstrations]),
        achieved_goals=None,
    )
    source = archive(tmp_path / "bare.npz", **arrays)
    cli.main(["demos", "convert", source, str(tmp_path / "ours.hdf5"), "--env", "FixedGridPickAndPlace", "--horizon", "200"])
    converted = read_recording(tmp_path / "ours.hdf5")
    assert (converted.env_name, converted.env_kwargs["horizon"]) == ("FixedGridPickAndPlace", 200)
    np.testing.assert_array_equal(converted.demonstrations[1].achieved_goals, recording.demonstrations[1].achieved_goals)


def test_info_and_plot_of_foreign_files(recorded, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    cli.main(["demos", "info", str(ROBOMIMIC_FILE)])
    printed = capsys.readouterr().out
    for words in (
        "robomimic, FixedGridPickAndPlace, 2 demonstrations, 112 transitions",
        "filter key train: 1 demonstration",
        "objects",
        "--observation-keys",
    ):
        assert words in printed
    cli.main(["demos", "info", str(ROBOMIMIC_FILE), "--observation-keys", *KEYS, "--epsilon-steps", "5"])
    assert "2 demonstrations, 2 solved, 112 transitions" in capsys.readouterr().out
    write("minari:group/grid-v0", read_recording(recorded))
    keeps = []
    for source in (str(recorded), "minari:group/grid-v0"):
        cli.main(["demos", "info", source, "--epsilon-steps", "3"])
        keeps.append(next(line for line in capsys.readouterr().out.splitlines() if line.startswith("the filter keeps")))
    assert keeps[0] == keeps[1]
    cli.main(["demos", "plot", "minari:group/grid-v0", "--epsilon-steps", "3"])
    assert (tmp_path / "grid-v0.png").read_bytes().startswith(b"\x89PNG")
