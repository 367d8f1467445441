"""Pictures and animations of the cable tasks, rendered off screen by MuJoCo. The dynamics never import this module."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from os import PathLike
from typing import Any

import jax
import numpy as np

from hindrl_jax.envs import drawing, panda, rotations
from hindrl_jax.envs.cable import chains, geometry, model
from hindrl_jax.envs.cable.rules import CableTask, tip_error
from hindrl_jax.envs.cable.types import CableState
from hindrl_jax.envs.panda import meshes
from hindrl_jax.envs.panda.renderer import Renderer, View

_VIEW = View(width=480, height=400, look_at=(-0.52, 0.0, 1.31), distance=1.58, azimuth=152.0, elevation=-14.0)  # the caption comes below
_CABLE = (0.22, 0.24, 0.28, 1.0)
_PATHS = ((0.85, 0.26, 0.20, 0.6), (0.18, 0.43, 0.84, 0.6))  # of the tips of plug and socket, in the colours of both
_POINTS = 24  # along a cable


def frame(env: CableTask, state: CableState, *, caption: str = "") -> np.ndarray:
    """Draws one state: both arms, the cables from the bar, the plug in red with its pin, the socket in blue.

    In closed form a cable has no shape: it is drawn as a curve of its length. Below the picture stands in words which heads are held, and how far the
    plug is from where it is to be.

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


def save_png(env: CableTask, state: CableState, path: str | PathLike, *, caption: str = "") -> None:
    """Saves the picture that `frame` draws."""
    drawing.save_png(frame(env, state, caption=caption), path)


def animation(
    env: CableTask,
    states: Sequence[CableState] | CableState,
    *,
    seconds_per_frame: float = panda.CONTROL_PERIOD,
    captions: Sequence[str] | None = None,
) -> tuple[list[np.ndarray], list[float]]:
    """Draws an episode, with the paths of both tips so far.

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
    pairs = drawing.captioned_states(states, captions, CableState)
    shown, seconds = drawing.shown_states(len(pairs), seconds_per_frame)
    way = [_tips(state) for state, _ in pairs]
    return [_draw(env, pairs[i][0], pairs[i][1], way[: i + 1]) for i in shown], seconds


def in_words(env: CableTask, state: CableState) -> str:
    """The state of the task: which heads are held, and how far the plug's tip is from where it is to be."""
    held = np.asarray(state.scene.held)
    what = "both" if held.all() else f"{model.HEADS[int(held.argmax())]} alone" if held.any() else "nothing"
    axes = np.asarray(state.scene.head_rotations, float)[:, :, 2]
    far = 1000.0 * float(np.linalg.norm(np.asarray(tip_error(state.scene, env.depth))))
    angle = f", {np.degrees(np.arccos(np.clip(-axes[0] @ axes[1], -1.0, 1.0))):.1f}°" if env.depth > 0 else ""
    return f"{what} held    {far:.{0 if far >= 10 else 1}f} mm{angle} to go"


def _draw(env: CableTask, state: CableState, caption: str, way: Sequence[np.ndarray]) -> np.ndarray:
    """`frame`, with lines through the positions `way` (2, 3) of the tips, in m."""
    renderer = _renderer()
    renderer.pose(_everything(state))
    for cable in _cables(state):
        for start, end in itertools.pairwise(cable):
            renderer.rod(start, end, geometry.CABLE_RADIUS, _CABLE)
    for index, colour in enumerate(_PATHS):
        for before, after in itertools.pairwise(way):
            renderer.line(before[index], after[index], colour)
    for name in model.HEADS:
        renderer.shade_arm(f"{name}_")
    progress = f"step {int(state.step)}    {in_words(env, state)}"
    strip = drawing.caption_strip(_VIEW.width, caption or env.name, progress, solved=bool(env.is_solved(state.scene)))
    return np.concatenate([renderer.render(), strip])


def _tips(state: CableState) -> np.ndarray:
    """(2, 3) m, of plug and socket."""
    positions, axes = np.asarray(state.scene.head_positions, float), np.asarray(state.scene.head_rotations, float)[:, :, 2]
    return positions + np.array([[geometry.to_tip(0)], [geometry.to_tip(1)]]) * axes


def _everything(state: CableState) -> np.ndarray:
    """What moves in the model to draw: for each arm seven joints and two fingers, for each head its position and quaternion."""
    physics, scene = state.physics, state.scene
    joints = np.asarray(chains.arms(physics)[0] if isinstance(physics, chains.Joints) else physics.joints)
    fingers = np.asarray(scene.fingers)
    arms = np.concatenate([joints, fingers[:, None], -fingers[:, None]], axis=1)
    ends = _ends(state)
    heads = [np.concatenate([ends[i], _quaternion(scene.head_rotations[i])]) for i in range(2)]
    return np.concatenate([arms.reshape(-1), *heads])


def _ends(state: CableState) -> np.ndarray:
    """(2, 3) m, where the cables end and the heads begin."""
    return np.asarray(state.scene.head_positions, float) - geometry.GRIP * np.asarray(state.scene.head_rotations, float)[:, :, 2]


def _quaternion(matrix: Any) -> np.ndarray:
    vector = np.asarray(_rotation_vector(matrix), float)
    angle = np.linalg.norm(vector)
    return np.concatenate([[np.cos(angle / 2)], np.sin(angle / 2) * vector / max(angle, 1e-12)])


_rotation_vector = jax.jit(rotations.to_rotation_vector)
_joints_of_cables = jax.jit(chains.cables)


def _cables(state: CableState) -> list[np.ndarray]:
    """The points through which each cable runs, (P, 3) m."""
    if isinstance(state.physics, chains.Joints):
        return list(np.asarray(_joints_of_cables(state.physics)))
    axes = np.asarray(state.scene.head_rotations, float)[:, :, 2]
    return [_curve(geometry.ANCHORS[i], end, axes[i]) for i, end in enumerate(_ends(state))]


def _curve(anchor: np.ndarray, end: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """(P, 3) m, a cable as a cubic Bezier curve of the cable's length: from the bar straight down, into the head along its axis."""
    t = np.linspace(0.0, 1.0, _POINTS)[:, None]

    def curve(reach: float) -> np.ndarray:
        first, second = anchor - np.array([0.0, 0.0, reach]), end - reach * axis
        return (1 - t) ** 3 * anchor + 3 * (1 - t) ** 2 * t * first + 3 * (1 - t) * t**2 * second + t**3 * end

    least, most = 0.0, 2.0 * geometry.CABLE_LENGTH
    for _ in range(20):
        middle = 0.5 * (least + most)
        is_short = np.linalg.norm(np.diff(curve(middle), axis=0), axis=1).sum() < geometry.CABLE_LENGTH
        least, most = (middle, most) if is_short else (least, middle)
    return curve(least)


@functools.cache
def _renderer() -> Renderer:
    """The renderer of this process; to set it up takes as long as dozens of pictures."""
    prefixes = [f"{name}_" for name in model.HEADS]
    return Renderer(meshes.with_meshes(model.xml(0), prefixes) or model.model(0), _VIEW)
