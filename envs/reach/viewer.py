"""Pictures and animations of the reach tasks, rendered off screen by MuJoCo. The dynamics never import this module."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from os import PathLike

import numpy as np
from PIL import Image, ImageDraw

from hindrl_jax.envs import drawing, panda
from hindrl_jax.envs.panda import meshes
from hindrl_jax.envs.panda.renderer import Renderer, View
from hindrl_jax.envs.reach.rules import ReachTask
from hindrl_jax.envs.reach.types import ReachState

_VIEW = View(width=480, height=400, look_at=(0.32, 0.03, 0.25), distance=1.46, azimuth=145.0, elevation=-22.0)  # the caption comes below

_GREEN = tuple(v / 255 for v in drawing.GREEN)
_BLUE = tuple(v / 255 for v in drawing.BLUE)
_GREY = (0.62, 0.65, 0.69)
_AXES = ((0.85, 0.22, 0.22), (0.20, 0.62, 0.25), (0.18, 0.40, 0.85))  # colours of x, y, z
_HAND_TO_FINGERTIPS = 0.067  # m


def frame(env: ReachTask, state: ReachState, *, caption: str = "") -> np.ndarray:
    """Draws one state.

    Each waypoint is a green T, where the hand would be with its fingers pointing along the stem, with the x, y and z axes of its orientation in red,
    green and blue. The next waypoint is opaque, those after it are the fainter the later their turn (as in thesis figure 3.4), and those already
    reached are grey and ticked. The numbers give the order. Below the arm and the waypoints lie their shadows, in the same colours.

    Args:
      env: the environment that `state` belongs to.
      state: unbatched state.
      caption: the first line below the picture; the name of the environment if empty.

    Returns:
      (height, width, 3) uint8 RGB picture. Its size is always the same.

    Raises:
      UserError: if no OpenGL library can draw without a screen.
    """
    return _draw(env, state, caption, [])


def save_png(env: ReachTask, state: ReachState, path: str | PathLike, *, caption: str = "") -> None:
    """Saves the picture that `frame` draws."""
    drawing.save_png(frame(env, state, caption=caption), path)


def animation(
    env: ReachTask,
    states: Sequence[ReachState] | ReachState,
    *,
    seconds_per_frame: float = panda.CONTROL_PERIOD,
    captions: Sequence[str] | None = None,
) -> tuple[list[np.ndarray], list[float]]:
    """Draws an episode, with the path of the hand so far.

    Of long episodes only every second state is shown, or every third, and so on, and the last one. Each is then shown for longer, so that the
    animation takes as long as it would with all of them.

    Args:
      env: the environment that the states belong to.
      states: a list of states, or one state whose arrays have a leading time axis.
      seconds_per_frame: time between states, real time by default.
      captions: one caption per state, as in `frame`.

    Returns:
      The pictures, (height, width, 3) uint8 each, and how many seconds each is shown.

    Raises:
      ValueError: if there are no states, or not one caption per state.
      UserError: if no OpenGL library can draw without a screen.
    """
    pairs = drawing.captioned_states(states, captions, ReachState)
    shown, seconds = drawing.shown_states(len(pairs), seconds_per_frame)
    way = [_renderer().hand_position(state.joints) for state, _ in pairs]
    return [_draw(env, pairs[i][0], pairs[i][1], way[: i + 1]) for i in shown], seconds


def _draw(env: ReachTask, state: ReachState, caption: str, way: Sequence[np.ndarray]) -> np.ndarray:
    """`frame`, with a line through the positions `way` of the hand, in m."""
    renderer = _renderer()
    positions, rotations = np.asarray(state.positions, float), np.asarray(state.rotations, float)
    num_reached, num_waypoints = int(state.num_reached), len(positions)

    renderer.pose(state.joints)
    for start, end in itertools.pairwise(way):
        renderer.line(start, end, (*_BLUE, 0.7))
    renderer.shade_arm()
    for i in range(num_waypoints):
        _add_waypoint(renderer, positions[i], rotations[i], i - num_reached)
    image = Image.fromarray(renderer.render())

    for i in reversed(range(num_waypoints)):  # so that the next one's number lies on top
        top = positions[i] - _HAND_TO_FINGERTIPS * rotations[i][:, 2]
        x, y = renderer.pixel(top + np.array([0.0, 0.0, 0.04]))
        label = _label(i + 1, i - num_reached)
        left, upper = (round(float(np.clip(v - label.width / 2, 0, limit - label.width))) for v, limit in ((x, _VIEW.width), (y, _VIEW.height)))
        image.paste(label, (left, upper), label)

    progress = f"step {int(state.step)}    reached {num_reached}/{num_waypoints}"
    strip = drawing.caption_strip(_VIEW.width, caption or env.name, progress, solved=bool(env.is_solved(state)))
    return np.concatenate([np.asarray(image), strip])


def _add_waypoint(renderer: Renderer, position: np.ndarray, rotation: np.ndarray, turns_left: int) -> None:
    """Adds the marker of a waypoint whose turn comes after `turns_left` others; that of a reached one has passed and is negative."""
    x, y, z = rotation.T
    opacity, reached = _opacity(turns_left), turns_left < 0
    colour = _GREY if reached else _GREEN
    on_floor = tuple(1 - (0.3 + 0.7 * opacity) * (1 - c) for c in colour)
    palm = position - _HAND_TO_FINGERTIPS * z
    for start, end, radius in ((palm - 0.05 * y, palm + 0.05 * y, 0.016), (palm, position, 0.008)):
        renderer.rod(start, end, radius, (*colour, opacity))
        renderer.shade(start, end, radius, on_floor, 0.001 + 0.001 * opacity)  # the next one's on top
    for axis, axis_colour in zip((x, y, z), _AXES, strict=True):
        renderer.rod(position, position + 0.05 * axis, 0.003, (*(_GREY if reached else axis_colour), opacity))


def _opacity(turns_left: int) -> float:
    """Of a waypoint whose turn comes after `turns_left` others, or has passed."""
    return 0.45 if turns_left < 0 else max(0.55**turns_left, 0.15)


@functools.lru_cache(maxsize=256)
def _label(number: int, turns_left: int) -> Image.Image:
    """A disc with the number of a waypoint, or with a tick if it has been reached."""
    radius, rim = (13 if turns_left == 0 else 10), 2  # pixels
    scale = drawing.SUPERSAMPLING
    size, rim = 2 * radius * scale, rim * scale
    colour, strength = (_GREY, 1.0) if turns_left < 0 else (_GREEN, _opacity(turns_left))
    mixed = tuple(round(255 * (1 - strength * (1 - c))) for c in colour)
    image = Image.new("RGBA", (size, size))
    draw = ImageDraw.Draw(image)
    draw.ellipse([0, 0, size - 1, size - 1], fill=drawing.BACKGROUND)
    draw.ellipse([rim, rim, size - 1 - rim, size - 1 - rim], fill=mixed)
    if turns_left < 0:
        drawing.tick(draw, size / 2, size / 2, size / 2 - rim)
    else:
        ink = drawing.BACKGROUND if turns_left == 0 else tuple(round(150 * c) for c in _GREEN)  # white would not be seen on paler discs
        draw.text((size / 2, size / 2), str(number), font=drawing.font(round(0.65 * size)), fill=ink, anchor="mm")
    return image.reduce(scale)


@functools.cache
def _renderer() -> Renderer:
    """The renderer of this process; to set it up takes as long as dozens of pictures."""
    return Renderer(meshes.visible_model(), _VIEW)
