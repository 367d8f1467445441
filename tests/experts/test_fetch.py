"""The experts of the Fetch tasks, in the real environments."""

import numpy as np
import pytest

import hindrl_jax as hindrl
from hindrl_jax.base.errors import UserError
from hindrl_jax.experts.fetch import FetchPickAndPlaceExpert, FetchPushExpert, FetchReachExpert, FetchSlideExpert, _sliding_velocity
from hindrl_jax.tasks.registry import task
from hindrl_jax.tasks.simulators import Simulators

pytest.importorskip("gymnasium_robotics")


@pytest.mark.parametrize(
    ("name", "expert", "dims"),
    [
        ("gymnasium:FetchReach-v4", FetchReachExpert, (13, 3, 4)),
        ("gymnasium:FetchPickAndPlace-v4", FetchPickAndPlaceExpert, (28, 3, 4)),
        ("gymnasium:FetchPush-v4", FetchPushExpert, (28, 3, 4)),
        ("gymnasium:FetchSlide-v4", FetchSlideExpert, (28, 3, 4)),
    ],
)
def test_demonstrations_reach_their_goals_soon(name, expert, dims):
    env = hindrl.make(name)
    assert task(name).expert is expert
    assert (env.observation_dim, env.goal_dim, env.action_dim) == dims
    assert env.horizon == 50
    np.testing.assert_allclose(env.goal_tolerance, 0.05 / 3**0.5)
    demonstrations = hindrl.record_demonstrations(env, 6)
    last = demonstrations.observations[np.arange(6), demonstrations.lengths]
    assert (np.linalg.norm(env.achieved_goal(last) - demonstrations.desired_goals, axis=1) <= 0.05).all()
    assert demonstrations.lengths.tolist() == [50] * 6  # they stay at their goals, to the end
    assert demonstrations.rewards.argmax(axis=1).max() < 45
    assert np.abs(demonstrations.actions).max() <= 1.0


@pytest.mark.parametrize("expert", [FetchReachExpert(noise=0.0), FetchPickAndPlaceExpert(noise=0.0), FetchPushExpert()])
def test_nearly_every_episode_is_solved(expert):
    """The recorder gives up after as many episodes as there are demonstrations and one."""
    env = hindrl.make(f"gymnasium:{expert.tasks}-v4")
    hindrl.record_gymnasium(env, expert.act, 8, seed=1, max_attempts=9)


def test_two_pucks_in_five_or_more_are_hit_to_their_goals():
    """Some goals are out of reach. Of 100 episodes it was 60; a hit in a wrong direction reaches one goal in ten."""
    env = hindrl.make("gymnasium:FetchSlide-v4", success="reached")
    hindrl.record_gymnasium(env, FetchSlideExpert().act, 8, seed=1, max_attempts=20)


@pytest.mark.parametrize("velocity", [(0.03, 0.01), (0.01, -0.02), (-0.02, 0.02), (0.02, 0.0)])
def test_a_puck_that_slides_off_at_the_velocity_comes_to_rest_at_the_goal(velocity):
    """Friction slows the faster of x and y alone, until both are equally fast, then each by half."""
    position, velocity, slices = np.zeros(2), np.array(velocity), 1_000
    start = velocity.copy()
    while np.abs(velocity).max() > 1e-5:
        slower = np.abs(np.abs(velocity[0]) - np.abs(velocity[1])) < 2e-6
        shares = np.full(2, 0.5) if slower else np.eye(2)[np.argmax(np.abs(velocity))]
        velocity = np.sign(velocity) * np.maximum(np.abs(velocity) - shares * 0.1 * 9.8 * 0.04**2 / slices, 0.0)
        position = position + velocity / slices
    np.testing.assert_allclose(_sliding_velocity(position), start, rtol=0.02, atol=5e-4)


def test_noise_must_not_be_negative():
    with pytest.raises(ValueError, match="noise"):
        FetchReachExpert(noise=-1.0)


def test_a_task_without_expert_says_what_to_do():
    with pytest.raises(UserError, match="record_gymnasium"):
        hindrl.record_demonstrations(hindrl.make("gymnasium:FetchReachDense-v4"), 1)


def test_it_draws_itself():
    simulators = Simulators(hindrl.make("gymnasium:FetchReach-v4"), 1, render_mode="rgb_array")
    simulators.begin(np.array([0]))
    try:
        picture = simulators.picture()
    except UserError as error:
        pytest.skip(str(error))
    finally:
        simulators.close()
    assert picture.shape == (480, 480, 3)
    assert picture.std() > 10
