"""Hindsight steps and goals: exactly the promised support, drawn uniformly."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hindrl_jax.goals import GoalTable
from hindrl_jax.relabel import hindsight_steps, relabelled_goals

DRAWS = 400  # per transition; a state of an episode of 5 is missed by all of them with probability (5/6)^400 < 1e-31


def support_twin(step, length, strategy):
    """The states that may become the goal of transition `step`, as a plain loop."""
    states = []
    for state in range(length + 1):
        future = state > step
        if strategy == "episode" or (strategy == "future" and future) or (strategy == "final" and state == length):
            states.append(state)
    return states


@pytest.mark.parametrize("strategy", ["final", "future", "episode"])
def test_support_of_hindsight_steps(strategy):
    cases = [(t, length) for length in range(1, 6) for t in range(length)]
    steps, lengths = (jnp.repeat(jnp.array(column), DRAWS) for column in zip(*cases, strict=True))
    drawn = np.asarray(hindsight_steps(jax.random.key(1), steps, lengths, strategy=strategy)).reshape(len(cases), DRAWS)
    for (t, length), row in zip(cases, drawn, strict=True):
        assert sorted(set(row.tolist())) == support_twin(t, length, strategy), (t, length)


def test_future_steps_are_uniform():
    # States 2 .. 5 of an episode of 5: 4000 draws, 1000 each, standard deviation 27.
    drawn = np.asarray(hindsight_steps(jax.random.key(2), jnp.full(4000, 1), jnp.full(4000, 5), strategy="future"))
    counts = np.bincount(drawn, minlength=6)
    assert counts[:2].tolist() == [0, 0]
    assert np.abs(counts[2:] - 1000).max() < 140


# Goals of the demonstrations are 1, 2, 3 (the fourth row is padding), those of the rollouts are negative and name their row.
TABLE = GoalTable(goals=jnp.array([[1.0], [2.0], [3.0], [99.0]]), count=jnp.asarray(3))
ROLLOUT_GOALS = -1.0 - jnp.arange(2000.0)[:, None]


def draw(strategy, ratio=0.5):
    return np.asarray(relabelled_goals(jax.random.key(3), TABLE, ROLLOUT_GOALS, strategy=strategy, union_sampling_ratio=ratio))


@pytest.mark.parametrize("strategy", ["final", "future", "episode"])
def test_goals_of_the_own_episode_pass_through(strategy):
    np.testing.assert_array_equal(draw(strategy), ROLLOUT_GOALS)


def test_task_conditioned_goals_come_from_the_demonstrations():
    assert set(draw("task_conditioned", ratio=0.0)[:, 0].tolist()) == {1.0, 2.0, 3.0}


def test_union_takes_each_goal_from_either_source():
    np.testing.assert_array_equal(draw("joint_union", ratio=0.0), ROLLOUT_GOALS)
    assert set(draw("joint_union", ratio=1.0)[:, 0].tolist()) == {1.0, 2.0, 3.0}
    for ratio in (0.5, 0.2):
        goals = draw("joint_union", ratio=ratio)
        demonstrated = goals[:, 0] > 0
        # 2000 draws: the standard deviation of the share is at most 0.0112, and the bound is about five of them away.
        assert abs(demonstrated.mean() - ratio) < 0.056
        assert set(goals[demonstrated, 0].tolist()) == {1.0, 2.0, 3.0}
        np.testing.assert_array_equal(goals[~demonstrated], ROLLOUT_GOALS[~demonstrated])
