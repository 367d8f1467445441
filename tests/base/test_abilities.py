"""What an environment can do is asked of it, with the back end that it has."""

import pytest
from host_env import HostCorridor
from point_env import CONFIG
from toy_env import Corridor

import hindrl_jax as hindrl
from hindrl_jax.base.environments import Environment, Restorable, Steppable, backends_with, can_step, state_dim
from hindrl_jax.base.steppers import HostStepped, Watchable, can_step_on_host
from hindrl_jax.training.playing import plays_one_by_one

ROBOSUITE = hindrl.make("FixedParameterizedReach", backend="robosuite")
POINT = "gymnasium:point_env:PointGoal-v0"


@pytest.mark.parametrize(
    ("env", "in_jax", "on_host", "restorable", "watchable"),
    [
        (Corridor(), True, False, True, False),
        (hindrl.make("GridPickAndPlace"), True, False, True, False),
        (hindrl.make("FixedParameterizedReach"), True, False, True, False),
        (hindrl.make("ParameterizedReach", backend="mjx"), True, False, True, False),
        (ROBOSUITE, False, False, True, False),
        (hindrl.make(POINT), False, True, False, True),
        (HostCorridor(), False, True, False, False),
    ],
    ids=lambda value: getattr(value, "name", None),
)
def test_abilities(env, in_jax, on_host, restorable, watchable):
    assert isinstance(env, Environment)
    assert (can_step(env), can_step_on_host(env)) == (in_jax, on_host)
    assert plays_one_by_one(env) == (env == ROBOSUITE)
    assert (isinstance(env, Restorable), isinstance(env, Watchable)) == (restorable, watchable)
    assert (state_dim(env) > 0) == restorable


def test_a_config_is_no_environment():
    assert not isinstance(CONFIG, Environment | Steppable | HostStepped)


def test_back_ends_with_an_ability():
    assert backends_with(ROBOSUITE, can_step) == ["closed_form", "mjx"]
    assert backends_with(ROBOSUITE, plays_one_by_one) == ["robosuite"]
    assert backends_with(hindrl.make(POINT), can_step) == backends_with(Corridor(), can_step) == []
