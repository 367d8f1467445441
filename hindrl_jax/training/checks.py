"""What is refused before anything is computed: environments, configs, seeds and demonstrations that do not go together.

A refusal names the ability that is missing, see `hindrl_jax.base.environments`, and what to do.
"""

from __future__ import annotations

import inspect
import traceback
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hindrl_jax.base.environments import Environment, RelabelsObservations, Restorable, backends_with, can_step, state_dim
from hindrl_jax.base.errors import UserError, one_line
from hindrl_jax.base.steppers import can_step_on_host, gives_goals
from hindrl_jax.base.types import Episodes
from hindrl_jax.config import IMITATION_NET_ARCH, RESIDUAL_EXPANSION, SWEEPABLE, TrainConfig, sweepable_value, with_traced_values
from hindrl_jax.core.imitation import NUM_STARTS
from hindrl_jax.core.train import warm_up_iterations
from hindrl_jax.training.devices import free_memory, seed_mesh


def can_train(env: Any) -> bool:
    """Whether many episodes can be played side by side, in JAX or outside."""
    return can_step(env) or can_step_on_host(env)


def check_trainable(env: Environment) -> None:
    """Makes sure that the environment can be stepped many at once, as it has to be to learn in, and that its dimensions are what it gives.

    Raises:
      UserError: if not.
    """
    if can_train(env):
        check_dimensions(env)
        return
    others = backends_with(env, can_train)
    if others:
        raise UserError(
            f"{env.name} cannot be trained with backend = {getattr(env, 'backend', None)}, which steps one environment at a time outside JAX: "
            f"train with backend {' or '.join(others)}"
        )
    raise UserError(f"{env.name} cannot be trained: it has neither reset and step in JAX, nor a stepper of many environments outside it")


def check_dimensions(env: Environment) -> None:
    """Makes sure that an environment's functions give arrays of the lengths that it states. Nothing is computed, and tasks of this package are not
    looked at: their tests do that.

    Args:
      env: one that is stepped in JAX; others are checked where they are stepped.

    Raises:
      UserError: naming the first dimension that does not fit; or where `step` fails with an action of the length that the environment states.
    """
    if not can_step(env) or _is_of_this_package(env):
        return
    state, observation = jax.eval_shape(env.reset, jax.random.key(0))
    _expect(env, "observation_dim", env.observation_dim, "reset gives an observation", observation)
    _expect(env, "goal_dim", env.goal_dim, "achieved_goal gives a goal", jax.eval_shape(env.achieved_goal, observation))
    _expect(env, "goal_dim", env.goal_dim, "task_goal gives a goal", jax.eval_shape(env.task_goal))
    if isinstance(env, Restorable):
        _expect(env, "state_dim", env.state_dim, "state_to_vector gives a vector", jax.eval_shape(env.state_to_vector, state))
    try:
        _, time_step = jax.eval_shape(env.step, state, jax.ShapeDtypeStruct((env.action_dim,), np.float32))
    except (TypeError, ValueError) as error:
        if "shape" not in str(error):
            raise  # a mistake of another kind, whose place the traceback shows
        raise UserError(
            f"{env.name}: action_dim is {env.action_dim}, and step fails with an action of shape ({env.action_dim},){_place(env, error)}: "
            f"{one_line(error)}"
        ) from error
    _expect(env, "observation_dim", env.observation_dim, "step gives an observation", time_step.observation)


def check_expert(env: Environment, expert: Any) -> None:
    """Makes sure that an expert gives actions of the length that the environment states.

    Args:
      env: one that is stepped in JAX; with others nothing is checked.
      expert: with act(key, env, state); those of this package are not looked at.

    Raises:
      UserError: if it does not.
    """
    if not can_step(env) or _is_of_this_package(expert):
        return
    state, _ = jax.eval_shape(env.reset, jax.random.key(0))
    action = jax.eval_shape(lambda key, begun: jnp.asarray(expert.act(key, env, begun)), jax.random.key(0), state)
    _expect(env, "action_dim", env.action_dim, f"{type(expert).__name__}.act gives an action", action)


def _expect(env: Environment, name: str, length: int, gives: str, found: Any) -> None:
    """Raises a UserError unless what was found is a vector of the length that the environment states by that name."""
    if getattr(found, "shape", None) != (length,):
        shape = f"of shape {found.shape}" if hasattr(found, "shape") else f"that is no array but {type(found).__name__}"
        raise UserError(f"{env.name}: {name} is {length}, and {gives} {shape}: mend the one or the other")


def _is_of_this_package(thing: Any) -> bool:
    return type(thing).__module__.startswith("hindrl_jax.")


def _place(env: Environment, error: Exception) -> str:
    """Where in the environment's own file something failed."""
    file = inspect.getsourcefile(type(env))
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == file]
    return f" in line {lines[-1]} of {file}" if lines else ""


def check_config(env: Environment, config: TrainConfig) -> None:
    """Makes sure that the environment can give what the config asks for.

    Raises:
      UserError: if not.
    """
    name, goal = env.name, config.goal
    in_jax = can_step(env)
    own_goals = not in_jax and gives_goals(env)
    if own_goals and not config.own_goals:
        raise UserError(
            f"behavioural_goals = {goal.behavioural_goals} cannot be had in {name}, whose episodes come with goals of their own: choose environment"
        )
    if config.own_goals and not own_goals:
        raise UserError(f"behavioural_goals = environment cannot be had in {name}, which gives its episodes no goals: choose another")
    if isinstance(env, RelabelsObservations) and config.batch.uses_intersections:
        raise UserError(f"joint_intersection compares goals, and hindsight changes none in {name}: choose another hindrl_sampling_strategy")
    if config.demo_reset_ratio > 0.0 and not (in_jax and isinstance(env, Restorable)):
        missing = "restorable states" if in_jax else "restorable states in JAX"
        raise UserError(f"{name} cannot begin in demonstrated states: it has no {missing}: set demo_reset_ratio to 0")
    if not in_jax and config.action_chunks:
        raise UserError(f"action_chunks = True needs a step in JAX, which {name} does not have: set it to False, and each action is held")


def steps_to_learn(env: Environment, config: TrainConfig) -> int:
    """What is left of `config.num_steps` after the random steps at the start.

    Raises:
      UserError: if nothing is.
    """
    at_random = warm_up_iterations(env, config) * config.steps_per_iteration if config.learns_from_rollouts else 0
    if config.num_steps <= at_random:
        raise UserError(f"steps = {config.num_steps} ends within the {at_random} random steps before learning: raise steps")
    return config.num_steps - at_random


MOST_DEMONSTRATIONS = 100_000


def check_memory(env: Environment, config: TrainConfig, num_runs: int, num_demos: int = 1) -> None:
    """Compares what a training takes, as far as its sizes say, with the memory there is, before any of it is taken.

    Args:
      env: the task.
      config: of the runs.
      num_runs: S, side by side.
      num_demos: demonstrations of each run.

    Raises:
      UserError: if it does not fit; it names what takes most of it, and what to lower.
    """
    rows = {name: 4 * num_runs * numbers / jax.process_count() for name, numbers in _numbers_in_memory(env, config, num_demos).items()}
    # Nobody divides absurd numbers of seeds among devices, and one device has as much as all of them on a CPU.
    free = free_memory(seed_mesh(num_runs))
    needed, most = sum(rows.values()), max(rows, key=lambda name: rows[name])
    if free is not None and needed > free:
        what, advice = most.split(": ")
        raise UserError(
            f"{num_runs} run{'s' if num_runs > 1 else ''} side by side take{'' if num_runs > 1 else 's'} {needed / 2**30:,.1f} GiB of memory, "
            f"{rows[most] / needed:.0%} of it for the {what}, and {free / 2**30:,.1f} GiB are free: lower {advice} or the number of seeds"
        )


def _numbers_in_memory(env: Environment, config: TrainConfig, num_demos: int) -> dict[str, float]:
    """How many numbers of 4 bytes one run holds at a time, by what they are for and which options they follow from; a little less than it does."""
    steps, dim, action_dim, agent, batch = env.horizon, env.observation_dim + env.goal_dim, env.action_dim, config.agent, config.batch
    inputs, widths = 2 * dim + action_dim, [width * (RESIDUAL_EXPANSION if agent.residual else 1) for width in agent.net_arch]
    weights = sum(before * after for before, after in zip([inputs, *widths], [*widths, agent.critic_outputs], strict=True))
    demonstrations = num_demos * steps * (env.observation_dim + action_dim + state_dim(env))
    if config.imitation_steps > 0:  # of practice the best, the newest, and both tables in one
        demonstrations += 3 * NUM_STARTS * steps * (env.observation_dim + action_dim)
    networks = weights * (6 + 4 * agent.num_critics)  # parameters, targets and averages, moments, and those that are kept
    if config.imitation_steps > 0:  # parameters, moments, the average, three clones and those that are kept
        first, second = IMITATION_NET_ARCH
        networks += 11 * (2 * dim * first + first * second + 2 * second * action_dim)
    in_networks = (1 + agent.num_critics) * sum(widths)
    if not config.learns_from_rollouts:
        drawn, replay = batch.batch_size * (dim + sum(widths)), 0.0
    else:
        drawn = config.num_updates * batch.batch_size * (batch.n_step + 2) * env.observation_dim + batch.batch_size * in_networks
        replay = max(config.buffer_size, 2 * config.num_envs) * (env.observation_dim + action_dim)
    return {
        "demonstrations: horizon, the number of demonstrations": demonstrations,
        "replay: buffer_size": replay,
        "batches: batch_size, n_step, updates_per_iteration": drawn,
        "networks: net_arch, num_critics, num_quantiles": networks,
        "environments: num_envs": config.num_envs * (dim + state_dim(env) + sum(widths)),
        "evaluations: eval_episodes": config.eval_episodes * (dim + state_dim(env) + sum(widths)),
    }


def check_demonstrations(num_demos: int) -> None:
    """Makes sure that so many demonstrations can be recorded.

    Raises:
      UserError: if not.
    """
    if not 1 <= num_demos <= MOST_DEMONSTRATIONS:
        few = num_demos < 1
        raise UserError(
            f"num_demos = {num_demos} is too {'few: record at least 1 demonstration' if few else f'many: record at most {MOST_DEMONSTRATIONS}'}"
        )


def check_seeds(seeds: Sequence[int]) -> None:
    """Makes sure that there is a seed, and that all can be had.

    Raises:
      UserError: if not.
    """
    if not seeds or not all(0 <= seed < 2**32 for seed in seeds):
        raise UserError(f"seeds = {list(seeds)} is not usable: give at least one whole number from 0 to {2**32 - 1}")


def demonstrations_per_seed(demonstrations: Episodes | Sequence[Episodes], seeds: Sequence[int], env: Environment) -> Episodes:
    """Stacks one table per seed, numpy leaves (S, ...). States are kept if every table has them.

    Raises:
      UserError: if the tables do not fit the seeds and the environment.
    """
    tables = _one_for_each(seeds, demonstrations, Episodes, "tables of demonstrations")
    expected = (env.horizon + 1, env.observation_dim, env.horizon, env.action_dim)
    for table in tables:
        found = table.observations.shape[1:] + table.actions.shape[1:]
        if found != expected or table.observations.shape[0] < 1 or table.observations.shape != (len(tables[0].lengths), *found[:2]):
            raise UserError(
                f"demonstrations of shapes {table.observations.shape} and {table.actions.shape} do not fit {env.name}: it takes one or more, "
                f"as many for each seed, with observations (N, {expected[0]}, {expected[1]}) and actions (N, {expected[2]}, {expected[3]})"
            )
        states = table.states
        if states is not None and isinstance(env, Restorable) and states.shape != (*table.observations.shape[:2], env.state_dim):
            raise UserError(f"demonstrated states of shape {states.shape} are not those of {env.name}, which has {env.state_dim}: record again")
    if any(table.states is None for table in tables):
        tables = tuple(table.replace(states=None) for table in tables)
    return jax.tree.map(lambda *leaves: np.stack(leaves), *jax.device_get(tables))


def configs_per_seed(config: TrainConfig | Sequence[TrainConfig], seeds: Sequence[int]) -> tuple[TrainConfig, ...]:
    """One config per seed.

    Raises:
      UserError: if one program cannot serve them all.
    """
    configs = _one_for_each(seeds, config, TrainConfig, "configs")
    swept = swept_fields(configs)
    for other in configs[1:]:
        if with_traced_values(configs[0], {name: sweepable_value(other, name) for name in swept}) != other:
            raise UserError(f"configs of one experiment may differ only in {', '.join(SWEEPABLE)}; these differ in more: run them apart")
    for name in swept:
        if any(sweepable_value(config, name) is None for config in configs):
            raise UserError(f"{name} is None in some configs and a number in others: give numbers only")
    return configs


def swept_fields(configs: Sequence[TrainConfig]) -> list[str]:
    """The fields of `config.SWEEPABLE` in which the configs differ."""
    return [name for name in SWEEPABLE if len({sweepable_value(config, name) for config in configs}) > 1]


def _one_for_each(seeds: Sequence[int], given: Any, kind: type[Any], noun: str) -> tuple[Any, ...]:
    """What was given for all seeds, repeated, or for each of them."""
    items = (given,) * len(seeds) if isinstance(given, kind) else tuple(given)
    if len(items) != len(seeds):
        raise UserError(f"{len(items)} {noun} for {len(seeds)} seeds: give one for all, or one for each")
    return items
