"""Pictures and animations of the grid worlds. The dynamics never import this module.

x grows to the right and y grows downwards, as in the original's pictures: cell (0, 0) is at the top left.
"""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike

import numpy as np
from PIL import Image, ImageDraw

from hindrl_jax.envs import drawing
from hindrl_jax.envs.grid.rules import GridTask
from hindrl_jax.envs.grid.types import GridState

_MIN_CELL = 48  # pixels
_MIN_WIDTH = 360  # pixels, so that the caption fits beside small grids
_MARGIN = drawing.MARGIN
_CAPTION_HEIGHT = drawing.CAPTION_HEIGHT

_BACKGROUND = drawing.BACKGROUND
_CELL = (247, 248, 250)
_LINE = (222, 226, 232)
_START_BOX = (255, 244, 204)
_GOAL = (253, 222, 221)
_GOAL_LINE = (217, 65, 65)
_AGENT = drawing.BLUE
_OBJECT = drawing.GREEN
_DELIVERED = (112, 188, 143)


def frame(env: GridTask, state: GridState, *, caption: str = "") -> np.ndarray:
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
    canvas = _Canvas(width, width - _MARGIN // 2, cell)  # the caption takes the other half of the margin
    agent, goal, cells = (tuple(int(v) for v in np.ravel(a)) for a in (state.agent, state.goal, state.objects))
    objects = [cells[2 * i : 2 * i + 2] for i in range(env.num_objects)]
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

    solved = bool(env.is_solved(state))  # with the last object still in the hand
    progress = f"step {int(state.step)}    delivered {env.num_objects if solved else num_delivered}/{env.num_objects}"
    strip = drawing.caption_strip(width, caption or env.name, progress, solved=solved)
    return np.concatenate([canvas.pixels(), strip])


def save_png(env: GridTask, state: GridState, path: str | PathLike, *, caption: str = "") -> None:
    """Saves the picture that `frame` draws."""
    drawing.save_png(frame(env, state, caption=caption), path)


def animation(
    env: GridTask,
    states: Sequence[GridState] | GridState,
    *,
    seconds_per_frame: float = 0.15,
    captions: Sequence[str] | None = None,
) -> tuple[list[np.ndarray], list[float]]:
    """Draws an episode.

    Args:
      env: the environment that the states belong to.
      states: a list of states, or one state whose arrays have a leading time axis.
      seconds_per_frame: time between states.
      captions: one caption per state, as in `frame`.

    Returns:
      The pictures, (height, width, 3) uint8 each, and how many seconds each is shown.

    Raises:
      ValueError: if there are no states, or not one caption per state.
    """
    pictures = [frame(env, state, caption=caption) for state, caption in drawing.captioned_states(states, captions, GridState)]
    return pictures, [seconds_per_frame] * len(pictures)


class _Canvas:
    """Draws in units of cells at a larger scale and averages down at the end."""

    def __init__(self, width: int, height: int, cell: int):
        self._scale = drawing.SUPERSAMPLING
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
        drawing.tick(self._draw, x, y, radius * self._cell)

    def label(self, cell, height: float, text: str):
        """White text in the middle of a cell; its height is in cells."""
        self._draw.text(self._centre(cell, (0.0, 0.0)), text, font=drawing.font(round(height * self._cell)), fill=_BACKGROUND, anchor="mm")

    def _corner(self, cell) -> tuple[float, float]:
        return self._origin + cell[0] * self._cell, self._origin + cell[1] * self._cell

    def _centre(self, cell, shift) -> tuple[float, float]:
        return self._corner((cell[0] + 0.5 + shift[0], cell[1] + 0.5 + shift[1]))
