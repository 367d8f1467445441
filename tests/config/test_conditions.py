"""Which field matters when, held to what is computed: a field has an effect exactly where changing it changes the training program.

Programs are compared as they are traced, without what does not lead to the policy, so that hardly anything is compiled. A change that leaves the text
the same has no effect. Where a change is multiplied by zero the text differs all the same, and gradients are compared.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen as nn
from traced_programs import DEMONSTRATIONS, ENV, Program

from hindrl_jax.base.types import Transition
from hindrl_jax.config import AgentConfig, BatchConfig, GoalConfig, TrainConfig, without_effect
from hindrl_jax.config.conditions import CONDITIONS
from hindrl_jax.core import agent
from hindrl_jax.core.batch import num_demo_rows
from hindrl_jax.core.guidance import guidance
from hindrl_jax.core.inputs import InputScale
from hindrl_jax.core.schedules import schedule

SMALL = TrainConfig(
    steps=60,
    num_envs=2,
    updates_per_iteration=1,
    learning_starts=20,
    buffer_size=40,
    batch=BatchConfig(batch_size=8, n_step=2),
    goal=GoalConfig(epsilon_steps=0),
    agent=AgentConfig(net_arch=(4,), num_quantiles=3, top_quantiles_to_drop_per_net=1),
)


class Tanh(nn.Module):
    """A network of one's own."""

    out_dim: int

    @nn.compact
    def __call__(self, features):
        return nn.Dense(self.out_dim)(jnp.tanh(nn.Dense(3)(features)))


# Not a part of the program: what the host reads, to choose the program and to count.
OF_THE_HOST = {
    "algo": "each algorithm is a base below; what it means beyond the other fields is which of two programs is run",
    "steps": "ends the run; what schedules make of it is the business of their other ends",
    "eval_every": "how many iterations are run between evaluations",
    "eval_episodes": "how many episodes an evaluation plays; it does not lead back to the policy",
    "stop_at": "ends the run",
    "network_resets": "replaces the agent between two calls of the program",
    "action_chunks": "as action_hold",
    "action_hold": "the programs are given another environment and other demonstrations, and count steps by it",
}

# Per field, values of which one at least is another than a base's.
VALUES = {
    "num_envs": (3, 2),
    "updates_per_iteration": (2, 1),
    "learning_starts": (30, 20),
    "demo_reset_ratio": (0.5, 0.25),
    "demo_reset_curriculum": (True, False),
    "imitation_steps": (3, 6),
    "practice_rounds": (1, 0),
    "imitation_proposal": (True, False),
    "buffer_size": (60, 40),
    "batch_size": (16, 8),
    "max_demo_ratio": (0.5, 0.25),
    "reach_zero": (50, 40),
    "relabelled_per_original": (1.0, 0.5),
    "hindrl_sampling_strategy": ("future", "final"),
    "union_sampling_ratio": (0.3, 0.4),
    "intersection_goals": ("demonstrations", "rollout"),
    "n_step": (3, 2),
    "gamma": (0.9, 0.8),
    "epsilon_steps": (2, 1),
    "epsilon_deviations": (1.0, 2.0),
    "epsilon": (0.2, 0.3),
    "epsilon_filtering": (True, False),
    "behavioural_goals": ("task", "final_demonstration_states"),
    "base": ("sac", "tqc"),
    "net_arch": ((5,), (4,)),
    "layer_norm": (True, False),
    "residual": (True, False),
    "learning_rate": (1e-2, 1e-4),
    "clip_targets": (True, False),
    "num_critics": (3, 2),
    "num_target_critics": (1, 2),
    "num_quantiles": (4, 3),
    "top_quantiles_to_drop_per_net": (0, 1),
    "target_update_rate": (0.1, 0.2),
    "actor_average_span": (0.5, 1.0),
    "relative_value": (False, True),
    "initial_alpha": (0.1, 0.2),
    "target_entropy": (-3.0, -5.0),
    "final_target_entropy": (-4.0, -5.0),
    "bc_weight": (0.1, 0.2),
    "q_filter": ("hard", "smooth"),
    "actor_network": (Tanh,),
    "critic_network": (Tanh,),
    "actor_loss": (lambda terms, config: jnp.mean(jnp.square(terms.mode)),),
    "critic_loss": (lambda terms, config: jnp.mean(jnp.square(terms.quantiles)),),
    "input_encoding": ("raw", "multiscale"),
    "strict_goal_test": (True, False),
    "bootstrap_past_relabelled_goals": (True, False),
    "timeouts_are_terminal": (True, False),
    "exclude_last_goal": (True, False),
    "unscaled_demo_actions": (True, False),
    "misaligned_demo_actions": (True, False),
    "bc_loss": ("norm", "squared"),
    "bc_action": ("sample", "mean"),
    "achieved_goal_input": (True, False),
}
SECTIONS = {
    field.name: section
    for section in ("", "batch", "goal", "agent", "quirks")
    for field in dataclasses.fields(getattr(SMALL, section) if section else SMALL)
    if not dataclasses.is_dataclass(getattr(getattr(SMALL, section) if section else SMALL, field.name))
}


def value_of(config, name):
    return getattr(getattr(config, SECTIONS[name]) if SECTIONS[name] else config, name)


def changed(config, **values):
    """The config with other values of fields, whichever section they are in."""
    outermost = {name: value for name, value in values.items() if not SECTIONS[name]}
    for section in {SECTIONS[name] for name in values} - {""}:
        fields = {name: value for name, value in values.items() if SECTIONS[name] == section}
        outermost[section] = dataclasses.replace(getattr(config, section), **fields)
    return dataclasses.replace(config, **outermost)


def changed_together(config, values):
    """The config with as many of these changes at once as it accepts, then with the others: as few configs as will do."""
    while values:
        together, left = config, {}
        for name, value in values.items():
            try:
                together = changed(together, **{name: value})
            except ValueError:
                left[name] = value
        yield together
        values = left


def other_value(config, name):
    """Another value that the config accepts, as changes; none where it refuses all that are tried."""
    for value in VALUES[name]:
        if value != value_of(config, name):
            try:
                changed(config, **{name: value})
            except ValueError:
                continue
            return {name: value}
    return {}


BASES = {
    name: changed(SMALL, **values)
    for name, values in {
        "hindrl": {},
        "bc": dict(algo="bc"),
        "tqcfd": dict(algo="tqcfd", relabelled_per_original=0.0),
        "smooth-hindrl with sac": dict(algo="smooth-hindrl", epsilon_filtering=True, epsilon_steps=1, base="sac", demo_reset_ratio=0.5),
        "joint_union with sac and one critic": dict(hindrl_sampling_strategy="joint_union", base="sac", num_critics=1),
        "joint_intersection": dict(hindrl_sampling_strategy="joint_intersection"),
        "future with redq, residual": dict(hindrl_sampling_strategy="future", residual=True, num_critics=3, num_target_critics=2, epsilon=0.1),
        "the other joint_intersection": dict(hindrl_sampling_strategy="joint_intersection", intersection_goals="demonstrations"),
        "no relabelling": dict(relabelled_per_original=0.0, final_target_entropy=None),
        "no demonstration rows": dict(max_demo_ratio=0.0),
        "no demonstration rows, proposals of a clone": dict(max_demo_ratio=0.0, imitation_steps=1, imitation_proposal=True),
        "networks of one's own": dict(actor_network=Tanh, critic_network=Tanh),
        "no cloning": dict(bc_weight=0.0),
    }.items()
}
# What the text of a program does not show: what is multiplied by zero there, or masked for all rows. The last three tests are about it.
CLONING = {"bc_weight", "bc_loss", "bc_action", "q_filter"}


def out_of_sight(config):
    fields = set() if config.goal.epsilon_steps else {"epsilon_deviations"}
    fields |= {*CLONING, "reach_zero"} if config.batch.max_demo_rows == 0 and config.learns_from_rollouts else set()
    return fields | (CLONING if config.agent.bc_weight == 0.0 else set())


def claims(config):
    """Changes to fields that are said to have an effect, and to fields that are said to have none."""
    effective, ineffective = {}, {}
    for name in VALUES:
        (effective if without_effect(config, name) is None else ineffective).update(other_value(config, name))
    return effective, ineffective


def test_the_table_is_about_fields_that_exist():
    assert {name for names, _, _ in CONDITIONS for name in names.split()} <= VALUES.keys()
    assert VALUES.keys() == SECTIONS.keys() - OF_THE_HOST.keys()


def test_every_field_is_tried_and_every_condition_both_ways():
    tried = [claims(config) for config in BASES.values()]
    assert VALUES.keys() - {name for effective, _ in tried for name in effective} == set()
    with_a_condition = {name for names, _, _ in CONDITIONS for name in names.split()}
    # Where it would have no effect, the config refuses this one.
    assert with_a_condition - {name for _, ineffective in tried for name in ineffective} == {"demo_reset_curriculum"}


def test_equal_configs_have_equal_programs():
    assert Program(SMALL).is_that_of(dataclasses.replace(SMALL))
    assert not Program(SMALL).differs_from(dataclasses.replace(SMALL))


# What matters under more conditions than that there are rollouts is tried in several bases, the rest in one with rollouts and in one without.
# All else is tried on demand.
OFTEN = {name for names, _, _ in CONDITIONS[1:] for name in names.split()}
IN_ALL = ("hindrl", "bc")
IN_OFTEN = ("tqcfd", "joint_union with sac and one critic", "future with redq, residual", "no demonstration rows, proposals of a clone", "no cloning")
FAST = {name: VALUES.keys() for name in IN_ALL} | {name: OFTEN for name in IN_OFTEN}
TRIED = [pytest.param(name, fields, id=name) for name, fields in FAST.items()]
TRIED += [
    pytest.param(name, VALUES.keys() - FAST.get(name, set()), id=f"{name}, the rest", marks=pytest.mark.slow) for name in BASES if name not in IN_ALL
]


# Parts of the program in which most fields of a section show.
SHOWS_IN = {"agent": ("descend", "clone"), "batch": ("draw",)}


@pytest.mark.parametrize(("name", "fields"), TRIED)
def test_fields_have_an_effect_exactly_where_the_table_says_so(name, fields):
    config = BASES[name]
    program, (effective, ineffective) = Program(config), claims(config)
    vain = {field for field in program.values if field in effective and field not in program.used_values}
    tried = {field: changed(config, **{field: effective[field]}) for field in effective.keys() & fields if field not in program.values}
    vain |= {field for field, other in tried.items() if not program.differs_from(other, SHOWS_IN.get(SECTIONS[field], ()))}
    assert vain == set(), "said to have an effect"

    hidden = out_of_sight(config)
    busy = {field for field in program.used_values if field in ineffective} - hidden
    without = {field: value for field, value in ineffective.items() if field not in program.values and field not in hidden}
    if not all(map(program.is_that_of, changed_together(config, without))):  # to be quick; else one for each
        busy |= {field for field, value in without.items() if not program.is_that_of(changed(config, **{field: value}))}
    assert busy == set(), "said to have no effect"


def gradient_of_actor(config, *, demonstrations):
    """Adam's first moment after one step is a tenth of the gradient."""
    rng = np.random.default_rng(0)
    batch = Transition(
        observation=rng.normal(size=(8, 3)),
        achieved_goal=rng.normal(size=(8, 1)),
        action=rng.uniform(-1, 1, size=(8, 2)),
        reward=np.zeros(8),
        discount=np.full(8, 0.9),
        next_observation=rng.normal(size=(8, 3)),
        next_achieved_goal=rng.normal(size=(8, 1)),
        desired_goal=rng.normal(size=(8, 1)),
        is_demonstration=np.arange(8) < demonstrations,
        is_relabelled=np.zeros(8, bool),
    )
    batch = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32 if leaf.dtype == np.float64 else leaf.dtype), batch)
    scale = InputScale(observation=jnp.ones(3), goal=jnp.ones(1), observation_centre=jnp.zeros(3), goal_centre=jnp.zeros(1))

    def step(key):
        state = agent.init(key, scale, config, action_dim=2)
        return agent.update(key, state, batch, schedule(0.5, 3, config.agent, action_dim=2), config)[0].actor_optimiser.mu

    compiled = jax.jit(step).lower(jax.random.key(1)).compile({"xla_backend_optimization_level": 0})
    return np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(compiled(jax.random.key(1)))])


@pytest.mark.parametrize(("name", "demonstrations"), [("no demonstration rows", 0), ("no cloning", 4)])
def test_what_is_not_cloned_has_no_gradient(name, demonstrations):
    config = BASES[name]
    ineffective = {field: value for field, value in claims(config)[1].items() if field in CLONING}
    assert {"bc_loss", "bc_action", "q_filter"} <= ineffective.keys()
    gradient = gradient_of_actor(config, demonstrations=demonstrations)
    changed_gradient = gradient_of_actor(changed(config, **ineffective), demonstrations=demonstrations)
    np.testing.assert_allclose(changed_gradient, gradient, atol=1e-5 * np.abs(gradient).max())
    cloned = gradient_of_actor(changed(config, bc_weight=0.5), demonstrations=4)
    assert np.abs(cloned - gradient).max() > 0.01 * np.abs(gradient).max()


def test_without_demonstration_rows_their_share_has_nothing_to_fall_from():
    config = changed(SMALL, max_demo_ratio=0.0, reach_zero=50)
    assert [int(num_demo_rows(jnp.asarray(steps), config.batch)) for steps in (0, 25, 1_000)] == [0, 0, 0]


def test_states_no_steps_apart_have_no_distances_that_deviate():
    assert not jnp.any(guidance(DEMONSTRATIONS, ENV, changed(SMALL, epsilon_deviations=5.0)).epsilon)
