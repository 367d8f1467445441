"""The options of the recipe: what each changes, and that it can be trained."""

import dataclasses
import re
from typing import get_args

import jax
import pytest

from hindrl_jax.base.errors import UserError
from hindrl_jax.config import TrainConfig, without_effect
from hindrl_jax.core import train as training
from hindrl_jax.core.guidance import guidance
from hindrl_jax.reproduction.cells import changed
from hindrl_jax.reproduction.options import BASELINE, OPTIONS, RECIPE, Group, Option, half_of_the_run
from hindrl_jax.tasks.registry import make
from hindrl_jax.training.recording import record_demonstrations


@pytest.mark.parametrize("option", OPTIONS, ids=lambda option: option.name)
def test_every_option_changes_each_of_its_fields_and_nothing_else(option):
    config = RECIPE
    before, after = (dataclasses.asdict(each) for each in (config, changed(config, option.changes)))
    for part in ("batch", "goal", "agent", "quirks"):
        before |= {f"{part}.{name}": value for name, value in before.pop(part).items()}
        after |= {f"{part}.{name}": value for name, value in after.pop(part).items()}
    different = {name for name in before if before[name] != after[name]}
    asked = {name for name, _ in option.changes}
    # joint_union names its share, which is the default's, for the reader
    assert different
    assert different == asked - {"batch.union_sampling_ratio"}


@pytest.fixture(scope="module")
def demonstration():
    env = make("FixedGridPickAndPlace")
    return env, record_demonstrations(env, 1)


def go_together(options):
    """Whether options change different fields, the config takes all their changes, and each has its effect beside the others."""
    changes = [change for option in options for change in option.changes]
    names = [name for name, _ in changes]
    try:
        config = changed(RECIPE, changes)
    except UserError:
        return False
    return len(set(names)) == len(names) and all(without_effect(config, name.rpartition(".")[2]) is None for name in names)


def together():
    """All options, as many at once as go together: tracing one program takes a second."""
    packs = []
    for option in reversed(OPTIONS):  # the other algorithm last, since most have their effect with either
        pack = next((pack for pack in packs if go_together([*pack, option])), None)
        if pack is None:
            packs.append([option])
        else:
            pack.append(option)
    return packs


@pytest.mark.parametrize("options", together(), ids=lambda options: options[0].name)
def test_every_option_makes_a_program(options, demonstration):
    """Traced, not compiled: what the config's own checks let pass, the training must not refuse."""
    env, episodes = demonstration
    config = changed(RECIPE, [change for option in options for change in option.changes])

    def start_and_learn(key):
        data = guidance(episodes, env, config)
        return training.learn(training.init(key, data, env, config), data, env=env, config=config, num_iterations=1)

    state, metrics = jax.eval_shape(start_and_learn, jax.random.key(0))
    assert (state.env_steps.shape, metrics["critic/loss"].shape) == ((), ())


def test_options_have_names_for_directories_of_their_own():
    names = [option.name for option in (BASELINE, *OPTIONS)]
    assert len(set(names)) == len(names)
    assert all(re.fullmatch(r"[a-z0-9]+([-.][a-z0-9]+)*", name) for name in names)
    assert all(option.summary and "|" not in option.summary for option in OPTIONS)
    assert all(option.group in get_args(Group) and option.group != BASELINE.group for option in OPTIONS)
    order = [get_args(Group).index(option.group) for option in OPTIONS]
    assert order == sorted(order)  # tables have a heading for each group


def test_the_summaries_speak_of_the_recipe_as_it_is():
    """They say "in place of 5" and the like by hand, so whoever changes the recipe must look at them."""
    recipe = RECIPE
    batch, agent = recipe.batch, recipe.agent
    assert (batch.n_step, batch.gamma, batch.max_demo_ratio, batch.relabelled_per_original, batch.batch_size) == (5, 0.98, 0.25, 0.25, 256)
    assert (agent.num_critics, agent.target_update_rate, agent.bc_weight, agent.initial_alpha) == (2, 0.02, 0.01, 0.002)
    assert (agent.target_entropy, agent.final_target_entropy) == (-0.2, -2.0)
    assert (recipe.num_envs, recipe.updates_per_iteration) == (16, 2)


def test_changes_are_made_at_once_and_may_depend_on_the_config():
    config = TrainConfig(steps=1_000)
    option = Option("both", "targets", "", (("algo", "tqcfd"), ("batch.relabelled_per_original", 0.0), ("batch.reach_zero", half_of_the_run)))
    after = changed(config, option.changes)  # one after the other they would be refused
    assert (after.algo, after.batch.relabelled_per_original, after.batch.reach_zero) == ("tqcfd", 0.0, 500)
    with pytest.raises(UserError, match="n_step = 0"):
        changed(config, (("batch.n_step", 0),))
