"""What an experiment leaves: the thresholds of its summary."""

import numpy as np
import pytest
from tiny import CONFIG, ENV

from hindrl_jax.training.result import Result, Row
from hindrl_jax.training.selection import Returned


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
        kept=None,
        rows=rows,
        compile_seconds=1.0,
        train_seconds=3.0,
        env_steps=300,
        final_success=np.array([0.91, 0.8]),
        final_length=np.array([8.0, 10.0]),
        evaluation_steps=np.array([700, 800]),
        returned=Returned(
            actor=None,
            noise=np.array([1.0, 0.0]),
            success=np.array([0.97, 0.75]),
            length=np.array([7.0, 9.0]),
            env_steps=np.array([200, 300]),
            updates=np.array([20, 30]),
            seconds=np.array([2.0, 3.0]),
        ),
    )
    reached, never = result.summaries()
    assert (reached.env_steps_to_95, reached.updates_to_95, reached.seconds_to_95) == (200, 20, 2.0)
    assert (reached.final_success, reached.episode_length) == (0.91, 8.0)
    assert (never.env_steps_to_95, never.updates_to_95, never.seconds_to_95) == (None, None, None)
    assert (reached.returned_success, reached.returned_length, reached.evaluation_steps) == (0.97, 7.0, 700)
    assert (reached.returned_noise, never.returned_noise) == (1.0, 0.0)
    assert (never.returned_env_steps, never.returned_updates, never.returned_seconds) == (300, 30, 3.0)
    assert result.latest_success() == pytest.approx(0.8)
