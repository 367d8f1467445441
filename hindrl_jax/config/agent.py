"""Critics, actor, and how both are trained."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, Literal

from hindrl_jax.base.checks import check, check_types, unchecked

RESIDUAL_EXPANSION = 4
"""Width inside a residual block, over that of the block."""
IMITATION_NET_ARCH = (256, 256)
"""Two wide layers imitate better than four narrow ones, and sooner (docs/cables.md)."""


@dataclasses.dataclass(frozen=True)
class AgentConfig:
    """Truncated quantile critics, the actor, and how both are trained."""

    base: Literal["tqc", "sac"] = "tqc"
    """The algorithm below the demonstrations: truncated quantile critics, or soft actor-critic (Haarnoja et al., 2018), which has no quantiles."""
    net_arch: tuple[int, ...] = (64, 64, 64, 64)
    """Widths of the hidden layers, the same for actor and critics."""
    layer_norm: bool = True
    """Layer normalisation before each activation of the critics; residual networks have their own."""
    residual: bool = False
    """Residual networks, actor and critics (SimBa; Lee et al., 2024): an embedding, then for each of the widths, which must be equal, a block
    x + W2 relu(W1 LN(x)) that is four times as wide inside, then layer normalisation."""
    learning_rate: float = 1e-3
    """Adam's step size, for actor, critics and entropy coefficient."""
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
    actor_average_span: float = 0.25
    """Share of the gradient steps so far that the actor's running average spans, which evaluations and the saved policy use: it moves by
    1 / (1 + span * steps), less and less. With 0 it is the actor itself."""
    relative_value: bool = True
    """Divide each row's value in the actor's loss by max(itself, 0.01), a constant: as if the actor climbed the value's logarithm. One step lost then
    weighs alike near the reward and far from it. For values in [0, 1]. Entropy is then in other units, and not added to the critics' targets."""
    initial_alpha: float = 0.02
    """Entropy coefficient at the start; it is tuned automatically from there."""
    target_entropy: float = -1.0
    """Entropy that the automatic tuning aims at, in nats per action dimension; SAC's rule is -1."""
    final_target_entropy: float | None = -2.0
    """Where the target entropy has moved, linearly, by the end of the run; None keeps it constant."""
    bc_weight: float = 0.1
    """Weight of the behaviour cloning loss on demonstration rows (lambda_BC of the thesis)."""
    q_filter: Literal["off", "hard", "smooth"] = "off"
    """Clone only the demonstrated actions that the critics value above the policy's own (hard; Nair et al., 2018, eq. 4), or each in proportion to
    the probability that it is better (smooth; SPReD, Zhu et al., 2025), where the critics' values, tqc's the means of their quantiles, are an
    ensemble."""
    actor_network: Callable[..., Any] | None = None
    """An actor of your own, MODULE:NAME: called with the number of outputs, twice the action's, returns a flax module, (B, inputs) -> (B, outputs).
    See `core.networks`."""
    critic_network: Callable[..., Any] | None = None
    """Critics of your own, likewise: their inputs are the actor's and the action, their outputs the quantiles, or one value."""
    actor_loss: Callable[..., Any] | None = None
    """A loss of the actor of your own, MODULE:NAME: called with `core.losses.ActorTerms` and this config, in place of `core.losses.actor_loss`."""
    critic_loss: Callable[..., Any] | None = None
    """A loss of the critics of your own, called with `core.losses.CriticTerms` and this config, in place of `core.losses.critic_loss`."""
    input_encoding: Literal["raw", "multiscale", "standardised"] = "multiscale"
    """Networks see inputs as they are (thesis); or less their mean in the demonstrations, over their standard deviation; or (multiscale) that and
    tanh(4 x), x being the input over its root mean square there."""

    def __post_init__(self) -> None:
        check_types(self)
        check(
            self,
            net_arch=(len(self.net_arch) >= 1 and all(width >= 1 for width in self.net_arch), "one or more widths, each at least 1"),
            learning_rate=(self.learning_rate > 0.0, "greater than 0"),
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
            actor_average_span=(self.actor_average_span >= 0.0, "0 or more"),
            initial_alpha=(self.initial_alpha > 0.0, "greater than 0"),
            bc_weight=(self.bc_weight >= 0.0, "0 or more"),
            actor_network=(not _is_module(self.actor_network), "a class or a function that returns a module, not a module"),
            critic_network=(not _is_module(self.critic_network), "a class or a function that returns a module, not a module"),
        )
        if self.residual and len(set(self.net_arch)) > 1:
            raise ValueError(f"residual adds up layers of equal widths, but net_arch = {self.net_arch}: give equal ones, or turn residual off")
        if self.q_filter == "smooth" and self.num_critics < 2:
            raise ValueError("q_filter = smooth compares the critics' values with each other, but num_critics = 1: raise it, or choose hard")

    @property
    def for_imitation(self) -> AgentConfig:
        """The same with the network of bc, or one's own `actor_network`; not checked, since other values may be traced."""
        return unchecked(self, net_arch=IMITATION_NET_ARCH, residual=False)

    @property
    def widest_layer(self) -> int:
        """Units of the widest hidden layer."""
        return max(self.net_arch) * (RESIDUAL_EXPANSION if self.residual else 1)

    @property
    def critic_outputs(self) -> int:
        """Numbers that each critic returns: its quantiles, or one value."""
        return self.num_quantiles if self.base == "tqc" else 1


def _is_module(network: Any) -> bool:
    """Whether a network of one's own is itself a module of flax, which is a dataclass."""
    return dataclasses.is_dataclass(network) and not isinstance(network, type)
