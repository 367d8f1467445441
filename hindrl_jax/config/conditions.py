"""Which fields have an effect only under a condition. `tests/config/test_conditions.py` holds the table to what is computed."""

from __future__ import annotations

from collections.abc import Callable

from hindrl_jax.config.train import TrainConfig


def _relabels(config: TrainConfig) -> bool:
    return config.learns_from_rollouts and config.batch.relabelled_per_original > 0


def _relabels_with_demonstrations(config: TrainConfig) -> bool:
    return _relabels(config) and not {"task_conditioned", "joint_intersection"}.isdisjoint(dict(config.batch.sources))


def _has_demo_rows(config: TrainConfig) -> bool:
    return not config.learns_from_rollouts or config.batch.max_demo_rows > 0


def _clones(config: TrainConfig) -> bool:
    """Whether cloning is ever part of the loss; the policy of `imitation_steps` is cloned whatever this says."""
    return not config.learns_from_rollouts or config.agent.bc_weight > 0.0


def _has_a_network_of_ours(config: TrainConfig) -> bool:
    return config.agent.actor_network is None or (config.learns_from_rollouts and config.agent.critic_network is None)


CONDITIONS: tuple[tuple[str, Callable[[TrainConfig], bool], str], ...] = (
    (
        "max_demo_ratio reach_zero relabelled_per_original hindrl_sampling_strategy union_sampling_ratio intersection_goals "
        "n_step gamma bootstrap_past_relabelled_goals timeouts_are_terminal "
        "clip_targets num_critics num_target_critics num_quantiles top_quantiles_to_drop_per_net "
        "layer_norm target_update_rate initial_alpha relative_value target_entropy final_target_entropy bc_weight num_envs "
        "updates_per_iteration learning_starts buffer_size demo_reset_ratio demo_reset_curriculum critic_network actor_loss critic_loss",
        lambda c: c.learns_from_rollouts,
        "behaviour cloning does not use it: choose another algo",
    ),
    ("num_quantiles top_quantiles_to_drop_per_net", lambda c: c.agent.base == "tqc", "{base} has no quantiles: choose --base tqc"),
    ("net_arch residual", _has_a_network_of_ours, "networks of your own are as large as they say: drop it"),
    ("layer_norm", lambda c: c.agent.critic_network is None, "critics of your own have layer normalisation or not: drop it"),
    ("layer_norm", lambda c: not c.agent.residual, "residual networks have layer normalisation of their own: set --no-residual"),
    (
        "hindrl_sampling_strategy union_sampling_ratio intersection_goals bootstrap_past_relabelled_goals strict_goal_test",
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
    (
        "epsilon_filtering exclude_last_goal",
        _relabels_with_demonstrations,
        "nothing is relabelled with goals of demonstrations: choose --algo hindrl with --hindrl-sampling-strategy task_conditioned",
    ),
    ("practice_rounds", lambda c: c.imitation_steps > 0, "no policy imitates: raise --imitation-steps"),
    ("reach_zero", lambda c: c.batch.max_demo_rows > 0, "the batch has no demonstration rows: raise --max-demo-ratio"),
    ("bc_weight q_filter", _has_demo_rows, "the batch has no demonstration rows to clone: raise --max-demo-ratio"),
    (
        "bc_loss bc_action unscaled_demo_actions",
        lambda c: _has_demo_rows(c) or c.imitation_steps > 0,
        "the batch has no demonstration rows to clone: raise --max-demo-ratio",
    ),
    ("q_filter", _clones, "nothing is cloned: raise --bc-weight"),
    ("bc_loss bc_action", lambda c: _clones(c) or c.imitation_steps > 0, "nothing is cloned: raise --bc-weight"),
    ("epsilon_steps epsilon_deviations", lambda c: c.goal.epsilon is None, "epsilon itself is given: set it to None (--epsilon None)"),
    ("epsilon_deviations", lambda c: c.goal.epsilon_steps > 0, "epsilon depends on it only where pairs are some steps apart: add --epsilon-steps 5"),
    ("epsilon_steps epsilon_deviations epsilon", _relabels, "epsilon is used only for relabelling and the filter: choose --algo hindrl"),
)
"""The fields, the condition under which they have an effect, and what to do where it does not hold."""


def without_effect(config: TrainConfig, name: str) -> str | None:
    """Why changing a field would change nothing in this config, and what to do; None if it has an effect, as far as is known."""
    for names, has_effect, reason in CONDITIONS:
        if name in names.split() and not has_effect(config):
            return reason.format(base=config.agent.base)
    return None
