"""Films of episodes: GIF by Pillow, MP4 by PyAV (the optional extra `video`), and a PNG of a last state."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hindrl_jax.base.environments import Environment
from hindrl_jax.base.errors import UserError, one_line
from hindrl_jax.base.extras import require
from hindrl_jax.tasks.registry import is_registered_by_user, viewer

SUFFIXES = (".gif", ".mp4", ".png")
_FRAMES_PER_SECOND = 20  # the arm's control rate, and three frames for each step of a grid


def check_film(path: Path, num_episodes: int = 1) -> None:
    """Makes sure that `save_film` could write there.

    Raises:
      UserError: if not.
    """
    if path.suffix not in SUFFIXES:
        raise UserError(f"cannot draw {path.name}: the name must end in {', '.join(SUFFIXES[:-1])} or {SUFFIXES[-1]}")
    if path.suffix == ".png" and num_episodes > 1:
        raise UserError(f"cannot draw {num_episodes} episodes into {path.name}, which holds the last state of one: write a .gif or .mp4")
    if not os.path.isdir(path.parent):
        raise UserError(f"cannot write {path}: there is no folder {path.parent}; make it first")
    if path.suffix == ".mp4":
        require("av.container", "write a .gif")


def save_film(env: Environment, episodes: Sequence[Sequence[Any]], path: Path) -> None:
    """Draws episodes, one after the other, as a film: .gif or .mp4. As a .png, draws the last state alone.

    Args:
      env: the task.
      episodes: the states of each.
      path: see `check_film`.

    Raises:
      UserError: if they cannot be drawn.
      OSError: if the file cannot be written.
    """
    from hindrl_jax.envs import drawing  # not with this module: it loads Pillow, which only drawing needs

    with _failures_of_the_viewer(env):
        draw = viewer(env)
        if draw is None:
            raise UserError(f"{env.name} has no viewer to draw it: give one to hindrl_jax.register")
        if path.suffix == ".png":
            draw.save_png(env, episodes[-1][-1], path)
            return
        pictures: list[np.ndarray] = []
        seconds: list[float] = []
        for number, states in enumerate(episodes, 1):
            if pictures:
                seconds[-1] += drawing.LINGER
            captions = [f"{env.name}, {number} of {len(episodes)}"] * len(states) if len(episodes) > 1 else None
            more_pictures, more_seconds = draw.animation(env, states, captions=captions)
            pictures += more_pictures
            seconds += more_seconds
        save_pictures(pictures, seconds, path)


@contextlib.contextmanager
def _failures_of_the_viewer(env: Environment) -> Iterator[None]:
    """A viewer that somebody gave to `register` and that fails, or draws what is no picture, is theirs to mend, and no bug of ours."""
    try:
        yield
    except (UserError, OSError):
        raise
    except Exception as error:  # of any kind: it is somebody else's code
        if not is_registered_by_user(env):
            raise
        said = f"{type(error).__name__}: {one_line(error)}"
        raise UserError(f"the viewer of {env.name} fails ({said}): mend it, or give hindrl_jax.register none") from error


def save_pictures(pictures: Sequence[np.ndarray], seconds: Sequence[float], path: Path) -> None:
    """Saves pictures (H, W, 3) uint8 as a film, each shown for so many seconds; as a .png, the last one alone.

    Raises:
      OSError: if the file cannot be written.
    """
    from hindrl_jax.envs import drawing

    if path.suffix == ".png":
        drawing.save_png(pictures[-1], path)
    else:
        (drawing.save_gif if path.suffix == ".gif" else save_mp4)(pictures, seconds, path)


def save_mp4(pictures: Sequence[np.ndarray], seconds: Sequence[float], path: Path) -> None:
    """Saves a film in H.264, which browsers, slides and editors play.

    Args:
      pictures: (H, W, 3) uint8 each.
      seconds: how long each is shown, to a twentieth; the last one stays a second longer.
      path: file to write.

    Raises:
      OSError: if it cannot be written.
    """
    import av

    from hindrl_jax.envs import drawing

    ends = np.rint(np.cumsum([*seconds[:-1], seconds[-1] + drawing.LINGER]) * _FRAMES_PER_SECOND).astype(int)
    height, width = (length + length % 2 for length in pictures[0].shape[:2])  # the encoder halves the resolution of colour
    with av.open(str(path), "w", options={"movflags": "faststart"}) as file:
        stream = file.add_stream("libx264", rate=_FRAMES_PER_SECOND, options={"crf": "18", "preset": "medium"})
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        for picture, repeats in zip(pictures, np.diff(ends, prepend=0), strict=True):
            padded = np.pad(picture, ((0, height - picture.shape[0]), (0, width - picture.shape[1]), (0, 0)), mode="edge")
            for _ in range(repeats):
                file.mux(stream.encode(av.VideoFrame.from_ndarray(padded, format="rgb24")))
        file.mux(stream.encode())
