"""Running experiments: thresholds of the summary, exact length of a run, and seeds that do not depend on each other."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

import hindrl_jax as hindrl
from hindrl_jax.config import AgentConfig, BatchConfig, TrainConfig
from hindrl_jax.experiment import Result, Row

ENV = hindrl.make("FixedGridPickAndPlace", size=4, random_box_size=1, horizon=20)
CONFIG = TrainConfig(
    steps=60,
    num_envs=2,
    updates_per_iteration=1,
    learning_starts=40,
    buffer_size=200,
    eval_every=20,
    eval_episodes=4,
    batch=BatchConfig(batch_size=8, n_step=2),
    agent=AgentConfig(net_arch=(4,), num_quantiles=3, top_quantiles_to_drop_per_net=1),
)


@pytest.fixture(scope="module")
def demonstrations():
    return hindrl.record_demonstrations(ENV, 2).episodes


def row(seed, env_steps, success):
    return Row(seed=seed, env_steps=env_steps, updates=env_steps // 10, seconds=env_steps / 100, success=success, episode_length=9.0, metrics={})


def test_summary_takes_the_first_evaluation_at_95_percent():
    rows = [row(1, 100, 0.94), row(2, 100, 0.5), row(1, 200, 0.95), row(2, 200, 0.6), row(1, 300, 0.9), row(2, 300, 0.7)]
    result = Result(
        env=ENV,
        config=CONFIG,
        seeds=(1, 2),
        guidance=None,
        state=None,
        rows=rows,
        compile_seconds=1.0,
        train_seconds=3.0,
        steps_done=300,
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


def test_damaged_parameters_are_refused(demonstrations, tmp_path):
    result = hindrl.fit(ENV, demonstrations, dataclasses.replace(CONFIG, algo="bc", steps=2), seeds=[0])
    hindrl.save_run(tmp_path, result)
    with pytest.raises(hindrl.UserError, match="already holds a run"):
        hindrl.save_run(tmp_path, result)
    file = tmp_path / "parameters.npz"
    file.write_bytes(file.read_bytes()[:200])
    with pytest.raises(hindrl.UserError, match="damaged"):
        hindrl.load_run(tmp_path)
    file.unlink()
    with pytest.raises(hindrl.UserError, match="did not finish"):
        hindrl.load_run(tmp_path)
