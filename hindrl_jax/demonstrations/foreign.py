"""Demonstrations as other tools keep them, and what they mean to us.

A reader of a format gives a `ForeignRecording`: the observations under the names that they have there, actions in the units that they have there.
`interpret` makes a `Recording` of it: one observation vector, achieved and desired goals, actions in [-1, 1], and whether the task was solved.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Sequence
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from hindrl_jax.base.environments import RestorableEnvironment, action_to_env, compiler_options
from hindrl_jax.base.errors import UserError
from hindrl_jax.demonstrations.hdf5 import Demonstration, Recording, layout, plain
from hindrl_jax.training.recording import on_host

SOURCE = "source/"
"""Where our file keeps a dataset of the source whose name we need for something else."""
MINARI_OBSERVATIONS = "minari/observations/"
"""Where it keeps the observations of a Minari dataset."""
_ACTION_TOLERANCE = 1e-5
_STATE_TOLERANCE = 1e-4

Solved = Literal["dones", "reward", "all"]


@dataclasses.dataclass(frozen=True)
class Interpretation:
    """What the names and numbers of another tool's file mean."""

    observation_keys: tuple[str, ...] = ()
    """Modalities that make up the observation, in this order (default: observation). KEY[2:5] takes some columns of one."""
    achieved_goal_keys: tuple[str, ...] = ()
    """Modalities that make up the achieved goal (default: what the environment derives from the observation, else achieved_goal)."""
    desired_goal_keys: tuple[str, ...] = ()
    """Modalities that make up the desired goal (default: desired_goal if there is one, else the goal achieved at the end)."""
    solved: Solved = "dones"
    """Which demonstrations solve the task: those that end with done (in Minari: success, or terminated), those that end with a reward (above 0; or 0
    where all rewards of the file are 0 or below, and some below), or all."""
    sparse_rewards: bool = False
    """Put a reward of 1 at the end of each solved demonstration and 0 everywhere else, in place of the rewards in the file."""
    cut: bool = False
    """Cut off what follows the first done (with --solved reward: the first such reward) of a demonstration."""
    repeat_last_observation: bool = False
    """Where the observation after the last action is missing, use the last one that is there."""
    action_low: tuple[float, ...] = ()
    """Lowest actions, one number or one per dimension, if not -1: actions are mapped to [-1, 1]."""
    action_high: tuple[float, ...] = ()
    """Highest actions, likewise."""
    filter_key: str | None = None
    """Take the demonstrations of this filter key only (robomimic's mask)."""

    def __post_init__(self) -> None:
        if self.cut and self.solved == "all":
            raise UserError("cut = True needs solved to be 'dones' or 'reward', which say where to cut; with 'all', demonstrations are kept whole")


@dataclasses.dataclass(frozen=True)
class ForeignDemonstration:
    """One demonstration of L transitions."""

    name: str
    modalities: dict[str, np.ndarray]
    """By key: (L + 1, n), or (L, n) where what follows the last action is not known."""
    actions: np.ndarray  # (L, A), in the units of the source
    rewards: np.ndarray | None  # (L,)
    dones: np.ndarray | None  # (L,), not 0 where the task was solved or over
    states: np.ndarray | None = None
    """(L + 1, S), or (L, S) where the last is not known; only of use if they are those of our own environment."""
    extras: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)
    """All datasets that our file is to keep, by the name that they have there."""
    attributes: dict[str, Any] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class ForeignRecording:
    """What a file or dataset of another tool holds."""

    source: str
    """Its name, for messages."""
    format: str
    env_name: str
    env_kwargs: dict[str, Any]
    demonstrations: tuple[ForeignDemonstration, ...]
    expert: dict[str, Any] | None = None
    observation_keys: tuple[str, ...] = ("observation",)
    """The modalities that make up the observation, where nobody says otherwise."""
    action_low: np.ndarray | None = None  # (A,) bounds of the actions, where the source tells them
    action_high: np.ndarray | None = None
    filters: dict[str, list[str]] = dataclasses.field(default_factory=dict)
    """Names of the demonstrations that belong to each filter key."""
    extras: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)
    attributes: dict[str, Any] = dataclasses.field(default_factory=dict)
    ours: bool = False
    """Whether we have written it, so that a conversion back gives a file as if it had been recorded."""
    about: dict[str, Any] = dataclasses.field(default_factory=dict)
    """What else a conversion back needs to know."""

    @property
    def shapes(self) -> dict[str, int]:
        """Number of columns of each modality."""
        return {key: rows.shape[1] for key, rows in self.demonstrations[0].modalities.items()}


def interpret(foreign: ForeignRecording, meaning: Interpretation, env: RestorableEnvironment | None) -> Recording:
    """Makes a recording of what another tool has written.

    Args:
      foreign: from the reader of a format.
      meaning: which modality is what.
      env: the environment of the task, if it is one of ours; else the goals must be among the modalities.

    Raises:
      UserError: something is missing, out of range or inconsistent; the message names the option that helps.
    """
    foreign = dataclasses.replace(foreign, demonstrations=tuple(_filtered(foreign, meaning.filter_key)))
    demos = foreign.demonstrations
    selection = _selection(foreign, meaning, env)
    _check_alike(foreign, demos, selection)
    last_state, solved_by_zero = _last_state(env), _solved_by_zero(demos)
    interpreted = [_interpret_one(foreign, demo, meaning, selection, env, last_state, solved_by_zero=solved_by_zero) for demo in demos]
    if not selection["achieved_goal"]:  # one call for all: under JAX, one per demonstration would compile for every length
        goals = np.asarray(env.achieved_goal(jnp.asarray(np.concatenate([demo.observations for demo in interpreted]), jnp.float32)))
        along = np.split(goals, np.cumsum([len(demo) + 1 for demo in interpreted])[:-1])
        interpreted = [_with_goals(demo, reached) for demo, reached in zip(interpreted, along, strict=True)]
    as_recorded = foreign.ours and all(demo.states is not None for demo in interpreted)
    return Recording(
        env_name=foreign.env_name if env is None else env.name,
        env_kwargs=foreign.env_kwargs if env is None else plain(dataclasses.asdict(env)),
        expert=foreign.expert,
        demonstrations=tuple(_settled(demo) for demo in interpreted),
        converted_from=None if as_recorded else _converted_from(foreign, meaning),
        extras=foreign.extras,
        attributes=foreign.attributes,
    )


def _converted_from(foreign: ForeignRecording, meaning: Interpretation) -> dict[str, Any]:
    return {
        "format": foreign.format,
        "interpretation": {name: value for name, value in dataclasses.asdict(meaning).items() if value},
        "datasets": sorted({name for demo in foreign.demonstrations for name in demo.extras}),
        "attributes": sorted(foreign.attributes),
        **foreign.about,
    }


# ------------------------------------------------------------------------------------------------------------------------- what is what

_Columns = list[tuple[str, slice]]


def _filtered(foreign: ForeignRecording, filter_key: str | None) -> Sequence[ForeignDemonstration]:
    if filter_key is None:
        return foreign.demonstrations
    if filter_key not in foreign.filters:
        there = f"it has {', '.join(foreign.filters)}" if foreign.filters else "it has none"
        raise UserError(f"{foreign.source}: no filter key {filter_key!r}; {there}")
    chosen = [demo for demo in foreign.demonstrations if demo.name in foreign.filters[filter_key]]
    if not chosen:
        raise UserError(f"{foreign.source}: filter key {filter_key!r} names no demonstration of the file; choose another")
    return chosen


def _selection(foreign: ForeignRecording, meaning: Interpretation, env: RestorableEnvironment | None) -> dict[str, _Columns]:
    """The columns of modalities that make up the observation and the goals; none for a goal that is derived."""
    shapes = foreign.shapes
    listed = ", ".join(f"{key} ({width})" for key, width in shapes.items()) or "none"

    def columns(keys: Sequence[str], flag: str) -> _Columns:
        return [found for key in keys for found in _columns_of(key, shapes, f"{foreign.source}: --{flag} {key}", listed)]

    if not shapes:
        raise UserError(
            f"{foreign.source}: holds no observations, only actions and states; let the tool that wrote it extract observations first "
            "(robomimic: scripts/dataset_states_to_obs.py --done_mode 0)"
        )
    if not meaning.observation_keys and "observation" not in shapes:
        raise UserError(f"{foreign.source}: has no modality 'observation'; name some with --observation-keys, out of {listed}")
    observation = columns(meaning.observation_keys or foreign.observation_keys, "observation-keys")
    achieved, desired = columns(meaning.achieved_goal_keys, "achieved-goal-keys"), columns(meaning.desired_goal_keys, "desired-goal-keys")
    if not achieved and env is None:
        achieved = _columns_of("achieved_goal", shapes, None, listed)
        if not achieved:
            raise UserError(
                f"{foreign.source}: has no modality 'achieved_goal'; name some with --achieved-goal-keys, out of {listed}, "
                "or name the environment with --env if it is one of ours"
            )
    if not desired and not meaning.achieved_goal_keys:
        desired = _columns_of("desired_goal", shapes, None, listed)
    for name, found, dim in (
        ("observation", observation, env and env.observation_dim),
        ("achieved_goal", achieved, env and env.goal_dim),
        ("desired_goal", desired, env and env.goal_dim if env else _width(achieved)),
    ):
        if found and dim is not None and _width(found) != dim:
            owner = env.name if env is not None else "the achieved goal"
            raise UserError(
                f"{foreign.source}: the keys of the {name.replace('_', ' ')} have {_width(found)} numbers, but {owner} has {dim}; "
                f"choose others with --{name.replace('_', '-')}-keys, out of {listed}"
            )
    return {"observation": observation, "achieved_goal": achieved, "desired_goal": desired}


def _columns_of(key: str, shapes: dict[str, int], where: str | None, listed: str) -> _Columns:
    """One key, with [a:b] or [a] for some of its columns; a key of a group stands for all keys in it. Without `where`, a missing one is none."""
    match = re.fullmatch(r"(?P<key>[^\[\]]+)(\[(?P<start>\d+|\d*(?=:))(?P<colon>:?)(?P<stop>(?<=:)\d*|)\])?", key)
    name = match["key"] if match else key
    within = [name] if name in shapes else [other for other in shapes if other.startswith(f"{name}/")]
    if not within:
        if where is None:
            return []
        raise UserError(f"{where}: there is no such modality; there are {listed}")
    if match is None or match[2] is None:
        return [(other, slice(0, shapes[other])) for other in within]
    start = int(match["start"] or 0)
    stop = int(match["stop"] or shapes[within[0]]) if match["colon"] else start + 1
    if len(within) > 1 or not 0 <= start < stop <= shapes[within[0]]:
        raise UserError(f"{where}: has no such columns; write KEY[START:STOP] with numbers from 0 to {shapes[within[0]]}")
    return [(within[0], slice(start, stop))]


def _width(columns: _Columns) -> int:
    return sum(columns.stop - columns.start for _, columns in columns)


def _joined(demo: ForeignDemonstration, columns: _Columns) -> np.ndarray:
    return np.concatenate([demo.modalities[key][:, part] for key, part in columns], axis=1)


# ----------------------------------------------------------------------------------------------------------------- one demonstration


def _check_alike(foreign: ForeignRecording, demos: Sequence[ForeignDemonstration], selection: dict[str, _Columns]) -> None:
    """All demonstrations must have the modalities that are used, with as many columns as the first, and as many rows as actions."""
    used = {key for columns in selection.values() for key, _ in columns}
    for demo in demos:
        where = f"{foreign.source}: {demo.name}"
        if len(demo.actions) < 1:
            raise UserError(f"{where}: has no actions; delete this demonstration")
        for key in sorted(used):
            if key not in demo.modalities or demo.modalities[key].shape[1] != foreign.shapes[key]:
                found = demo.modalities[key].shape[1] if key in demo.modalities else "no"
                raise UserError(f"{where}: has {found} columns of {key}, but {demos[0].name} has {foreign.shapes[key]}; delete one of them")
        for what, rows in {**{key: demo.modalities[key] for key in used}, "rewards": demo.rewards, "dones": demo.dones}.items():
            if rows is not None and len(rows) not in (len(demo.actions), len(demo.actions) + (what in used)):
                raise UserError(f"{where}: has {len(demo.actions)} actions, but {len(rows)} rows of {what}; the file is inconsistent, write it again")


def _interpret_one(
    foreign: ForeignRecording,
    demo: ForeignDemonstration,
    meaning: Interpretation,
    selection: dict[str, _Columns],
    env: RestorableEnvironment | None,
    last_state: Callable[..., Any] | None,
    *,
    solved_by_zero: bool,
) -> Demonstration:
    """The demonstration with all extras that it came with, and without achieved goals where those are to be derived."""
    where = f"{foreign.source}: {demo.name}"
    used = {key for columns in selection.values() for key, _ in columns}
    demo = _with_last_observation(where, demo, used, repeat=meaning.repeat_last_observation)
    end, solved = _end(where, demo, meaning, solved_by_zero=solved_by_zero)
    if end < len(demo.actions):
        demo = _shortened(demo, end)
    rewards = demo.rewards
    if meaning.sparse_rewards or rewards is None:
        rewards = (np.arange(end) == end - 1).astype(np.float32) * np.float32(solved)
    observations, actions = _joined(demo, selection["observation"]), _policy_actions(where, foreign, demo.actions, meaning)
    achieved, desired = np.zeros((end + 1, 0), np.float32), np.zeros(0, np.float32)
    if selection["achieved_goal"]:
        achieved = _joined(demo, selection["achieved_goal"])
        desired = achieved[-1]
    if selection["desired_goal"]:
        along = _joined(demo, selection["desired_goal"])
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
        states=_states(demo, observations, actions, env, last_state),
        extras=demo.extras,
        attributes=demo.attributes,
    )


def _with_goals(demo: Demonstration, reached: np.ndarray) -> Demonstration:
    """Adds goals that were derived from the observations; a desired goal that the source has stays."""
    return dataclasses.replace(demo, achieved_goals=reached, desired_goal=demo.desired_goal if demo.desired_goal.size else reached[-1])


def _settled(demo: Demonstration) -> Demonstration:
    """Finds a place for each extra: what our file holds anyway is no extra, and what it holds otherwise is kept under `source/`.

    `dones` keep their place, since our file has an attribute for what we take from them.
    """
    ours, extras = layout(demo), {}
    along = {"observation": demo.observations, "achieved_goal": demo.achieved_goals}
    along["desired_goal"] = np.broadcast_to(demo.desired_goal, (len(demo) + 1, *demo.desired_goal.shape))
    same_elsewhere = {MINARI_OBSERVATIONS + key: rows for key, rows in along.items()}
    for name, array in demo.extras.items():
        there = (ours | same_elsewhere).get(name)
        if there is None or there.dtype != array.dtype or not np.array_equal(there, array):
            extras[SOURCE + name if name in ours and name != "dones" else name] = array
    return dataclasses.replace(demo, extras=extras)


def _with_last_observation(where: str, demo: ForeignDemonstration, used: set[str], *, repeat: bool) -> ForeignDemonstration:
    modalities = dict(demo.modalities)
    for key in sorted(used):
        if len(modalities[key]) == len(demo.actions):
            if not repeat:
                raise UserError(
                    f"{where}: {key} after the last action is not known, since next_obs is missing; write the file with next_obs, "
                    "or use the last one that is there with --repeat-last-observation"
                )
            modalities[key] = np.concatenate([modalities[key], modalities[key][-1:]])
    return dataclasses.replace(demo, modalities=modalities)


def _solved_by_zero(demos: Sequence[ForeignDemonstration]) -> bool:
    """Whether the rewards of a file are -1 and 0 rather than 0 and 1. One demonstration cannot tell: it may have failed."""
    rewards = [demo.rewards for demo in demos if demo.rewards is not None and len(demo.rewards)]
    return bool(rewards) and max(rows.max() for rows in rewards) <= 0 and min(rows.min() for rows in rewards) < 0


def _end(where: str, demo: ForeignDemonstration, meaning: Interpretation, *, solved_by_zero: bool) -> tuple[int, bool]:
    """Number of transitions to keep, and whether the last of them solves the task."""
    length = len(demo.actions)
    if meaning.solved == "all":
        return length, True
    rows, what = (demo.dones, "dones") if meaning.solved == "dones" else (demo.rewards, "rewards")
    if rows is None:
        others = "reward or --solved all" if what == "dones" else "all"
        raise UserError(f"{where}: has no {what}, so it is not known which demonstrations solve the task; say --solved {others}")
    times = np.flatnonzero(rows == 0 if what == "rewards" and solved_by_zero else rows > 0)
    if not times.size:
        return length, False
    first = int(times[0])
    if first < length - 1 and not meaning.cut:
        what = "done" if what == "dones" else "rewarded"
        raise UserError(f"{where}: is {what} after {first + 1} of {length} steps and goes on; cut off the rest with --cut, or see --solved")
    return first + 1, True


def _shortened(demo: ForeignDemonstration, end: int) -> ForeignDemonstration:
    """The first `end` transitions. Extras with a row for each action or each state are cut too."""
    length = len(demo.actions)

    def cut(rows: np.ndarray | None) -> np.ndarray | None:
        if rows is None or rows.ndim == 0 or len(rows) not in (length, length + 1):
            return rows
        return rows[: end + len(rows) - length]

    return dataclasses.replace(
        demo,
        modalities={key: rows[: end + 1] for key, rows in demo.modalities.items()},
        actions=demo.actions[:end],
        rewards=cut(demo.rewards),
        dones=cut(demo.dones),
        states=None if demo.states is None else demo.states[: end + 1],
        extras={name: cut(rows) for name, rows in demo.extras.items()},
    )


def _policy_actions(where: str, foreign: ForeignRecording, actions: np.ndarray, meaning: Interpretation) -> np.ndarray:
    """Actions in [-1, 1]; untouched where that is their range already."""
    low, high = (
        _bound(where, given, known, actions.shape[1], default)
        for given, known, default in ((meaning.action_low, foreign.action_low, -1.0), (meaning.action_high, foreign.action_high, 1.0))
    )
    if (low >= high).any():
        raise UserError(f"{where}: the lowest action must be below the highest; correct --action-low and --action-high")
    if (low == -1.0).all() and (high == 1.0).all():
        mapped = actions
    else:
        mapped = (2.0 * (actions.astype(np.float64) - low) / (high - low) - 1.0).astype(np.float32)
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


def _last_state(env: RestorableEnvironment | None) -> Callable[..., Any] | None:
    """A program (state (S,), action (A,)) -> the next state (S,) and what is observed in it; None where that takes a simulator outside JAX."""
    if env is None or on_host(env):
        return None

    def step(vector: jax.Array, action: jax.Array) -> tuple[jax.Array, jax.Array]:
        state, _ = env.step(env.vector_to_state(jax.random.key(0), vector), action_to_env(action, env))
        return env.state_to_vector(state), env.observe(state)

    return jax.jit(step, compiler_options=compiler_options(env))


def _states(
    demo: ForeignDemonstration,
    observations: np.ndarray,
    actions: np.ndarray,
    env: RestorableEnvironment | None,
    last_state: Callable[..., Any] | None,
) -> np.ndarray | None:
    """(L + 1, S) states of our environment, if the source has them.

    robomimic keeps no state after the last action. It is had by taking that action once more, and only believed if it looks as observed.
    """
    if env is None or demo.states is None or demo.states.ndim != 2 or demo.states.shape[1] != env.state_dim:
        return None
    if len(demo.states) == len(actions) + 1:
        return demo.states
    if last_state is None or len(demo.states) != len(actions):
        return None
    state, observed = map(np.asarray, last_state(demo.states[-1].astype(np.float32), actions[-1].astype(np.float32)))
    if not np.allclose(observed, observations[-1], rtol=_STATE_TOLERANCE, atol=_STATE_TOLERANCE):
        return None
    return np.concatenate([demo.states, state[None].astype(demo.states.dtype)])
