"""`hindrl train --render-every`: episodes along a run. In process, with a run that is as short as can be."""

import dataclasses
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from commands import TINY, refusal
from PIL import Image

import hindrl_jax as hindrl
from hindrl_jax import cli
from hindrl_jax.base.errors import UserError
from hindrl_jax.config import TrainConfig
from hindrl_jax.runs import films
from hindrl_jax.runs.reader import load_run
from hindrl_jax.tasks import registry

TRAIN = ["train", "--env", "FixedGridPickAndPlace", "--seed", "5", *TINY]


def frames(path):
    with Image.open(path) as film:
        pictures = []
        for index in range(film.n_frames):
            film.seek(index)
            pictures.append(np.asarray(film.convert("RGB")))
    return np.stack(pictures)


def test_films_are_of_the_policy_of_their_moment(tmp_path, capsys):
    """With TINY a run learns from step 200 to 260, in chunks of 4 steps; the last film is of the policy that the run ends with."""
    out = tmp_path / "run"
    (out / "films").mkdir(parents=True)
    (out / "films" / "step_999.gif").touch()  # of a run that is overwritten
    cli.main([*TRAIN, "--render-every", "130", "--out", str(out), "--overwrite"])
    assert sorted(path.name for path in (out / "films").iterdir()) == ["step_204.gif", "step_260.gif"]
    assert ", films\n" in capsys.readouterr().out
    assert not np.array_equal(*(frames(out / "films" / f"step_{step}.gif")[10:20] for step in (204, 260)))
    load_run(out, last=True).render(tmp_path / "last.gif", key=jax.random.key(0))
    np.testing.assert_array_equal(frames(out / "films" / "step_260.gif"), frames(tmp_path / "last.gif"))


def test_a_film_that_cannot_be_drawn_does_not_end_the_run(tmp_path, monkeypatch):
    monkeypatch.setattr(films.Run, "render", lambda run, path: (_ for _ in ()).throw(UserError("no OpenGL")))
    along = films.Films(tmp_path, hindrl.make("FixedGridPickAndPlace"), 10)
    monkeypatch.setattr(films, "_run_of", lambda result, index, path: films.Run(path, None, None, None))
    config = TrainConfig(steps=100)
    for steps in (0, 9):
        along.film_when_due(SimpleNamespace(steps_done=steps, config=config))
    with pytest.warns(UserWarning, match=r"no film step_012\.gif: no OpenGL"):
        along.film_when_due(SimpleNamespace(steps_done=12, config=config))


def test_refusals(tmp_path, capsys, monkeypatch):
    out = tmp_path / "run"
    refused = refusal(capsys, *TRAIN, "--render-every", "0", "--out", out)
    assert "--render-every 0 is too few: give the number of steps between two films" in refused
    undrawn = dataclasses.replace(registry.TASKS["FixedGridPickAndPlace"], viewer=None)
    monkeypatch.setitem(registry.TASKS, "FixedGridPickAndPlace", undrawn)
    assert "nothing draws FixedGridPickAndPlace" in refusal(capsys, *TRAIN, "--render-every", "30", "--out", out)
    assert not out.exists()
