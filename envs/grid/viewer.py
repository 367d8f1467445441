"""Pictures and animations of the grid worlds. The dynamics never import this module.

x grows to the right and y grows downwards, as in the original's pictures: cell (0, 0) is at the top left.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from os import PathLike

import jax
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from envs.grid.pick_and_place import FixedGridPickAndPlace, GridPickAndPlace, GridState

_SUPERSAMPLING = 3  # pictures are drawn this many times larger and then averaged down, for smooth edges
_MIN_CELL = 48  # pixels
_MIN_WIDTH = 360  # pixels, so that the caption fits beside small grids
_MARGIN = 12  # pixels
_CAPTION_HEIGHT = 56  # pixels

_BACKGROUND = (255, 255, 255)
_CELL = (247, 248, 250)
_LINE = (222, 226, 232)
_START_BOX = (255, 244, 204)
_GOAL = (253, 222, 221)
_GOAL_LINE = (217, 65, 65)
_AGENT = (47, 111, 214)
_OBJECT = (46, 158, 91)
_DELIVERED = (112, 188, 143)
_INK = (38, 44, 54)
_FAINT_INK = (110, 118, 130)


def frame(env: GridPickAndPlace | FixedGridPickAndPlace, state: GridState, *, caption: str = "") -> np.ndarray:
    """Draws one state.

    The agent is a blue disc, the objects are numbered green discs and the goal is the red cell. A held object is drawn inside the agent. An object
    that shares its cell with the agent without being held has the agent at its corner. Delivered objects are faint ticked discs on the goal. The
    start boxes of the fixed task are yellow.

    Args:
      env: the environment that `state` belongs to.
      state: unbatched state.
      caption: the first line below the grid; the name of the environment if empty.

    Returns:
      (height, width, 3) uint8 RGB picture. Its size depends on `env` only.
    """
    cell = max(_MIN_CELL, -(-_MIN_WIDTH // env.size))
    width = env.size * cell + 2 * _MARGIN
    canvas = _Canvas(width, width + _CAPTION_HEIGHT, cell)
    agent, goal, objects = (tuple(int(v) for v in np.ravel(a)) for a in (state.agent, state.goal, state.objects))
    objects = [objects[2 * i : 2 * i + 2] for i in range(env.num_objects)]
    held, num_delivered = int(state.held), int(state.num_delivered)

    canvas.rectangle((0, 0), (env.size - 1, env.size - 1), _CELL)
    for low, high in env.start_boxes:
        canvas.rectangle(low, high, _START_BOX)
    canvas.rectangle(goal, goal, _GOAL)
    canvas.grid(env.size)
    canvas.outline(goal, _GOAL_LINE)

    shared = False
    for i in range(num_delivered, env.num_objects):
        if i != held:
            shared = shared or objects[i] == agent
            canvas.disc(objects[i], 0.34, _OBJECT)
            canvas.label(objects[i], 0.40, str(i))
    if held >= 0:
        canvas.disc(agent, 0.43, _AGENT)
        canvas.disc(agent, 0.34, _BACKGROUND)
        canvas.disc(agent, 0.30, _OBJECT)
        canvas.label(agent, 0.36, str(held))
    elif shared:
        canvas.disc(agent, 0.20, _BACKGROUND, shift=(0.26, 0.26))
        canvas.disc(agent, 0.17, _AGENT, shift=(0.26, 0.26))
    else:
        canvas.disc(agent, 0.36, _AGENT)
    for i in range(num_delivered):  # on top, in rows of three along the upper edge of the goal cell
        canvas.tick(objects[i], 0.15, _DELIVERED, shift=(-0.32 + 0.32 * (i % 3), -0.32 + 0.32 * (i // 3)))

    below = width - _MARGIN + 6
    canvas.text((_MARGIN, below), caption or env.name, 17, _INK, width - 2 * _MARGIN)
    canvas.text((_MARGIN, below + 25), f"step {int(state.step)}    delivered {num_delivered}/{env.num_objects}", 15, _FAINT_INK, width // 2)
    if bool(env.is_solved(state)):
        canvas.text((width - _MARGIN, below + 25), "solved", 15, _OBJECT, width // 3, anchor="ra")
    return canvas.pixels()


def save_png(env: GridPickAndPlace | FixedGridPickAndPlace, state: GridState, path: str | PathLike, *, caption: str = "") -> None:
    """Saves the picture that `frame` draws."""
    Image.fromarray(frame(env, state, caption=caption)).save(path, format="PNG")


def save_gif(
    env: GridPickAndPlace | FixedGridPickAndPlace,
    states: Sequence[GridState] | GridState,
    path: str | PathLike,
    *,
    seconds_per_frame: float = 0.15,
    captions: Sequence[str] | None = None,
) -> None:
    """Saves an endlessly repeated animation; the last picture stays a second longer.

    Args:
      env: the environment that the states belong to.
      states: a list of states, or one state whose arrays have a leading time axis.
      path: file to write.
      seconds_per_frame: time between pictures; viewers round it to hundredths.
      captions: one caption per state, as in `frame`.

    Raises:
      ValueError: if there are no states, or not one caption per state.
    """
    states = _as_list(states)
    captions = [""] * len(states) if captions is None else captions
    if not states:
        raise ValueError("There are no states to draw; pass at least one.")
    if len(captions) != len(states):
        raise ValueError(f"Pass one caption per state: got {len(captions)} captions for {len(states)} states.")
    pictures = [frame(env, state, caption=caption) for state, caption in zip(states, captions, strict=True)]
    images = _to_palette_images(pictures)
    durations = [round(1000 * seconds_per_frame)] * len(images)
    durations[-1] += 1000
    images[0].save(path, format="GIF", save_all=True, append_images=images[1:], duration=durations, loop=0, optimize=False)


def _as_list(states: Sequence[GridState] | GridState) -> list[GridState]:
    """Splits a state with a leading time axis into a list of states without keys."""
    if not isinstance(states, GridState):
        return list(states)
    states = jax.tree.map(np.asarray, states.replace(key=None))
    return [jax.tree.map(lambda a, t=t: a[t], states) for t in range(len(states.step))]


def _to_palette_images(pictures: Sequence[np.ndarray]) -> list[Image.Image]:
    """Reduces pictures to one common palette of their 256 most frequent colours.

    All flat areas stay exact, and nothing flickers; only rare shades on the edges move to the nearest colour. (Pillow's own reduction merges
    colours as close as our white and light grey.)
    """
    packed = []  # one 0xRRGGBB integer per pixel
    for picture in pictures:
        red, green, blue = np.moveaxis(picture.astype(np.int32), -1, 0)
        packed.append((red << 16) | (green << 8) | blue)
    per_picture = [np.unique(p, return_counts=True) for p in packed]
    colours, group = np.unique(np.concatenate([c for c, _ in per_picture]), return_inverse=True)
    frequency = np.bincount(group, np.concatenate([n for _, n in per_picture]))

    rgb = np.stack([colours >> 16, (colours >> 8) & 255, colours & 255], axis=1)
    palette = rgb[np.argsort(-frequency)[:256]]
    nearest = np.zeros(1 << 24, np.uint8)
    nearest[colours] = np.abs(rgb[:, None] - palette[None]).sum(axis=2).argmin(axis=1)
    images = [Image.fromarray(nearest[p]) for p in packed]
    for image in images:
        image.putpalette(palette.astype(np.uint8).tobytes())
    return images


@lru_cache(maxsize=64)
def _font(size: int) -> ImageFont.FreeTypeFont:
    return ImageFont.load_default(size)


class _Canvas:
    """Draws in units of cells at a larger scale and averages down at the end."""

    def __init__(self, width: int, height: int, cell: int):
        self._scale = _SUPERSAMPLING
        self._cell = cell * self._scale
        self._origin = _MARGIN * self._scale
        self._image = Image.new("RGB", (width * self._scale, height * self._scale), _BACKGROUND)
        self._draw = ImageDraw.Draw(self._image)

    def pixels(self) -> np.ndarray:
        return np.asarray(self._image.reduce(self._scale))

    def rectangle(self, low, high, colour):
        """Fills the cells from `low` to `high`, both included."""
        self._draw.rectangle([*self._corner(low), *self._corner((high[0] + 1, high[1] + 1))], fill=colour)

    def outline(self, cell, colour):
        inset = 2 * self._scale
        x, y = self._corner(cell)
        self._draw.rectangle([x + inset, y + inset, x + self._cell - inset, y + self._cell - inset], outline=colour, width=2 * self._scale)

    def grid(self, size: int):
        for i in range(size + 1):
            for ends in ([(i, 0), (i, size)], [(0, i), (size, i)]):
                self._draw.line([self._corner(end) for end in ends], fill=_LINE, width=self._scale)

    def disc(self, cell, radius: float, colour, *, shift=(0.0, 0.0)):
        """Radius and shift are in cells."""
        x, y = self._centre(cell, shift)
        r = radius * self._cell
        self._draw.ellipse([x - r, y - r, x + r, y + r], fill=colour)

    def tick(self, cell, radius: float, colour, *, shift):
        """A disc with a white tick in it."""
        self.disc(cell, radius + 0.02, _BACKGROUND, shift=shift)
        self.disc(cell, radius, colour, shift=shift)
        x, y = self._centre(cell, shift)
        r = radius * self._cell
        points = [(x - 0.5 * r, y + 0.05 * r), (x - 0.1 * r, y + 0.45 * r), (x + 0.55 * r, y - 0.4 * r)]
        self._draw.line(points, fill=_BACKGROUND, width=round(0.3 * r), joint="curve")

    def label(self, cell, height: float, text: str):
        """White text in the middle of a cell; its height is in cells."""
        self._draw.text(self._centre(cell, (0.0, 0.0)), text, font=_font(round(height * self._cell)), fill=_BACKGROUND, anchor="mm")

    def text(self, position, text: str, size: int, colour, max_width: int, *, anchor: str = "la"):
        """Position, size and width are in pixels of the final picture; text that is too wide is made smaller."""
        pixels = size * self._scale
        wide = _font(pixels).getlength(text)
        pixels = max(1, int(pixels * min(1.0, max_width * self._scale / max(wide, 1.0))))
        self._draw.text([v * self._scale for v in position], text, font=_font(pixels), fill=colour, anchor=anchor)

    def _corner(self, cell) -> tuple[float, float]:
        return self._origin + cell[0] * self._cell, self._origin + cell[1] * self._cell

    def _centre(self, cell, shift) -> tuple[float, float]:
        return self._corner((cell[0] + 0.5 + shift[0], cell[1] + 0.5 + shift[1]))
