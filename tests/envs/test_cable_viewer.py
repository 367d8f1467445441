"""Pictures of the cable tasks. What they look like a person has judged; here is what must be so."""

import jax
import numpy as np
import pytest
from cable_states import in_closed_form, reset, state_in_c

from hindrl_jax.envs.cable import BringNear, CableInsertion, geometry, viewer

pytestmark = pytest.mark.usefixtures("opengl_here")


def states(task):
    state = state_in_c("lifted")
    return {"mujoco": (task(backend="mujoco"), state), "closed_form": (task(), in_closed_form(state))}


@pytest.mark.parametrize("backend", ["closed_form", "mujoco"])
def test_a_picture_shows_both_heads_and_says_how_far_it_is(backend):
    env, state = states(CableInsertion)[backend]
    picture = viewer.frame(env, state)
    assert picture.shape == (462, 480, 3)
    assert picture.dtype == np.uint8
    red, green, blue = np.moveaxis(picture[:400].astype(int), -1, 0)
    assert ((red > 120) & (red > 2 * green) & (red > 2 * blue)).sum() > 30  # the plug
    assert ((blue > 120) & (blue > 2 * red)).sum() > 60  # the socket
    assert "both held" in viewer.in_words(env, state)
    assert "°" in viewer.in_words(env, state)


def test_a_start_in_words():
    state, _ = reset(BringNear(), jax.random.key(0))
    # 360 mm lie between the heads, and 2 between the heights of their tips.
    assert viewer.in_words(BringNear(), state) == "nothing held    360 mm to go"


def test_both_back_ends_draw_arms_and_heads_alike():
    drawn = [viewer._everything(state) for _, state in states(CableInsertion).values()]
    np.testing.assert_allclose(drawn[0][:7], drawn[1][:7], atol=1e-5)
    np.testing.assert_allclose(drawn[0][18:21], drawn[1][18:21], atol=1e-4)


def test_a_cable_of_the_closed_form_has_its_length_and_ends_in_its_head():
    _, state = states(CableInsertion)["closed_form"]
    for curve, anchor, end in zip(viewer._cables(state), geometry.ANCHORS, viewer._ends(state), strict=True):
        np.testing.assert_allclose(curve[0], anchor, atol=1e-6)
        np.testing.assert_allclose(curve[-1], end, atol=1e-6)
        assert np.linalg.norm(np.diff(curve, axis=0), axis=1).sum() == pytest.approx(geometry.CABLE_LENGTH, abs=0.002)


def test_an_animation_and_a_file(tmp_path):
    env, state = states(BringNear)["closed_form"]
    pictures, seconds = viewer.animation(env, [state, state, state], captions=["a", "b", "c"])
    assert len(pictures) == len(seconds) == 3
    np.testing.assert_allclose(seconds, 0.05)
    viewer.save_png(env, state, tmp_path / "state.png")
    assert (tmp_path / "state.png").stat().st_size > 10_000
    with pytest.raises(ValueError, match="one caption per state"):
        viewer.animation(env, [state], captions=[])
