"""What training takes from demonstrations: epsilon, the goal table, behavioural goals, scales, states to begin in."""

import dataclasses

import chex
import jax.numpy as jnp
import numpy as np
import pytest
from toy_env import Corridor, corridor_demonstrations

from hindrl_jax.base.errors import UserError
from hindrl_jax.base.types import Episodes
from hindrl_jax.config import GoalConfig, QuirksConfig, TrainConfig
from hindrl_jax.core.guidance import guidance

ENV = Corridor(horizon=5, width=3.0)
# One demonstration in steps of 1, whose achieved goals are 0, 1, 2, 3, 4, and one in steps of 2: 0, 2, 4. Lengths 4 and 2.
TWO_SPEEDS = (1.0, 2.0)


def guidance_of(goal=None, quirks=None, speeds=TWO_SPEEDS):
    config = TrainConfig(goal=goal or GoalConfig(), quirks=quirks or QuirksConfig())
    return guidance(corridor_demonstrations(speeds, env=ENV), ENV, config)


def goals_of(table):
    return table.goals[: int(table.count), 0].tolist()


def test_guidance_by_default():
    data = guidance_of()
    assert goals_of(data.goals) == [0.0, 1.0, 2.0, 3.0, 4.0, 0.0, 2.0, 4.0]
    assert goals_of(data.behavioural_goals) == [4.0, 4.0]
    np.testing.assert_allclose(data.epsilon, [8 / 6], rtol=1e-6)  # four steps of 1 and two of 2
    # The mean of the 5 + 3 goals is 2, and their variance (4 + 1 + 0 + 1 + 4 + 4 + 0 + 4) / 8 = 1.5^2.
    np.testing.assert_allclose([data.scale.goal[0], data.scale.goal_centre[0]], [1.5, 2.0], rtol=1e-6)
    np.testing.assert_allclose(data.scale.observation[2], 1.5, rtol=1e-6)
    demonstrations = data.demonstrations
    assert demonstrations.desired_goals.tolist() == [[4.0], [4.0]]
    given = corridor_demonstrations(TWO_SPEEDS)
    for field in dataclasses.fields(Episodes):
        if field.name not in ("desired_goals", "states"):
            np.testing.assert_array_equal(getattr(demonstrations, field.name), getattr(given, field.name))
    assert demonstrations.states is None  # they would only travel along
    assert data.starts is None


def test_goals_stand_beside_the_observations_that_reach_them():
    # Observations are (10 + demonstration, step, position).
    data = guidance_of(GoalConfig(epsilon=1.0, epsilon_filtering=True))
    assert data.goals.observations[: int(data.goals.count)].tolist() == [
        [10.0, 0.0, 0.0],
        [10.0, 2.0, 2.0],
        [10.0, 4.0, 4.0],
        [11.0, 0.0, 0.0],
        [11.0, 1.0, 2.0],
        [11.0, 2.0, 4.0],
    ]


def test_guidance_reads_no_padding():
    clean = corridor_demonstrations(TWO_SPEEDS, env=ENV)
    inside = (np.arange(6) <= np.asarray(clean.lengths)[:, None])[..., None]
    dirty = clean.replace(observations=jnp.asarray(np.where(inside, clean.observations, np.nan)))
    config = TrainConfig(goal=GoalConfig(epsilon_steps=1, epsilon_deviations=1.0, epsilon_filtering=True))
    expected, found = (guidance(demonstrations, ENV, config) for demonstrations in (clean, dirty))
    for name in ("epsilon", "behavioural_goals", "scale"):
        chex.assert_trees_all_close(getattr(found, name), getattr(expected, name))
    assert goals_of(found.goals) == goals_of(expected.goals)


@pytest.mark.parametrize(
    ("goal", "quirks", "expected"),
    [
        (dict(), dict(), [0.0, 1.0, 1.0, 3.0, 4.0, 5.0]),
        (dict(), dict(exclude_last_goal=True), [0.0, 1.0, 1.0, 4.0]),
        (dict(epsilon_filtering=True, epsilon=0.0), dict(), [0.0, 1.0, 3.0, 4.0, 5.0]),
        (dict(epsilon_filtering=True, epsilon=0.0), dict(strict_goal_test=True), [0.0, 1.0, 3.0, 4.0, 5.0]),  # the filter has no strict form
        (dict(epsilon_filtering=True, epsilon=1.0), dict(), [0.0, 3.0, 4.0]),
        (dict(epsilon_filtering=True, epsilon=1.0), dict(strict_goal_test=True), [0.0, 3.0, 4.0]),
        (dict(epsilon_filtering=True, epsilon=1.0), dict(exclude_last_goal=True), [0.0, 4.0]),  # 4 is all that its demonstration has
        (dict(epsilon_filtering=True, epsilon=3.0), dict(exclude_last_goal=True), [0.0, 4.0]),
        (dict(epsilon_filtering=True, epsilon=1.5), dict(), [0.0, 3.0, 4.0]),  # the filter starts again in every demonstration: 4 is near 3 and stays
    ],
)
def test_goals_that_are_kept_by_hand(goal, quirks, expected):
    # The demonstrations reach 0, 1, 1, 3 and 4, 5; what is at 99 is padding.
    positions = np.array([[0.0, 1.0, 1.0, 3.0], [4.0, 5.0, 99.0, 99.0]], np.float32)
    demonstrations = Episodes(
        observations=jnp.asarray(np.stack([0.0 * positions, 0.0 * positions, positions], axis=-1)),
        actions=jnp.zeros((2, 3, 2)),
        rewards=jnp.zeros((2, 3)),
        lengths=jnp.array([3, 1]),
        terminated=jnp.ones(2, bool),
        desired_goals=jnp.zeros((2, 1)),
    )
    data = guidance(demonstrations, ENV, TrainConfig(goal=GoalConfig(**goal), quirks=QuirksConfig(**quirks)))
    assert data.goals.goals.shape == (8, 1)
    assert goals_of(data.goals) == expected


def test_demonstrations_without_states_cannot_be_begun_in():
    demonstrations = corridor_demonstrations(TWO_SPEEDS).replace(states=None)
    with pytest.raises(UserError, match=r"demo_reset_ratio = 0\.1 needs the states of the demonstrations"):
        guidance(demonstrations, Corridor(), TrainConfig(demo_reset_ratio=0.1))
    assert guidance(demonstrations, Corridor(), TrainConfig()).starts is None


def test_behavioural_goal_may_be_the_one_of_the_task():
    data = guidance_of(GoalConfig(behavioural_goals="task"))
    assert goals_of(data.behavioural_goals) == [3.0]
    assert data.demonstrations.desired_goals.tolist() == [[3.0], [3.0]]


def test_where_nobody_knows_the_goal_it_is_the_mean_of_where_the_demonstrations_end():
    env = type("Unknown", (Corridor,), {"task_goal": lambda self: None})(horizon=5, width=3.0)
    data = guidance(corridor_demonstrations((1.0, 2.0, 1.5), env=ENV), env, TrainConfig(goal=GoalConfig(behavioural_goals="task")))
    assert goals_of(data.behavioural_goals) == [pytest.approx((4.0 + 4.0 + 4.5) / 3)]
    assert data.demonstrations.desired_goals.tolist() == [goals_of(data.behavioural_goals)] * 3


def test_behavioural_goals_may_be_those_that_the_demonstrations_came_with():
    demonstrations = corridor_demonstrations(TWO_SPEEDS, env=ENV).replace(desired_goals=jnp.array([[6.0], [7.0]]))
    data = guidance(demonstrations, ENV, TrainConfig(goal=GoalConfig(behavioural_goals="environment")))
    assert goals_of(data.behavioural_goals) == [6.0, 7.0]
    assert data.demonstrations.desired_goals.tolist() == [[6.0], [7.0]]


def test_where_goals_are_the_environments_own_their_scale_is_that_of_what_is_left_to_them():
    demonstrations = corridor_demonstrations(TWO_SPEEDS, env=ENV).replace(desired_goals=jnp.array([[6.0], [7.0]]))
    scale = guidance(demonstrations, ENV, TrainConfig(goal=GoalConfig(behavioural_goals="environment"))).scale
    left = [6.0, 5.0, 4.0, 3.0, 2.0, 7.0, 5.0, 3.0]
    np.testing.assert_allclose([*scale.goal_centre, *scale.goal], [np.mean(left), np.std(left)], rtol=1e-6)


def test_last_goals_may_be_excluded():
    assert goals_of(guidance_of(quirks=QuirksConfig(exclude_last_goal=True)).goals) == [0.0, 1.0, 2.0, 3.0, 0.0, 2.0]


def test_epsilon_and_filtering_follow_the_config():
    # Distances one step apart: 1, 1, 1, 1, 2, 2. Mean 8 / 6, variance (4 * 1 + 2 * 4) / 6 - (8 / 6)^2 = 2 / 9.
    assert guidance_of(GoalConfig(epsilon_steps=1)).epsilon[0] == pytest.approx(8 / 6)
    data = guidance_of(GoalConfig(epsilon_steps=1, epsilon_deviations=2.0, epsilon_filtering=True))
    assert data.epsilon[0] == pytest.approx(8 / 6 + 2 * (2 / 9) ** 0.5)  # 2.28
    assert goals_of(data.goals) == [0.0, 3.0, 0.0, 4.0]
    # With epsilon 0 only equal neighbours are dropped, and not even those under the strict test.
    assert goals_of(guidance_of(GoalConfig(epsilon_steps=0, epsilon_filtering=True)).goals) == [0.0, 1.0, 2.0, 3.0, 4.0, 0.0, 2.0, 4.0]
    assert guidance_of(GoalConfig(epsilon=0.25)).epsilon.tolist() == [0.25]


def test_the_last_goal_is_the_last_one_that_the_filter_keeps():
    # Demonstrations of 0, 1, 2, 3, 4 and 0, 2, 4. Epsilon 2.5 keeps 0, 3 and 0, 4: so 3 and 4 are dropped, and 3 is not the last state.
    goal = GoalConfig(epsilon=2.5, epsilon_filtering=True)
    assert goals_of(guidance_of(goal).goals) == [0.0, 3.0, 0.0, 4.0]
    assert goals_of(guidance_of(goal, QuirksConfig(exclude_last_goal=True)).goals) == [0.0, 0.0]


def test_demonstrated_actions_may_be_left_in_units_of_the_environment():
    actions = guidance_of(quirks=QuirksConfig(unscaled_demo_actions=True)).demonstrations.actions
    assert actions[0, :4].tolist() == [[1.0, 0.5]] * 4
    assert actions[1, :2].tolist() == [[2.0, 0.5]] * 2


def test_demonstrated_actions_may_be_paired_with_the_observation_after_them():
    env = Corridor(horizon=7, width=4.0)
    given = corridor_demonstrations((1.0, 1.25), env=env)
    # Actions that tell their step.
    given = given.replace(actions=given.actions.at[..., 1].set(np.arange(7) / 10.0 * np.ones((2, 1))))
    paired = guidance(given, env, TrainConfig(quirks=QuirksConfig(misaligned_demo_actions=True))).demonstrations
    assert paired.lengths.tolist() == [4, 3]
    for row, length in enumerate((4, 3)):
        assert paired.observations[row, : length + 1, 1].tolist() == list(range(1, length + 2))
        np.testing.assert_allclose(paired.actions[row, :length, 1], np.arange(length) / 10.0)
        assert paired.rewards[row, :length].tolist() == [0.0] * (length - 1) + [1.0]
