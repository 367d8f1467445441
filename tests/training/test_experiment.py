"""Running experiments: exact length of a run, and seeds that do not depend on each other."""

import dataclasses
from pathlib import Path

import chex
import numpy as np
import pytest
from tiny import CONFIG, ENV

import hindrl_jax as hindrl
from hindrl_jax.config import SWEEPABLE, GoalConfig, sweepable_value, with_values
from hindrl_jax.runs import reader


@pytest.fixture(scope="module")
def demonstrations():
    return hindrl.record_demonstrations(ENV, 2)


def test_a_run_is_as_long_as_asked_and_seeds_do_not_depend_on_each_other(demonstrations):
    tables = [demonstrations, demonstrations.replace(states=None)]  # which are not asked for where they are not used
    together = hindrl.fit(ENV, tables, CONFIG, seeds=[3, 4])
    # 20 iterations of 2 environments at random, then 10 of learning, in chunks of one; evaluated at 60 alone, 20 steps after the warm-up
    assert (together.env_steps, together.updates, together.steps_done) == (60, 10, 60)
    assert [(row.seed, row.env_steps) for row in together.rows] == [(3, 60), (4, 60)]
    alone = hindrl.fit(ENV, demonstrations, CONFIG, seeds=[4])
    for name, value in alone.rows[0].metrics.items():
        np.testing.assert_allclose(value, together.rows[1].metrics[name], rtol=1e-3, atol=1e-5, err_msg=name)


def test_demonstrated_states_are_asked_for_where_they_are_used_and_then_for_every_seed(demonstrations):
    tables = [demonstrations, demonstrations.replace(states=None)]
    with pytest.raises(hindrl.UserError, match="needs the states"):
        hindrl.fit(ENV, tables, dataclasses.replace(CONFIG, demo_reset_ratio=0.5), seeds=[3, 4])
    with pytest.raises(hindrl.UserError, match="states of shape"):
        hindrl.fit(ENV, demonstrations.replace(states=demonstrations.states[..., :-1]), CONFIG)


# Every sweepable field, with a value other than CONFIG's, in a config where each of them has a say.
OTHER_VALUES = dict(
    union_sampling_ratio=0.9,
    gamma=0.7,
    epsilon_deviations=2.0,
    learning_rate=3e-3,
    target_update_rate=0.2,
    actor_average_span=3.0,
    initial_alpha=0.1,
    target_entropy=-2.0,
    final_target_entropy=-4.0,
    bc_weight=0.5,
)


def test_configs_that_differ_in_numbers_share_one_program(demonstrations):
    """Each run is its own: all numbers differ, and the other one is what it would be alone, with its numbers as constants of the program."""
    assert OTHER_VALUES.keys() == SWEEPABLE.keys()
    config = dataclasses.replace(
        CONFIG,
        batch=dataclasses.replace(CONFIG.batch, hindrl_sampling_strategy="joint_union", relabelled_per_original=1.0),
        goal=GoalConfig(epsilon_steps=2),
        agent=dataclasses.replace(CONFIG.agent, target_entropy=-1.0, final_target_entropy=-10.0),
    )
    other = with_values(config, OTHER_VALUES)
    assert all(sweepable_value(config, name) != sweepable_value(other, name) for name in SWEEPABLE)
    together = hindrl.fit(ENV, demonstrations, [config, other], seeds=[3, 3])
    first, second = (together.part(slice(index, index + 1)) for index in range(2))
    assert (first.config, first.seeds) == (dataclasses.replace(config, action_hold=1), (3,))
    alone = hindrl.fit(ENV, demonstrations, other, seeds=[3])
    assert (second.config, second.seeds, len(second.rows)) == (alone.config, (3,), len(alone.rows))
    for name, value in alone.rows[0].metrics.items():
        np.testing.assert_allclose(second.rows[0].metrics[name], value, rtol=1e-3, atol=1e-5, err_msg=name)
    chex.assert_trees_all_close(second.state.agent, alone.state.agent, rtol=1e-3, atol=1e-4)
    chex.assert_trees_all_close(second.guidance.epsilon, alone.guidance.epsilon, rtol=1e-5)
    with pytest.raises(hindrl.UserError, match="different configs"):
        hindrl.save_run("nowhere", together)
    assert not Path("nowhere").exists()
    metrics = [part.rows[0].metrics for part in (first, second)]
    assert all(metrics[0][name] != metrics[1][name] for name in metrics[0] if not name.startswith(("batch/", "evaluation/")))


def test_cloning_takes_as_many_updates_as_asked_and_no_environment_step(demonstrations):
    config = dataclasses.replace(CONFIG, algo="bc", steps=7, eval_every=1000)
    result = hindrl.fit(ENV, demonstrations, config, seeds=[0])
    assert (result.env_steps, result.updates) == (0, 7)


def test_the_reach_recipe_runs_from_demonstration_to_evaluation(tmp_path, monkeypatch):
    """With the options of the recipe but for a clone, in a task so coarse and networks so small that it takes seconds."""
    env = hindrl.make("ParameterizedReach", num_waypoints=1, position_tolerance=0.1, rotation_tolerance=0.3, horizon=100)
    recipe = hindrl.preset("hindrl", env=env)
    config = dataclasses.replace(
        recipe,
        steps=432,
        num_envs=2,
        updates_per_iteration=2,
        learning_starts=400,
        demo_reset_ratio=0.5,
        eval_every=16,
        eval_episodes=2,
        imitation_steps=0,
        practice_rounds=0,
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
    monkeypatch.setattr(reader, "draw_episodes", lambda path, env, episodes: path.touch())
    hindrl.save_run(tmp_path, result)
    (outcome,) = hindrl.load_run(tmp_path).evaluate(episodes=3)
    assert outcome["seed"] == 0
    assert 1 <= outcome["episode_length"] <= 100
