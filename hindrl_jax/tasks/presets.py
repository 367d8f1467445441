"""Configs by name: the four models of the thesis, under the project's own recipe, the thesis's settings, the original code's, or those of RLPD.

    default    the project's own recipe: one for all tasks, and for bc another
    thesis     the hyperparameters of the thesis's appendix, on plain correct code
    original   the same, with the quirks of the original implementation that explain its published figures
    rlpd       efficient online reinforcement learning with offline data (Ball et al., 2023), as far as the fields can say it, see `_rlpd`

The default is `TrainConfig()` with a policy cloned at the start (`imitation_steps`), for bc with two wide layers and few steps, whatever the task is
called. What differs between tasks follows from what they are and from the demonstrations:

    action_hold            from the median length of the demonstrations (`core.holding.longest_hold`)
    updates_per_iteration  one gradient step for every 4 environment steps; for every 2 where episodes have goals of their own
    input scales, epsilon  from the demonstrations (`core.inputs.input_scale`, thesis eq. 4.7); epsilon is the tolerance of the environment where
                           episodes come with its goals and it tells one
    behavioural goals      those that episodes come with; else the task's one goal where hindsight relabels observations, and the mean of the
                           demonstrations' ends in flat environments of Gymnasium; else the ends of demonstrations (thesis algorithm 5)
    relabelling            where episodes have goals of their own, four fifths of the replay rows, as in HER (Andrychowicz et al., 2017), and where
                           they have parameters of the task in their observations half of them, with goals of demonstrations and rollouts; where
                           all aim at the same, a fifth, with goals of demonstrations: there, other goals are not what is to be learnt, and take
                           rows of the batch
    practice               where the environment is stepped in JAX, since it takes many steps, and all episodes aim at the same: where each is
                           another task, its 32 episodes say too little about the others
    the goal as an input   what is left to it, desired less achieved, where episodes have goals of their own; else the goal
    target entropy         counts per action dimension
    random steps           one horizon in each environment

The thesis has settings for the grid worlds and others for the reach tasks, which here are those of the cable tasks, too, on which it trained nothing.
"""

from __future__ import annotations

import dataclasses
import decimal
from typing import Any, Literal, get_args

import numpy as np

from hindrl_jax.base.environments import Environment, RelabelsObservations, can_step
from hindrl_jax.base.errors import UserError
from hindrl_jax.base.steppers import gives_goals
from hindrl_jax.config import IMITATION_NET_ARCH, AgentConfig, Algorithm, BatchConfig, GoalConfig, QuirksConfig, TrainConfig
from hindrl_jax.envs.cable import CableTask
from hindrl_jax.envs.reach import ReachTask
from hindrl_jax.tasks.from_gymnasium import GymnasiumEnv
from hindrl_jax.tasks.registry import did_you_mean, make

Preset = Literal["default", "thesis", "original", "rlpd"]


def preset(algo: Algorithm = "hindrl", name: Preset = "default", *, env: str | Environment = "FixedGridPickAndPlace") -> TrainConfig:
    """The config of a model.

    Args:
      algo: "bc", "tqcfd", "hindrl" or "smooth-hindrl".
      name: "default", "thesis", "original" or "rlpd", see the module's docstring.
      env: what it is for: an environment, or its name.

    Raises:
      UserError: for a name that does not exist, and for a preset that the algorithm or the environment has not.
    """
    for value, kind, known in ((algo, "algorithm", get_args(Algorithm)), (name, "preset", get_args(Preset))):
        if value not in known:
            raise UserError(f"unknown {kind} {value!r}{did_you_mean(value, known)}; choose one of {', '.join(known)}")
    env = make(env) if isinstance(env, str) else env
    if name == "default":
        return _as_algorithm(_default(algo, env), algo)
    if name == "rlpd":
        return _as_algorithm(_rlpd(algo, env), algo)
    if isinstance(env, GymnasiumEnv):
        raise UserError(f"the preset {name} is for the thesis's tasks: choose default for environments of Gymnasium")
    return _as_algorithm({"thesis": _thesis, "original": _original}[name](algo, reach=isinstance(env, ReachTask | CableTask)), algo)


def original_rules(env: type[Any]) -> dict[str, Any]:
    """The arguments under which the original code ran, of those that a class of environments has: the last object wins alone, and orientations are
    axis-angles, which jump where the hand points down."""
    rules: dict[str, Any] = {"strict_order": False, "orientation": "axis_angle", "rotation_test": "axis_angle"}
    return {name: value for name, value in rules.items() if name in {field.name for field in dataclasses.fields(env)}}


def _as_algorithm(config: TrainConfig, algo: Algorithm) -> TrainConfig:
    """TQCfD is HinDRL without relabelling, Smooth HinDRL is HinDRL with the filter (thesis sections 4.1.3 and 4.1.4)."""
    batch, goal = config.batch, config.goal
    if algo == "tqcfd":
        batch = dataclasses.replace(batch, relabelled_per_original=0.0)
    if algo == "smooth-hindrl":
        goal = dataclasses.replace(goal, epsilon_filtering=True)
    return dataclasses.replace(config, algo=algo, batch=batch, goal=goal)


def _default(algo: Algorithm, env: Environment) -> TrainConfig:
    """The project's own recipe."""
    goal = _goals(env)
    if algo == "bc":
        agent = AgentConfig(net_arch=IMITATION_NET_ARCH)
        return TrainConfig(algo="bc", steps=1_500, eval_every=250, batch=BatchConfig(n_step=1), goal=goal, agent=agent)
    practice_rounds = _PRACTICE_ROUNDS if can_step(env) and not isinstance(env, RelabelsObservations) else 0
    return TrainConfig(imitation_steps=_IMITATION_STEPS, practice_rounds=practice_rounds, network_resets=True, goal=goal, batch=_batch(env))


def _batch(env: Environment) -> BatchConfig:
    """Where hindsight turns an episode into one of another task that is to be learnt, too, more is relabelled, and with goals of both sources."""
    if gives_goals(env):
        return BatchConfig(relabelled_per_original=4.0, hindrl_sampling_strategy="joint_union")
    if isinstance(env, RelabelsObservations):
        return BatchConfig(relabelled_per_original=1.0, hindrl_sampling_strategy="joint_union")
    return BatchConfig()


def _goals(env: Environment) -> GoalConfig:
    """Goals and epsilon, by what the environment is."""
    if gives_goals(env):
        tolerance = getattr(env, "goal_tolerance", None)
        return GoalConfig(behavioural_goals="environment", epsilon=None if tolerance is None else _rounded_down(np.min(tolerance)))
    return GoalConfig(behavioural_goals="task" if isinstance(env, RelabelsObservations | GymnasiumEnv) else "final_demonstration_states")


def _rounded_down(value: float) -> float:
    """A number of four digits that is not above the value: a goal in hindsight is never easier than the task's own, and its box never empty.

    Example:
      >>> _rounded_down(0.05 / 3**0.5), _rounded_down(0.00002), _rounded_down(0.0)
      (0.02886, 2e-05, 0.0)
    """
    return float(decimal.Context(prec=4, rounding=decimal.ROUND_FLOOR).create_decimal(str(value)))


_IMITATION_STEPS = 750  # by the cable tasks (docs/recipe.md, Imitation first)
_PRACTICE_ROUNDS = 10  # it ends of itself, mostly sooner
_FRAMEWORK: dict[str, Any] = dict(input_encoding="raw", actor_average_span=0.0, relative_value=False)
"""How the networks of the thesis's framework are fed, trained and evaluated."""


def _rlpd(algo: Algorithm, env: Environment) -> TrainConfig:
    """RLPD: SAC, half of each batch from the demonstrations, layer normalisation, 10 critics of which 2 at random make the targets, 20 gradient steps
    for each environment step; no cloning. What is relabelled is the algorithm's business: tqcfd is the paper's.

    Differences from the paper: the actor, too, takes all 20 of these steps, in the paper one; and a batch has 128 demonstration rows however few
    demonstrations there are. The width is the paper's; on a CPU one gradient step takes 15 times as long as one of the default recipe.

    Raises:
      UserError: for behaviour cloning.
    """
    if algo == "bc":
        raise UserError("the preset rlpd is for reinforcement learning, which bc is not: choose another preset, or another algo")
    batch = dataclasses.replace(_batch(env), batch_size=256, max_demo_ratio=0.5, n_step=1, gamma=0.99)
    agent = AgentConfig(
        base="sac",
        net_arch=(256, 256),
        layer_norm=True,
        clip_targets=False,
        learning_rate=3e-4,
        num_critics=10,
        num_target_critics=2,
        target_update_rate=0.005,
        initial_alpha=1.0,
        target_entropy=-0.5,
        final_target_entropy=None,
        bc_weight=0.0,
        **_FRAMEWORK,
    )
    return TrainConfig(
        num_envs=1, action_hold=1, updates_per_iteration=20, learning_starts=5_000, buffer_size=1_000_000, batch=batch, goal=_goals(env), agent=agent
    )


def _thesis(algo: Algorithm, *, reach: bool) -> TrainConfig:
    """Appendices A.1.1 and A.1.2, with what the text leaves to its framework: gamma 0.99, target rate 0.005, one environment, one update per step."""
    if algo == "bc":
        return TrainConfig(
            algo="bc",
            steps=20_000,
            action_hold=1,
            eval_every=1_000,
            batch=BatchConfig(batch_size=2_048, n_step=1),
            agent=AgentConfig(net_arch=(32, 32), learning_rate=1e-3, **_FRAMEWORK),
            quirks=QuirksConfig(achieved_goal_input=True, bc_loss="squared"),
        )
    return TrainConfig(
        steps=300_000,
        num_envs=1,
        action_hold=1,
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
            clip_targets=False,
            learning_rate=1e-3,
            top_quantiles_to_drop_per_net=8 if reach else 2,
            target_update_rate=0.005,
            initial_alpha=1.0,
            final_target_entropy=None,
            bc_weight=0.0 if reach else 1.0,
            **_FRAMEWORK,
        ),
        quirks=QuirksConfig(achieved_goal_input=True, bootstrap_past_relabelled_goals=True, bc_loss="squared"),
    )


def _original(algo: Algorithm, *, reach: bool) -> TrainConfig:
    config = _thesis(algo, reach=reach)
    quirks = dataclasses.replace(
        config.quirks,
        strict_goal_test=True,
        timeouts_are_terminal=True,
        exclude_last_goal=True,
        unscaled_demo_actions=True,
        misaligned_demo_actions=reach,
    )
    if algo != "bc":  # the code's own baseline compares the mean action, squared
        quirks = dataclasses.replace(quirks, bc_loss="norm", bc_action="sample")
    return dataclasses.replace(config, goal=dataclasses.replace(config.goal, behavioural_goals="task"), quirks=quirks)
