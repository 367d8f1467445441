"""Which fields have an effect only under a condition."""

from __future__ import annotations

from collections.abc import Callable

from hindrl_jax.config.train import TrainConfig


def _relabels(config: TrainConfig) -> bool:
    return config.algo not in ("bc", "tqcfd") and config.batch.relabelled_per_original > 0


def _has_demo_rows(config: TrainConfig) -> bool:
    return config.algo == "bc" or config.batch.max_demo_rows > 0 or config.priority.is_used


# Which fields have an effect only under a condition: the fields, the condition, and what to do where it does not hold.
_CONDITIONS: tuple[tuple[str, Callable[[TrainConfig], bool], str], ...] = (
    (
        "max_demo_ratio reach_zero relabelled_per_original hindrl_sampling_strategy union_sampling_ratio intersection_goals strategy_mixture "
        "n_step gamma bootstrap_past_relabelled_goals bound_by_obtained_return timeouts_are_terminal importance_exponent demo_priority_bonus "
        "achieved_goal_ratio final_achieved_goal_ratio clip_targets num_critics num_target_critics num_quantiles top_quantiles_to_drop_per_net "
        "layer_norm target_update_rate initial_alpha target_entropy final_target_entropy exploration_noise target_noise "
        "target_noise_clip relative_value preactivation_weight bc_weight final_bc_weight agent_resets num_envs "
        "updates_per_iteration learning_starts buffer_size demo_reset_ratio demo_reset_curriculum random_truncation",
        lambda config: config.learns_from_rollouts,
        "behaviour cloning does not use it: choose another algo",
    ),
    (
        "initial_alpha target_entropy final_target_entropy",
        lambda c: c.agent.has_entropy,
        "{base} has no entropy coefficient: choose --base tqc or sac",
    ),
    ("num_quantiles top_quantiles_to_drop_per_net", lambda c: c.agent.base == "tqc", "{base} has no quantiles: choose --base tqc"),
    ("exploration_noise", lambda c: not c.agent.has_entropy, "{base} samples its actions: choose --base td3 or ddpg"),
    ("target_noise target_noise_clip", lambda c: c.agent.base == "td3", "{base} has no such noise: choose --base td3"),
    (
        "hindrl_sampling_strategy union_sampling_ratio intersection_goals strategy_mixture bootstrap_past_relabelled_goals",
        _relabels,
        "nothing is relabelled: choose --algo hindrl with --relabelled-per-original above 0",
    ),
    (
        "union_sampling_ratio",
        lambda c: c.batch.hindrl_sampling_strategy == "joint_union",
        "only relabelling by joint_union uses it: choose --hindrl-sampling-strategy joint_union",
    ),
    (
        "intersection_goals",
        lambda c: c.batch.uses_intersections,
        "only relabelling by joint_intersection uses it: choose --hindrl-sampling-strategy joint_intersection",
    ),
    ("importance_exponent demo_priority_bonus", lambda c: c.priority.is_used, "transitions have no priorities: raise --priority-exponent"),
    ("reach_zero", lambda c: c.batch.max_demo_rows > 0, "the batch has no demonstration rows: raise --max-demo-ratio"),
    (
        "bc_weight final_bc_weight bc_loss bc_action q_filter",
        _has_demo_rows,
        "the batch has no demonstration rows to clone: raise --max-demo-ratio",
    ),
    ("q_filter bc_loss bc_action", lambda c: c.algo == "bc" or c.agent.bc_weight > 0.0, "nothing is cloned: raise --bc-weight"),
    ("epsilon_deviations", lambda c: c.goal.epsilon_steps > 0, "epsilon depends on it only for epsilon_steps > 0: add --epsilon-steps 5"),
    (
        "epsilon_steps epsilon_deviations epsilon",
        lambda c: _relabels(c) or c.goal.epsilon_filtering or c.goal.has_achieved_goals,
        "epsilon is used only for relabelling, achieved goals and the filter: choose --algo hindrl",
    ),
)


def without_effect(config: TrainConfig, name: str) -> str | None:
    """Why changing a field would change nothing in this config, and what to do; None if it has an effect, as far as is known."""
    for names, has_effect, reason in _CONDITIONS:
        if name in names.split() and not has_effect(config):
            return reason.format(base=config.agent.base)
    return None
