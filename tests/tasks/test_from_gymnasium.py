"""Environments of Gymnasium, as tasks to learn."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from point_env import SPEED

import hindrl_jax as hindrl
from hindrl_jax.base.environments import Environment, holds_goal
from hindrl_jax.base.errors import UserError
from hindrl_jax.tasks import describing
from hindrl_jax.tasks.simulators import Simulators

POINT = "gymnasium:point_env:PointGoal-v0"


@pytest.fixture
def simulators():
    """Makes environments side by side, and ends them."""
    made = []

    def make(env, num_envs, **options):
        made.append(Simulators(env, num_envs, **options))
        return made[-1]

    yield make
    for one in made:
        one.close()


def test_it_is_an_environment_like_others():
    env = hindrl.make(POINT)
    assert isinstance(env, Environment)
    assert (env.name, env.horizon, env.observation_dim, env.goal_dim, env.action_dim) == (POINT, 10, 5, 2, 2)
    np.testing.assert_array_equal([env.action_low, env.action_high], [[-2, -2], [2, 2]])
    np.testing.assert_array_equal(env.achieved_goal(jnp.arange(10.0).reshape(2, 5)), [[3, 4], [8, 9]])
    np.testing.assert_allclose(env.goal_tolerance, [0.2 / 2**0.5] * 2)  # the square within a circle of radius 0.2
    assert env == hindrl.make(POINT)
    assert hash(env) == hash(hindrl.make(POINT))
    assert env != hindrl.make(POINT, horizon=7)


def test_arguments_go_to_gymnasium_and_survive_the_way_through_a_file():
    env = hindrl.make(POINT, says="success", horizon=7)
    assert env.arguments == {"says": "success"}
    assert hindrl.make(env.name, **dataclasses.asdict(env)) == env
    assert hindrl.make(POINT, make_kwargs=["says=reward"]) == hindrl.make(POINT, says="reward")  # a list, as JSON has it
    for word, value in (("False", False), ("false", False), ("None", None), ("null", None), ("3", 3), ("Falsely", "Falsely")):
        assert describing.arguments_of((f"says={word}",)) == {"says": value}


@pytest.mark.parametrize(
    ("name", "arguments", "message"),
    [
        ("gymnasium:PointGoal-v7", {}, "knows no environment 'PointGoal-v7' .did you mean 'PointGoal-v0'"),
        ("gymnasium:no_such_module:X-v0", {}, "no_such_module cannot be imported"),
        ("gymnasium:CartPole-v1", {}, "its actions are Discrete.2., which are discrete.* choose the continuous form"),
        ("gymnasium:PointGoalForever-v0", {}, "give a horizon"),
        (POINT, {"speed": 3}, "failed: .*unexpected keyword argument 'speed'"),
        (POINT, {"make_kwargs": ("says",)}, "NAME=VALUE"),
        (POINT, {"vectorization": "threads"}, "vectorization"),
        (POINT, {"success": "kept"}, "success"),
        (POINT, {"success": "held", "ends": True}, "ends episodes there: leave it out"),
        ("gymnasium:Pendulum-v1", {"success": "held"}, "is for environments that give goals"),
        (POINT, {"horizon": 0}, "at least 1"),
    ],
)
def test_what_cannot_be_is_refused_in_a_line(name, arguments, message):
    with pytest.raises(UserError, match=message):
        hindrl.make(name, **arguments)


@pytest.mark.parametrize("says", ["is_success", "success", "reward"])
def test_an_episode_ends_at_its_goal_with_its_true_last_observation(simulators, says):
    """Three points; the first goes to its goal, the second stands still, the third goes on when it has arrived and is reset."""
    env = hindrl.make(POINT, says=says)
    three = simulators(env, 3)
    observation, goal = three.begin(np.array([4, 5, 6]))
    num_solved = 0
    for _ in range(10):
        wish = np.clip((goal - observation[:, 3:]) / SPEED, -1, 1) * 2 * np.array([[1], [0], [1]])
        outcome = three.step(wish)
        np.testing.assert_allclose(outcome.next_observation[:, :2], np.clip(observation[:, :2] + SPEED * wish / 2, -1, 1), atol=1e-6)
        np.testing.assert_array_equal(outcome.next_observation[:, :2], outcome.next_observation[:, 3:])
        reached = np.linalg.norm(outcome.next_observation[:, 3:] - goal, axis=1) <= 0.2
        np.testing.assert_array_equal(outcome.success, reached)
        np.testing.assert_array_equal(outcome.terminated, reached)
        assert ((outcome.observation != outcome.next_observation).any(axis=1) == outcome.ended).all()
        assert ((outcome.desired_goal != goal).any(axis=1) == outcome.ended).all()
        num_solved += reached.sum()
        observation, goal = outcome.observation, outcome.desired_goal
    assert num_solved >= 4
    assert outcome.truncated.tolist() == [False, True, False]  # the second, at the horizon


@pytest.mark.parametrize(("arguments", "holds"), [({}, False), ({"ends": False}, True), ({"ends": True}, False), ({"success": "held"}, True)])
def test_a_goal_is_to_be_held_where_the_environment_goes_on_there_or_it_is_asked_for(arguments, holds):
    env = hindrl.make(POINT, **arguments)
    assert (env.success == "held", holds_goal(env)) == (holds, holds)
    assert hindrl.make(env.name, **dataclasses.asdict(env)) == env


@pytest.mark.parametrize("num_held", [1, 4])
def test_where_the_goal_is_to_be_held_only_the_last_step_counts(simulators, num_held):
    """The first point stays at its goal, the second goes beyond when it was there; both episodes last for their 10 steps."""
    two = simulators(hindrl.make(POINT, success="held"), 2, num_held=num_held)
    observation, goal = two.begin(np.array([4, 5]))
    success = []
    for _ in range(-(-10 // num_held)):
        away = any(step[1] for step in success)
        wish = np.clip((goal - observation[:, 3:]) / SPEED / num_held, -1, 1) * 2
        outcome = two.step(np.where([[False], [away]], 2.0, wish), autoreset=False)
        assert not outcome.terminated.any()
        success.append(outcome.success.tolist())
        observation = outcome.observation
    assert outcome.truncated.all()
    assert [1, 1] in success
    assert success[-1] == [1, 0]


@pytest.mark.parametrize("says", ["is_success", "reward"])
def test_held_actions_are_steps_with_the_same_action_up_to_the_goal(simulators, says):
    """Two points: the first moves towards its goal by a third of the way at a time, the second stands still, to its horizon of 10 steps."""
    env = hindrl.make(POINT, says=says)
    held, stepped = env.stepper(2, num_held=4), simulators(env, 2)
    observation, goal = held.begin(np.array([4, 5]))
    stepped.begin(np.array([4, 5]))
    wish = np.clip((goal - observation[:, 3:]) / SPEED / 3, -1, 1) * 2 * np.array([[1], [0]])
    assert (np.linalg.norm(goal - observation[:, 3:], axis=1) > 3 * 0.2).all()
    steps = [stepped.step(wish, autoreset=False) for _ in range(3)]
    outcome = held.step(wish)
    assert [bool(step.success[0]) for step in steps] == [False, False, True]
    assert outcome.success.tolist() == outcome.terminated.tolist() == [True, False]
    np.testing.assert_array_equal(outcome.next_observation[0], steps[-1].next_observation[0])  # a fourth step would lead beyond
    np.testing.assert_array_equal(outcome.next_observation[1], observation[1])
    truncated = [held.step(0.0 * wish).truncated[1] for _ in range(2)]
    assert truncated == [False, True]  # after 8 and 10 steps
    held.close()


@pytest.mark.parametrize("num_held", [1, 3])
def test_equal_seeds_give_equal_episodes_in_processes_of_their_own_as_well(simulators, num_held):
    env = hindrl.make(POINT)
    both = [simulators(env, 2, num_held=num_held), simulators(dataclasses.replace(env, vectorization="async"), 2, num_held=num_held)]
    begun = [one.begin(np.array([1, 2])) for one in both]
    np.testing.assert_array_equal(begun[0][0], begun[1][0])
    for step in range(12):  # beyond the horizon
        outcomes = [one.step(np.full((2, 2), 0.1 * step)) for one in both]
        for field in dataclasses.fields(outcomes[0]):
            np.testing.assert_array_equal(*(getattr(outcome, field.name) for outcome in outcomes), err_msg=field.name)


def test_actions_beyond_the_bounds_are_clipped(simulators):
    two = simulators(hindrl.make(POINT), 2)
    two.begin(np.array([3, 3]))
    observation = two.step(np.array([[9.0, -9.0], [2.0, -2.0]])).next_observation
    np.testing.assert_array_equal(observation[0], observation[1])
