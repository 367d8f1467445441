"""Critics, actor, and how both are trained."""

from __future__ import annotations

import dataclasses
from typing import Literal

from hindrl_jax.base.checks import check, check_types

RESIDUAL_EXPANSION = 4
"""Width inside a residual block, over that of the block."""


@dataclasses.dataclass(frozen=True)
class AgentConfig:
    """Truncated quantile critics, the actor, and how both are trained."""

    base: Literal["tqc", "sac", "td3", "ddpg"] = "tqc"
    """The algorithm below the demonstrations: truncated quantile critics, soft actor-critic (Haarnoja et al., 2018), TD3 (Fujimoto et al., 2018;
    its actor delayed) or DDPG (Lillicrap et al., 2016; with one critic). Only tqc has quantiles, only tqc and sac have entropy; td3 and
    ddpg need a preactivation_weight."""
    net_arch: tuple[int, ...] = (64, 64, 64, 64)
    """Widths of the hidden layers, the same for actor and critics."""
    layer_norm: bool = True
    """Layer normalisation before each activation of the critics; residual networks have their own."""
    residual: bool = False
    """Residual networks, actor and critics (SimBa; Lee et al., 2024): an embedding, then for each of the widths, which must be equal, a block
    x + W2 relu(W1 LN(x)) that is four times as wide inside, then layer normalisation."""
    network_precision: Literal["float32", "bfloat16"] = "float32"
    """Operands of the networks' products: float32 (on NVIDIA GPUs TF32, as JAX has it), or bfloat16 summed in float32: faster, less steady."""
    learning_rate: float = 1e-3
    """Adam's step size, for actor, critics and entropy coefficient."""
    final_learning_rate: float | None = None
    """Where the step size has moved, linearly, by the end of the run; None keeps it constant."""
    clip_targets: bool = True
    """Clip the critics' targets to [0, 1], which holds every return where the one reward of an episode is 1 and ends it (Andrychowicz et al.,
    hindsight experience replay, 2017)."""
    num_critics: int = 2
    """Number of critics."""
    num_target_critics: int | None = None
    """Target critics drawn at random for each gradient step (REDQ; Chen et al., 2021), the actor climbing the mean of all; None takes all."""
    num_quantiles: int = 25
    """Quantiles per critic."""
    top_quantiles_to_drop_per_net: int = 2
    """Largest target quantiles dropped per critic (TQC's truncation)."""
    target_update_rate: float = 0.02
    """Share of the online critics that moves into the target critics at each gradient step (Polyak averaging)."""
    actor_average_rate: float = 0.002
    """Share of the actor that moves into its running average at each gradient step; evaluations and the saved policy use the average."""
    actor_average_span: float = 0.25
    """Share of the gradient steps so far that the average spans at least: it moves by at most 1 / (1 + span * steps), less and less."""
    initial_alpha: float = 0.002
    """Entropy coefficient at the start; it is tuned automatically from there."""
    target_entropy: float | None = None
    """Entropy that the automatic tuning aims at, in nats; None means minus the number of action dimensions."""
    final_target_entropy: float | None = None
    """Where the target entropy has moved, linearly, by the end of the run; None keeps it constant."""
    exploration_noise: float = 0.1
    """For td3 and ddpg: standard deviation of the noise on the actions of rollouts, which lie in [-1, 1]."""
    target_noise: float = 0.2
    """For td3: standard deviation of the noise on the actions of the targets."""
    target_noise_clip: float = 0.5
    """For td3: the largest noise on the actions of the targets."""
    relative_value: bool = False
    """Divide the value in the actor's loss, row by row, by itself, or by 0.01 where it is less (negative, too): as if the actor climbed the value's
    logarithm. One step lost then weighs alike near the reward and far from it. The entropy's weight is then in other units than the rewards, so that
    the critics' targets leave entropy out."""
    preactivation_weight: float = 0.0
    """Weight, in the actor's loss, of the squared length of the mode before tanh (HER, appendix A). Without entropy nothing else keeps td3 and ddpg
    away from saturated actions, which have no gradient."""
    bc_weight: float = 0.05
    """Weight of the behaviour cloning loss on demonstration rows (lambda_BC of the thesis)."""
    final_bc_weight: float | None = None
    """Where that weight has moved, linearly, by the end of the run; None keeps it constant."""
    q_filter: Literal["off", "hard", "smooth"] = "off"
    """Clone only the demonstrated actions that the critics value above the policy's own (hard; Nair et al., 2018, eq. 4), or each in proportion to
    the probability that it is better (smooth; SPReD, Zhu et al., 2025), where the critics' values, tqc's the means of their quantiles, are an
    ensemble."""
    input_encoding: Literal["raw", "multiscale", "standardised"] = "multiscale"
    """Networks see inputs as they are (thesis); or less their mean in the demonstrations, over their standard deviation; or (multiscale) that and
    tanh(4 x), x being the input over its root mean square there."""

    def __post_init__(self) -> None:
        check_types(self)
        check(
            self,
            net_arch=(len(self.net_arch) >= 1 and all(width >= 1 for width in self.net_arch), "one or more widths, each at least 1"),
            learning_rate=(self.learning_rate > 0.0, "greater than 0"),
            final_learning_rate=(self.final_learning_rate is None or self.final_learning_rate >= 0.0, "0 or more, or None"),
            num_critics=(self.num_critics >= 1, "at least 1"),
            num_target_critics=(
                self.num_target_critics is None or 1 <= self.num_target_critics <= self.num_critics,
                f"between 1 and num_critics = {self.num_critics}, or None",
            ),
            num_quantiles=(self.num_quantiles >= 1, "at least 1"),
            top_quantiles_to_drop_per_net=(
                0 <= self.top_quantiles_to_drop_per_net < self.num_quantiles,
                f"between 0 and num_quantiles - 1 = {self.num_quantiles - 1}",
            ),
            target_update_rate=(0.0 < self.target_update_rate <= 1.0, "in (0, 1]"),
            actor_average_rate=(0.0 < self.actor_average_rate <= 1.0, "in (0, 1]; 1 means no averaging"),
            actor_average_span=(self.actor_average_span >= 0.0, "0 or more"),
            initial_alpha=(self.initial_alpha > 0.0, "greater than 0"),
            exploration_noise=(self.exploration_noise >= 0.0, "0 or more"),
            target_noise=(self.target_noise >= 0.0, "0 or more"),
            target_noise_clip=(self.target_noise_clip >= 0.0, "0 or more"),
            preactivation_weight=(self.preactivation_weight >= 0.0, "0 or more"),
            bc_weight=(self.bc_weight >= 0.0, "0 or more"),
            final_bc_weight=(self.final_bc_weight is None or self.final_bc_weight >= 0.0, "0 or more, or None"),
        )
        if self.residual and len(set(self.net_arch)) > 1:
            raise ValueError(f"residual adds up layers of equal widths, but net_arch = {self.net_arch}: give equal ones, or turn residual off")
        if self.q_filter == "smooth" and self.num_critics < 2:
            raise ValueError("q_filter = smooth compares the critics' values with each other, but num_critics = 1: raise it, or choose hard")
        if self.base == "ddpg" and self.num_critics > 1:
            raise ValueError(f"ddpg has one critic, but num_critics = {self.num_critics}: set it to 1, or choose td3")

    @property
    def has_entropy(self) -> bool:
        """Whether the policy is random and rewarded for it; td3 and ddpg have a deterministic one."""
        return self.base in ("tqc", "sac")

    @property
    def widest_layer(self) -> int:
        """Units of the widest hidden layer."""
        return max(self.net_arch) * (RESIDUAL_EXPANSION if self.residual else 1)

    @property
    def critic_outputs(self) -> int:
        """Numbers that each critic returns: its quantiles, or one value."""
        return self.num_quantiles if self.base == "tqc" else 1
