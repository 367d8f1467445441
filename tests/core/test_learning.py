"""Learning from beginning to end. Minutes each: `make test-slow`."""

import dataclasses

import numpy as np
import pytest

import hindrl_jax as hindrl

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("algo", ["tqcfd", "hindrl", "smooth-hindrl"])
def test_one_demonstration_solves_the_fixed_grid(algo):
    env = hindrl.make("FixedGridPickAndPlace")
    seeds = [7001, 7002]
    demonstrations = [hindrl.record_demonstrations(env, 1, seed=seed) for seed in seeds]
    result = hindrl.fit(env, demonstrations, hindrl.preset(algo), seeds=seeds)
    assert (result.final_success >= 0.95).all(), result.final_success
    assert (result.final_length <= 46).all(), result.final_length  # the best possible is 41.5, the expert's 54.5
    assert all(np.isfinite(value) for row in result.rows for value in row.metrics.values())


def test_one_demonstration_solves_the_fixed_reach_task():
    env = hindrl.make("FixedParameterizedReach")
    seeds = [7001, 7002]
    demonstrations = [hindrl.record_demonstrations(env, 1, seed=seed) for seed in seeds]
    result = hindrl.fit(env, demonstrations, hindrl.preset("hindrl", env=env), seeds=seeds)
    assert all(summary.returned_success >= 0.95 for summary in result.summaries())
    assert (result.final_success >= 0.9).all(), result.final_success
    assert (result.final_length <= 220).all(), result.final_length  # the best possible is about 165, the demonstrations' 290


def test_hindsight_that_moves_the_waypoints_solves_the_random_reach_task():
    env = hindrl.make("ParameterizedReach")
    config = dataclasses.replace(hindrl.preset("hindrl", env=env), steps=40_000)
    result = hindrl.fit(env, hindrl.record_demonstrations(env, 100, seed=7001), config, seeds=[7001])
    (summary,) = result.summaries()
    assert summary.returned_success >= 0.9
    assert result.final_success[0] >= 0.85  # cloning alone ended at 0.25 at best
    assert result.final_length[0] <= 190  # the demonstrations' 255


def test_cloning_needs_many_demonstrations():
    env = hindrl.make("FixedGridPickAndPlace")
    few, many = (hindrl.fit(env, hindrl.record_demonstrations(env, count), hindrl.preset("bc")).final_success[0] for count in (1, 250))
    assert few < 0.3 < many


@pytest.mark.parametrize("name", ["BringNear", "CableInsertion"])
def test_cloning_solves_the_cable_tasks(name):
    env = hindrl.make(name)
    seeds = [7001, 7002]
    demonstrations = [hindrl.record_demonstrations(env, 20, seed=seed) for seed in seeds]
    result = hindrl.fit(env, demonstrations, hindrl.preset("bc", env=env), seeds=seeds)
    success = [summary.returned_success for summary in result.summaries()]
    assert min(success) >= 0.8, success


@pytest.mark.parametrize("name", ["BringNear", "CableInsertion"])
def test_what_was_learnt_in_closed_form_holds_in_mujoco(name):
    (outcome,) = hindrl.load_run(f"policy:{name}").in_backend("mujoco").evaluate(episodes=25)
    assert outcome["success"] >= 0.9
