"""Running experiments: thresholds of the summary, exact length of a run, and seeds that do not depend on each other."""

import dataclasses
import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import chex
import numpy as np
import pytest
from tiny import CONFIG, ENV

import hindrl_jax as hindrl
from hindrl_jax.config import SWEEPABLE, GoalConfig, sweepable_value, with_values
from hindrl_jax.plotting import films
from hindrl_jax.runs import writer as runs
from hindrl_jax.training.result import Result, Row


@pytest.fixture(scope="module")
def demonstrations():
    return hindrl.record_demonstrations(ENV, 2)


def row(seed, env_steps, success):
    return Row(seed=seed, env_steps=env_steps, updates=env_steps // 10, seconds=env_steps / 100, success=success, episode_length=9.0, metrics={})


def test_summary_takes_the_first_evaluation_at_95_percent():
    rows = [row(1, 100, 0.94), row(2, 100, 0.5), row(1, 200, 0.95), row(2, 200, 0.6), row(1, 300, 0.9), row(2, 300, 0.7)]
    result = Result(
        env=ENV,
        configs=(CONFIG, CONFIG),
        seeds=(1, 2),
        guidance=None,
        state=None,
        rows=rows,
        compile_seconds=1.0,
        train_seconds=3.0,
        env_steps=300,
        final_success=np.array([0.91, 0.8]),
        final_length=np.array([8.0, 10.0]),
    )
    reached, never = result.summaries()
    assert (reached.env_steps_to_95, reached.updates_to_95, reached.seconds_to_95) == (200, 20, 2.0)
    assert (reached.best_success, reached.final_success, reached.episode_length) == (0.95, 0.91, 8.0)
    assert (never.env_steps_to_95, never.updates_to_95, never.seconds_to_95) == (None, None, None)
    assert never.best_success == 0.8  # the final evaluation counts
    assert result.latest_success() == pytest.approx(0.8)


def test_a_run_is_as_long_as_asked_and_seeds_do_not_depend_on_each_other(demonstrations):
    together = hindrl.fit(ENV, demonstrations, CONFIG, seeds=[3, 4])
    # 20 iterations of 2 environments at random, then 10 of learning, in chunks of one; evaluated at 60 alone, 20 steps after the warm-up
    assert (together.env_steps, together.updates, together.steps_done) == (60, 10, 60)
    assert [(row.seed, row.env_steps) for row in together.rows] == [(3, 60), (4, 60)]
    alone = hindrl.fit(ENV, demonstrations, CONFIG, seeds=[4])
    for name, value in alone.rows[0].metrics.items():
        np.testing.assert_allclose(value, together.rows[1].metrics[name], rtol=1e-3, atol=1e-5, err_msg=name)


def test_demonstrated_states_are_asked_for_only_where_they_are_used_and_then_for_every_seed(demonstrations):
    tables = [demonstrations, demonstrations.replace(states=None)]
    with pytest.raises(hindrl.UserError, match="needs the states"):
        hindrl.fit(ENV, tables, dataclasses.replace(CONFIG, demo_reset_ratio=0.5), seeds=[3, 4])
    assert hindrl.fit(ENV, tables, CONFIG, seeds=[3, 4]).env_steps == 60
    with pytest.raises(hindrl.UserError, match="states of shape"):
        hindrl.fit(ENV, demonstrations.replace(states=demonstrations.states[..., :-1]), CONFIG)


# Every sweepable field, with a value other than CONFIG's, in a config where each of them has a say.
OTHER_VALUES = dict(
    union_sampling_ratio=0.9,
    gamma=0.7,
    k=2.0,
    learning_rate=3e-3,
    final_learning_rate=1e-3,
    target_update_rate=0.2,
    actor_average_rate=0.5,
    actor_average_span=3.0,
    initial_alpha=0.1,
    target_entropy=-2.0,
    final_target_entropy=-4.0,
    bc_weight=0.5,
    final_bc_weight=0.2,
)


def test_configs_that_differ_in_numbers_share_one_program(demonstrations):
    """Each run is what it would be alone, with its numbers as constants of the program."""
    assert OTHER_VALUES.keys() == SWEEPABLE.keys()
    config = dataclasses.replace(
        CONFIG,
        batch=dataclasses.replace(CONFIG.batch, hindrl_sampling_strategy="joint_union", relabelled_per_original=1.0),
        goal=GoalConfig(m=2),
        agent=dataclasses.replace(CONFIG.agent, final_learning_rate=1e-4, final_bc_weight=0.01),
    )
    other = with_values(config, OTHER_VALUES)
    assert all(sweepable_value(config, name) != sweepable_value(other, name) for name in SWEEPABLE)
    together = hindrl.fit(ENV, demonstrations, [config, other], seeds=[3, 3])
    alone = [hindrl.fit(ENV, demonstrations, each, seeds=[3]) for each in (config, other)]
    for index, single in enumerate(alone):
        part = together.part(slice(index, index + 1))
        assert (part.config, part.seeds, len(part.rows)) == (single.config, (3,), len(single.rows))
        for name, value in single.rows[0].metrics.items():
            np.testing.assert_allclose(part.rows[0].metrics[name], value, rtol=1e-3, atol=1e-5, err_msg=name)
        chex.assert_trees_all_close(part.state.agent, single.state.agent, rtol=1e-3, atol=1e-4)
        chex.assert_trees_all_close(part.guidance.epsilon, single.guidance.epsilon, rtol=1e-5)
    with pytest.raises(hindrl.UserError, match="different configs"):
        hindrl.save_run("nowhere", together)
    assert not Path("nowhere").exists()
    metrics = [single.rows[0].metrics for single in alone]
    assert all(metrics[0][name] != metrics[1][name] for name in metrics[0] if not name.startswith("batch/"))


@pytest.mark.parametrize(
    ("configs", "message"),
    [
        ([CONFIG], "1 configs for 2 seeds"),
        ([CONFIG, dataclasses.replace(CONFIG, num_envs=4)], "may differ only in union_sampling_ratio, gamma"),
        ([CONFIG, with_values(CONFIG, {"final_learning_rate": 1e-3})], "final_learning_rate is None in some"),
    ],
)
def test_configs_that_need_programs_of_their_own_are_refused(configs, message, demonstrations):
    with pytest.raises(hindrl.UserError, match=message):
        hindrl.fit(ENV, demonstrations, configs, seeds=[0, 1])


def test_cloning_takes_as_many_updates_as_asked_and_no_environment_step(demonstrations):
    config = dataclasses.replace(CONFIG, algo="bc", steps=7, eval_every=1000)
    result = hindrl.fit(ENV, demonstrations, config, seeds=[0])
    assert (result.env_steps, result.updates) == (0, 7)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seeds": []}, "at least one"),
        ({"seeds": [-1]}, "at least one whole number"),
        ({"tables": 1, "seeds": [0, 1]}, "1 tables of demonstrations for 2 seeds"),
        ({"env": hindrl.make("FixedGridPickAndPlace", size=4, random_box_size=1, horizon=21)}, "do not fit"),
        ({"config": dataclasses.replace(CONFIG, steps=40)}, "steps = 40 ends within the 40 random steps"),
        ({"config": dataclasses.replace(CONFIG, buffer_size=79)}, "buffer_size = 79"),
    ],
)
def test_what_does_not_fit_is_refused(changes, message, demonstrations):
    given = SimpleNamespace(**({"env": ENV, "config": CONFIG, "seeds": [0], "tables": None} | changes))
    tables = demonstrations if given.tables is None else [demonstrations] * given.tables
    with pytest.raises(hindrl.UserError, match=message):
        hindrl.fit(given.env, tables, given.config, seeds=given.seeds)


@pytest.fixture(scope="module")
def saved(demonstrations, tmp_path_factory):
    """A result and the directory that it was saved in."""
    config = dataclasses.replace(CONFIG, algo="bc", steps=2, agent=dataclasses.replace(CONFIG.agent, input_encoding="standardised"))
    result, path = hindrl.fit(ENV, demonstrations, config, seeds=[0]), tmp_path_factory.mktemp("runs")
    hindrl.save_run(path, result)
    return result, path


def test_a_saved_run_sees_its_inputs_as_it_did_in_training(saved, tmp_path):
    result, path = saved
    scale = hindrl.load_run(path).scale
    chex.assert_trees_all_equal(scale, result.guidance.scale)
    assert np.abs(scale.observation_centre).max() > 0.1
    # Runs from before there were centres had them at 0.
    older = shutil.copytree(path, tmp_path / "older")
    with np.load(path / "parameters.npz") as archive:
        np.savez(older / "parameters.npz", **{name: archive[name] for name in archive.files if not name.endswith("_centre")})
    scale = hindrl.load_run(older).scale
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


@pytest.mark.parametrize("task", ["FixedParameterizedReach", "ParameterizedReach"])
def test_the_reach_recipe_runs_from_demonstration_to_evaluation(task, tmp_path, monkeypatch):
    """With every lever of the recipe, in a task so coarse and networks so small that it takes seconds."""
    env = hindrl.make(task, num_waypoints=1, position_tolerance=0.1, rotation_tolerance=0.3, horizon=100)
    recipe = hindrl.preset("hindrl", env=env)
    config = dataclasses.replace(
        recipe,
        steps=432,
        num_envs=2,
        updates_per_iteration=2,
        learning_starts=400,
        eval_every=16,
        eval_episodes=2,
        batch=dataclasses.replace(recipe.batch, batch_size=32),
        agent=dataclasses.replace(recipe.agent, net_arch=(8,)),
    )
    demonstrations = hindrl.record_demonstrations(env, 1)
    result = hindrl.fit(env, demonstrations, config, seeds=[0])
    assert all(np.isfinite(value) for row in result.rows for value in row.metrics.values())
    episodes = result.state.replay.episodes
    begun = np.asarray(episodes.observations)[np.asarray(episodes.lengths) > 0][:, 0]
    later = np.asarray(demonstrations.observations)[0, 1 : int(demonstrations.lengths[0])]
    assert np.isclose(begun[:, None], later[None], atol=1e-4).all(axis=-1).any()  # an episode that began in a demonstrated state
    monkeypatch.setattr(runs, "draw_episodes", lambda path, env, episodes: path.touch())
    hindrl.save_run(tmp_path, result)
    (outcome,) = hindrl.load_run(tmp_path).evaluate(episodes=3)
    assert outcome["seed"] == 0
    assert 1 <= outcome["episode_length"] <= 100


def test_goals_cannot_be_compared_where_hindsight_changes_none():
    env = hindrl.make("ParameterizedReach", num_waypoints=1)
    config = hindrl.preset("hindrl", env=env)
    batch = dataclasses.replace(config.batch, hindrl_sampling_strategy="joint_intersection")
    with pytest.raises(hindrl.UserError, match="joint_intersection compares goals"):
        hindrl.fit(env, hindrl.record_demonstrations(env, 1), dataclasses.replace(config, batch=batch), seeds=[0])
    goal = dataclasses.replace(config.goal, achieved_goal_ratio=0.5)
    with pytest.raises(hindrl.UserError, match="achieved_goal_ratio is for tasks"):
        hindrl.fit(env, hindrl.record_demonstrations(env, 1), dataclasses.replace(config, goal=goal), seeds=[0])


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
