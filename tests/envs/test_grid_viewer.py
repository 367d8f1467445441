"""The pictures of the grid worlds: what is drawn where, and what is written to disk."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from hindrl_jax.envs import drawing
from hindrl_jax.envs.grid import FixedGridPickAndPlace, GridPickAndPlace, GridState, viewer


def place(agent, objects, goal, *, num_delivered=0, held=-1, step=0):
    """A state with everything where the test wants it; cells are (x, y)."""
    integers = {"agent": agent, "objects": objects, "goal": goal, "num_delivered": num_delivered, "held": held, "step": step}
    return GridState(key=jax.random.key(0), **{name: jnp.asarray(value, jnp.int32) for name, value in integers.items()})


def cell_of(picture, env, cell):
    """The pixels of one cell."""
    width = (picture.shape[1] - 2 * viewer._MARGIN) // env.size
    x, y = (viewer._MARGIN + v * width for v in cell)
    return picture[y : y + width, x : x + width].reshape(-1, 3)


def share(picture, env, cell, colour):
    """Which part of a cell has exactly this colour."""
    return np.mean((cell_of(picture, env, cell) == colour).all(axis=1))


def test_everything_is_drawn_in_its_cell_and_nowhere_else():
    env = GridPickAndPlace(size=5)
    picture = viewer.frame(env, place((1, 0), [(4, 1), (2, 3)], (0, 4)))
    assert picture.dtype == np.uint8
    for colour, expected in [(viewer._AGENT, {(1, 0)}), (viewer._OBJECT, {(4, 1), (2, 3)}), (viewer._GOAL, {(0, 4)})]:
        drawn = {(x, y) for x in range(5) for y in range(5) if share(picture, env, (x, y), colour) > 0.1}
        assert drawn == expected  # also says that y grows downwards: row y is y cells below the top


def test_start_boxes_are_tinted():
    env = FixedGridPickAndPlace()
    picture = viewer.frame(env, place((0, 0), [(9, 0), (9, 9)], (0, 9)))
    tinted = {(x, y) for x in range(10) for y in range(10) if share(picture, env, (x, y), viewer._START_BOX) > 0.8}
    assert tinted == {(x, y) for x in (0, 1, 8, 9) for y in (0, 1, 8, 9)} - {(0, 0), (9, 0), (9, 9), (0, 9)}


def test_held_shared_and_delivered_objects_look_different():
    env = GridPickAndPlace()
    shared = viewer.frame(env, place((4, 4), [(4, 4), (9, 9)], (0, 9)))
    held = viewer.frame(env, place((4, 4), [(4, 4), (9, 9)], (0, 9), held=0))
    for picture in (shared, held):
        assert share(picture, env, (4, 4), viewer._AGENT) > 0.03
        assert share(picture, env, (4, 4), viewer._OBJECT) > 0.1
    assert share(held, env, (4, 4), viewer._AGENT) > 1.5 * share(shared, env, (4, 4), viewer._AGENT)
    delivered = viewer.frame(env, place((4, 4), [(0, 9), (9, 9)], (0, 9), num_delivered=1))
    assert share(delivered, env, (0, 9), viewer._DELIVERED) > 0.02
    assert share(delivered, env, (0, 9), viewer._OBJECT) == 0


def test_the_caption_shows_step_deliveries_success_and_the_given_text():
    env = GridPickAndPlace()
    state = place((1, 9), [(0, 9), (9, 9)], (0, 9), num_delivered=1, step=3)
    caption = viewer.frame(env, state)[-viewer._CAPTION_HEIGHT :]
    for other in (state.replace(step=jnp.int32(4)), state.replace(num_delivered=jnp.int32(0))):
        assert (viewer.frame(env, other)[-viewer._CAPTION_HEIGHT :] != caption).any()
    assert (viewer.frame(env, state, caption="hello")[-viewer._CAPTION_HEIGHT :] != caption).any()
    # "solved" is the only green text
    solved = viewer.frame(env, place((0, 9), [(0, 9), (0, 9)], (0, 9), num_delivered=1, held=1))[-viewer._CAPTION_HEIGHT :]
    assert (solved == viewer._OBJECT).all(axis=2).any()
    assert not (caption == viewer._OBJECT).all(axis=2).any()


def test_a_long_caption_is_shrunk_to_fit():
    env = GridPickAndPlace(size=4)
    state = place((1, 0), [(3, 1), (2, 3)], (0, 3))
    picture = viewer.frame(env, state, caption="a caption that is a good deal longer than the picture is wide")
    assert picture.shape == viewer.frame(env, state).shape
    assert (picture[:, -viewer._MARGIN // 2 :] == 255).all()


def test_png_holds_the_frame(tmp_path):
    env = GridPickAndPlace()
    state = place((1, 0), [(4, 1), (2, 3)], (0, 4))
    viewer.save_png(env, state, tmp_path / "state.png")
    with Image.open(tmp_path / "state.png") as image:
        np.testing.assert_array_equal(np.asarray(image), viewer.frame(env, state))


@pytest.mark.parametrize("stacked", [True, False])
def test_gif_holds_every_state_in_order(tmp_path, stacked):
    env = GridPickAndPlace(size=5)
    states = [place((x, 0), [(4, 1), (2, 3)], (0, 4), step=x) for x in range(3)]
    path = tmp_path / "episode.gif"
    episode = jax.tree.map(lambda *a: jnp.stack(a), *states) if stacked else states
    drawing.save_gif(*viewer.animation(env, episode, seconds_per_frame=0.2), path)
    with Image.open(path) as image:
        assert image.n_frames == 3
        for x in range(3):
            image.seek(x)
            assert image.info["duration"] == (1200 if x == 2 else 200)
            shown = np.asarray(image.convert("RGB")).astype(int)  # colours are off by a little, because of the palette
            errors = [np.abs(shown - viewer.frame(env, state)).mean() for state in states]
            assert np.argmin(errors) == x
            assert errors[x] < 0.5


def test_an_animation_rejects_what_it_cannot_draw():
    env = GridPickAndPlace()
    with pytest.raises(ValueError, match="no states"):
        viewer.animation(env, [])
    with pytest.raises(ValueError, match="one caption per state"):
        viewer.animation(env, [place((1, 0), [(4, 1), (2, 3)], (0, 4))], captions=["a", "b"])
