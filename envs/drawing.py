"""What the viewers share: fonts, the caption below a picture, episodes as lists of states, and GIF files. The dynamics never import this module."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from os import PathLike
from typing import Any, cast

import jax
import numpy as np
from PIL import Image, ImageDraw, ImageFont

SUPERSAMPLING = 3
"""Drawings are made this many times larger and then averaged down, for smooth edges."""
MARGIN = 12
"""Pixels."""
CAPTION_HEIGHT = 62
"""Pixels."""
LINGER = 1.0
"""Seconds that the last picture of an episode stays longer."""
MAX_PICTURES = 160
"""Of one animation at 20 states per second; of longer episodes every second state is shown, or every third, ..."""
BACKGROUND = (255, 255, 255)
INK = (38, 44, 54)
FAINT_INK = (110, 118, 130)
GREEN = (46, 158, 91)
BLUE = (47, 111, 214)

_NUM_COLOURS = 255  # of a GIF's 256, one is left over to mean "as in the picture before"
_MIN_SHARE = 0.0002  # of all pixels, from which on a colour is kept exactly
_MAX_EXACT = 128  # colours kept exactly, at most


@lru_cache(maxsize=64)
def font(size: int) -> ImageFont.FreeTypeFont:
    """The font of all text, by its size in pixels."""
    return cast(ImageFont.FreeTypeFont, ImageFont.load_default(size))  # with a size it is of that kind


def tick(draw: ImageDraw.ImageDraw, x: float, y: float, radius: float) -> None:
    """Draws the white tick of a disc with this centre and radius, in the pixels of `draw`."""
    points = [(x - 0.5 * radius, y + 0.05 * radius), (x - 0.1 * radius, y + 0.45 * radius), (x + 0.55 * radius, y - 0.4 * radius)]
    draw.line(points, fill=BACKGROUND, width=round(0.3 * radius), joint="curve")


def caption_strip(width: int, title: str, progress: str, *, solved: bool) -> np.ndarray:
    """The lines below a picture.

    Args:
      width: of the picture, in pixels.
      title: the first line; made smaller if it is too wide.
      progress: the second line.
      solved: whether "solved" stands at its end.

    Returns:
      (CAPTION_HEIGHT, width, 3) uint8.
    """
    image = Image.new("RGB", (width * SUPERSAMPLING, CAPTION_HEIGHT * SUPERSAMPLING), BACKGROUND)
    draw = ImageDraw.Draw(image)

    def text(position: tuple[int, int], line: str, size: int, colour: tuple[int, int, int], max_width: int, anchor: str = "la") -> None:
        pixels = size * SUPERSAMPLING
        wide = font(pixels).getlength(line)
        pixels = max(1, int(pixels * min(1.0, max_width * SUPERSAMPLING / max(wide, 1.0))))
        draw.text((position[0] * SUPERSAMPLING, position[1] * SUPERSAMPLING), line, font=font(pixels), fill=colour, anchor=anchor)

    text((MARGIN, 0), title, 17, INK, width - 2 * MARGIN)
    text((MARGIN, 25), progress, 15, FAINT_INK, width // 2)
    if solved:
        text((width - MARGIN, 25), "solved", 15, GREEN, width // 3, anchor="ra")
    return np.asarray(image.reduce(SUPERSAMPLING))


def captioned_states(states: Any, captions: Sequence[str] | None, state_type: type[Any]) -> list[tuple[Any, str]]:
    """Pairs each state of an episode with its caption.

    Args:
      states: a list of states, or one state whose arrays have a leading time axis (its key is dropped).
      captions: one caption per state; none at all means empty ones.
      state_type: the class of the states.

    Raises:
      ValueError: if there are no states, or not one caption per state.
    """
    if isinstance(states, state_type):
        states = jax.tree.map(np.asarray, states.replace(key=None))
        states = [jax.tree.map(lambda a, t=t: a[t], states) for t in range(len(states.step))]
    states = list(states)
    captions = [""] * len(states) if captions is None else captions
    if not states:
        raise ValueError("There are no states to draw; pass at least one.")
    if len(captions) != len(states):
        raise ValueError(f"Pass one caption per state: got {len(captions)} captions for {len(states)} states.")
    return list(zip(states, captions, strict=True))


def shown_states(num_states: int, seconds_per_state: float) -> tuple[list[int], list[float]]:
    """Which of an episode's states an animation shows, at most `MAX_PICTURES` or so and the last one always, and for how many seconds each.

    The animation takes as long as it would with all of them.
    """
    stride = -(-num_states // MAX_PICTURES)
    shown = [*range(0, num_states - 1, stride), num_states - 1]
    return shown, [*(seconds_per_state * np.diff(shown)), seconds_per_state]


def save_png(picture: np.ndarray, path: str | PathLike) -> None:
    """Saves a picture (H, W, 3)."""
    Image.fromarray(picture).save(path, format="PNG")


def save_gif(pictures: Sequence[np.ndarray], seconds: Sequence[float], path: str | PathLike) -> None:
    """Saves an endlessly repeated animation.

    Args:
      pictures: (H, W, 3) uint8 each.
      seconds: how long each picture is shown; the last one stays a second longer. Programs that show GIFs round to hundredths.
      path: file to write.
    """
    images = _to_palette_images(pictures)
    durations = [round(1000 * s) for s in seconds]
    durations[-1] += round(1000 * LINGER)
    images[0].save(path, format="GIF", save_all=True, append_images=images[1:], duration=durations, loop=0, optimize=False)


def _to_palette_images(pictures: Sequence[np.ndarray]) -> list[Image.Image]:
    """Reduces pictures to one common palette.

    Colours that fill an area stay exact, and nothing flickers. The others, from edges and shading, are merged where they are close. (Pillow's own
    reduction merges colours as close as the grid worlds' white and light grey, and has a palette for each picture.)
    """
    counts = np.zeros(1 << 24, np.int32)
    for picture in pictures:
        present, number = np.unique(_packed(picture), return_counts=True)
        counts[present] += number.astype(np.int32)
    colours = np.flatnonzero(counts)
    frequency = counts[colours]
    rgb = np.stack([colours >> 16, (colours >> 8) & 255, colours & 255], axis=1).astype(np.uint8)

    order = np.argsort(-frequency, kind="stable")
    num_exact = len(order) if len(order) <= _NUM_COLOURS else min(int(np.sum(frequency >= _MIN_SHARE * frequency.sum())), _MAX_EXACT)
    exact, rest = order[:num_exact], order[num_exact:]
    palette = rgb[exact]
    if rest.size:
        # Roots, since small things such as a coloured axis would not count beside large shaded ones otherwise.
        weighted = np.repeat(rgb[rest], np.ceil(np.sqrt(frequency[rest])).astype(int), axis=0)
        merged = Image.fromarray(weighted[None]).quantize(_NUM_COLOURS - num_exact, Image.Quantize.MEDIANCUT, kmeans=1)
        palette = np.concatenate([palette, np.array(merged.getpalette(), np.uint8).reshape(-1, 3)])

    nearest = np.zeros(1 << 24, np.uint8)
    for part in np.array_split(np.arange(len(colours)), -(-len(colours) // 16384)):
        # |c - p|^2 without |c|^2, which is the same for every colour p of the palette.
        distance = np.sum(np.square(palette.astype(np.float32)), axis=1)[None] - 2.0 * rgb[part].astype(np.float32) @ palette.astype(np.float32).T
        nearest[colours[part]] = distance.argmin(axis=1)
    images = [Image.fromarray(nearest[_packed(picture)]) for picture in pictures]
    for image in images:
        image.putpalette(palette.tobytes())
    return images


def _packed(picture: np.ndarray) -> np.ndarray:
    """(H, W) one integer 0xRRGGBB per pixel."""
    red, green, blue = np.moveaxis(picture.astype(np.int32), -1, 0)
    return (red << 16) | (green << 8) | blue
