"""Demonstrations as an environment judges them, by hand."""

import numpy as np
import pytest
from host_env import HostCorridor

from hindrl_jax.base.errors import UserError
from hindrl_jax.base.types import Episodes
from hindrl_jax.training.judging import as_judged_by, steps_to_goal


def table(*rewards, lengths):
    count, steps = np.shape(rewards)
    zeros = np.zeros((count, steps + 1, 1), np.float32)
    return Episodes(
        observations=zeros,
        actions=zeros[:, 1:],
        rewards=np.array(rewards, np.float32),
        lengths=np.array(lengths, np.int32),
        terminated=np.ones(count, bool),
        desired_goals=np.zeros((count, 1), np.float32),
    )


def env_with(success=None, *, gives_goals=True):
    return type("Judge", (HostCorridor,), {"gives_goals": gives_goals} | ({} if success is None else {"success": success}))()


STAYS = table([0, 1, 1, 1], [0, 0, 1, 9], [0, 0, 0, 0], lengths=[4, 3, 2])  # the 9 is padding


def test_steps_to_goal_by_hand():
    assert steps_to_goal(STAYS).tolist() == [2, 3, 2]


@pytest.mark.parametrize("success", ["reached", None])
def test_demonstrations_end_where_the_goal_is_first_reached(success):
    cut = as_judged_by(env_with(success), STAYS)
    assert cut.lengths.tolist() == [2, 3, 2]
    assert cut.rewards.tolist() == [[0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 0]]


@pytest.mark.parametrize("env", [env_with("held"), env_with(gives_goals=False)])
def test_elsewhere_they_stay_as_they_are(env):
    assert as_judged_by(env, STAYS) is STAYS


@pytest.mark.parametrize("reward", [-1.0, 0.3])
def test_where_the_goal_is_to_be_held_rewards_say_whether_it_is(reward):
    dense = table([reward, 1.0], lengths=[2])
    assert as_judged_by(env_with("reached"), dense) is dense
    with pytest.raises(UserError, match=f"a reward of {reward:g}, and .*takes 1 at the goal and 0 elsewhere: convert with --sparse-rewards"):
        as_judged_by(env_with("held"), dense)
