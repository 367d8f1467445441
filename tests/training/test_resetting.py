"""Runs that are stuck begin anew."""

import dataclasses

import jax
import numpy as np
import pytest
import tiny
from host_env import HostCorridor
from matplotlib.axes import Axes
from toy_env import Corridor, corridor_demonstrations

import hindrl_jax as hindrl
from hindrl_jax.plotting import curves
from hindrl_jax.runs.checkpoints import Checkpoints
from hindrl_jax.training.progress import reset_line
from hindrl_jax.training.resetting import resets


@pytest.mark.parametrize(
    ("success", "at"),
    [
        ([0.0] * 10, []),  # it has nothing to learn anew from
        ([0.15] * 10, []),
        ([0.5] * 10, [30, 60]),  # at 90 no agent would have the time that this one had
        ([0.5, 0.59, 0.41, 0.55, 0.5, 0.59, 0.5, 0.5, 0.5, 0.5], [30, 60]),  # noise: the standard error is 0.05
        ([0.5, 0.61, 0.6, 0.6, 0.6, 0.6, 0.6, 0.6, 0.6, 0.6], [40, 70]),  # better at 20
        ([0.1, 0.2, 0.3, 0.4, 0.4, 0.4, 0.4, 0.4, 0.4, 0.4], []),  # better until 40, and at 80 too little is left
        ([0.1, 0.1, 0.3, 0.5, 0.62, 0.75, 0.7, 0.7, 0.7, 0.7], []),  # better until 60
        ([0.5, 0.5, 0.96, 0.3, 0.3, 0.3, 0.3, 0.3, 0.3, 0.3], []),  # it was enough once
        ([0.5, 0.5, 0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0], [30]),  # the second agent solves nothing
        ([0.5, 0.5, 0.5, 0.2, 0.4, 0.6, 0.8, 0.96, 0.9, 0.9], [30]),
        ([0.94, 0.94, 0.95, 0.94, 0.94, 0.94, 0.94, 0.94, 0.94, 0.94], []),  # so it was here, by however little
        ([0.5, 0.5], []),
    ],
)
def test_a_run_begins_anew_where_nothing_was_better_for_long(success, at):
    steps = list(range(10, 10 * len(success) + 1, 10))
    assert resets(steps, success, of=100, num_episodes=100, enough=0.95) == at


def test_it_does_not_where_too_few_steps_are_left():
    steps, success = [10, 20, 30, 40, 50, 60, 70, 80, 90], [0.1, 0.2, 0.3, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5]
    assert resets(steps, success, of=120, num_episodes=100, enough=0.95) == [80]
    assert resets(steps, success, of=119, num_episodes=100, enough=0.95) == []


ENV = Corridor(width=4.0)
"""At a rate at which nothing is learnt, seed 3 solves two fifths of its episodes with sampled actions, and seed 4 all of them."""
CONFIG = dataclasses.replace(
    tiny.CONFIG,
    steps=240,
    buffer_size=600,  # all of them
    learning_starts=20,
    eval_every=20,
    eval_episodes=40,
    action_hold=1,
    network_resets=True,
    agent=dataclasses.replace(tiny.CONFIG.agent, learning_rate=1e-9),
)


def fit(config=CONFIG, *, env=ENV, seeds=(3, 4), **choices):
    return hindrl.fit(env, corridor_demonstrations((1.25, 1.7), env=ENV), config, seeds=seeds, **choices)


@pytest.fixture(scope="module")
def result():
    return fit()


@pytest.fixture(scope="module")
def unchanged():
    """The same, in which no networks are reset."""
    return fit(dataclasses.replace(CONFIG, network_resets=False))


def test_the_agent_of_a_run_that_is_stuck_is_fresh_and_the_other_goes_on(result, unchanged):
    assert unchanged.resets == [[], []]
    (*_, last), of_other = result.resets
    assert of_other == []
    assert [summary.network_resets for summary in result.summaries()] == [len(result.resets[0]), 0]
    assert np.asarray(result.state.updates).tolist() == [(result.env_steps - last) // CONFIG.num_envs, result.updates]
    kernels = [np.asarray(one.state.agent.actor["params"]["Dense_0"]["kernel"]) for one in (result, unchanged)]
    assert (np.abs(kernels[0] - kernels[1]).max(axis=(1, 2)) > 0.1).tolist() == [True, False]


def test_what_was_played_before_stays_in_the_replay(result, unchanged):
    replays = [jax.device_get(one.state.replay.episodes) for one in (result, unchanged)]
    ended = result.resets[0][0] // (CONFIG.num_envs * ENV.horizon) - 1  # episodes of the first environment, at least, that had ended then
    assert ended > 1
    for name in ("observations", "actions", "lengths"):
        first, second = (getattr(replay, name)[0, :ended] for replay in replays)
        np.testing.assert_array_equal(first, second, err_msg=name)


def test_a_run_that_was_killed_after_its_networks_were_reset_goes_on_as_it_would_have(result, tmp_path):
    checkpoints = Checkpoints(tmp_path, seconds=0)

    def report(so_far):
        checkpoints.save_when_due(so_far)
        if any(so_far.resets):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit(report=report)
    resumed = fit(restore=Checkpoints(tmp_path).restore)
    assert resumed.resets == result.resets
    jax.tree.map(np.testing.assert_array_equal, resumed.state.agent, result.state.agent)
    np.testing.assert_array_equal(resumed.returned.success, result.returned.success)


def test_a_run_that_is_ended_when_its_agent_is_stuck_keeps_it():
    """The last policy is the one that was evaluated, and not one that has learnt nothing."""
    ended = fit(report=lambda so_far: bool(so_far.are_stuck.any()))
    assert ended.env_steps < CONFIG.steps
    assert (ended.resets, ended.summaries()[0].network_resets) == ([[], []], 0)
    assert np.asarray(ended.state.updates).tolist() == [ended.updates] * 2


def test_fresh_agents_where_environments_are_stepped_outside_jax_and_where_settings_differ():
    """Each begins with the entropy coefficient of its own config."""
    others = [dataclasses.replace(CONFIG, agent=dataclasses.replace(CONFIG.agent, initial_alpha=alpha)) for alpha in (0.5, 0.1)]
    result = fit(others, env=HostCorridor(width=ENV.width), seeds=(3, 3))
    assert all(result.resets)
    assert (np.asarray(result.state.updates) < result.updates).all()
    np.testing.assert_allclose(np.exp(np.asarray(result.state.agent.log_alpha)), [0.5, 0.1], rtol=1e-3)


def test_what_is_said_and_drawn_of_it(result, tmp_path, monkeypatch):
    assert (
        reset_line([3, 4], np.array([True, False]), 40)
        == "       40 steps   seed 3 got no better for long: fresh networks learn from what was played"
    )
    assert "seeds 3, 4 got" in reset_line([3, 4], np.array([True, True]), 40)
    assert "1 of 2 runs got" in reset_line([3, 3], np.array([False, True]), 40)
    drawn, scatter = {}, Axes.scatter
    monkeypatch.setattr(Axes, "scatter", lambda axis, x, y, **given: drawn.update({given["label"]: (x, y)}) or scatter(axis, x, y, **given))
    curves.save_curve(result, tmp_path / "curve.png")
    steps, success = drawn["networks reset"]
    assert list(steps) == result.resets[0]
    assert list(success) == [100 * row.success for row in result.rows if row.seed == 3 and row.env_steps in result.resets[0]]
