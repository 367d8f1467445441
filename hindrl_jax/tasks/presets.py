"""Configs by name: the four models of the thesis, under the project's own recipe, the thesis's settings, or the original code's.

    default    the project's own recipe, for a laptop CPU
    thesis     the hyperparameters of the thesis's appendix, on plain correct code
    original   the same, with the quirks of the original implementation that explain its published figures

Each has settings for the grid worlds and others for the reach tasks, as the thesis's appendix does. Beside them the default has a recipe for HinDRL
in tasks whose observations hindsight relabels (`environments.RelabelsObservations`), such as ParameterizedReach. Environments of Gymnasium have the
default only.
"""

from __future__ import annotations

import dataclasses
from typing import Any, Literal, get_args

from hindrl_jax.base.environments import Environment
from hindrl_jax.base.errors import UserError
from hindrl_jax.config import AgentConfig, Algorithm, BatchConfig, GoalConfig, QuirksConfig, TrainConfig
from hindrl_jax.tasks.registry import Family, did_you_mean, make, task

Preset = Literal["default", "thesis", "original"]

ORIGINAL_RULES: dict[str, dict[str, Any]] = {"grid": {"strict_order": False}, "reach": {"orientation": "axis_angle", "rotation_test": "axis_angle"}}
"""Per family of environments, the arguments under which the original code ran: the last object wins alone, and orientations are axis-angles,
which jump where the hand points down."""


def preset(algo: Algorithm = "hindrl", name: Preset = "default", *, env: str | Environment = "FixedGridPickAndPlace") -> TrainConfig:
    """The config of a model.

    Args:
      algo: "bc", "tqcfd", "hindrl" or "smooth-hindrl".
      name: "default", "thesis" or "original", see the module's docstring.
      env: what it is for: an environment, or its name.

    Raises:
      UserError: for a name that does not exist.
    """
    for value, kind, known in ((algo, "algorithm", get_args(Algorithm)), (name, "preset", get_args(Preset))):
        if value not in known:
            raise UserError(f"unknown {kind} {value!r}{did_you_mean(value, known)}; choose one of {', '.join(known)}")
    known_task = task(env if isinstance(env, str) else env.name)
    family = known_task.family
    if family == "gymnasium":
        if name != "default":
            raise UserError(f"the preset {name} is for the thesis's tasks: choose default for environments of Gymnasium")
        return _as_algorithm(_gymnasium(algo, make(env) if isinstance(env, str) else env), algo)
    if name == "default" and algo in ("hindrl", "smooth-hindrl") and hasattr(known_task.environment, "relabel_observations"):
        return _as_algorithm(_observation_relabelling(), algo)
    return _as_algorithm({"default": _default, "thesis": _thesis, "original": _original}[name](algo, family), algo)


def _as_algorithm(config: TrainConfig, algo: Algorithm) -> TrainConfig:
    """TQCfD is HinDRL without relabelling, Smooth HinDRL is HinDRL with the filter (thesis sections 4.1.3 and 4.1.4)."""
    batch, goal = config.batch, config.goal
    if algo == "tqcfd":
        batch = dataclasses.replace(batch, relabelled_per_original=0.0)
    if algo == "smooth-hindrl":
        goal = dataclasses.replace(goal, epsilon_filtering=True)
    return dataclasses.replace(config, algo=algo, batch=batch, goal=goal)


_ARM_AGENT = AgentConfig(
    layer_norm=True,
    final_learning_rate=1e-5,
    clip_targets=True,
    actor_average_rate=1.0,
    actor_average_span=0.5,
    relative_value=True,
    bc_weight=0.03,
    final_bc_weight=0.0,
)
"""What both recipes for the arm have in common: clipped targets, cloning and a learning rate that fall, a long average of the actor, and an actor
that climbs the value relative to its size. Each says for itself how far its target entropy falls."""


def _default(algo: Algorithm, family: Family) -> TrainConfig:
    """The project's own recipe. For the grid it is `TrainConfig()`, run for longer and with a reset of the agent."""
    encoding: Literal["standardised", "multiscale"] = "standardised" if family == "reach" else "multiscale"
    if algo == "bc":
        return TrainConfig(
            algo="bc",
            steps=4_000,
            eval_every=1_000,
            batch=BatchConfig(n_step=1),
            agent=AgentConfig(net_arch=(64, 64), actor_average_span=0.0, input_encoding=encoding),
        )
    if family == "grid":
        return TrainConfig(steps=240_000, agent_resets=(1 / 3,))
    return TrainConfig(
        steps=44_000,
        num_envs=8,
        updates_per_iteration=8,
        learning_starts=2_400,
        demo_reset_ratio=0.75,
        random_truncation=0.01,
        eval_every=4_000,
        eval_episodes=20,
        batch=BatchConfig(n_step=10, gamma=0.99, bound_by_obtained_return=True),
        goal=GoalConfig(epsilon_steps=5),
        # -4, not -8: with less noise the mean action comes to rest at the edge of a waypoint (docs/recipe.md)
        agent=dataclasses.replace(_ARM_AGENT, target_update_rate=0.01, final_target_entropy=-4.0, input_encoding=encoding),
    )


def _observation_relabelling() -> TrainConfig:
    """The recipe for `environments.RelabelsObservations`: four relabelled rows for each original one, and few demonstration rows."""
    return TrainConfig(
        steps=100_000,
        num_envs=16,
        updates_per_iteration=16,
        learning_starts=4_800,
        demo_reset_ratio=0.5,
        eval_every=10_000,
        batch=BatchConfig(n_step=3, max_demo_ratio=0.125, relabelled_per_original=4.0, hindrl_sampling_strategy="joint_union"),
        goal=GoalConfig(epsilon_steps=5, behavioural_goals="task"),
        agent=dataclasses.replace(_ARM_AGENT, final_target_entropy=-8.0),
    )


def _gymnasium(algo: Algorithm, env: Any) -> TrainConfig:
    """The recipe for environments of Gymnasium: rollouts aim at the goal that an episode comes with, as the demonstrations did."""
    tolerance = env.goal_tolerance
    epsilon: dict[str, Any] = dict(epsilon_steps=5) if tolerance is None else dict(epsilon=round(float(tolerance.min()), 4))
    goal = GoalConfig(behavioural_goals="environment", **epsilon)
    if algo == "bc":
        config = _default("bc", "reach")
        return dataclasses.replace(config, goal=goal, eval_episodes=50)
    return TrainConfig(
        steps=50_000,
        num_envs=8,
        updates_per_iteration=8,
        learning_starts=1_000,
        eval_every=2_500,
        eval_episodes=50,
        goal=goal,
        batch=BatchConfig(n_step=1, relabelled_per_original=1.0, hindrl_sampling_strategy="joint_union"),
        agent=AgentConfig(
            net_arch=(256, 256),
            layer_norm=True,
            learning_rate=1e-3,
            clip_targets=True,
            bc_weight=0.1,
            initial_alpha=0.01,
            input_encoding="standardised",
        ),
    )


_FRAMEWORK: dict[str, Any] = dict(input_encoding="raw", actor_average_rate=1.0, actor_average_span=0.0)
"""How the networks of the thesis's framework are fed and evaluated."""


def _thesis(algo: Algorithm, family: Family) -> TrainConfig:
    """Appendices A.1.1 and A.1.2, with what the text leaves to its framework: gamma 0.99, target rate 0.005, one environment, one update per step."""
    if algo == "bc":
        return TrainConfig(
            algo="bc",
            steps=20_000,
            eval_every=1_000,
            batch=BatchConfig(batch_size=2_048, n_step=1),
            agent=AgentConfig(net_arch=(32, 32), learning_rate=1e-3, **_FRAMEWORK),
            quirks=QuirksConfig(achieved_goal_input=True),
        )
    reach = family == "reach"
    return TrainConfig(
        steps=300_000,
        num_envs=1,
        updates_per_iteration=1,
        learning_starts=5_000 if reach else 10_000,
        buffer_size=1_000_000 if reach else 500_000,
        eval_every=5_000,
        batch=BatchConfig(
            batch_size=12_000 if reach else 4_096,
            max_demo_ratio=0.1,
            reach_zero=1_000_000 if reach else 500_000,
            relabelled_per_original=4.0,
            hindrl_sampling_strategy="task_conditioned",
            n_step=1,
            gamma=0.99,
        ),
        goal=GoalConfig(epsilon_steps=5 if reach else 0),
        agent=AgentConfig(
            net_arch=8 * (32,) if reach else 4 * (64,),  # for reach the appendix prints seven layers, the code has eight
            layer_norm=False,
            learning_rate=1e-3,
            final_learning_rate=None,
            top_quantiles_to_drop_per_net=8 if reach else 2,
            target_update_rate=0.005,
            initial_alpha=1.0,
            target_entropy=None,
            final_target_entropy=None,
            bc_weight=0.0 if reach else 1.0,
            **_FRAMEWORK,
        ),
        quirks=QuirksConfig(achieved_goal_input=True, bootstrap_past_relabelled_goals=True),
    )


def _original(algo: Algorithm, family: Family) -> TrainConfig:
    config = _thesis(algo, family)
    quirks = dataclasses.replace(
        config.quirks,
        strict_goal_test=True,
        timeouts_are_terminal=True,
        exclude_last_goal=True,
        unscaled_demo_actions=True,
        misaligned_demo_actions=family == "reach",
    )
    if algo != "bc":  # the code's own baseline compares the mean action, squared
        quirks = dataclasses.replace(quirks, bc_loss="norm", bc_action="sample")
    return dataclasses.replace(config, goal=dataclasses.replace(config.goal, behavioural_goals="task"), quirks=quirks)
