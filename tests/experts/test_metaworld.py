"""The adapter for metaworld's scripted policies, with a package of that name in its place; it is not among those of the tests."""

import sys
import types

import numpy as np
import pytest

import hindrl_jax as hindrl
from hindrl_jax.base.errors import UserError
from hindrl_jax.experts.fetch import FetchPushExpert
from hindrl_jax.experts.metaworld import MetaWorldExpert


class Policy:
    def get_action(self, observation):
        return np.full(4, 3.0) * observation[0]


@pytest.fixture(autouse=True)
def metaworld(monkeypatch):
    package, policies = types.ModuleType("metaworld"), types.ModuleType("metaworld.policies")
    package.policies = policies
    policies.ENV_POLICY_MAP = {"push-v3": Policy}
    monkeypatch.setitem(sys.modules, "metaworld", package)
    monkeypatch.setitem(sys.modules, "metaworld.policies", policies)


class Env:
    def __init__(self, **arguments):
        self.arguments = arguments


def test_the_policy_of_the_environments_task_is_clipped_and_noisy():
    env, rng = Env(env_name="push-v3", seed=0), np.random.default_rng(0)
    assert MetaWorldExpert(noise=0.0).acting_in(env)(np.array([1.0]), rng).tolist() == [1.0] * 4
    actions = np.stack([MetaWorldExpert(noise=0.2).acting_in(env)(np.array([0.0]), rng) for _ in range(500)])
    assert actions.std() == pytest.approx(0.2, rel=0.1)
    assert np.abs(MetaWorldExpert(noise=0.2).acting_in(env)(np.array([1.0]), rng)).max() <= 1.0


def test_a_task_without_policy_is_refused():
    with pytest.raises(UserError, match=r"no scripted policy of env_name = 'pull-v3': choose one of push-v3"):
        MetaWorldExpert().acting_in(Env(env_name="pull-v3"))


def test_it_plays_single_tasks_only_and_fetch_is_not_its_business():
    assert MetaWorldExpert.plays("Meta-World/MT1")
    assert not MetaWorldExpert.plays("Meta-World/MT10")
    assert not MetaWorldExpert.plays("FetchPush-v4")
    assert not FetchPushExpert.plays("FetchPushDense-v4")


def test_an_expert_that_depends_on_the_environment_is_recorded():
    class ToTheCorner:
        def acting_in(self, env):
            corner = np.full(env.action_dim, 0.8)
            return lambda observation, rng: np.clip(corner - observation[:2], -1.0, 1.0)

    demonstrations = hindrl.record_demonstrations(hindrl.make("gymnasium:flat_env:PointFlat-v0"), 2, expert=ToTheCorner())
    assert (demonstrations.rewards.sum(axis=1) == 1.0).all()
