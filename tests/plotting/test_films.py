"""Films: read back frame by frame."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

import hindrl_jax as hindrl
from hindrl_jax.plotting import films

ENV = hindrl.make("FixedGridPickAndPlace", size=4, random_box_size=1, horizon=20)


def test_mp4_shows_each_picture_as_long_as_asked(tmp_path):
    import av

    colours = [(200, 30, 30), (30, 160, 60), (40, 60, 200)]
    pictures = [np.full((33, 47, 3), colour, np.uint8) for colour in colours]  # odd, which the encoder cannot do
    films.save_mp4(pictures, [0.15, 0.05, 0.1], tmp_path / "film.mp4")
    with av.open(str(tmp_path / "film.mp4")) as file:
        assert file.streams.video[0].average_rate == 20
        frames = [frame.to_ndarray(format="rgb24") for frame in file.decode(video=0)]
    shown = [int(np.abs(np.asarray(colours) - frame[16, 20]).sum(axis=1).argmin()) for frame in frames]
    assert shown == [0] * 3 + [1] * 1 + [2] * 22  # in twentieths of a second; the last one a second longer
    assert frames[0].shape == (34, 48, 3)
    assert all(np.abs(frame[16, 20].astype(int) - colours[which]).max() < 20 for frame, which in zip(frames, shown, strict=True))


def test_episodes_follow_one_another(tmp_path):
    state, _ = jax.jit(ENV.reset)(jax.random.key(0))
    states = [state.replace(step=jnp.asarray(step)) for step in range(3)]
    films.save_film(ENV, [states[:2], states], tmp_path / "two.gif")
    with Image.open(tmp_path / "two.gif") as film:
        durations = []
        for index in range(film.n_frames):
            film.seek(index)
            durations.append(film.info["duration"])
    assert durations == [150, 1150, 150, 150, 1150]  # the end of each episode stays a second longer


def test_what_cannot_be_filmed_is_refused(tmp_path, monkeypatch):
    with pytest.raises(hindrl.UserError, match="holds the last state of one"):
        films.check_film(tmp_path / "two.png", 2)
    films.check_film(tmp_path / "film.mp4")
    monkeypatch.setitem(sys.modules, "av.container", None)
    with pytest.raises(hindrl.UserError, match=r"av is not installed: run .* -m pip install av`, or write a \.gif"):
        films.check_film(tmp_path / "film.mp4")
