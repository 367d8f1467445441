"""What is refused before anything is computed, in a line that names what is missing and what to do."""

import dataclasses
import importlib
import sys
from pathlib import Path
from types import SimpleNamespace

import jax.numpy as jnp
import pytest
from host_env import HostCorridor
from tiny import CONFIG, ENV
from toy_env import Corridor

import hindrl_jax as hindrl
from hindrl_jax.tasks import registry
from hindrl_jax.training.checks import check_config, check_trainable


@pytest.fixture(scope="module")
def demonstrations():
    return hindrl.record_demonstrations(ENV, 2)


@pytest.mark.parametrize(
    ("configs", "message"),
    [
        ([CONFIG], "1 configs for 2 seeds"),
        ([CONFIG, dataclasses.replace(CONFIG, num_envs=4)], "may differ only in union_sampling_ratio, gamma"),
        (
            [CONFIG, dataclasses.replace(CONFIG, agent=dataclasses.replace(CONFIG.agent, final_target_entropy=None))],
            "final_target_entropy is None in some",
        ),
    ],
)
def test_configs_that_need_programs_of_their_own_are_refused(configs, message, demonstrations):
    with pytest.raises(hindrl.UserError, match=message):
        hindrl.fit(ENV, demonstrations, configs, seeds=[0, 1])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seeds": []}, "at least one"),
        ({"seeds": [-1]}, "at least one whole number"),
        ({"tables": 1, "seeds": [0, 1]}, "1 tables of demonstrations for 2 seeds"),
        ({"env": hindrl.make("FixedGridPickAndPlace", size=4, random_box_size=1, horizon=21)}, "do not fit"),
        ({"config": dataclasses.replace(CONFIG, steps=40)}, "steps = 40 ends within the 40 random steps"),
        ({"config": dataclasses.replace(CONFIG, buffer_size=79)}, "buffer_size = 79"),
    ],
)
def test_what_does_not_fit_is_refused(changes, message, demonstrations):
    given = SimpleNamespace(**({"env": ENV, "config": CONFIG, "seeds": [0], "tables": None} | changes))
    tables = demonstrations if given.tables is None else [demonstrations] * given.tables
    with pytest.raises(hindrl.UserError, match=message):
        hindrl.fit(given.env, tables, given.config, seeds=given.seeds)


def test_goals_cannot_be_compared_where_hindsight_changes_none():
    env = hindrl.make("ParameterizedReach", num_waypoints=1)
    config = hindrl.preset("hindrl", env=env)
    batch = dataclasses.replace(config.batch, hindrl_sampling_strategy="joint_intersection")
    with pytest.raises(hindrl.UserError, match="joint_intersection compares goals"):
        hindrl.fit(env, hindrl.record_demonstrations(env, 1), dataclasses.replace(config, batch=batch), seeds=[0])


class Unstepped(HostCorridor):
    """It has a stepper, but not with the back end that it has now."""

    steps_on_host = False


def test_an_environment_that_cannot_be_stepped_many_at_once_is_refused():
    check_trainable(ENV)
    check_trainable(HostCorridor())
    with pytest.raises(hindrl.UserError, match=r"with backend = robosuite, .* at a time outside JAX: train with backend closed_form or mjx"):
        check_trainable(hindrl.make("ParameterizedReach", backend="robosuite"))
    with pytest.raises(hindrl.UserError, match="HostCorridor cannot be trained: it has neither reset and step in JAX, nor a stepper"):
        check_trainable(Unstepped())


class WrongObservation(Corridor):
    observation_dim = 4


class WrongGoal(Corridor):
    goal_dim = 2


class WrongTaskGoal(Corridor):
    def task_goal(self):
        return jnp.zeros(2)


class WrongState(Corridor):
    state_dim = 2


class WrongAction(Corridor):
    """Its step needs three numbers."""

    def step(self, state, action):
        return super().step(state, action + jnp.zeros(3))


class WrongStep(Corridor):
    """Its observations grow."""

    def step(self, state, action):
        state, time_step = super().step(state, action)
        return state, dataclasses.replace(time_step, observation=jnp.zeros(7))


class NoArray(Corridor):
    def achieved_goal(self, observation):
        return {"position": observation[2:]}


@pytest.mark.parametrize(
    ("env", "message"),
    [
        (WrongObservation(), r"^Corridor: observation_dim is 4, and reset gives an observation of shape \(3,\): mend the one or the other$"),
        (WrongGoal(), r"goal_dim is 2, and achieved_goal gives a goal of shape \(1,\)"),
        (WrongTaskGoal(), r"goal_dim is 1, and task_goal gives a goal of shape \(2,\)"),
        (WrongState(), r"state_dim is 2, and state_to_vector gives a vector of shape \(3,\)"),
        (WrongAction(), r"action_dim is 2, and step fails with an action of shape \(2,\) in line \d+ of .*test_checks.py: add got"),
        (WrongStep(), r"observation_dim is 3, and step gives an observation of shape \(7,\)"),
        (NoArray(), r"goal_dim is 1, and achieved_goal gives a goal that is no array but dict"),
    ],
)
def test_dimensions_are_what_the_environment_gives(env, message):
    check_trainable(Corridor())
    for refused in (lambda: check_trainable(env), lambda: hindrl.record_demonstrations(env, 1, expert=Walker())):
        with pytest.raises(hindrl.UserError, match=message) as told:
            refused()
        assert "\n" not in str(told.value)


@dataclasses.dataclass(frozen=True)
class Walker:
    length: int = 2

    def act(self, key, env, state):
        return jnp.ones(self.length)


def test_an_expert_gives_actions_of_the_environment():
    assert hindrl.record_demonstrations(Corridor(), 1, expert=Walker()).lengths.shape == (1,)
    with pytest.raises(hindrl.UserError, match=r"action_dim is 2, and Walker.act gives an action of shape \(3,\)"):
        hindrl.record_demonstrations(Corridor(), 1, expert=Walker(length=3))


class Mistaken(Corridor):
    def step(self, state, action):
        return undefined_name  # noqa: F821


def test_a_mistake_of_another_kind_keeps_its_traceback():
    with pytest.raises(NameError, match="undefined_name"):
        check_trainable(Mistaken())


def test_the_tutorial_shows_the_line_that_one_meets(monkeypatch):
    root = Path(__file__).parent.parent.parent
    monkeypatch.setattr(registry, "TASKS", dict(registry.TASKS))
    monkeypatch.syspath_prepend(str(root / "examples"))
    arm = importlib.import_module("planar_arm").PlanarArm
    sys.modules.pop("planar_arm")  # whoever imports it next has it registered
    observe = arm.observe
    monkeypatch.setattr(arm, "observe", lambda self, state: jnp.append(observe(self, state), 0.0))
    with pytest.raises(hindrl.UserError) as told:
        check_trainable(arm())
    assert f"\nhindrl: {told.value}\n" in (root / "docs" / "tutorial.md").read_text()


class Unrestorable:
    """A corridor whose states cannot be written down."""

    def __init__(self):
        for name in ("name", "horizon", "observation_dim", "goal_dim", "action_dim", "action_low", "action_high"):
            setattr(self, name, getattr(Corridor(), name))
        self.achieved_goal, self.task_goal, self.reset, self.step = (getattr(Corridor(), n) for n in ("achieved_goal", "task_goal", "reset", "step"))
        self.__dataclass_fields__ = {}


def with_goals(behavioural_goals):
    return dataclasses.replace(CONFIG, goal=dataclasses.replace(CONFIG.goal, behavioural_goals=behavioural_goals))


@pytest.mark.parametrize(
    ("env", "config", "message"),
    [
        (Unrestorable(), dataclasses.replace(CONFIG, demo_reset_ratio=0.5), "it has no restorable states: set demo_reset_ratio to 0"),
        (HostCorridor(), dataclasses.replace(CONFIG, demo_reset_ratio=0.5), "it has no restorable states in JAX: set demo_reset_ratio to 0"),
        (HostCorridor(), dataclasses.replace(CONFIG, action_chunks=True), "action_chunks = True needs a step in JAX, which HostCorridor"),
        (HostCorridor(), with_goals("environment"), "HostCorridor, which gives its episodes no goals: choose another"),
        (ENV, with_goals("environment"), "FixedGridPickAndPlace, which gives its episodes no goals: choose another"),
        (hindrl.make("gymnasium:point_env:PointGoal-v0"), with_goals("task"), "whose episodes come with goals of their own: choose environment"),
    ],
)
def test_an_ability_that_is_missing_is_named(env, config, message):
    with pytest.raises(hindrl.UserError, match=message):
        check_config(env, config)


def test_goals_need_not_be_the_environments_where_it_gives_none():
    for goals in ("task", "final_demonstration_states"):
        check_config(HostCorridor(), with_goals(goals))
        check_config(ENV, with_goals(goals))
