"""Every knob of training, as frozen dataclasses: hashable, passed whole, static under `jax.jit`.

The line under each field is its documentation and its help text on the command line. The defaults are the project's own recipe; the thesis's
numbers and the original code's quirks are presets (`hindrl_jax.tasks.presets`).
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, Literal

from hindrl_jax.base.checks import check, check_types

Algorithm = Literal["bc", "tqcfd", "hindrl", "smooth-hindrl"]
Source = Literal["final", "future", "episode", "random", "task_conditioned", "joint_intersection"]
"""Where a relabelled goal may come from, explained in `hindrl_jax.core.hindsight`."""
Strategy = Literal["final", "future", "rollout_conditioned", "episode", "random", "task_conditioned", "joint_union", "joint_intersection", "mixture"]
"""Hindsight strategies: one of the sources, or a mixture of them."""


@dataclasses.dataclass(frozen=True)
class BatchConfig:
    """How a training batch is put together (thesis section 4.1.2)."""

    batch_size: int = 256
    """Rows of the batch of a gradient step, demonstrations included."""
    max_demo_ratio: float = 0.25
    """Share of demonstration rows in the batch at the start of training (MAX_d of thesis eq. 4.9, as a ratio)."""
    reach_zero: int | None = None
    """Environment step at which the demonstration share has fallen linearly to zero (thesis eq. 4.9); None keeps it constant."""
    num_sampled_goals: float = 0.25
    """Relabelled rows per original replay row, n: the relabelled share of the replay rows is n / (n + 1). Zero turns relabelling off."""
    hindrl_sampling_strategy: Strategy = "task_conditioned"
    """Where relabelled goals come from; rollout_conditioned is the thesis's name for future."""
    union_sampling_ratio: float = 0.5
    """For joint_union: the share of relabelled goals that comes from the demonstrations."""
    intersection_goals: Literal["rollout", "demonstrations"] = "rollout"
    """For joint_intersection: goals that the rollout reached within epsilon of a demonstrated one, or the demonstrated ones that it came near."""
    strategy_mixture: tuple[tuple[Source, float], ...] = ()
    """For mixture: the sources of goals and their weights, as in future 0.5 random 0.2 task_conditioned 0.3."""
    n_step: int = 5
    """Steps of reward before the value estimate takes over."""
    gamma: float = 0.98
    """Discount factor."""
    demo_returns: Literal["n_step", "monte_carlo"] = "n_step"
    """Returns of demonstration rows: over n_step steps, as those of all rows, or all the way to the demonstration's end."""
    inclusive_goal_test: bool = True
    """A goal counts as reached at distance <= epsilon; false gives the strict < of the thesis's formula and code."""
    terminate_on_relabel: bool = True
    """Reaching a relabelled goal ends the return; false bootstraps past it, as the thesis does, and values can exceed 1. Where hindsight changes
    observations in place of goals (ParameterizedReach), a solved task always does."""
    bound_by_obtained_return: bool = False
    """No target lies below the return that the row's own episode went on to obtain, which is a lower bound of the optimal value where neither
    actions nor rewards are random (He et al., optimality tightening, 2017; Oh et al., self-imitation learning, 2018)."""
    timeouts_are_terminal: bool = False
    """Treat episodes that are cut, by the horizon or by random_truncation, as terminated, as the original code does by mistake."""
    priority_exponent: float = 0.0
    """0 draws uniformly, an episode, then one of its transitions. More draws transitions in proportion to their temporal-difference error to this
    power (Schaul et al., prioritised experience replay, 2016), from demonstrations and replay together: max_demo_ratio and reach_zero then have no
    say."""
    importance_exponent: float = 0.4
    """With priorities: 1 corrects the critics' loss wholly for what is drawn too often, 0 not at all. Schaul's first value, kept: his rise to 1
    makes the end of training unbiased, and sparse rewards are found long before."""
    demo_priority_bonus: float = 0.0
    """With priorities: what is added to the error of a demonstration's transitions, so that they keep being drawn (DDPGfD, Vecerik et al., 2017)."""

    def __post_init__(self) -> None:
        check_types(self)
        if self.hindrl_sampling_strategy == "rollout_conditioned":
            object.__setattr__(self, "hindrl_sampling_strategy", "future")
        check(
            self,
            batch_size=(self.batch_size >= 1, "at least 1"),
            max_demo_ratio=(0.0 <= self.max_demo_ratio <= 1.0, "between 0 and 1"),
            reach_zero=(self.reach_zero is None or self.reach_zero >= 1, "at least 1 environment step, or None"),
            num_sampled_goals=(self.num_sampled_goals >= 0, "0 (no relabelling) or more"),
            union_sampling_ratio=(0.0 <= self.union_sampling_ratio <= 1.0, "between 0 and 1"),
            strategy_mixture=(
                all(weight > 0.0 for _, weight in self.strategy_mixture) and len(dict(self.strategy_mixture)) == len(self.strategy_mixture),
                "sources that differ, with weights greater than 0",
            ),
            n_step=(self.n_step >= 1, "at least 1"),
            gamma=(0.0 < self.gamma <= 1.0, "in (0, 1]"),
            priority_exponent=(0.0 <= self.priority_exponent <= 1.0, "between 0 (uniform) and 1"),
            importance_exponent=(0.0 <= self.importance_exponent <= 1.0, "between 0 and 1"),
            demo_priority_bonus=(self.demo_priority_bonus >= 0.0, "0 or more"),
        )
        if self.demo_priority_bonus > 0.0 and not self.has_priorities:
            raise ValueError(f"demo_priority_bonus = {self.demo_priority_bonus} is of no use while priority_exponent = 0: raise that, too")
        if self.reach_zero is not None and self.has_priorities:
            raise ValueError(
                f"reach_zero = {self.reach_zero} is of no use with priority_exponent = {self.priority_exponent}, by which the share of "
                "demonstrations follows from their priorities: set one of them to None or 0"
            )
        if (self.hindrl_sampling_strategy == "mixture") != bool(self.strategy_mixture):
            raise ValueError(
                f"strategy_mixture = {self.strategy_mixture!r} and hindrl_sampling_strategy = {self.hindrl_sampling_strategy!r} do not belong "
                "together: give both mixture and its parts, or neither"
            )
        if self.batch_size - self.max_demo_rows < 1:
            raise ValueError(
                f"max_demo_ratio = {self.max_demo_ratio} of batch_size = {self.batch_size} leaves no replay row: "
                "lower max_demo_ratio or raise batch_size"
            )

    @property
    def has_priorities(self) -> bool:
        """Whether transitions are drawn by their priorities rather than uniformly."""
        return self.priority_exponent > 0.0

    @property
    def max_demo_rows(self) -> int:
        """Number of demonstration rows at the start of training."""
        return int(self.max_demo_ratio * self.batch_size)

    @property
    def uses_intersections(self) -> bool:
        """Whether some relabelled goals are those of an intersection, for which the replay notes what lies near."""
        return "joint_intersection" in dict(self.sources)

    @property
    def sources(self) -> tuple[tuple[Any, Any], ...]:
        """The sources of relabelled goals and their weights, which need not sum to 1; none if nothing is relabelled."""
        if self.num_sampled_goals == 0:
            return ()
        if self.hindrl_sampling_strategy == "joint_union":
            return ("task_conditioned", self.union_sampling_ratio), ("future", 1.0 - self.union_sampling_ratio)
        return self.strategy_mixture or ((self.hindrl_sampling_strategy, 1.0),)


@dataclasses.dataclass(frozen=True)
class GoalConfig:
    """Epsilon, the goals taken from demonstrations, and the behavioural goals."""

    m: int = 0
    """Distance in steps between the demonstration states whose mean distance gives epsilon (thesis eq. 4.7); 0 gives epsilon 0."""
    k: float = 0.0
    """Weight of the standard deviation in epsilon (thesis eq. 4.7)."""
    epsilon: float | None = None
    """Epsilon itself, the same in all dimensions of the goal, in place of the one that the demonstrations give."""
    epsilon_filtering: bool = False
    """Drop demonstration goals that lie within epsilon of the last kept one (thesis algorithm 6, Smooth HinDRL)."""
    behavioural_goals: Literal["final_demonstration_states", "task", "environment"] = "final_demonstration_states"
    """Goal of a rollout: the end of a random demonstration (thesis algorithm 5), the task's one constant goal (original code), or in Gymnasium's
    environments, and only there, the goal that the episode comes with."""
    achieved_goal_ratio: float = 0.0
    """Share of training episodes with another behavioural goal: a state reached earlier in training, whatever the task (thesis chapter 6). They
    are rewarded, when drawn, for reaching that goal. Evaluations never have one."""
    final_achieved_goal_ratio: float | None = None
    """Where that share has moved, linearly, by the end of the run; None keeps it constant."""
    exclude_last_goal: bool = False
    """Never draw the last goal of a demonstration, as the original code does by mistake."""
    rescale_demo_actions: bool = True
    """Bring demonstrated actions to the policy's [-1, 1]; false leaves them in the environment's own range, as the original code does."""
    misalign_demo_actions: bool = False
    """Pair each demonstrated action with the observation after it, as the original code does for robot demonstrations."""

    def __post_init__(self) -> None:
        check_types(self)
        check(
            self,
            m=(self.m >= 0, "0 or more"),
            k=(self.k >= 0.0, "0 or more"),
            epsilon=(self.epsilon is None or self.epsilon >= 0.0, "0 or more, or None"),
            achieved_goal_ratio=(0.0 <= self.achieved_goal_ratio <= 1.0, "between 0 and 1"),
            final_achieved_goal_ratio=(
                self.final_achieved_goal_ratio is None or 0.0 <= self.final_achieved_goal_ratio <= 1.0,
                "between 0 and 1, or None",
            ),
        )

        if self.epsilon is not None and self.m > 0:
            raise ValueError(f"m = {self.m} is of no use while epsilon = {self.epsilon} is given: set m to 0, or epsilon to None")

    @property
    def has_achieved_goals(self) -> bool:
        """Whether some training episodes have a behavioural goal that was achieved earlier."""
        return self.achieved_goal_ratio > 0.0 or bool(self.final_achieved_goal_ratio)


@dataclasses.dataclass(frozen=True)
class AgentConfig:
    """Truncated quantile critics, the actor, and how both are trained."""

    base: Literal["tqc", "sac", "td3", "ddpg"] = "tqc"
    """The algorithm below the demonstrations: truncated quantile critics, soft actor-critic (Haarnoja et al., 2018), TD3 (Fujimoto et al., 2018;
    there with actor_delay 2) or DDPG (Lillicrap et al., 2016; with one critic). Only tqc has quantiles, only tqc and sac have entropy; td3 and
    ddpg need a preactivation_weight."""
    net_arch: tuple[int, ...] = (64, 64, 64, 64)
    """Widths of the hidden layers, the same for actor and critics."""
    layer_norm: bool = False
    """Layer normalisation before each activation of the critics."""
    network_precision: Literal["float32", "bfloat16"] = "float32"
    """Operands of the networks' products: float32 (on NVIDIA GPUs TF32, as JAX has it), or bfloat16 summed in float32: faster, less steady."""
    learning_rate: float = 1e-3
    """Adam's step size, for actor, critics and entropy coefficient."""
    final_learning_rate: float | None = None
    """Where the step size has moved, linearly, by the end of the run; None keeps it constant."""
    clip_targets: bool = False
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
    target_entropy: float | None = -1.0
    """Entropy that the automatic tuning aims at, in nats; None means minus the number of action dimensions."""
    final_target_entropy: float | None = -10.0
    """Where the target entropy has moved, linearly, by the end of the run; None keeps it constant."""
    actor_delay: int = 1
    """Gradient steps of the critics for each one of the actor and the entropy coefficient (TD3's delayed policy updates). Saves no time here."""
    max_gradient_norm: float | None = None
    """Longer gradients are shortened to this length, those of the actor and of the critics each as a whole; None leaves them."""
    exploration_noise: float = 0.1
    """For td3 and ddpg: standard deviation of the noise on the actions of rollouts, which lie in [-1, 1]."""
    target_noise: float = 0.2
    """For td3: standard deviation of the noise on the actions of the targets."""
    target_noise_clip: float = 0.5
    """For td3: the largest noise on the actions of the targets."""
    normalise_value: bool = False
    """Divide the value in the actor's loss by its mean size over the batch, so that bc_weight weighs alike whatever the values are (TD3+BC,
    Fujimoto and Gu, 2021). The entropy's weight is then in other units than the rewards, so that the critics' targets leave entropy out."""
    relative_value: bool = False
    """Divide the value in the actor's loss, row by row, by itself, or by 0.01 where it is less (negative, too): as if the actor climbed the value's
    logarithm. One step lost then weighs alike near the reward and far from it. As with normalise_value, the critics' targets leave entropy out."""
    preactivation_weight: float = 0.0
    """Weight, in the actor's loss, of the squared length of the mode before tanh (HER, appendix A). Without entropy nothing else keeps td3 and ddpg
    away from saturated actions, which have no gradient."""
    bc_weight: float = 0.01
    """Weight of the behaviour cloning loss on demonstration rows (lambda_BC of the thesis)."""
    final_bc_weight: float | None = None
    """Where that weight has moved, linearly, by the end of the run; None keeps it constant."""
    q_filter: bool = False
    """Clone only the demonstrated actions that the critics value above the policy's own (Nair et al., 2018, eq. 4)."""
    bc_loss: Literal["squared", "norm"] = "squared"
    """Squared distance to the demonstrated action (thesis), or its square root per row (original code)."""
    bc_action: Literal["mean", "sample"] = "mean"
    """Compare the policy's mean action (thesis) or a sampled one (original code) with the demonstrated action."""
    input_encoding: Literal["raw", "multiscale", "standardised"] = "multiscale"
    """Networks see inputs as they are (thesis); x and tanh(4 x), x being the input over its root mean square in the demonstrations; or the input
    less its mean there, over its standard deviation."""
    policy_input: Literal["observation_goal", "achieved_desired_observation"] = "observation_goal"
    """What the networks see; the second form repeats the achieved goal, as the thesis's framework does."""

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
            actor_delay=(self.actor_delay >= 1, "at least 1"),
            max_gradient_norm=(self.max_gradient_norm is None or self.max_gradient_norm > 0.0, "greater than 0, or None"),
            exploration_noise=(self.exploration_noise >= 0.0, "0 or more"),
            target_noise=(self.target_noise >= 0.0, "0 or more"),
            target_noise_clip=(self.target_noise_clip >= 0.0, "0 or more"),
            preactivation_weight=(self.preactivation_weight >= 0.0, "0 or more"),
            bc_weight=(self.bc_weight >= 0.0, "0 or more"),
            final_bc_weight=(self.final_bc_weight is None or self.final_bc_weight >= 0.0, "0 or more, or None"),
        )
        if self.normalise_value and self.relative_value:
            raise ValueError("normalise_value and relative_value both divide the value in the actor's loss: choose one of them")
        if self.base == "ddpg" and self.num_critics > 1:
            raise ValueError(f"ddpg has one critic, but num_critics = {self.num_critics}: set it to 1, or choose td3")

    @property
    def has_entropy(self) -> bool:
        """Whether the policy is random and rewarded for it; td3 and ddpg have a deterministic one."""
        return self.base in ("tqc", "sac")

    @property
    def divides_value(self) -> bool:
        """Whether the value in the actor's loss is divided by a size of its own. The entropy's weight there is then in other units than rewards."""
        return self.normalise_value or self.relative_value

    @property
    def critic_outputs(self) -> int:
        """Numbers that each critic returns: its quantiles, or one value."""
        return self.num_quantiles if self.base == "tqc" else 1


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """A whole training run, except the environment and the demonstrations."""

    algo: Algorithm = "hindrl"
    """Which of the four models: bc, tqcfd (no relabelling), hindrl, smooth-hindrl."""
    steps: int = 160_000
    """Environment steps of the run per seed, rounded up to a tenth of eval_every; for bc, which takes none, gradient steps."""
    num_envs: int = 16
    """Environments stepped side by side."""
    updates_per_iteration: int = 2
    """Gradient steps after each (vectorised) environment step."""
    learning_starts: int = 1_600
    """Environment steps with uniformly random actions before the first gradient step; at least one horizon in each environment is taken."""
    demo_reset_ratio: float = 0.0
    """Share of training episodes that begin in a demonstrated state, drawn uniformly, with the steps that it had left (Nair et al., overcoming
    exploration in reinforcement learning with demonstrations, 2018). Evaluations never do."""
    demo_reset_curriculum: float = 0.0
    """Share of the run over which those states widen from the end of each demonstration to all of it: a reverse curriculum (RFCL, Tao et al.,
    2024, widens by success instead). 0 draws from all of them throughout."""
    random_truncation: float = 0.0
    """Probability with which a training episode is cut off after a step, as a time-out cuts it: the future value still counts (unless
    timeouts_are_terminal). Episodes that stand still are left sooner, and more are begun. Evaluations are never cut. Each episode keeps room for a
    whole horizon in the replay, which so holds fewer transitions than buffer_size; and since an episode is drawn before one of its transitions,
    those of short episodes are drawn more often."""
    bc_warm_start: int = 0
    """Gradient steps of behaviour cloning alone before the first of reinforcement learning, after the random actions of learning_starts."""
    pretrain_updates: int = 0
    """Gradient steps of actor and critics on demonstrations alone, after the warm start and before the first on mixed batches (DQfD, Hester et
    al., 2018; DDPGfD, Vecerik et al., 2017)."""
    agent_resets: tuple[float, ...] = ()
    """Shares of the run, in order, after which networks, optimisers and their schedules begin anew, while the replay stays (Nikishin et al., The
    primacy bias in deep reinforcement learning, 2022)."""
    buffer_size: int = 500_000
    """Transitions that the replay holds."""
    eval_every: int = 4_000
    """Environment steps (bc: gradient steps) between evaluations."""
    eval_episodes: int = 100
    """Episodes of each evaluation, with the policy's mean action."""
    batch: BatchConfig = BatchConfig()
    goal: GoalConfig = GoalConfig()
    agent: AgentConfig = AgentConfig()

    def __post_init__(self) -> None:
        check_types(self)
        counts = ("steps", "num_envs", "updates_per_iteration", "buffer_size", "eval_every", "eval_episodes")
        check(
            self,
            **{name: (getattr(self, name) >= 1, "at least 1") for name in counts},
            learning_starts=(self.learning_starts >= 0, "0 or more"),
            demo_reset_ratio=(0.0 <= self.demo_reset_ratio <= 1.0, "between 0 and 1"),
            demo_reset_curriculum=(0.0 <= self.demo_reset_curriculum <= 1.0, "between 0 and 1"),
            random_truncation=(0.0 <= self.random_truncation < 1.0, "0 or more, and less than 1"),
            bc_warm_start=(self.bc_warm_start >= 0, "0 or more"),
            agent_resets=(
                all(0.0 < share < 1.0 for share in self.agent_resets) and sorted(set(self.agent_resets)) == list(self.agent_resets),
                "shares between 0 and 1, each larger than the one before",
            ),
            pretrain_updates=(self.pretrain_updates >= 0, "0 or more"),
        )
        if self.demo_reset_curriculum > 0.0 and self.demo_reset_ratio == 0.0:
            raise ValueError(f"demo_reset_curriculum = {self.demo_reset_curriculum} is of no use while demo_reset_ratio = 0: raise that, too")
        if self.algo == "bc":
            given: dict[str, Any] = {"bc_warm_start": self.bc_warm_start, "pretrain_updates": self.pretrain_updates, "q_filter": self.agent.q_filter}
            given |= {"priority_exponent": self.batch.priority_exponent, "base": self.agent.base != "tqc" and self.agent.base}
            for name, value in given.items():
                if value:
                    raise ValueError(f"{name} = {value} has no effect on bc, which is behaviour cloning alone: drop it, or choose another algo")
        if self.algo == "tqcfd" and self.batch.num_sampled_goals > 0:
            raise ValueError(f"tqcfd does not relabel, but num_sampled_goals = {self.batch.num_sampled_goals}: set it to 0, or choose hindrl")
        if self.algo == "smooth-hindrl" and not self.goal.epsilon_filtering:
            raise ValueError("smooth-hindrl is hindrl with epsilon_filtering, which is off: turn it on, or choose hindrl")


SWEEPABLE: dict[str, Literal["batch", "goal", "agent"]] = {
    "union_sampling_ratio": "batch",
    "gamma": "batch",
    "k": "goal",
    "learning_rate": "agent",
    "final_learning_rate": "agent",
    "target_update_rate": "agent",
    "actor_average_rate": "agent",
    "actor_average_span": "agent",
    "initial_alpha": "agent",
    "target_entropy": "agent",
    "final_target_entropy": "agent",
    "bc_weight": "agent",
    "final_bc_weight": "agent",
}
"""The fields that only enter arithmetic, and their sections: configs that differ in nothing else share one compiled program."""


def linear_schedule(start: Any, end: Any, progress: Any) -> Any:
    """Where a value is that moves linearly along a run: its field holds the start, the field named final_... the end, None if it does not move.

    Args:
      start, end: numbers, or () arrays where they are swept.
      progress: share of the run that is over, in [0, 1].
    """
    return start if end is None else start + (end - start) * progress


def sweepable_value(config: TrainConfig, name: str) -> float | None:
    """The value of a field of `SWEEPABLE`."""
    return getattr(getattr(config, SWEEPABLE[name]), name)


def _relabels(config: TrainConfig) -> bool:
    return config.algo not in ("bc", "tqcfd") and config.batch.num_sampled_goals > 0


def _has_demo_rows(config: TrainConfig) -> bool:
    return config.algo == "bc" or config.batch.max_demo_rows > 0 or config.batch.has_priorities


# Which fields have an effect only under a condition: the fields, the condition, and what to do where it does not hold.
_CONDITIONS: tuple[tuple[str, Callable[[TrainConfig], bool], str], ...] = (
    (
        "max_demo_ratio reach_zero num_sampled_goals hindrl_sampling_strategy union_sampling_ratio intersection_goals strategy_mixture n_step gamma "
        "demo_returns terminate_on_relabel bound_by_obtained_return timeouts_are_terminal importance_exponent demo_priority_bonus "
        "achieved_goal_ratio final_achieved_goal_ratio clip_targets num_critics num_target_critics num_quantiles top_quantiles_to_drop_per_net "
        "layer_norm target_update_rate initial_alpha target_entropy final_target_entropy actor_delay exploration_noise target_noise "
        "target_noise_clip normalise_value relative_value preactivation_weight bc_weight final_bc_weight agent_resets num_envs "
        "updates_per_iteration learning_starts buffer_size demo_reset_ratio demo_reset_curriculum random_truncation",
        lambda config: config.algo != "bc",
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
        "hindrl_sampling_strategy union_sampling_ratio intersection_goals strategy_mixture terminate_on_relabel",
        _relabels,
        "nothing is relabelled: choose --algo hindrl with --num-sampled-goals above 0",
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
    ("importance_exponent demo_priority_bonus", lambda c: c.batch.has_priorities, "transitions have no priorities: raise --priority-exponent"),
    ("reach_zero", lambda c: c.batch.max_demo_rows > 0, "the batch has no demonstration rows: raise --max-demo-ratio"),
    (
        "bc_weight final_bc_weight bc_loss bc_action q_filter demo_returns",
        _has_demo_rows,
        "the batch has no demonstration rows to clone: raise --max-demo-ratio",
    ),
    ("q_filter bc_loss bc_action", lambda c: c.algo == "bc" or c.agent.bc_weight > 0.0, "nothing is cloned: raise --bc-weight"),
    ("k", lambda c: c.goal.m > 0, "epsilon depends on it only for m > 0: add --m 5"),
    (
        "m k epsilon",
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


def with_values(config: TrainConfig, values: Mapping[str, Any]) -> TrainConfig:
    """The config with some fields of `SWEEPABLE` replaced, and checked.

    Raises:
      ValueError: if a value is refused.
    """
    for name, value in values.items():
        section = getattr(config, SWEEPABLE[name])
        config = dataclasses.replace(config, **{SWEEPABLE[name]: dataclasses.replace(section, **{name: value})})
    return config


def with_traced_values(config: TrainConfig, values: Mapping[str, Any]) -> TrainConfig:
    """As `with_values`, for arrays or tracers in place of numbers: not checked, and neither hashable nor static. For use inside a program."""
    config = copy.copy(config)
    for name, value in values.items():
        section = copy.copy(getattr(config, SWEEPABLE[name]))
        object.__setattr__(section, name, value)
        object.__setattr__(config, SWEEPABLE[name], section)
    return config
