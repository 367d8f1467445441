"""Configs by name: the four models of the thesis, under the project's own recipe, the thesis's settings, or the original code's.

default    the project's own recipe, for a laptop CPU
thesis     the hyperparameters of the thesis's appendix, on plain correct code
original   the same, with the quirks of the original implementation that explain its published figures
"""

from __future__ import annotations

import dataclasses
from typing import Literal, get_args

from hindrl_jax.config import AgentConfig, Algorithm, BatchConfig, GoalConfig, TrainConfig
from hindrl_jax.errors import UserError
from hindrl_jax.registry import did_you_mean

Preset = Literal["default", "thesis", "original"]

ORIGINAL_RULES = {"strict_order": False}
"""Arguments of the grid environments under which the original code ran: its rules let the last object win alone."""


def preset(algo: Algorithm = "hindrl", name: Preset = "default") -> TrainConfig:
    """The config of a model.

    Args:
      algo: "bc", "tqcfd", "hindrl" or "smooth-hindrl".
      name: "default", "thesis" or "original", see the module's docstring.

    Raises:
      UserError: for a name that does not exist.
    """
    for value, kind, known in ((algo, "algorithm", get_args(Algorithm)), (name, "preset", get_args(Preset))):
        if value not in known:
            raise UserError(f"unknown {kind} {value!r}{did_you_mean(value, known)}; choose one of {', '.join(known)}")
    return {"default": _default, "thesis": _thesis, "original": _original}[name](algo)


def _as_algorithm(config: TrainConfig, algo: Algorithm) -> TrainConfig:
    """TQCfD is HinDRL without relabelling, Smooth HinDRL is HinDRL with the filter (thesis sections 4.1.3 and 4.1.4)."""
    batch, goal = config.batch, config.goal
    if algo == "tqcfd":
        batch = dataclasses.replace(batch, num_sampled_goals=0.0)
    if algo == "smooth-hindrl":
        goal = dataclasses.replace(goal, epsilon_filtering=True)
    return dataclasses.replace(config, algo=algo, batch=batch, goal=goal)


def _default(algo: Algorithm) -> TrainConfig:
    if algo == "bc":
        return TrainConfig(
            algo="bc",
            steps=4_000,
            eval_every=1_000,
            batch=BatchConfig(n_step=1),
            agent=AgentConfig(net_arch=(64, 64)),
        )
    return _as_algorithm(TrainConfig(), algo)


def _thesis(algo: Algorithm) -> TrainConfig:
    """Appendix A.1.1, with what the text leaves to its framework: gamma 0.99, target rate 0.005, one environment, one update per step."""
    if algo == "bc":
        return TrainConfig(
            algo="bc",
            steps=20_000,
            eval_every=1_000,
            batch=BatchConfig(batch_size=2_048, n_step=1),
            agent=AgentConfig(
                net_arch=(32, 32), learning_rate=1e-3, input_encoding="raw", actor_average_rate=1.0, policy_input="achieved_desired_observation"
            ),
        )
    config = TrainConfig(
        steps=300_000,
        num_envs=1,
        updates_per_iteration=1,
        learning_starts=10_000,
        buffer_size=500_000,
        eval_every=5_000,
        batch=BatchConfig(
            batch_size=4_096,
            max_demo_ratio=0.1,
            reach_zero=500_000,
            num_sampled_goals=4.0,
            hindrl_sampling_strategy="task_conditioned",
            n_step=1,
            gamma=0.99,
            terminate_on_relabel=False,
        ),
        goal=GoalConfig(m=0, k=0.0),
        agent=AgentConfig(
            net_arch=(64, 64, 64, 64),
            layer_norm=False,
            learning_rate=1e-3,
            final_learning_rate=None,
            top_quantiles_to_drop_per_net=2,
            target_update_rate=0.005,
            initial_alpha=1.0,
            target_entropy=None,
            final_target_entropy=None,
            bc_weight=1.0,
            input_encoding="raw",
            actor_average_rate=1.0,
            policy_input="achieved_desired_observation",
        ),
    )
    return _as_algorithm(config, algo)


def _original(algo: Algorithm) -> TrainConfig:
    config = _thesis(algo)
    return dataclasses.replace(
        config,
        batch=dataclasses.replace(config.batch, inclusive_goal_test=False, timeouts_are_terminal=True),
        goal=dataclasses.replace(config.goal, behavioural_goals="task", exclude_last_goal=True, rescale_demo_actions=False),
        agent=dataclasses.replace(config.agent, bc_loss="norm", bc_action="sample"),
    )
