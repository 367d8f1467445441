"""The pictures of the arm: where positions are drawn, which meshes it has, and which OpenGL library draws it."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest

from hindrl_jax.base.errors import UserError
from hindrl_jax.envs import panda
from hindrl_jax.envs.panda import meshes, opengl
from hindrl_jax.envs.reach import viewer

LEFT, MIDDLE, RIGHT = (0.5, -0.25, 0.25), (0.6, 0.0, 0.35), (0.5, 0.28, 0.15)  # m, as seen from the camera, clear of the arm
ROOT = Path(__file__).parent.parent.parent


needs_opengl = pytest.mark.usefixtures("opengl_here")


@needs_opengl
@pytest.mark.parametrize("position", [LEFT, MIDDLE, RIGHT, (0.1, 0.3, 0.4)])
def test_positions_are_drawn_where_their_pixel_is_said_to_be(position):
    renderer, position = viewer._renderer(), np.asarray(position)
    renderer.pose(panda.INITIAL_JOINTS)
    without = renderer.render().astype(int)
    up = np.array([0.0, 0.0, 1e-3])
    renderer.rod(position - up, position + up, 0.01, (0.0, 0.0, 1.0, 1.0))
    rows, columns = np.nonzero((renderer.render() != without).any(axis=2))
    np.testing.assert_allclose([columns.mean() + 0.5, rows.mean() + 0.5], renderer.pixel(position), atol=0.7)


@needs_opengl
def test_meshes_belong_to_the_same_bodies():
    model, bare = meshes.visible_model(), panda.model()
    if importlib.util.find_spec("robosuite") is None:
        assert model is bare
        return
    assert model.nmesh > 0
    assert not (model.geom_type == mujoco.mjtGeom.mjGEOM_CAPSULE).any()
    for attribute in ("nq", "nbody"):
        assert getattr(model, attribute) == getattr(bare, attribute)
    for attribute in ("body_pos", "body_quat", "body_mass", "body_inertia", "jnt_range", "site_pos"):
        np.testing.assert_array_equal(getattr(model, attribute), getattr(bare, attribute))


@needs_opengl
def test_without_robosuite_the_arm_has_capsules(monkeypatch, tmp_path):
    monkeypatch.setattr(meshes.importlib.util, "find_spec", lambda name: None)
    assert meshes.visible_model() is panda.model()
    # Nor is a robosuite that keeps its files elsewhere any trouble.
    monkeypatch.setattr(meshes.importlib.util, "find_spec", lambda name: importlib.machinery.ModuleSpec(name, None, origin=str(tmp_path / "x.py")))
    assert meshes.visible_model() is panda.model()


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere there is no choice")
@pytest.mark.parametrize(
    ("egl", "display", "wish", "expected"),
    [
        (True, "", "", "egl"),
        (True, ":0", "", "egl"),
        (False, "", "", "osmesa"),
        (False, ":0", "", "glfw"),
        (True, "", "osmesa", "osmesa"),
        (False, "", "EGL", "egl"),
        (True, "", "off", "egl"),
    ],
)
def test_choice_of_the_opengl_library(monkeypatch, egl, display, wish, expected):
    tried = []
    monkeypatch.setattr(opengl.importlib, "import_module", lambda name: tried.append(name))
    monkeypatch.setattr(opengl, "_egl_has_device", lambda: egl)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setenv("DISPLAY", display)
    monkeypatch.setenv("MUJOCO_GL", wish)
    with pytest.raises(UserError):
        opengl.open_context(panda.model(), 480, 400)
    assert tried == [f"mujoco.{expected}"]


@needs_opengl
def test_a_process_that_has_drawn_ends_quietly():
    program = """
import numpy as np
from hindrl_jax.envs import panda
from hindrl_jax.envs.panda.renderer import Renderer
from hindrl_jax.envs.reach import viewer
renderer = Renderer(panda.model(), viewer._VIEW)
renderer.pose(np.zeros(7))
renderer.render()
"""
    environment = {name: value for name, value in os.environ.items() if name != "PYOPENGL_PLATFORM"} | {"JAX_PLATFORMS": "cpu"}
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, env=environment, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
