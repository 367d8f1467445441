"""What another tool has written, as a recording: one observation vector, goals, actions in [-1, 1], and whether the task was solved."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hindrl_jax.base.environments import Environment, Restorable, action_to_env, can_step, compiler_options, state_dim
from hindrl_jax.base.errors import UserError
from hindrl_jax.demonstrations._endings import cut_at_end, with_last_observation, zero_is_success
from hindrl_jax.demonstrations._layout import layout
from hindrl_jax.demonstrations._selection import Selection, joined_columns, select
from hindrl_jax.demonstrations.foreign import MINARI_OBSERVATIONS, SOURCE, ForeignDemonstration, ForeignRecording, Interpretation
from hindrl_jax.demonstrations.recording import Demonstration, Recording, plain
from hindrl_jax.tasks.registry import full_name

_ACTION_TOLERANCE = 1e-5
_STATE_TOLERANCE = 1e-4


def interpret(foreign: ForeignRecording, meaning: Interpretation, env: Environment | None) -> Recording:
    """Makes a recording of what another tool has written.

    Args:
      foreign: from the reader of a format.
      meaning: which modality is what.
      env: the environment of the task, if it is one of ours; else the goals must be among the modalities.

    Raises:
      UserError: something is missing, out of range or inconsistent; the message names the option that helps.
    """
    foreign = dataclasses.replace(foreign, demonstrations=tuple(_filtered(foreign, meaning.filter_key)))
    selection = select(foreign, meaning, env)
    zero = zero_is_success(foreign.demonstrations)
    interpreted = [_interpret_one(foreign, demo, meaning, selection, zero_is_success=zero) for demo in foreign.demonstrations]
    if not selection.achieved_goal:  # one call for all: under JAX, one per demonstration would compile for every length
        goals = np.asarray(env.achieved_goal(jnp.asarray(np.concatenate([demo.observations for demo in interpreted]), jnp.float32)))
        along = np.split(goals, np.cumsum([len(demo) + 1 for demo in interpreted])[:-1])
        interpreted = [_with_goals(demo, reached) for demo, reached in zip(interpreted, along, strict=True)]
    last_state = _last_state(env)
    interpreted = [dataclasses.replace(demo, states=_states(demo, env, last_state)) for demo in interpreted]
    as_recorded = foreign.ours and all(demo.states is not None for demo in interpreted)
    return Recording(
        env_name=foreign.env_name if env is None else full_name(env),
        env_kwargs=foreign.env_kwargs if env is None else plain(dataclasses.asdict(env)),
        expert=foreign.expert,
        demonstrations=tuple(_settled(demo) for demo in interpreted),
        converted_from=None if as_recorded else _converted_from(foreign, meaning),
        extras=foreign.extras,
        attributes=foreign.attributes,
        file_attributes=foreign.file_attributes,
    )


def redeclared(recording: Recording, env: Environment, where: str) -> Recording:
    """A recording of ours, as one of another environment: its goals are those that `env` derives, and its states are kept if they may be its own.

    Args:
      recording: as it was read.
      env: what the demonstrations are declared to be of.
      where: begins the messages.

    Raises:
      UserError: if its observations or actions have other dimensions than the environment's.
    """
    first = recording.demonstrations[0]
    for what, there, here in (("observations", first.observations, env.observation_dim), ("actions", first.actions, env.action_dim)):
        if there.shape[1] != here:
            raise UserError(
                f"{where}: {what} have {there.shape[1]} numbers, but {here} in {env.name}; declare it to be of another task with --as-env"
            )
    goals = [np.asarray(env.achieved_goal(jnp.asarray(demo.observations, jnp.float32))) for demo in recording.demonstrations]
    has_states = first.states is not None and first.states.shape[1] == state_dim(env)
    demos = (
        dataclasses.replace(demo, achieved_goals=reached, desired_goal=reached[-1], states=demo.states if has_states else None)
        for demo, reached in zip(recording.demonstrations, goals, strict=True)
    )
    before = {"format": "hindrl_jax", "env_name": recording.env_name, "attributes": sorted(recording.attributes)}
    return dataclasses.replace(
        recording,
        env_name=full_name(env),
        env_kwargs=plain(dataclasses.asdict(env)),
        demonstrations=tuple(demos),
        converted_from=recording.converted_from or before,
    )


def _converted_from(foreign: ForeignRecording, meaning: Interpretation) -> dict[str, Any]:
    return {
        "format": foreign.format,
        "interpretation": {name: value for name, value in dataclasses.asdict(meaning).items() if value},
        "datasets": sorted({name for demo in foreign.demonstrations for name in demo.extras}),
        "attributes": sorted(foreign.attributes),
        **foreign.about,
    }


def _filtered(foreign: ForeignRecording, filter_key: str | None) -> Sequence[ForeignDemonstration]:
    if filter_key is None:
        return foreign.demonstrations
    if filter_key not in foreign.filters:
        there = f"it has {', '.join(foreign.filters)}" if foreign.filters else "it has none"
        raise UserError(f"{foreign.source}: no filter key {filter_key!r}; {there}")
    named = dict.fromkeys(foreign.filters[filter_key])
    chosen = [demo for demo in foreign.demonstrations if demo.name in named]
    if not chosen:
        raise UserError(f"{foreign.source}: filter key {filter_key!r} names no demonstration of the file; choose another")
    missing = [name for name in named if name not in {demo.name for demo in chosen}]
    if missing:
        more = f" and {len(missing) - 3} more" if len(missing) > 3 else ""
        warnings.warn(f"{foreign.source}: filter key {filter_key!r} names {', '.join(missing[:3])}{more}, which the file does not hold", stacklevel=2)
    return chosen


def _interpret_one(
    foreign: ForeignRecording, demo: ForeignDemonstration, meaning: Interpretation, selection: Selection, *, zero_is_success: bool
) -> Demonstration:
    """The demonstration with all states and extras that it came with, and without achieved goals where those are to be derived."""
    where = f"{foreign.source}: {demo.name}"
    demo = with_last_observation(where, demo, selection.used, repeat=meaning.repeat_last_observation)
    demo, solved = cut_at_end(where, demo, meaning, zero_is_success=zero_is_success)
    end, rewards = len(demo.actions), demo.rewards
    if meaning.sparse_rewards or rewards is None:
        rewards = (np.arange(end) == end - 1).astype(np.float32) * np.float32(solved)
    for key in selection.used:
        _check_finite(where, key, demo.modalities[key], "name others with --observation-keys, or delete this demonstration")
    _check_finite(where, "actions", demo.actions, "delete this demonstration")
    _check_finite(where, "rewards", rewards, "put others in their place with --sparse-rewards, or delete this demonstration")
    observations, actions = joined_columns(demo, selection.observation), _policy_actions(where, foreign, demo.actions, meaning)
    achieved, desired = np.zeros((end + 1, 0), np.float32), np.zeros(0, np.float32)
    if selection.achieved_goal:
        achieved = joined_columns(demo, selection.achieved_goal)
        desired = achieved[-1]
    if selection.desired_goal:
        along = joined_columns(demo, selection.desired_goal)
        if (along != along[0]).any():
            raise UserError(f"{where}: the desired goal changes during the episode, which is not supported; name other --desired-goal-keys")
        desired = along[0]
    return Demonstration(
        name=demo.name,
        observations=observations,
        achieved_goals=achieved,
        desired_goal=desired,
        actions=actions,
        rewards=rewards,
        terminated=solved,
        states=demo.states,
        extras=demo.extras,
        attributes=demo.attributes,
    )


def _check_finite(where: str, name: str, rows: np.ndarray, advice: str) -> None:
    """Of the steps that are kept; what is cut off or not used may be anything."""
    if not np.isfinite(rows).all():
        raise UserError(f"{where}: {name} is not finite in row {np.argwhere(~np.isfinite(rows))[0][0]}; {advice}")


def _with_goals(demo: Demonstration, reached: np.ndarray) -> Demonstration:
    """Adds goals that were derived from the observations; a desired goal that the source has stays."""
    return dataclasses.replace(demo, achieved_goals=reached, desired_goal=demo.desired_goal if demo.desired_goal.size else reached[-1])


def _settled(demo: Demonstration) -> Demonstration:
    """Finds a place for each extra: what our file holds anyway is no extra, and what it holds otherwise is kept under `source/`.

    `dones` keep their place, since our file has an attribute for what we take from them.
    """
    ours, extras = layout(demo), {}
    same_elsewhere = {MINARI_OBSERVATIONS + key: rows for key, rows in demo.observed.items()}
    for name, array in demo.extras.items():
        there = (ours | same_elsewhere).get(name)
        if there is None or there.dtype != array.dtype or not np.array_equal(there, array):
            extras[SOURCE + name if name in ours and name != "dones" else name] = array
    return dataclasses.replace(demo, extras=extras)


def _policy_actions(where: str, foreign: ForeignRecording, actions: np.ndarray, meaning: Interpretation) -> np.ndarray:
    """Actions in [-1, 1]; untouched where that is their range already."""
    low, high = (
        _bound(where, given, known, actions.shape[1], default)
        for given, known, default in ((meaning.action_low, foreign.action_low, -1.0), (meaning.action_high, foreign.action_high, 1.0))
    )
    fixed = low == high
    if (low > high).any() or (fixed.any() and (meaning.action_low or meaning.action_high)):
        raise UserError(f"{where}: the lowest action must be below the highest; correct --action-low and --action-high")
    if (low == -1.0).all() and (high == 1.0).all():
        mapped = actions
    else:
        mapped = 2.0 * (actions.astype(np.float64) - low) / np.where(fixed, 1.0, high - low) - 1.0
        mapped = np.where(fixed, np.where(np.isclose(actions, low), 0.0, np.inf), mapped).astype(np.float32)
    largest = np.abs(mapped).max(initial=0.0)
    if not largest <= 1.0 + _ACTION_TOLERANCE:
        dims = np.flatnonzero((np.abs(mapped) > 1.0 + _ACTION_TOLERANCE).any(axis=0)).tolist()
        reach = f"from {actions[:, dims].min():g} to {actions[:, dims].max():g}"
        raise UserError(
            f"{where}: actions go {reach} in dimension{'s' if len(dims) > 1 else ''} {', '.join(map(str, dims))}, beyond the range of the policy; "
            "say what their range is with --action-low and --action-high"
        )
    return mapped


def _bound(where: str, given: tuple[float, ...], known: np.ndarray | None, action_dim: int, default: float) -> np.ndarray:
    if given:
        if len(given) not in (1, action_dim):
            raise UserError(f"{where}: has {action_dim} actions, but {len(given)} bounds are given; give one, or one for each")
        return np.broadcast_to(np.asarray(given, np.float64), action_dim)
    if known is not None and np.isfinite(known).all():
        return np.asarray(known, np.float64)
    return np.full(action_dim, default)


def _last_state(env: Environment | None) -> Callable[..., Any] | None:
    """A program (state (S,), action (A,)) -> the next state (S,) and what is observed in it; None where that takes a simulator outside JAX."""
    if not (can_step(env) and isinstance(env, Restorable)):
        return None

    def step(vector: jax.Array, action: jax.Array) -> tuple[jax.Array, jax.Array]:
        state, _ = env.step(env.vector_to_state(jax.random.key(0), vector), action_to_env(action, env))
        return env.state_to_vector(state), env.observe(state)

    return jax.jit(step, compiler_options=compiler_options(env))


def _states(demo: Demonstration, env: Environment | None, last_state: Callable[..., Any] | None) -> np.ndarray | None:
    """(L + 1, S) states of our environment, if the source has them.

    robomimic keeps no state after the last action. It is had by taking that action once more, and only believed if it looks as observed.
    """
    if env is None or demo.states is None or demo.states.ndim != 2 or demo.states.shape[1] != state_dim(env):
        return None
    if len(demo.states) == len(demo) + 1:
        return demo.states
    if last_state is None or len(demo.states) != len(demo):
        return None
    state, observed = map(np.asarray, last_state(demo.states[-1].astype(np.float32), demo.actions[-1].astype(np.float32)))
    if not np.allclose(observed, demo.observations[-1], rtol=_STATE_TOLERANCE, atol=_STATE_TOLERANCE):
        return None
    return np.concatenate([demo.states, state[None].astype(demo.states.dtype)])
