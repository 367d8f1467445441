"""Runs that are stuck begin anew."""

import dataclasses

import jax
import numpy as np
import pytest
import tiny
from toy_env import Corridor, corridor_demonstrations

import hindrl_jax as hindrl
from hindrl_jax.runs.checkpoints import Checkpoints
from hindrl_jax.training.resetting import resets


@pytest.mark.parametrize(
    ("success", "at"),
    [
        ([0.0] * 10, []),  # it has nothing to learn anew from
        ([0.5] * 10, [30, 60, 90]),
        ([0.5, 0.59, 0.41, 0.55, 0.5, 0.59, 0.5, 0.5, 0.5, 0.5], [30, 60, 90]),  # noise: the standard error is 0.05
        ([0.5, 0.61, 0.6, 0.6, 0.6, 0.6, 0.6, 0.6, 0.6, 0.6], [40, 70]),  # better at 20
        ([0.1, 0.2, 0.3, 0.4, 0.4, 0.4, 0.4, 0.4, 0.4, 0.4], []),  # it took 30 steps, was given 30 more, and is stuck at 60: too late
        ([0.1, 0.1, 0.3, 0.5, 0.6, 0.75, 0.7, 0.7, 0.7, 0.7], []),  # 60
        ([0.5, 0.5, 0.96, 0.3, 0.3, 0.3, 0.3, 0.3, 0.3, 0.3], []),  # it was enough once
        ([0.5, 0.5, 0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0], [30]),  # the second agent solves nothing
        ([0.5, 0.5, 0.5, 0.2, 0.4, 0.6, 0.8, 0.96, 0.9, 0.9], [30]),
        ([0.94, 0.94, 0.95, 0.94, 0.94, 0.94, 0.94, 0.94, 0.94, 0.94], []),  # so it was here, by however little
        ([0.5, 0.5], []),
    ],
)
def test_a_run_begins_anew_where_nothing_was_better_for_long(success, at):
    steps = list(range(10, 10 * len(success) + 1, 10))
    assert resets(steps, success, of=100, num_episodes=100, enough=0.95) == [step for step in at if step <= steps[-1]]


def test_it_does_not_where_too_few_steps_are_left():
    steps, success = [10, 20, 30, 40, 50, 60, 70, 80, 90], [0.1, 0.2, 0.3, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5]
    assert resets(steps, success, of=120, num_episodes=100, enough=0.95) == [80]
    assert resets(steps, success, of=119, num_episodes=100, enough=0.95) == []


ENV = Corridor(width=4.5)
"""At a rate at which nothing is learnt, seed 3 solves a fifth of its episodes with sampled actions, and seed 4 all of them."""
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


def fit(config=CONFIG, **choices):
    return hindrl.fit(ENV, corridor_demonstrations((1.25, 1.7), env=ENV), config, seeds=[3, 4], **choices)


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
