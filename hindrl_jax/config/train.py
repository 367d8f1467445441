"""A whole training run."""

from __future__ import annotations

import dataclasses
from typing import Any, Literal

from hindrl_jax.base.checks import LARGEST, check, check_types
from hindrl_jax.config.agent import AgentConfig
from hindrl_jax.config.batch import BatchConfig
from hindrl_jax.config.goal import GoalConfig
from hindrl_jax.config.quirks import QuirksConfig

STEPS_PER_UPDATE = 4
"""Control steps for each gradient step, where the config does not say how many of these there are."""
STEPS_PER_UPDATE_OWN_GOALS = 2
"""The same where episodes have goals of their own, so that four fifths of the replay rows are relabelled (docs/recipe.md has the measurement)."""
FEWEST_STEPS, DECISIONS = 100_000, 50_000
"""Environment steps of a run, where the config does not say how many: at least so many, and enough for so many decisions."""
Algorithm = Literal["bc", "tqcfd", "hindrl", "smooth-hindrl"]


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """A whole training run, except the environment and the demonstrations."""

    algo: Algorithm = "hindrl"
    """Which of the four models: bc, tqcfd (no relabelling), hindrl, smooth-hindrl."""
    steps: int | None = None
    """Environment steps of the run per seed, rounded up to a tenth of eval_every; for bc, which takes none, gradient steps. None takes 50,000
    decisions, and at least 100,000 steps."""
    num_envs: int = 8
    """Environments stepped side by side."""
    action_hold: int | None = None
    """Control steps for which each action is held: one decision of the policy. Steps, horizon and episode lengths count control steps; epsilon_steps,
    n_step and gamma count decisions. None lets `fit` choose: as many as leave the median demonstration at least 60 decisions."""
    action_chunks: bool = False
    """Each decision is as many different actions in place of one that is held, played one after the other, and the critics value all of them together
    (Q-chunking; Li, Zhou and Levine, 2025). action_hold says how many."""
    updates_per_iteration: int | None = None
    """Gradient steps after each decision of all environments; None takes one for every 4 control steps, for every 2 where episodes have goals of
    their own."""
    learning_starts: int = 0
    """Environment steps with uniformly random actions before the first gradient step; at least one horizon in each environment is taken."""
    demo_reset_ratio: float = 0.0
    """Share of training episodes that begin in a demonstrated state, drawn uniformly, with the steps that it had left (Nair et al., overcoming
    exploration in reinforcement learning with demonstrations, 2018). Evaluations never do."""
    demo_reset_curriculum: bool = False
    """Those states are near the end of each demonstration at first, and move towards its beginning where episodes succeed from them three times in a
    row: the reverse curriculum of RFCL (Tao et al., 2024)."""
    imitation_steps: int = 0
    """Gradient steps of behaviour cloning at the start, rounded up to a multiple of 3, which make a second policy, with the network of bc. As it is
    after each third of them it may be returned; reinforcement learning begins and goes on without it. 0 for no such policy."""
    practice_rounds: int = 0
    """Rounds of practice of that policy, at most: if it solves a fifth of its episodes it plays, and is cloned again, by as many gradient steps, from
    the demonstrations and the fastest of its episodes that solved the task, until two rounds running were no better than those before (expert
    iteration; Anthony et al., 2017). `steps` does not count the environment steps that it takes. 0 for none."""
    imitation_proposal: bool = False
    """That policy, as it is after its practice, proposes an action beside the actor's: whichever the target critics value more is taken, in episodes,
    evaluations and targets (IBRL, Hu et al., 2024)."""
    network_resets: bool = False
    """Where an agent solves part of the task and got no better for a fifth of the run, and for as long as it had taken to that, fresh networks learn
    in its place, from the same replay (Nikishin et al., the primacy bias in deep reinforcement learning, 2022)."""
    buffer_size: int = 500_000
    """Transitions that the replay holds."""
    stop_at: float | None = None
    """Success at which a seed's policy is taken as found: an evaluation reaches it, and 100 fresh episodes confirm it. When all seeds have one, the
    run ends. None runs to the end."""
    eval_every: int = 4_000
    """Environment steps (bc: gradient steps) between evaluations."""
    eval_episodes: int = 100
    """Episodes of each evaluation, played with mean actions and, but for bc, once more with sampled ones."""
    batch: BatchConfig = dataclasses.field(default_factory=BatchConfig)
    goal: GoalConfig = dataclasses.field(default_factory=GoalConfig)
    agent: AgentConfig = dataclasses.field(default_factory=AgentConfig)
    quirks: QuirksConfig = dataclasses.field(default_factory=QuirksConfig)

    def __post_init__(self) -> None:
        check_types(self)
        counts = ("num_envs", "buffer_size", "eval_every", "eval_episodes")
        check(
            self,
            **{name: (getattr(self, name) >= 1, "at least 1") for name in counts},
            steps=(self.steps is None or self.steps >= 1, "at least 1, or None"),
            updates_per_iteration=(self.updates_per_iteration is None or self.updates_per_iteration >= 1, "at least 1, or None"),
            action_hold=(self.action_hold is None or self.action_hold >= 1, "at least 1, or None"),
            stop_at=(self.stop_at is None or 0.0 < self.stop_at <= 1.0, "greater than 0 and at most 1, or None"),
            learning_starts=(self.learning_starts >= 0, "0 or more"),
            demo_reset_ratio=(0.0 <= self.demo_reset_ratio <= 1.0, "between 0 and 1"),
            practice_rounds=(0 <= self.practice_rounds <= LARGEST, f"between 0 and {LARGEST}"),
            imitation_steps=(0 <= self.imitation_steps <= LARGEST, f"between 0 and {LARGEST}"),
        )
        steps = self.num_steps if self.learns_from_rollouts else 0
        updates = self.num_updates * (steps // self.steps_per_iteration + 1) if self.learns_from_rollouts else self.num_steps
        if max(steps + self.steps_per_iteration, updates) > LARGEST:
            raise ValueError(
                f"steps = {self.num_steps} take {updates} gradient steps, and more than {LARGEST} of either are not counted: lower steps"
            )
        if self.demo_reset_curriculum and self.demo_reset_ratio == 0.0:
            raise ValueError(f"demo_reset_curriculum = {self.demo_reset_curriculum} is of no use while demo_reset_ratio = 0: raise that, too")
        if self.action_chunks and self.action_hold == 1:
            raise ValueError("action_chunks = True is of no use while action_hold = 1: raise that, too, or set it to None")
        if self.algo == "bc":
            given: dict[str, Any] = {
                "imitation_steps": self.imitation_steps,
                "practice_rounds": self.practice_rounds,
                "imitation_proposal": self.imitation_proposal,
                "network_resets": self.network_resets,
                "q_filter": self.agent.q_filter != "off" and self.agent.q_filter,
                "base": self.agent.base != "tqc" and self.agent.base,
            }
            for name, value in given.items():
                if value:
                    raise ValueError(f"{name} = {value} has no effect on bc, which is behaviour cloning alone: drop it, or choose another algo")
        if self.imitation_proposal and self.imitation_steps == 0:
            raise ValueError("imitation_proposal = True is of no use while imitation_steps = 0: raise that, too")
        if self.algo == "tqcfd" and self.batch.relabelled_per_original > 0:
            raise ValueError(
                f"tqcfd does not relabel, but relabelled_per_original = {self.batch.relabelled_per_original}: set it to 0, or choose hindrl"
            )
        if self.algo == "smooth-hindrl" and not self.goal.epsilon_filtering:
            raise ValueError("smooth-hindrl is hindrl with epsilon_filtering, which is off: turn it on, or choose hindrl")

    @property
    def num_held(self) -> int:
        """Control steps for which each action is held; 1 where none is set."""
        return self.action_hold or 1

    @property
    def num_steps(self) -> int:
        """Environment steps of the run per seed; for bc, gradient steps."""
        return self.steps or max(FEWEST_STEPS, DECISIONS * self.num_held)

    @property
    def steps_per_iteration(self) -> int:
        """Control steps that all environments take together for one decision each."""
        return self.num_envs * self.num_held

    @property
    def num_updates(self) -> int:
        """Gradient steps for each decision of all environments."""
        steps_per_update = STEPS_PER_UPDATE_OWN_GOALS if self.own_goals else STEPS_PER_UPDATE
        return self.updates_per_iteration or max(1, round(self.steps_per_iteration / steps_per_update))

    @property
    def own_goals(self) -> bool:
        """Whether each episode aims at a goal that the environment gives it, as Gymnasium's do with a `desired_goal`."""
        return self.goal.behavioural_goals == "environment"

    @property
    def relative_goals(self) -> bool:
        """Whether networks see what is left to the goal, desired less achieved, in place of the goal: where each episode has one of its own."""
        return self.own_goals and not self.quirks.achieved_goal_input

    @property
    def learns_from_rollouts(self) -> bool:
        """Whether environments are stepped and returns are learnt; behaviour cloning does neither."""
        return self.algo != "bc"
