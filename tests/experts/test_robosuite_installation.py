"""robosuite is imported quietly, and an installation of it that does not work is refused in one line."""

import importlib.util
import os
import subprocess
import sys
from importlib import metadata
from types import SimpleNamespace

import pytest

from hindrl_jax.base.errors import UserError
from hindrl_jax.experts.robosuite_arm import RobosuiteArm, check_versions, installation, scene

needs_robosuite = pytest.mark.skipif(importlib.util.find_spec("robosuite") is None, reason="robosuite is not installed")


def installed(**versions):
    def version(name):
        if name not in versions:
            raise metadata.PackageNotFoundError(name)
        return versions[name]

    return version


@pytest.mark.parametrize(
    ("versions", "message"),
    [
        (dict(mujoco="3.9.0"), r"needs robosuite, which is not installed: .*-m pip install robosuite==1.5.1 'mujoco==3.9.\*' 'mujoco-mjx==3.9.\*'$"),
        (dict(mujoco="3.10.0", robosuite="1.5.1"), r"needs robosuite 1.5.1 with mujoco 3.9, but robosuite 1.5.1 and mujoco 3.10.0 are installed"),
        (
            dict(mujoco="3.9.0", robosuite="1.5.2"),
            r"but robosuite 1.5.2 and mujoco 3.9.0 are installed: .*-m pip install robosuite==1.5.1 'mujoco==3.9.\*' 'mujoco-mjx==3.9.\*'$",
        ),
        (dict(mujoco="3.90.0", robosuite="1.5.1"), r"mujoco 3.90.0"),
    ],
)
def test_other_versions_are_refused(versions, message, monkeypatch):
    monkeypatch.setattr(metadata, "version", installed(**versions))
    with pytest.raises(UserError, match=message):
        check_versions()


def test_versions_that_go_together_are_accepted(monkeypatch):
    monkeypatch.setattr(metadata, "version", installed(mujoco="3.9.2", robosuite="1.5.1"))
    check_versions()


@pytest.mark.parametrize(
    ("error", "message"),
    [
        ("libGL.so.1: cannot open shared object file: No such file or directory", "apt-get install libgl1 libglib2.0-0"),
        ("libgthread-2.0.so.0: cannot open shared object file", "apt-get install libgl1 libglib2.0-0"),
        ("No module named 'termcolor'", "-m pip install robosuite==1.5.1"),
    ],
)
def test_an_import_that_fails_says_what_to_install(error, message, monkeypatch):
    def import_module(name):
        os.environ["MUJOCO_GL"] = "egl"  # as robosuite does
        raise ImportError(error)

    monkeypatch.setattr(metadata, "version", installed(mujoco="3.9.0", robosuite="1.5.1"))
    monkeypatch.setattr(installation, "importlib", SimpleNamespace(import_module=import_module))
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    with pytest.raises(UserError, match=message):
        installation.import_robosuite.__wrapped__()
    assert os.environ["MUJOCO_GL"] == "osmesa"


@needs_robosuite
def test_missing_files_of_robosuite_are_named(tmp_path, monkeypatch):
    scene.environment_class()  # robosuite is found first, then its files are not
    monkeypatch.setattr("robosuite.models.assets_root", str(tmp_path))
    with pytest.raises(UserError, match=f"{tmp_path}.*pip install --force-reinstall --no-deps robosuite==1.5.1"):
        RobosuiteArm(1)


@needs_robosuite
def test_robosuite_prints_nothing():
    """In a process of its own, where it is imported for the first time and warnings are errors."""
    code = (
        "import numpy as np, os\n"
        "from hindrl_jax.experts.robosuite_arm import RobosuiteArm\n"
        "arm = RobosuiteArm(1)\n"
        "arm.reset(np.zeros(7)), arm.step(np.zeros(6))\n"
        "print('MUJOCO_GL' in os.environ)"
    )
    environment = {name: value for name, value in os.environ.items() if name != "MUJOCO_GL"}
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=True, env=environment)
    assert (done.stdout, done.stderr) == ("False\n", "")
