"""Runs that are saved and read back."""

import dataclasses
import json
import shutil

import chex
import numpy as np
import pytest
from tiny import CONFIG, ENV

import hindrl_jax as hindrl
from hindrl_jax.plotting import films


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """A result and the directory that it was saved in."""
    config = dataclasses.replace(CONFIG, algo="bc", steps=2, agent=dataclasses.replace(CONFIG.agent, input_encoding="standardised"))
    demonstrations = hindrl.record_demonstrations(ENV, 2)
    result, path = hindrl.fit(ENV, demonstrations, config, seeds=[0]), tmp_path_factory.mktemp("runs")
    hindrl.save_run(path, result)
    return result, path


def test_a_saved_run_sees_its_inputs_as_it_did_in_training(saved, tmp_path):
    result, path = saved
    scale = hindrl.load_run(path).policies.scale
    chex.assert_trees_all_equal(scale, result.guidance.scale)
    assert np.abs(scale.observation_centre).max() > 0.1
    # Runs from before there were centres had them at 0.
    older = shutil.copytree(path, tmp_path / "older")
    with np.load(path / "parameters.npz") as archive:
        np.savez(older / "parameters.npz", **{name: archive[name] for name in archive.files if not name.endswith("_centre")})
    scale = hindrl.load_run(older).policies.scale
    np.testing.assert_array_equal(scale.observation, result.guidance.scale.observation)
    assert not scale.observation_centre.any()
    assert not scale.goal_centre.any()
    assert scale.goal_centre.shape == scale.goal.shape == (1, ENV.goal_dim)


def test_a_film_that_cannot_be_drawn_is_a_warning(saved, tmp_path, monkeypatch):
    def no_screen(env):
        raise hindrl.UserError("no OpenGL library can draw")

    monkeypatch.setattr(films, "viewer", no_screen)
    with pytest.warns(UserWarning, match=r"no episode\.gif: no OpenGL"):
        summary = hindrl.save_run(tmp_path, saved[0])
    assert json.loads((tmp_path / "summary.json").read_text()) == summary
    assert not (tmp_path / "episode.gif").exists()
    assert hindrl.load_run(tmp_path).spec.seeds == (0,)


def test_damaged_parameters_are_refused(saved, tmp_path):
    result, path = saved
    with pytest.raises(hindrl.UserError, match="already holds a run"):
        hindrl.save_run(path, result)
    tmp_path = shutil.copytree(path, tmp_path / "copy")
    file = tmp_path / "parameters.npz"
    file.write_bytes(file.read_bytes()[:200])
    with pytest.raises(hindrl.UserError, match="damaged"):
        hindrl.load_run(tmp_path)
    file.unlink()
    with pytest.raises(hindrl.UserError, match="did not finish"):
        hindrl.load_run(tmp_path)
