"""Configs: every field does something, equal configs are one, and bad values are named. Which field matters when is in `test_conditions`."""

import ast
import dataclasses
import inspect
from pathlib import Path

import pytest
from flax import linen as nn

import hindrl_jax
from hindrl_jax.config import AgentConfig, BatchConfig, GoalConfig, QuirksConfig, TrainConfig, without_effect

SOURCES = [path for path in Path(hindrl_jax.__file__).parent.rglob("*.py") if path.parent.name != "config"]
CONFIGS = (BatchConfig, GoalConfig, AgentConfig, QuirksConfig, TrainConfig)
FIELDS = [(part, field.name) for part in CONFIGS for field in dataclasses.fields(part)]
SECTIONS = ("batch", "goal", "agent", "quirks")
# Derived in the config itself and read elsewhere under another name.
READ_THROUGH = {
    "max_demo_ratio": "max_demo_rows",
    "hindrl_sampling_strategy": "sources",
    "union_sampling_ratio": "sources",
    "num_quantiles": "critic_outputs",
    "updates_per_iteration": "num_updates",
}


@pytest.fixture(scope="module")
def attributes_read():
    """Names of all attributes read (not written) in the package, and keyword arguments left out: replace(gamma=1) does not read gamma."""
    trees = [ast.parse(path.read_text()) for path in SOURCES]
    return {node.attr for tree in trees for node in ast.walk(tree) if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Load)}


@pytest.mark.parametrize(("config", "name"), FIELDS, ids=lambda value: getattr(value, "__name__", value))
def test_every_field_is_read_somewhere(config, name, attributes_read):
    assert name in attributes_read or READ_THROUGH.get(name) in attributes_read


@pytest.mark.parametrize(("config", "name"), FIELDS, ids=lambda value: getattr(value, "__name__", value))
def test_every_field_has_a_line_of_documentation(config, name):
    (definition,) = ast.parse(inspect.getsource(config)).body
    body = definition.body
    index = next(i for i, node in enumerate(body) if isinstance(node, ast.AnnAssign) and node.target.id == name)
    if name in SECTIONS and config is TrainConfig:
        return  # documented by its own fields
    following = body[index + 1]
    assert isinstance(following, ast.Expr)
    assert isinstance(following.value.value, str)


def test_names_of_fields_differ_between_sections():
    """The command line and `without_effect` know them by name alone."""
    names = [name for _, name in FIELDS]
    assert len(set(names)) == len(names)
    assert {name for name, value in vars(TrainConfig()).items() if dataclasses.is_dataclass(value)} == set(SECTIONS)


def test_equal_configs_are_equal_and_hash_equal():
    def build():
        return TrainConfig(
            batch=BatchConfig(gamma=0.9), agent=AgentConfig(net_arch=tuple([8, 8])), goal=GoalConfig(epsilon_steps=2, epsilon_deviations=1.0)
        )

    assert build() == build()
    assert build() is not build()
    assert hash(build()) == hash(build())
    assert build() != dataclasses.replace(build(), batch=BatchConfig(gamma=0.8))


def test_configs_are_frozen():
    with pytest.raises(dataclasses.FrozenInstanceError):
        TrainConfig().steps = 3


BAD = [
    (BatchConfig, "batch_size", [0, 1.5, True, "512"]),
    (BatchConfig, "max_demo_ratio", [-0.1, 1.1, float("nan"), None, 1.0]),  # 1.0 leaves no replay row
    (BatchConfig, "reach_zero", [0, -5, 0.5]),
    (BatchConfig, "relabelled_per_original", [-1, "4", float("inf")]),
    (BatchConfig, "hindrl_sampling_strategy", ["intersection", "Future", None, "mixture"]),
    (BatchConfig, "union_sampling_ratio", [-0.1, 1.5]),
    (BatchConfig, "intersection_goals", ["both"]),
    (BatchConfig, "n_step", [0, None]),
    (BatchConfig, "gamma", [0.0, 1.01, float("inf")]),
    (GoalConfig, "epsilon_steps", [-1, 0.5]),
    (GoalConfig, "epsilon_deviations", [-0.1, float("nan")]),
    (GoalConfig, "epsilon", [-0.1, float("nan"), "0.1"]),
    (GoalConfig, "epsilon_filtering", [1]),
    (GoalConfig, "behavioural_goals", ["final"]),
    (AgentConfig, "net_arch", [(), (8, 0), [8, 8], (8.0,), 8]),
    (AgentConfig, "layer_norm", [1]),
    (AgentConfig, "residual", [1]),
    (AgentConfig, "learning_rate", [0.0, -1e-3, float("inf"), "1e-3"]),
    (AgentConfig, "clip_targets", [1.0]),
    (AgentConfig, "base", ["ppo", "td3", None]),
    (AgentConfig, "num_critics", [0]),
    (AgentConfig, "num_target_critics", [0, 3]),
    (AgentConfig, "q_filter", [True, "yes"]),
    (AgentConfig, "num_quantiles", [0]),
    (AgentConfig, "top_quantiles_to_drop_per_net", [-1, AgentConfig().num_quantiles]),
    (AgentConfig, "target_update_rate", [0.0, 1.1]),
    (AgentConfig, "actor_average_span", [-0.1]),
    (AgentConfig, "relative_value", [1]),
    (AgentConfig, "initial_alpha", [0.0]),
    (AgentConfig, "target_entropy", [float("nan"), "auto"]),
    (AgentConfig, "final_target_entropy", [float("nan")]),
    (AgentConfig, "bc_weight", [-1.0]),
    *((AgentConfig, f"{of}_{what}", ["module:Name", 3]) for of in ("actor", "critic") for what in ("network", "loss")),
    (AgentConfig, "actor_network", [nn.Dense(3)]),  # the class is what is asked for
    (AgentConfig, "input_encoding", ["scaled", "standardized"]),
    (QuirksConfig, "strict_goal_test", [1, "yes"]),
    (QuirksConfig, "bootstrap_past_relabelled_goals", [0]),
    (QuirksConfig, "timeouts_are_terminal", [None]),
    (QuirksConfig, "exclude_last_goal", [0]),
    (QuirksConfig, "unscaled_demo_actions", ["true"]),
    (QuirksConfig, "misaligned_demo_actions", [1.0]),
    (QuirksConfig, "bc_loss", ["l2"]),
    (QuirksConfig, "bc_action", ["mode"]),
    (QuirksConfig, "achieved_goal_input", ["yes", 1]),
    (TrainConfig, "algo", ["HinDRL", "sac"]),
    (TrainConfig, "steps", [0, 1e5]),
    (TrainConfig, "num_envs", [0]),
    (TrainConfig, "updates_per_iteration", [0]),
    (TrainConfig, "learning_starts", [-1]),
    (TrainConfig, "demo_reset_ratio", [-0.1, 1.1, None]),
    (TrainConfig, "action_hold", [0, -1, 2.5]),
    (TrainConfig, "stop_at", [0.0, -0.1, 1.01]),
    (TrainConfig, "demo_reset_curriculum", [0.5, True]),  # True without resets to demonstrated states
    (TrainConfig, "imitation_steps", [-1, True, 2**31]),
    (TrainConfig, "practice_rounds", [-1, True, 2**31]),
    (TrainConfig, "imitation_proposal", [1, True]),  # True without a policy that could propose
    (TrainConfig, "action_chunks", [1, None]),
    (TrainConfig, "network_resets", [1, None]),
    (TrainConfig, "buffer_size", [0, 1e6]),
    (TrainConfig, "eval_every", [0]),
    (TrainConfig, "eval_episodes", [0]),
    (TrainConfig, "batch", [None, {}, AgentConfig()]),
    (TrainConfig, "goal", [None]),
    (TrainConfig, "agent", [None]),
    (TrainConfig, "quirks", [None, True]),
]


@pytest.mark.parametrize(("config", "name", "value"), [(config, name, value) for config, name, values in BAD for value in values])
def test_bad_values_are_named(config, name, value):
    with pytest.raises(ValueError, match=rf"\b{name} = "):
        config(**{name: value})


def test_epsilon_is_given_or_found_but_not_both():
    GoalConfig(epsilon=0.1)
    with pytest.raises(ValueError, match="epsilon_steps = 5 is of no use"):
        GoalConfig(epsilon=0.1, epsilon_steps=5)


def test_the_table_of_bad_values_is_complete():
    assert {(config, name) for config, name, _ in BAD} == set(FIELDS)


@pytest.mark.parametrize(
    "build",
    [
        lambda: BatchConfig(max_demo_ratio=0, gamma=1, reach_zero=None, relabelled_per_original=0.5),  # an int serves as a float
        lambda: AgentConfig(num_quantiles=25, top_quantiles_to_drop_per_net=24, target_entropy=-3.0, bc_weight=0, net_arch=(1,)),
        lambda: TrainConfig(algo="bc", steps=1, learning_starts=5),  # cloning takes no environment steps
        lambda: TrainConfig(demo_reset_ratio=1),
    ],
)
def test_values_at_the_edge_are_accepted(build):
    assert build() == build()


@pytest.mark.parametrize(
    ("fitting", "contradiction", "name"),
    [
        (
            dict(algo="tqcfd", batch=BatchConfig(relabelled_per_original=0)),
            dict(batch=BatchConfig(relabelled_per_original=1)),
            "relabelled_per_original",
        ),
        (dict(algo="smooth-hindrl", goal=GoalConfig(epsilon_filtering=True)), dict(goal=GoalConfig()), "epsilon_filtering"),
    ],
)
def test_the_algorithm_must_fit_its_settings(fitting, contradiction, name):
    config = TrainConfig(**fitting)
    with pytest.raises(ValueError, match=name):
        dataclasses.replace(config, **contradiction)


@pytest.mark.parametrize(
    "changes",
    [
        dict(imitation_steps=1),
        dict(practice_rounds=1),
        dict(imitation_proposal=True),
        dict(network_resets=True),
        dict(agent=AgentConfig(q_filter="hard")),
        dict(agent=AgentConfig(base="sac")),
    ],
)
def test_cloning_alone_refuses_what_it_would_ignore(changes):
    with pytest.raises(ValueError, match="has no effect on bc"):
        TrainConfig(algo="bc", **changes)


def test_rollout_conditioned_is_the_name_of_the_thesis_for_future():
    assert BatchConfig(hindrl_sampling_strategy="rollout_conditioned") == BatchConfig(hindrl_sampling_strategy="future")
    assert BatchConfig(hindrl_sampling_strategy="rollout_conditioned").hindrl_sampling_strategy == "future"


@pytest.mark.parametrize(("size", "ratio", "rows"), [(4096, 0.1, 409), (12_000, 0.1, 1200), (10, 0.0, 0), (3, 0.3, 0), (3, 0.34, 1)])
def test_number_of_demonstration_rows(size, ratio, rows):
    assert BatchConfig(batch_size=size, max_demo_ratio=ratio).max_demo_rows == rows


@pytest.mark.parametrize(
    ("changes", "sources"),
    [
        (dict(hindrl_sampling_strategy="random"), (("random", 1.0),)),
        (dict(hindrl_sampling_strategy="joint_union", union_sampling_ratio=0.25), (("task_conditioned", 0.25), ("future", 0.75))),
        (dict(relabelled_per_original=0), ()),
    ],
)
def test_sources_of_relabelled_goals_by_hand(changes, sources):
    assert BatchConfig(**changes).sources == sources


@pytest.mark.parametrize(
    ("changes", "name", "reason"),
    [
        ({}, "num_quantiles", None),
        ({"agent": {"base": "sac"}}, "num_quantiles", "sac has no quantiles"),
        ({"agent": {"residual": True}}, "layer_norm", "residual networks have layer normalisation"),
        ({}, "union_sampling_ratio", "only relabelling by joint_union"),
        ({"batch": {"hindrl_sampling_strategy": "joint_union"}}, "union_sampling_ratio", None),
        ({"batch": {"relabelled_per_original": 0.0}}, "hindrl_sampling_strategy", "nothing is relabelled"),
        ({"batch": {"max_demo_ratio": 0.0}}, "bc_loss", "no demonstration rows to clone"),
        ({"batch": {"max_demo_ratio": 0.0}, "imitation_steps": 1}, "bc_loss", None),
        ({"agent": {"bc_weight": 0.0}}, "bc_action", "nothing is cloned"),
        ({}, "practice_rounds", "no policy imitates"),
        ({"imitation_steps": 1}, "practice_rounds", None),
        ({"algo": "bc"}, "bc_action", None),
        ({}, "learning_rate", None),
        ({"algo": "bc"}, "learning_rate", None),
        ({"algo": "bc"}, "num_critics", "behaviour cloning does not use it"),
    ],
)
def test_fields_without_effect_are_known(changes, name, reason):
    values = {key: dataclasses.replace(getattr(TrainConfig(), key), **value) if key in SECTIONS else value for key, value in changes.items()}
    said = without_effect(TrainConfig(**values), name)
    assert said is None if reason is None else reason in said


@pytest.mark.parametrize(("hold", "own_goals", "updates"), [(1, False, 2), (1, True, 4), (4, False, 8), (4, True, 16), (None, False, 2)])
def test_gradient_steps_follow_from_environment_steps(hold, own_goals, updates):
    """8 environments take 8 steps, or 32 where actions are held for 4: a gradient step for every 4 of them, or 2."""
    goal = GoalConfig(behavioural_goals="environment" if own_goals else "task")
    assert TrainConfig(num_envs=8, action_hold=hold, goal=goal).num_updates == updates
    assert TrainConfig(num_envs=8, action_hold=hold, goal=goal, updates_per_iteration=3).num_updates == 3
