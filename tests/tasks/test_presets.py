"""Presets: the thesis's numbers as its appendix prints them, and the quirks of the original code."""

import dataclasses

import pytest

from hindrl_jax.base.errors import UserError
from hindrl_jax.config import TrainConfig
from hindrl_jax.tasks.presets import preset
from hindrl_jax.tasks.registry import make

# Appendix A.1.1 of the thesis, row by row.
APPENDIX = {
    "batch_size": 4_096,
    "learning_rate": 1e-3,
    "net_arch": (64, 64, 64, 64),
    "top_quantiles_to_drop_per_net": 2,
    "buffer_size": 500_000,
    "learning_starts": 10_000,
    "bc_weight": 1.0,
    "max_demo_ratio": 0.1,
    "reach_zero": 500_000,
    "hindrl_sampling_strategy": "task_conditioned",
    "epsilon_steps": 0,
    "epsilon_deviations": 0.0,
}
# Appendix A.1.2: where the robot task differs. The text of the appendix has lost one of its eight layers.
APPENDIX_REACH = APPENDIX | {
    "batch_size": 12_000,
    "net_arch": (32, 32, 32, 32, 32, 32, 32, 32),
    "top_quantiles_to_drop_per_net": 8,
    "buffer_size": 1_000_000,
    "learning_starts": 5_000,
    "bc_weight": 0.0,
    "reach_zero": 1_000_000,
    "epsilon_steps": 5,
}
# What its text leaves to its framework (Stable-Baselines3 with sb3-contrib's TQC).
FRAMEWORK = {
    "gamma": 0.99,
    "target_update_rate": 0.005,
    "initial_alpha": 1.0,
    "target_entropy": -1.0,
    "final_target_entropy": None,
    "num_critics": 2,
    "num_quantiles": 25,
    "num_envs": 1,
    "updates_per_iteration": 1,
    "n_step": 1,
    "bootstrap_past_relabelled_goals": True,
    "layer_norm": False,
    "input_encoding": "raw",
    "actor_average_span": 0.0,
    "achieved_goal_input": True,
    "strict_goal_test": False,
    "bc_loss": "squared",
    "bc_action": "mean",
    "behavioural_goals": "final_demonstration_states",
}


def flat(config: TrainConfig) -> dict:
    values = {}
    for name, value in dataclasses.asdict(config).items():
        values.update(value if isinstance(value, dict) else {name: value})
    return values


@pytest.mark.parametrize(
    ("env", "appendix"),
    [
        ("GridPickAndPlace", APPENDIX),
        ("FixedGridPickAndPlace", APPENDIX),
        ("ParameterizedReach", APPENDIX_REACH),
        ("FixedParameterizedReach", APPENDIX_REACH),
        ("CableInsertion", APPENDIX_REACH),
    ],
)
@pytest.mark.parametrize(("algo", "relabelled", "filtered"), [("tqcfd", 0, False), ("hindrl", 4, False), ("smooth-hindrl", 4, True)])
def test_thesis_preset_is_the_appendix(algo, relabelled, filtered, env, appendix):
    values = flat(preset(algo, "thesis", env=env))
    expected = appendix | FRAMEWORK | {"algo": algo, "relabelled_per_original": relabelled, "epsilon_filtering": filtered}
    assert {name: values[name] for name in expected} == expected


@pytest.mark.parametrize("env", ["FixedGridPickAndPlace", "FixedParameterizedReach"])
def test_thesis_bc_is_the_appendix(env):
    values = flat(preset("bc", "thesis", env=env))
    assert (values["batch_size"], values["learning_rate"], values["net_arch"]) == (2_048, 1e-3, (32, 32))


@pytest.mark.parametrize(("env", "more"), [("FixedGridPickAndPlace", {}), ("FixedParameterizedReach", {"misaligned_demo_actions": True})])
def test_original_preset_differs_from_the_thesis_by_the_quirks_alone(env, more):
    thesis, original = flat(preset("hindrl", "thesis", env=env)), flat(preset("hindrl", "original", env=env))
    assert {name: original[name] for name in original if original[name] != thesis[name]} == {
        "strict_goal_test": True,
        "timeouts_are_terminal": True,
        "behavioural_goals": "task",
        "exclude_last_goal": True,
        "unscaled_demo_actions": True,
        "bc_loss": "norm",
        "bc_action": "sample",
    } | more


# Ball et al. (2023): SAC with symmetric sampling, layer normalisation, large ensembles and 20 gradient steps for each environment step.
RLPD = {
    "base": "sac",
    "num_critics": 10,
    "num_target_critics": 2,
    "layer_norm": True,
    "net_arch": (256, 256),
    "learning_rate": 3e-4,
    "target_update_rate": 0.005,
    "initial_alpha": 1.0,
    "batch_size": 256,
    "max_demo_ratio": 0.5,
    "reach_zero": None,
    "n_step": 1,
    "gamma": 0.99,
    "clip_targets": False,
    "bc_weight": 0.0,
    "num_envs": 1,
    "action_hold": 1,
    "updates_per_iteration": 20,
    "input_encoding": "raw",
    "target_entropy": -0.5,
    "final_target_entropy": None,
}


@pytest.mark.parametrize(
    ("algo", "env", "relabelled"),
    [
        ("tqcfd", "FixedGridPickAndPlace", 0.0),
        ("hindrl", "FixedGridPickAndPlace", 0.25),
        ("hindrl", "ParameterizedReach", 1.0),
        ("hindrl", "gymnasium:FetchReach-v4", 4.0),
    ],
)
def test_rlpd_is_what_its_paper_says(algo, env, relabelled):
    values = flat(preset(algo, "rlpd", env=env))
    assert {name: values[name] for name in RLPD} == RLPD
    assert (values["algo"], values["relabelled_per_original"]) == (algo, relabelled)


def test_rlpd_is_no_behaviour_cloning():
    with pytest.raises(UserError, match="rlpd is for reinforcement learning, which bc is not"):
        preset("bc", "rlpd")


TASKS = [
    "GridPickAndPlace",
    "FixedGridPickAndPlace",
    "FixedParameterizedReach",
    "ParameterizedReach",
    "BringNear",
    "CableInsertion",
    "gymnasium:FetchReach-v4",
]


def test_there_is_one_recipe_and_what_differs_follows_from_what_an_environment_does():
    recipes = {name: flat(preset("hindrl", env=name)) for name in TASKS}
    grid = recipes["GridPickAndPlace"]
    differences = {name: {field: value for field, value in recipe.items() if value != grid[field]} for name, recipe in recipes.items()}
    both = {"hindrl_sampling_strategy": "joint_union", "practice_rounds": 0}
    own_goals = {"behavioural_goals": "environment", "epsilon": 0.02886, "relabelled_per_original": 4.0}  # 0.05 over the root of 3
    assert preset("hindrl", env="GridPickAndPlace") == TrainConfig(imitation_steps=750, practice_rounds=10, network_resets=True)
    assert differences == {
        "GridPickAndPlace": {},
        "FixedGridPickAndPlace": {},
        "FixedParameterizedReach": {},
        "BringNear": {},
        "CableInsertion": {},
        "ParameterizedReach": both | {"behavioural_goals": "task", "relabelled_per_original": 1.0},
        "gymnasium:FetchReach-v4": both | own_goals,
    }
    assert preset("tqcfd", env="ParameterizedReach").batch.relabelled_per_original == 0.0


@pytest.mark.parametrize("algo", ["bc", "tqcfd", "hindrl", "smooth-hindrl"])
def test_a_task_of_another_name_has_the_same_recipe(algo):
    for name in ("GridPickAndPlace", "FixedParameterizedReach", "ParameterizedReach"):
        known = make(name)
        stranger = dataclasses.dataclass(frozen=True)(type("Stranger", (type(known),), {"name": "Stranger"}))()
        assert preset(algo, env=stranger) == preset(algo, env=known)


def test_field_names_are_unique_across_the_nested_configs():
    """So that each can be a flag of its own."""
    config = preset()
    assert len(flat(config)) == sum(
        len(dataclasses.fields(getattr(config, field.name))) if dataclasses.is_dataclass(getattr(config, field.name)) else 1
        for field in dataclasses.fields(config)
    )


def test_unknown_names_are_refused():
    with pytest.raises(UserError, match="did you mean 'hindrl'"):
        preset("hindlr")
    with pytest.raises(UserError, match="unknown preset"):
        preset("hindrl", "paper")
    with pytest.raises(UserError, match="unknown environment"):
        preset("hindrl", env="Reach")
