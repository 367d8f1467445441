"""The pictures of the reach tasks: what is drawn where, what is written to disk, and what happens where nothing can be drawn."""

from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from PIL import Image

from hindrl_jax.base.errors import UserError
from hindrl_jax.envs import drawing, panda
from hindrl_jax.envs.panda import meshes, opengl
from hindrl_jax.envs.reach import FixedParameterizedReach, ParameterizedReach, ReachState, viewer

DOWN = np.diag([1.0, -1.0, -1.0])  # a hand that points straight down
LEFT, MIDDLE, RIGHT = (0.5, -0.25, 0.25), (0.6, 0.0, 0.35), (0.5, 0.28, 0.15)  # m, as seen from the camera, clear of the arm
ROOT = Path(__file__).parent.parent.parent


needs_opengl = pytest.mark.usefixtures("opengl_here")


def place(positions=(RIGHT, LEFT), *, joints=panda.INITIAL_JOINTS, num_reached=0, step=0):
    """A state with everything where the test wants it."""
    joints = jnp.asarray(joints, jnp.float32)
    return ReachState(
        key=jax.random.key(0),
        joints=joints,
        velocities=jnp.zeros_like(joints),
        rest=joints,
        positions=jnp.asarray(positions, jnp.float32),
        rotations=jnp.asarray([DOWN] * len(positions), jnp.float32),
        num_reached=jnp.asarray(num_reached, jnp.int32),
        step=jnp.asarray(step, jnp.int32),
    )


def scene_of(picture):
    """The picture without its caption, as integers."""
    return picture[: -drawing.CAPTION_HEIGHT].astype(int)


def around(picture, position, radius=30):
    """The pixels (P, 3) around a position in m."""
    column, row = (round(float(v)) for v in viewer._renderer().pixel(np.asarray(position)))
    return scene_of(picture)[row - radius : row + radius, column - radius : column + radius].reshape(-1, 3)


def greenish(pixels):
    """How many of the pixels are clearly more green than anything else."""
    return int(np.sum(pixels[..., 1] > np.maximum(pixels[..., 0], pixels[..., 2]) + 15))


@needs_opengl
def test_the_size_of_a_picture_is_always_the_same():
    shapes = set()
    for env, state in [
        (FixedParameterizedReach(), place()),
        (FixedParameterizedReach(), place(joints=np.zeros(7), num_reached=2)),
        (ParameterizedReach(num_waypoints=4), place([LEFT, MIDDLE, RIGHT, (0.4, 0.3, 0.0)], step=17)),
        (ParameterizedReach(num_waypoints=1), place([(50.0, 80.0, -70.0)])),  # far outside the picture, with its label
    ]:
        picture = viewer.frame(env, state, caption="x" * len(shapes))
        assert picture.dtype == np.uint8
        shapes.add(picture.shape)
    assert len(shapes) == 1


@needs_opengl
def test_the_arm_moves_with_its_joints_and_the_waypoints_stay():
    env, state = FixedParameterizedReach(), place()
    before = viewer.frame(env, state)
    turned = viewer.frame(env, state.replace(joints=state.joints.at[0].add(0.5)))
    moved = (scene_of(before) != scene_of(turned)).any(axis=2)
    assert moved.mean() > 0.02
    np.testing.assert_array_equal(viewer.frame(env, state), before)
    assert greenish(around(turned, RIGHT)) == greenish(around(before, RIGHT)) > 100
    # The hand is at the same place in the picture as in the dynamics, before and after.
    for joints in (state.joints, state.joints.at[0].add(0.5)):
        np.testing.assert_allclose(viewer._renderer().hand_position(joints), panda.posture(joints).hand_position, atol=1e-5)


@needs_opengl
def test_waypoints_reached_next_and_later_look_different():
    env = ParameterizedReach(num_waypoints=3)
    state = place([LEFT, MIDDLE, RIGHT])
    by_reached = [viewer.frame(env, state.replace(num_reached=jnp.int32(k))) for k in range(4)]
    for i, position in enumerate((LEFT, MIDDLE, RIGHT)):
        # Nothing of a waypoint that has been reached is green, not even its y axis.
        assert [greenish(around(picture, position)) > 100 for picture in by_reached] == [k <= i for k in range(4)]
    # The last waypoint becomes darker as its turn approaches.
    brightness = [around(picture, RIGHT).mean() for picture in by_reached[:3]]
    assert brightness[0] > brightness[1] > brightness[2]
    # Exactly one label has the full colour of the next one.
    for k, picture in enumerate(by_reached):
        full = [bool((around(picture, np.add(position, (0, 0, 0.107))) == drawing.GREEN).all(axis=1).any()) for position in (LEFT, MIDDLE, RIGHT)]
        assert full == [i == k for i in range(3)]


@needs_opengl
def test_numbers_tell_the_order():
    env, states = ParameterizedReach(), [place([LEFT, RIGHT]), place([RIGHT, LEFT])]
    first, second = (viewer.frame(env, state) for state in states)
    assert (around(first, LEFT) != around(second, LEFT)).any()
    label = [viewer._label(number, 1) for number in (2, 3)]
    assert label[0].tobytes() != label[1].tobytes()


@needs_opengl
@pytest.mark.parametrize("rotation", [DOWN, DOWN[:, [1, 0, 2]] * [1, -1, 1], np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])])
def test_a_marker_lies_as_the_hand_would(rotation):
    renderer, (x, y, z) = viewer._renderer(), rotation.T
    renderer.pose(panda.INITIAL_JOINTS)
    viewer._add_waypoint(renderer, np.array(MIDDLE), rotation, 0)
    picture = renderer.render().astype(int)

    def drawn(offset):
        column, row = (int(v) for v in renderer.pixel(np.add(MIDDLE, offset)))
        return greenish(picture[row - 1 : row + 2, column - 1 : column + 2]) > 0

    assert drawn(-0.067 * z + 0.05 * y)
    assert drawn(-0.067 * z - 0.05 * y)
    assert drawn(-0.03 * z)
    assert not drawn(-0.067 * z + 0.05 * x)
    assert not drawn(-0.067 * z - 0.05 * x)
    assert not drawn(-0.12 * z)


@needs_opengl
def test_the_hand_is_wide_along_its_y_axis_at_the_height_of_the_marker():
    model, joints = panda.model(), np.array(panda.INITIAL_JOINTS) + 0.1
    data = mujoco.MjData(model)
    data.qpos[:] = joints
    mujoco.mj_kinematics(model, data)
    palm = model.body("gripper").geomadr[0]
    assert model.geom_type[palm] == mujoco.mjtGeom.mjGEOM_CAPSULE
    hand = panda.posture(jnp.asarray(joints, jnp.float32))
    np.testing.assert_allclose(abs(data.geom_xmat[palm].reshape(3, 3)[:, 2] @ hand.hand_rotation[:, 1]), 1.0, atol=1e-4)
    np.testing.assert_allclose(data.geom_xpos[palm], hand.hand_position - viewer._HAND_TO_FINGERTIPS * hand.hand_rotation[:, 2], atol=1e-3)


@needs_opengl
def test_hundreds_of_waypoints_are_no_trouble():
    positions = np.random.default_rng(0).uniform((0.4, -0.3, 0.0), (0.6, 0.3, 0.4), (500, 3))
    viewer.frame(ParameterizedReach(num_waypoints=500), place(positions))


@needs_opengl
def test_the_caption_shows_step_progress_success_and_the_given_text():
    env, state = FixedParameterizedReach(), place(num_reached=1, step=3)
    caption = viewer.frame(env, state)[-drawing.CAPTION_HEIGHT :]
    for other in (state.replace(step=jnp.int32(4)), state.replace(num_reached=jnp.int32(0))):
        assert (viewer.frame(env, other)[-drawing.CAPTION_HEIGHT :] != caption).any()
    assert (viewer.frame(env, state, caption="hello")[-drawing.CAPTION_HEIGHT :] != caption).any()
    solved = viewer.frame(env, state.replace(num_reached=jnp.int32(2)))[-drawing.CAPTION_HEIGHT :]
    assert greenish(solved.astype(int)) > 0 == greenish(caption.astype(int))


@needs_opengl
def test_png_holds_the_frame(tmp_path):
    env, state = FixedParameterizedReach(), place()
    viewer.save_png(env, state, tmp_path / "state.png")
    with Image.open(tmp_path / "state.png") as image:
        np.testing.assert_array_equal(np.asarray(image), viewer.frame(env, state))


def episode(length):
    """The arm turns about its base."""
    return [place(joints=np.array(panda.INITIAL_JOINTS) + 0.1 * t * np.eye(7)[0], step=t) for t in range(length)]


def read_gif(path):
    """The pictures and their durations, in ms."""
    with Image.open(path) as image:
        pictures, durations = [], []
        for i in range(image.n_frames):
            image.seek(i)
            pictures.append(np.asarray(image.convert("RGB")).astype(int))
            durations.append(image.info["duration"])
    return pictures, durations


@needs_opengl
@pytest.mark.parametrize("stacked", [True, False])
def test_gif_holds_every_state_in_order_at_its_time(tmp_path, stacked):
    env, states = FixedParameterizedReach(), episode(4)
    path = tmp_path / "episode.gif"
    drawing.save_gif(*viewer.animation(env, jax.tree.map(lambda *a: jnp.stack(a), *states) if stacked else states), path)
    pictures, durations = read_gif(path)
    assert durations == [50, 50, 50, 1050]
    frames = [viewer.frame(env, state) for state in states]
    for t, picture in enumerate(pictures):
        errors = [np.abs(picture - frame).mean() for frame in frames]  # off by a little, because of the palette and the hand's path
        assert np.argmin(errors) == t
        assert errors[t] < 1.0


@pytest.mark.parametrize(
    ("length", "shown", "durations"),
    [
        (1, [0], [1050]),
        (4, [0, 1, 2, 3], [50, 50, 50, 1050]),
        (7, [0, 2, 4, 6], [100, 100, 100, 1050]),
        (10, [0, 3, 6, 9], [150, 150, 150, 1050]),
        (8, [0, 2, 4, 6, 7], [100, 100, 100, 50, 1050]),
    ],
)
def test_long_episodes_are_thinned_out_in_real_time(tmp_path, monkeypatch, length, shown, durations):
    monkeypatch.setattr(drawing, "MAX_PICTURES", 4)
    drawn = []

    def draw(env, state, caption, way):
        drawn.append((int(state.step), caption, len(way)))
        return np.full((20, 30, 3), 10 * int(state.step), np.uint8)

    monkeypatch.setattr(viewer, "_draw", draw)
    captions = [f"state {t}" for t in range(length)]
    drawing.save_gif(*viewer.animation(FixedParameterizedReach(), episode(length), captions=captions), tmp_path / "episode.gif")
    assert drawn == [(t, f"state {t}", t + 1) for t in shown]  # the hand's path includes the states that are left out
    assert read_gif(tmp_path / "episode.gif")[1] == durations


@needs_opengl
def test_gif_shows_the_path_of_the_hand(tmp_path):
    env, states = FixedParameterizedReach(), episode(5)
    drawing.save_gif(*viewer.animation(env, states, seconds_per_frame=0.2), tmp_path / "episode.gif")
    pictures, durations = read_gif(tmp_path / "episode.gif")
    assert durations == [200] * 4 + [1200]

    def blue(picture):
        return np.abs(scene_of(picture) - drawing.BLUE).sum(axis=2) < 60

    assert blue(pictures[-1]).sum() > blue(viewer.frame(env, states[-1])).sum() + 20


def test_an_animation_rejects_what_it_cannot_draw():
    env = FixedParameterizedReach()
    with pytest.raises(ValueError, match="no states"):
        viewer.animation(env, [])
    with pytest.raises(ValueError, match="one caption per state"):
        viewer.animation(env, [place()], captions=["a", "b"])


def no_opengl(monkeypatch):
    """Makes every OpenGL library fail, and the viewer set up a new renderer."""

    def fail(name):
        raise ImportError(name)

    monkeypatch.setattr(opengl.importlib, "import_module", fail)
    monkeypatch.setattr(viewer, "_renderer", viewer._renderer.__wrapped__)
    monkeypatch.setattr(meshes, "visible_model", panda.model)


def test_without_opengl_one_line_says_what_to_do(monkeypatch, tmp_path):
    no_opengl(monkeypatch)
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    for draw in (
        lambda: viewer.frame(FixedParameterizedReach(), place()),
        lambda: viewer.save_png(FixedParameterizedReach(), place(), tmp_path / "x.png"),
        lambda: drawing.save_gif(*viewer.animation(FixedParameterizedReach(), [place()]), tmp_path / "x.gif"),
    ):
        with pytest.raises(UserError, match="libegl1 or libosmesa6") as caught:
            draw()
        assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    with pytest.raises(UserError, match="MUJOCO_GL=osmesa does not work here"):
        viewer.frame(FixedParameterizedReach(), place())
