"""A recording as the padded table that is learned from, and a table as a recording; checked against the environment that it is for."""

from __future__ import annotations

import dataclasses
import os
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np

from hindrl_jax.base.environments import Environment, state_dim
from hindrl_jax.base.errors import UserError
from hindrl_jax.base.types import Episodes
from hindrl_jax.demonstrations.recording import RECORD_AGAIN, Demonstration, Recording, plain
from hindrl_jax.tasks.registry import full_name

_GOAL_TOLERANCE = 1e-4


def as_episodes(recording: Recording, env: Environment, *, where: str | os.PathLike[str], num_demos: int | None = None) -> Episodes:
    """A recording as the table that `load_demonstrations` makes of a file, with the same checks; `where` begins their messages."""
    where = Path(where)
    check_number(where, num_demos)
    check_lengths(where, [len(demo) for demo in recording.demonstrations], env.horizon, num_demos)
    demos = [demo for demo in recording.demonstrations if len(demo) <= env.horizon][:num_demos]
    recording = with_goals_chosen(dataclasses.replace(recording, demonstrations=tuple(demos)), env)
    check_against_env(where, recording, env)
    return as_table(recording.demonstrations, env.horizon)


def with_goals_chosen(recording: Recording, env: Environment) -> Recording:
    """The recording with the goals that `env` derives, where what a goal is is only chosen: flat observations of Gymnasium, `achieved_goal_indices`.

    So a file serves other choices than the one with which it was recorded. The desired goals are then the ends of the demonstrations.
    """
    chosen = getattr(env, "achieved_goal_indices", None)
    fits = all(demo.observations.shape[1] == env.observation_dim for demo in recording.demonstrations)
    if chosen is None or list(chosen) == list(recording.env_kwargs.get("achieved_goal_indices", ())) or not fits:
        return recording
    goals = [np.asarray(env.achieved_goal(cast(Any, demo.observations))) for demo in recording.demonstrations]
    demos = (
        dataclasses.replace(demo, achieved_goals=reached, desired_goal=reached[-1])
        for demo, reached in zip(recording.demonstrations, goals, strict=True)
    )
    return dataclasses.replace(recording, demonstrations=tuple(demos))


def as_table(demos: Sequence[Demonstration], horizon: int) -> Episodes:
    """Demonstrations of at most `horizon` transitions as a table padded with zeros, with states if all have some."""
    with_states = all(demo.states is not None for demo in demos)
    fields: dict[str, Any] = dict(
        observations=padded([demo.observations for demo in demos], horizon + 1),
        actions=padded([demo.actions for demo in demos], horizon),
        rewards=padded([demo.rewards for demo in demos], horizon),
        lengths=np.array([len(demo) for demo in demos], np.int32),
        terminated=np.array([demo.terminated for demo in demos], bool),
        desired_goals=np.stack([demo.desired_goal for demo in demos]).astype(np.float32),
        states=padded([demo.states for demo in demos], horizon + 1) if with_states else None,
    )
    return Episodes(**fields)


def padded(rows: Sequence[np.ndarray], num_rows: int) -> np.ndarray:
    """Stacks arrays (l_n, ...) of different lengths as float32 (N, num_rows, ...), with zeros after their ends."""
    out = np.zeros((len(rows), num_rows, *rows[0].shape[1:]), np.float32)
    for i, row in enumerate(rows):
        out[i, : len(row)] = row
    return out


def as_recording(demonstrations: Episodes, env: Environment, *, env_args: dict[str, Any], expert: dict[str, Any] | None = None) -> Recording:
    """Episodes as a recording, without their padding.

    Args:
      demonstrations: a table of N episodes with their states, as NumPy or JAX arrays.
      env: the environment that the demonstrations were recorded in.
      env_args: arguments that build this environment again.
      expert: name and settings of the expert, for the record.

    Raises:
      ValueError: the episodes have no states, or not those of the environment.
    """
    given: Any = Episodes(**{field.name: cast(Any, np.asarray(getattr(demonstrations, field.name))) for field in dataclasses.fields(Episodes)})
    expected = (*given.observations.shape[:2], state_dim(env))
    if given.states.shape != expected:
        raise ValueError(f"states must have shape {expected}, found {given.states.shape}")
    achieved_goals = np.asarray(env.achieved_goal(given.observations))
    recorded = tuple(
        Demonstration(
            name=f"demo_{i}",
            observations=given.observations[i, : length + 1].astype(np.float32),
            achieved_goals=achieved_goals[i, : length + 1].astype(np.float32),
            desired_goal=given.desired_goals[i].astype(np.float32),
            actions=given.actions[i, :length].astype(np.float32),
            rewards=given.rewards[i, :length].astype(np.float32),
            terminated=bool(given.terminated[i]),
            states=given.states[i, : length + 1],
        )
        for i, length in enumerate(given.lengths.tolist())
    )
    return Recording(env_name=full_name(env), env_kwargs=env_args, expert=expert, demonstrations=recorded)


def check_number(path: Path, num_demos: int | None) -> None:
    """Refuses to take less than one demonstration."""
    if num_demos is not None and num_demos < 1:
        raise UserError(f"{path}: {num_demos} demonstrations asked for; ask for at least 1")


def check_lengths(path: Path, lengths: Sequence[int], horizon: int, num_demos: int | None) -> None:
    """Refuses a recording with too few demonstrations that fit into the horizon, and warns if some do not."""
    num_dropped = sum(length > horizon for length in lengths)
    num_usable = len(lengths) - num_dropped
    if num_usable == 0:
        raise UserError(f"{path}: all {num_dropped} demonstrations are longer than the horizon of {horizon} steps; raise the horizon")
    if num_demos is not None and num_demos > num_usable:
        fit = f" that fit into the horizon of {horizon} steps" if num_dropped else ""
        raise UserError(f"{path}: {num_demos} demonstrations asked for, but it holds {num_usable}{fit}; ask for fewer or record more")
    if num_dropped:
        message = f"{path}: dropped {num_dropped} of {len(lengths)} demonstrations, longer than the horizon of {horizon} steps"
        warnings.warn(message, stacklevel=3)


def _say_what_is_out_of_bounds(path: Path, demos: Sequence[Demonstration], env: Environment) -> None:
    """Warns of observations that the environment itself never gives, if it says what it gives."""
    low, high = getattr(env, "observation_low", None), getattr(env, "observation_high", None)
    if low is None or high is None:
        return
    for demo in demos:
        room = _GOAL_TOLERANCE * (1.0 + np.abs(demo.observations))  # for rounding
        outside = (demo.observations < low - room) | (demo.observations > high + room)
        if outside.any():
            row, dim = np.argwhere(outside)[0]
            low, high = (float(np.broadcast_to(bound, outside.shape[1])[dim]) for bound in (low, high))
            warnings.warn(
                f"{path}: {demo.name}: observation[{dim}] = {demo.observations[row, dim]:g} in row {row} lies outside the bounds of {env.name}, "
                f"{low:g} to {high:g}: is it of this environment?",
                stacklevel=4,
            )
            return


def check_against_env(path: Path, recording: Recording, env: Environment) -> None:
    """Refuses a recording of another environment, of other arguments or dimensions, or with goals that the environment does not derive."""
    env_name, env_kwargs, demos = recording.env_name, recording.env_kwargs, recording.demonstrations
    if env.name not in (env_name, env_name.rpartition(":")[2]):  # the module of a task of the user's own may have moved
        raise UserError(f"{path}: was recorded in {env_name}, not in {env.name}; name a file of {env.name} or train in {env_name}")
    if dataclasses.is_dataclass(env):
        expected, missing = plain(dataclasses.asdict(env)), "nothing"
        may_differ = {"horizon", *getattr(env, "interchangeable", ())}
        for field in sorted((expected.keys() | env_kwargs.keys()) - may_differ):
            there, here = env_kwargs.get(field, missing), expected.get(field, missing)
            if there != here:
                raise UserError(
                    f"{path}: was recorded with {field} = {there}, but {env.name} here has {field} = {here}; use equal arguments or {RECORD_AGAIN}"
                )
    dims = {"observations": env.observation_dim, "actions": env.action_dim, "achieved_goals": env.goal_dim, "states": state_dim(env)}
    for demo in demos:
        for what, dim in dims.items():
            if getattr(demo, what) is not None and getattr(demo, what).shape[1] != dim:
                found, what = getattr(demo, what).shape[1], what.replace("_", " ")
                raise UserError(f"{path}: {demo.name}: {what} have {found} dimensions, but {dim} in {env.name}; {RECORD_AGAIN}")
    _say_what_is_out_of_bounds(path, demos, env)
    # One call for the whole file: under JAX, one per demonstration would compile for every length.
    owners = np.repeat(np.arange(len(demos)), [len(demo.observations) for demo in demos])
    observations: Any = np.concatenate([demo.observations for demo in demos])
    expected_goals = np.asarray(env.achieved_goal(observations))
    stored_goals = np.concatenate([demo.achieved_goals for demo in demos])
    wrong = ~np.isclose(stored_goals, expected_goals, rtol=_GOAL_TOLERANCE, atol=_GOAL_TOLERANCE).all(axis=1)
    if wrong.any():
        name = demos[owners[wrong.argmax()]].name
        raise UserError(f"{path}: {name}: achieved_goal is not what {env.name} derives from the observations; {RECORD_AGAIN}")
