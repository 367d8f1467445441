"""Options of the recipe that can be switched: one change each, by name."""

from __future__ import annotations

import dataclasses
from typing import Literal

from hindrl_jax.config import AgentConfig, BatchConfig, GoalConfig, QuirksConfig, TrainConfig
from hindrl_jax.reproduction.cells import Changes

Group = Literal["baseline", "algorithm", "hindsight", "goals", "targets", "demonstrations", "critic", "actor", "inputs", "replay", "rollout"]


@dataclasses.dataclass(frozen=True)
class Option:
    """One change to the recipe."""

    name: str
    """In kebab case; the name of its directory."""
    group: Group
    """What part of the recipe it is about."""
    summary: str
    """One line: what it changes, and the paper that it is from, if any."""
    changes: Changes
    """What is changed, see `cells.changed`."""


def half_of_the_run(config: TrainConfig) -> int:
    """Environment steps after which the run is half over."""
    return config.num_steps // 2


RECIPE = TrainConfig(
    steps=80_000,
    num_envs=16,
    action_hold=1,
    updates_per_iteration=2,
    learning_starts=1_600,
    batch=BatchConfig(max_demo_ratio=0.25),
    goal=GoalConfig(epsilon_steps=0),
    agent=AgentConfig(
        net_arch=(64, 64, 64, 64),
        layer_norm=False,
        clip_targets=False,
        relative_value=False,
        initial_alpha=0.002,
        target_entropy=-0.2,
        final_target_entropy=-2.0,
        bc_weight=0.01,
    ),
    quirks=QuirksConfig(bc_loss="squared"),
)
"""What is ablated: the recipe for the grid tasks that this project had when it was measured (docs/ablation.md). The default has moved on since."""

BASELINE = Option("default", "baseline", "the recipe as it is", ())

OPTIONS: tuple[Option, ...] = (
    Option("sac", "algorithm", "SAC in place of TQC", (("agent.base", "sac"),)),
    Option("goals-final", "hindsight", "relabelled with the rollout's last goal (HER)", (("batch.hindrl_sampling_strategy", "final"),)),
    Option("goals-future", "hindsight", "relabelled with goals later in the rollout (HER)", (("batch.hindrl_sampling_strategy", "future"),)),
    Option("goals-episode", "hindsight", "relabelled with any goal of the rollout (HER)", (("batch.hindrl_sampling_strategy", "episode"),)),
    Option(
        "goals-joint-union",
        "hindsight",
        "relabelled with goals of demonstrations and rollouts, half and half (HinDRL)",
        (("batch.hindrl_sampling_strategy", "joint_union"), ("batch.union_sampling_ratio", 0.5)),
    ),
    Option("goals-random", "hindsight", "relabelled with any goal of any rollout (HER)", (("batch.hindrl_sampling_strategy", "random"),)),
    Option(
        "goals-intersection",
        "hindsight",
        "relabelled with goals of the rollout that lie near a demonstrated one (HinDRL)",
        (("batch.hindrl_sampling_strategy", "joint_intersection"),),
    ),
    Option(
        "goals-intersection-demo",
        "hindsight",
        "relabelled with demonstrated goals that the rollout came near (HinDRL)",
        (("batch.hindrl_sampling_strategy", "joint_intersection"), ("batch.intersection_goals", "demonstrations")),
    ),
    Option("no-relabelling", "hindsight", "no relabelled rows (the thesis's TQCfD)", (("algo", "tqcfd"), ("batch.relabelled_per_original", 0.0))),
    Option(
        "relabelled-4", "hindsight", "four relabelled rows for each original one, in place of 1/4 (thesis)", (("batch.relabelled_per_original", 4.0),)
    ),
    Option(
        "relabelled-go-on",
        "hindsight",
        "reaching a relabelled goal does not end the return (thesis)",
        (("quirks.bootstrap_past_relabelled_goals", True),),
    ),
    Option("strict-goal-test", "goals", "a goal is reached at distance < epsilon, not <= (thesis)", (("quirks.strict_goal_test", True),)),
    Option(
        "task-goal", "goals", "rollouts aim at the task's constant goal, not at the end of a demonstration", (("goal.behavioural_goals", "task"),)
    ),
    Option(
        "smooth",
        "goals",
        "demonstration goals filtered by epsilon (the thesis's Smooth HinDRL)",
        (("algo", "smooth-hindrl"), ("goal.epsilon_filtering", True)),
    ),
    Option("n-step-1", "targets", "1-step returns in place of 5 (thesis)", (("batch.n_step", 1),)),
    Option("n-step-3", "targets", "3-step returns in place of 5", (("batch.n_step", 3),)),
    Option("gamma-0.99", "targets", "discount 0.99 in place of 0.98 (thesis)", (("batch.gamma", 0.99),)),
    Option("clip-targets", "targets", "targets clipped to [0, 1] (HER)", (("agent.clip_targets", True),)),
    Option(
        "timeouts-terminal",
        "targets",
        "episodes cut by the horizon count as terminated (original code)",
        (("quirks.timeouts_are_terminal", True),),
    ),
    Option("demo-rows-none", "demonstrations", "no demonstration rows in the batch, so no cloning either", (("batch.max_demo_ratio", 0.0),)),
    Option("demo-rows-half", "demonstrations", "half of the batch are demonstration rows, not a quarter (RLPD)", (("batch.max_demo_ratio", 0.5),)),
    Option(
        "demo-rows-fade",
        "demonstrations",
        "the share of demonstration rows falls to zero by the middle of the run (thesis)",
        (("batch.reach_zero", half_of_the_run),),
    ),
    Option("bc-0", "demonstrations", "no cloning loss", (("agent.bc_weight", 0.0),)),
    Option("bc-0.1", "demonstrations", "cloning loss with weight 0.1 in place of 0.01", (("agent.bc_weight", 0.1),)),
    Option("bc-1", "demonstrations", "cloning loss with weight 1 in place of 0.01 (thesis)", (("agent.bc_weight", 1.0),)),
    Option(
        "q-filter",
        "demonstrations",
        "as bc-0.1, where the critics prefer the demonstrated action (Nair et al.)",
        (("agent.q_filter", "hard"), ("agent.bc_weight", 0.1)),
    ),
    Option(
        "q-filter-smooth",
        "demonstrations",
        "as bc-0.1, as far as the critics are sure that the demonstrated action is better (SPReD)",
        (("agent.q_filter", "smooth"), ("agent.bc_weight", 0.1)),
    ),
    Option(
        "imitation-proposal",
        "demonstrations",
        "a policy cloned by 2,000 gradient steps proposes beside the actor, and the critics choose (IBRL)",
        (("imitation_steps", 2_000), ("imitation_proposal", True)),
    ),
    Option("bc-norm", "demonstrations", "cloning loss is the distance, not its square (original code)", (("quirks.bc_loss", "norm"),)),
    Option("bc-sample", "demonstrations", "cloning loss of a sampled action, not of the mean one (original code)", (("quirks.bc_action", "sample"),)),
    Option(
        "demo-resets-0.25",
        "demonstrations",
        "a quarter of all episodes begin in demonstrated states (Nair et al.)",
        (("demo_reset_ratio", 0.25),),
    ),
    Option("demo-resets-0.5", "demonstrations", "half of all episodes begin in demonstrated states (Nair et al.)", (("demo_reset_ratio", 0.5),)),
    Option(
        "demo-resets-reverse",
        "demonstrations",
        "half of all episodes begin in demonstrated states, the last ones first, and earlier ones where these succeed (RFCL)",
        (("demo_reset_ratio", 0.5), ("demo_reset_curriculum", True)),
    ),
    Option("layer-norm", "critic", "layer normalisation in the critics (RLPD)", (("agent.layer_norm", True),)),
    Option("residual", "critic", "residual blocks of width 64, four of them, in critics and actor (SimBa)", (("agent.residual", True),)),
    Option("critics-1", "critic", "1 critic in place of 2", (("agent.num_critics", 1),)),
    Option("critics-5", "critic", "5 critics in place of 2 (TQC)", (("agent.num_critics", 5),)),
    Option("redq", "critic", "5 critics, of which 2 at random make the targets (REDQ)", (("agent.num_critics", 5), ("agent.num_target_critics", 2))),
    Option("no-truncation", "critic", "no quantiles dropped from the targets", (("agent.top_quantiles_to_drop_per_net", 0),)),
    Option("target-rate-0.005", "critic", "target critics follow at 0.005 in place of 0.02 (TQC)", (("agent.target_update_rate", 0.005),)),
    Option("alpha-1", "actor", "the entropy coefficient starts at 1 in place of 0.002 (SAC)", (("agent.initial_alpha", 1.0),)),
    Option("entropy-constant", "actor", "the target entropy stays at -1, it does not fall to -10", (("agent.final_target_entropy", None),)),
    Option("no-actor-average", "actor", "the actor itself is evaluated, not its running average", (("agent.actor_average_span", 0.0),)),
    Option("inputs-raw", "inputs", "networks see inputs as they are (thesis)", (("agent.input_encoding", "raw"),)),
    Option("inputs-standardised", "inputs", "networks see standardised inputs", (("agent.input_encoding", "standardised"),)),
    Option("batch-1024", "replay", "batches of 1,024 rows in place of 256", (("batch.batch_size", 1_024),)),
    Option(
        "environments-64",
        "rollout",
        "64 environments in place of 16: four times as many environment steps for each gradient step",
        (("num_envs", 64), ("learning_starts", 6_400)),
    ),
    Option("updates-8", "rollout", "8 gradient steps per vectorised environment step in place of 2", (("updates_per_iteration", 8),)),
)
