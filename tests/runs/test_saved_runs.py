"""Runs that are saved and read back."""

import dataclasses
import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny import CONFIG, ENV

import hindrl_jax as hindrl
from hindrl_jax.base.environments import action_to_env
from hindrl_jax.core.agent import policy
from hindrl_jax.core.inputs import network_inputs
from hindrl_jax.core.networks import apply_actor
from hindrl_jax.plotting import films
from hindrl_jax.runs.shipped import shipped


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


def test_a_saved_policy_chooses_between_its_actor_and_its_imitation_as_it_did_in_training(tmp_path):
    """What is read back has both, and the critics that choose; played, it does what the policy in memory does."""
    config = dataclasses.replace(CONFIG, imitation_steps=2, imitation_proposal=True)
    checkpoints = hindrl.Checkpoints(tmp_path / "checkpoint", seconds=0)
    result = hindrl.fit(ENV, hindrl.record_demonstrations(ENV, 2), config, seeds=[0], report=checkpoints.save_when_due)
    hindrl.save_run(tmp_path / "run", result)
    run = hindrl.load_run(tmp_path / "run", last=True)
    expected = policy(result.state.agent, config, average=True)
    assert expected.actor.keys() == {"actor", "imitation", "imitates", "critics"}
    chex.assert_trees_all_equal(run.policies, jax.device_get(expected))
    assert len(run.evaluate(episodes=3)) == 1
    assert run.play(2, seed=0).lengths.shape == (2,)
    # The same run, gone on with from its last checkpoint.
    again = hindrl.fit(ENV, hindrl.record_demonstrations(ENV, 2), config, seeds=[0], restore=checkpoints.restore)
    chex.assert_trees_all_equal(again.state.agent.imitation, result.state.agent.imitation)
    chex.assert_trees_all_equal(again.returned.actor, result.returned.actor)


def test_a_saved_clone_is_what_acts(tmp_path):
    """Of two seeds, the policies of one are returned as they were learnt, and the other's clone."""
    config = dataclasses.replace(CONFIG, imitation_steps=2, stop_at=None)
    result = hindrl.fit(ENV, hindrl.record_demonstrations(ENV, 2), config, seeds=[0, 1])
    actor = result.returned.actor | {"imitates": np.array([0, 1], np.int32)}
    result.returned = result.returned.replace(actor=actor, noise=np.array([0.0, 1.0]))
    hindrl.save_run(tmp_path, result)
    run, last = hindrl.load_run(tmp_path), hindrl.load_run(tmp_path, last=True)
    assert (run.policies.actor["imitates"].tolist(), last.policies.actor["imitates"].tolist()) == ([0, 1], [0, 0])
    rng = np.random.default_rng(0)
    observation, goal = rng.normal(size=(5, ENV.observation_dim)), rng.normal(size=(5, ENV.goal_dim))
    for index, (seed, network, agent) in enumerate([(0, "actor", config.agent), (1, "imitation", config.agent.for_imitation)]):
        of_seed = jax.tree.map(lambda leaf, index=index: jnp.asarray(leaf[index]), (actor[network], result.state.agent.scale))
        inputs = network_inputs(*map(jnp.asarray, (observation, ENV.achieved_goal(observation), goal)), of_seed[1], result.config)
        action = action_to_env(apply_actor(of_seed[0], inputs.T, agent, action_dim=ENV.action_dim).mode.T, ENV)
        for play in (run.policy(seed), run.numpy_policy(seed)):
            np.testing.assert_allclose(play(observation, goal), action, atol=1e-5)
    assert len(run.evaluate(episodes=2)) == 2


def test_a_film_that_cannot_be_drawn_is_a_warning(saved, tmp_path, monkeypatch):
    def no_screen(env):
        raise hindrl.UserError("no OpenGL library can draw")

    monkeypatch.setattr(films, "viewer", no_screen)
    with pytest.warns(UserWarning, match=r"no episode\.gif: no OpenGL"):
        summary = hindrl.save_run(tmp_path, saved[0])
    assert json.loads((tmp_path / "summary.json").read_text()) == summary
    assert not (tmp_path / "episode.gif").exists()
    assert hindrl.load_run(tmp_path).spec.seeds == (0,)


@pytest.mark.parametrize(
    ("animation", "said"),
    [
        (lambda states: ([state.no_such_field for state in states], []), "AttributeError: .*no_such_field"),
        (lambda states: [np.zeros((8, 8, 3), np.uint8)] * 3, "ValueError"),  # no seconds beside the pictures
        (lambda states: (["no picture"] * len(states), [0.1] * len(states)), "Error: "),
    ],
)
def test_a_viewer_of_ones_own_that_fails_is_a_warning_of_one_line(saved, tmp_path, monkeypatch, animation, said):
    viewer = SimpleNamespace(animation=lambda env, states, captions=None: animation(states))
    monkeypatch.setattr(films, "viewer", lambda env: viewer)
    monkeypatch.setattr(films, "is_registered_by_user", lambda env: True)
    with pytest.warns(UserWarning, match=rf"no episode\.gif: the viewer of .* fails \(.*{said}.*\): mend it"):
        hindrl.save_run(tmp_path / "run", saved[0])
    assert (tmp_path / "run" / "summary.json").exists()
    monkeypatch.setattr(films, "is_registered_by_user", lambda env: False)
    with pytest.raises(Exception, match=r".") as bug:  # one of ours is a bug, and says where
        hindrl.load_run(tmp_path / "run").render(tmp_path / "film.gif")
    assert not isinstance(bug.value, hindrl.UserError)


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


def test_policies_that_come_with_the_package_are_read_by_name(tmp_path, monkeypatch):
    run = hindrl.load_run("policy:FixedGridPickAndPlace")
    assert run.path == shipped()["FixedGridPickAndPlace"]
    assert run.spec.env == hindrl.make("FixedGridPickAndPlace")
    with pytest.raises(hindrl.UserError, match=r"no policy 'FixedGrid' comes with hindrl_jax.*: choose one of BringNear, "):
        hindrl.load_run("policy:FixedGrid")
    monkeypatch.chdir(tmp_path)
    shutil.copytree(run.path, tmp_path / "policy:mine")
    for own in (Path("policy:mine"), "./policy:mine", str(tmp_path / "policy:mine")):
        assert hindrl.load_run(own).spec == run.spec
