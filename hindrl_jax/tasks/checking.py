"""`check_environment`: whether a task of your own is what training takes it for, as Gymnasium's and Stable-Baselines3's checkers do for theirs.

First what can be told from shapes alone, then what a few episodes show. They are played side by side in one compiled program, five rows and, where
the task has an expert, four more:

    0, 1    actions at random, with equal keys
    2       actions at random, with another key
    3, 4    at the bounds of the actions, and far beyond them, with equal keys
    5 to 8  the expert's actions, so that the task is solved now and then
"""

from __future__ import annotations

import dataclasses
import re
import warnings
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hindrl_jax.base.compilation import in_float32
from hindrl_jax.base.environments import RelabelsObservations, RestorableEnvironment, compiler_options
from hindrl_jax.base.errors import UserError, one_line
from hindrl_jax.base.types import Array, TimeStep
from hindrl_jax.tasks.registry import TASKS

_MOST_STEPS = 2_000
"""Longer episodes are played so far only, and how they end is not looked at."""
_TOLERANCE = 1e-4
"""Of observations and states, relative and absolute, for rounding; a step more may make ten times as much of it."""
_RANDOM, _AT_BOUNDS, _BEYOND, _EXPERT = range(4)
_KEYS, _MODES = (0, 0, 1, 0, 0), (_RANDOM, _RANDOM, _RANDOM, _AT_BOUNDS, _BEYOND)
_EXPERT_KEYS = (2, 3, 4, 5)
_LONGEST_QUOTE = 160
_QUICK = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}
"""The program runs once, so that its compilation is what it costs."""


@in_float32
def check_environment(env: Any) -> None:
    """Makes sure that an environment in JAX keeps what `hindrl_jax.base.environments.RestorableEnvironment` promises.

    Checked are: that it is hashable and equal to one of equal arguments; dimensions and bounds; shapes and types of what `reset`, `step`,
    `observe`, `achieved_goal`, `task_goal` and the two conversions of states return; that they work under jit and vmap, and give the same each time
    that they are traced; that equal keys give equal episodes; finite observations, within observation_low and observation_high where there are
    such; that actions beyond the bounds are clipped; that a state comes back from its vector and goes on as it would have; that the reward is 1
    where an episode terminates and 0 elsewhere, and the horizon truncates the others. Where the task has an expert, it plays, too.

    A start that is the same for all keys is only warned of: it may be meant.

    Args:
      env: an instance, for example from `hindrl_jax.make`.

    Raises:
      UserError: for the first fault, in one line: what is wrong, and what to do.

    Example:
      >>> import hindrl_jax as hindrl
      >>> hindrl.check_environment(hindrl.make("FixedGridPickAndPlace"))
    """
    if not isinstance(env, RestorableEnvironment):
        needed = [name for name in dir(RestorableEnvironment) if not name.startswith("_") and not hasattr(env, name)]
        raise UserError(f"{type(env).__name__} lacks {', '.join(needed)}: see hindrl_jax.base.environments.RestorableEnvironment, which has them")
    fault = _Fault(env.name)
    _check_identity(env, fault)
    _check_numbers(env, fault)
    _check_signatures(env, fault)
    _check_purity(env, fault)
    _check_episodes(env, _played(env, fault), fault)


class _Fault:
    """Refusals of one environment."""

    def __init__(self, name: str):
        self.name = name

    def __call__(self, what: str, advice: str) -> UserError:
        return UserError(f"{self.name}: {what}: {advice}")

    def unless(self, holds: Any, what: str, advice: str) -> None:
        if not holds:
            raise self(what, advice)

    def tried(self, doing: str, function: Callable[..., Any], *arguments: Any) -> Any:
        """Calls a function that runs the environment's code."""
        try:
            return function(*arguments)
        except UserError:
            raise
        except Exception as error:  # of any kind: it is somebody else's code
            said = re.split(r"\. |\n", str(error), maxsplit=1)[0]
            quote = f"{type(error).__name__}: {said[:_LONGEST_QUOTE]}" if said else one_line(error)
            advice = "mend it"
            if isinstance(error, jax.errors.ConcretizationTypeError):
                advice = (
                    "what it asks for is not known under jit; write jnp.where or jax.lax.cond in place of `if`, and jnp.asarray in place of float()"
                )
            if isinstance(error, jax.errors.TracerArrayConversionError):
                advice = "it gives an array of JAX to NumPy, which is not possible under jit; write jnp in place of np"
            raise self(f"{doing} fails ({one_line(ValueError(quote))})", advice) from error


def _check_identity(env: Any, fault: _Fault) -> None:
    try:
        hash(env)
    except TypeError as error:
        raise fault(f"it is not hashable ({one_line(error)})", "make it a frozen dataclass whose fields are numbers, texts or tuples") from error
    fields = [field.name for field in dataclasses.fields(env) if field.init]
    again = fault.tried("making it once more", lambda: type(env)(**{name: getattr(env, name) for name in fields}))
    fault.unless(again == env, "two of equal arguments are not equal, so every call would compile again", "leave its __eq__ to the dataclass")


def _check_numbers(env: Any, fault: _Fault) -> None:
    for name in ("horizon", "observation_dim", "goal_dim", "action_dim", "state_dim"):
        value = getattr(env, name)
        whole = isinstance(value, int | np.integer) and not isinstance(value, bool) and value >= 1
        fault.unless(whole, f"{name} = {value!r} is no whole number of at least 1", "give it one")
    bounds = []
    for name in ("action_low", "action_high"):
        try:
            bounds.append(np.broadcast_to(np.asarray(getattr(env, name), np.float32), (env.action_dim,)))
        except (TypeError, ValueError) as error:
            raise fault(f"{name} is not {env.action_dim} numbers, or one for all", "give it as many as action_dim says") from error
    low, high = bounds
    fault.unless(np.isfinite(high - low).all(), "the bounds of its actions are not finite", "give action_low and action_high finite numbers")
    fault.unless((low <= high).all() and (low < high).any(), "action_low is not below action_high", "correct the bounds")


def _shapes(tree: Any) -> dict[str, tuple[Any, Any]]:
    """Shape and type of each leaf, by its path; how weak a type is does not matter."""
    return {jax.tree_util.keystr(path) or "it": (leaf.shape, leaf.dtype) for path, leaf in jax.tree_util.tree_leaves_with_path(tree)}


def _check_signatures(env: Any, fault: _Fault) -> None:
    """What can be told without computing anything."""
    key, number = jax.random.key(0), np.dtype(np.float32)
    observed = jax.ShapeDtypeStruct((env.observation_dim,), number)

    def expect(what: str, found: Any, shape: tuple[int, ...], kind: Any, where: str) -> None:
        found = jax.eval_shape(jnp.asarray, found) if isinstance(found, int | float | bool) else found
        fault.unless(hasattr(found, "shape"), f"{what} is {type(found).__name__}, not an array", f"return an array {shape} of {kind}")
        fault.unless(found.shape == shape, f"{what} has shape {found.shape}, and {where} says {shape}", "correct one of them")
        fault.unless(
            found.dtype == kind,
            f"{what} is of {found.dtype}, not {kind}",
            f"convert it with .astype({'bool' if kind.kind == 'b' else 'jnp.float32'})",
        )

    begun = fault.tried("reset(key)", jax.eval_shape, env.reset, key)
    fault.unless(isinstance(begun, tuple) and len(begun) == 2, "reset(key) returns no pair", "return (state, observation)")
    state, observation = begun
    expect("the observation of reset", observation, observed.shape, number, "observation_dim")
    stepped = fault.tried("step(state, action)", jax.eval_shape, env.step, state, jax.ShapeDtypeStruct((env.action_dim,), number))
    is_step = isinstance(stepped, tuple) and len(stepped) == 2 and isinstance(stepped[1], TimeStep)
    fault.unless(is_step, "step(state, action) returns no state and hindrl_jax.TimeStep", "return (state, hindrl_jax.TimeStep(...))")
    after, time_step = stepped
    before_shapes, after_shapes = _shapes(state), _shapes(after)
    for path in before_shapes.keys() | after_shapes.keys():
        before, now = before_shapes.get(path), after_shapes.get(path)
        what = f"state{path} is {_in_words(before)} after reset and {_in_words(now)} after step"
        fault.unless(before == now, what, "a scan needs both alike; convert one of them")
    expect("the observation of step", time_step.observation, observed.shape, number, "observation_dim")
    expect("the reward", time_step.reward, (), number, "TimeStep")
    for name in ("terminated", "truncated"):
        expect(name, getattr(time_step, name), (), np.dtype(bool), "TimeStep")
    for batch in ((), (2, 3)):
        rows = jax.ShapeDtypeStruct((*batch, env.observation_dim), number)
        goals = fault.tried(f"achieved_goal of observations {rows.shape}", jax.eval_shape, env.achieved_goal, rows)
        expect(f"achieved_goal of observations {rows.shape}", goals, (*batch, env.goal_dim), number, "goal_dim")
    goal = fault.tried("task_goal()", lambda: jnp.asarray(env.task_goal()))
    expect("task_goal()", goal, (env.goal_dim,), number, "goal_dim")
    fault.unless(jnp.isfinite(goal).all(), "task_goal() is not finite", "give it numbers")
    expect("observe(state)", fault.tried("observe(state)", jax.eval_shape, env.observe, state), observed.shape, number, "observation_dim")
    vector = fault.tried("state_to_vector(state)", jax.eval_shape, env.state_to_vector, state)
    expect("state_to_vector(state)", vector, (env.state_dim,), number, "state_dim")
    restored = _shapes(fault.tried("vector_to_state(key, vector)", jax.eval_shape, env.vector_to_state, key, vector))
    for path in before_shapes.keys() | restored.keys():
        before, now = before_shapes.get(path), restored.get(path)
        what = f"state{path} is {_in_words(before)} after reset and {_in_words(now)} after vector_to_state"
        fault.unless(before == now, what, "convert it, for example with .astype(jnp.int32)")
    if isinstance(env, RelabelsObservations):
        rows = jax.ShapeDtypeStruct((4, env.observation_dim), number)
        subgoals = jax.ShapeDtypeStruct((env.num_subgoals, env.observation_dim), number)
        told = fault.tried("relabel_observations", jax.eval_shape, env.relabel_observations, key, rows, subgoals)
        fault.unless(isinstance(told, tuple) and len(told) == 2, "relabel_observations returns no pair", "return (observations, solved)")
        expect("the observations of relabel_observations", told[0], rows.shape, number, "what it is given")
        expect("what relabel_observations says is solved", told[1], (3,), np.dtype(bool), "what it is given")


def _in_words(shape: tuple[Any, Any] | None) -> str:
    return "missing" if shape is None else f"{shape[1]} {shape[0]}"


def _check_purity(env: Any, fault: _Fault) -> None:
    """Tracing a pure function twice gives the same program; what NumPy draws, a counter or a clock gives another."""
    state, _ = jax.eval_shape(env.reset, jax.random.key(0))
    action = jax.ShapeDtypeStruct((env.action_dim,), np.float32)
    for name, function, arguments in (("reset", env.reset, (jax.random.key(0),)), ("step", env.step, (state, action))):
        # A function of its own each time: else the second trace would be the first.
        first, second = (jax.make_jaxpr(lambda *given, function=function: function(*given))(*arguments) for _ in range(2))
        same = re.sub("0x[0-9a-f]+", "", str(first)) == re.sub("0x[0-9a-f]+", "", str(second))
        pairs = zip(map(_data, first.consts), map(_data, second.consts), strict=False)
        same = same and all(np.array_equal(one, other, equal_nan=one.dtype.kind == "f") for one, other in pairs)
        fault.unless(same, f"{name} is another function each time that it is compiled", "draw from the key, not from NumPy or a clock")


def _data(array: Any) -> np.ndarray:
    is_key = hasattr(array, "dtype") and jnp.issubdtype(array.dtype, jax.dtypes.prng_key)
    return np.asarray(jax.random.key_data(array) if is_key else array)


def _key_of(state: Any, otherwise: Array) -> Array:
    """The random key that a state carries."""
    keys = [leaf for leaf in jax.tree.leaves(state) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) and leaf.shape == ()]
    return keys[0] if keys else otherwise


def _played(env: Any, fault: _Fault) -> dict[str, np.ndarray]:
    """Episodes as long as the horizon, not reset at their ends; arrays (rows, T, ...), see the module's docstring."""
    entry = TASKS.get(env.name)
    expert = entry.expert() if entry is not None and entry.expert is not None else None
    seeds = _KEYS + (_EXPERT_KEYS if expert else ())
    modes = _MODES + (_EXPERT,) * (len(seeds) - len(_KEYS))
    low, high = (jnp.broadcast_to(jnp.asarray(bound, jnp.float32), (env.action_dim,)) for bound in (env.action_low, env.action_high))
    up = jnp.arange(env.action_dim) % 2 == 0

    def choose(key: Array, mode: Array, state: Any) -> Array:
        at_random = jax.random.uniform(key, low.shape, minval=low, maxval=high)
        beyond = jnp.where(up, high + 99.0 * (high - low), low - 99.0 * (high - low))
        action = jnp.stack([at_random, jnp.where(up, high, low), beyond])[jnp.minimum(mode, _BEYOND)]
        if expert is None:
            return action
        chosen = jnp.asarray(expert.act(key, env, state), jnp.float32)
        fault.unless(chosen.shape == low.shape, f"the expert's action has shape {chosen.shape}", f"give it {low.shape}")
        return jnp.where(mode == _EXPERT, chosen, action)

    def play(key: Array, mode: Array) -> dict[str, Array]:
        key_reset, key_actions, key_restored = jax.random.split(key, 3)
        state, observation = env.reset(key_reset)

        def step(state: Any, key: Array) -> tuple[Any, dict[str, Array]]:
            vector = env.state_to_vector(state)
            restored = env.vector_to_state(_key_of(state, key_restored), vector)
            both = jax.tree.map(lambda *leaves: jnp.stack(leaves), state, restored)
            action = choose(key, mode, state)
            after, steps = jax.vmap(env.step, (0, None))(both, action)
            state = jax.tree.map(lambda leaf: leaf[0], after)
            told = {name: getattr(steps, name)[0] for name in ("observation", "reward", "terminated", "truncated")}
            told |= {f"restored {name}": getattr(steps, name)[1] for name in ("observation", "reward", "terminated", "truncated")}
            told |= {"observed": env.observe(state), "vector": vector, "restored vector": env.state_to_vector(restored), "action": action}
            return state, told

        _, told = jax.lax.scan(step, state, jax.random.split(key_actions, min(env.horizon, _MOST_STEPS)))
        return told | {"first": observation, "first observed": env.observe(state), "first vector": env.state_to_vector(state)}

    program = jax.jit(jax.vmap(play), compiler_options=_QUICK | compiler_options(env))
    keys = jax.vmap(jax.random.key)(jnp.array(seeds))
    with jax.debug_key_reuse(False):  # a state and the one that its vector gives have the same key, on purpose
        return fault.tried("playing episodes side by side, under vmap and jit,", lambda: jax.device_get(program(keys, jnp.array(modes))))


def _check_episodes(env: Any, played: dict[str, np.ndarray], fault: _Fault) -> None:
    steps, rows = played["reward"].shape[1], range(len(played["reward"]))
    terminated, truncated = played["terminated"], played["truncated"]
    ended = terminated | truncated
    lengths = np.where(ended.any(axis=1), ended.argmax(axis=1) + 1, steps)
    until_end = np.arange(steps) < lengths[:, None]
    _check_finite(env, played, until_end, fault)
    for row in rows:
        _check_restored(played, row, int(lengths[row]), fault)
    same = all(np.array_equal(array[0], array[1], equal_nan=array.dtype.kind == "f") for array in played.values())
    fault.unless(same, "equal keys give different episodes", "draw all that is random from the key of reset, and carry it in the state")
    count = min(lengths[3], lengths[4])
    clipped = np.allclose(played["observation"][3, :count], played["observation"][4, :count], rtol=_TOLERANCE, atol=_TOLERANCE)
    fault.unless(
        clipped, "actions beyond the bounds do more than those at them", "clip them in step, jnp.clip(action, self.action_low, self.action_high)"
    )
    for row, step in np.argwhere(until_end):
        when = f"after {step + 1} steps of an episode"
        reward, over = played["reward"][row, step], terminated[row, step]
        what = f"the reward is {reward:g} {when}, where terminated is {bool(over)}"
        fault.unless(reward == float(over), what, "give 1 at the step that solves the task and ends the episode, and 0 at all others")
        fault.unless(
            not (over and truncated[row, step]), f"terminated and truncated are both true {when}", "let truncated be false where it is solved"
        )
        early = truncated[row, step] and step + 1 < env.horizon
        fault.unless(not early, f"an episode is truncated {when}, and the horizon is {env.horizon}", "truncate where the steps reach the horizon")
    if steps == env.horizon:
        on_time = ended.any(axis=1).all()
        fault.unless(on_time, f"an episode goes on after {env.horizon} steps, its horizon", "let truncated be true there, unless it is solved")
    if all(np.array_equal(array[0], array[2]) for array in (played["first"], played["first vector"])):
        warnings.warn(
            f"{env.name}: reset begins in the same state whatever its key is: draw something of it from the key, unless that is meant", stacklevel=4
        )


def _check_finite(env: Any, played: dict[str, np.ndarray], until_end: np.ndarray, fault: _Fault) -> None:
    """Observations are finite numbers within their bounds, up to the end of each episode."""
    observations = np.concatenate([played["first"][:, None], played["observation"]], axis=1)
    counts = np.concatenate([np.ones((len(until_end), 1), bool), until_end], axis=1)[..., None]
    low = np.asarray(getattr(env, "observation_low", -np.inf), np.float32) - _TOLERANCE
    high = np.asarray(getattr(env, "observation_high", np.inf), np.float32) + _TOLERANCE
    for wrong, what, advice in (
        (~np.isfinite(observations), "which is not finite", "look for divisions by 0 and roots of negative numbers in step and observe"),
        ((observations < low) | (observations > high), "beyond observation_low or observation_high", "correct the bounds, or the observation"),
    ):
        if (wrong & counts).any():
            row, step, dim = np.argwhere(wrong & counts)[0]
            raise fault(f"observation[{dim}] is {observations[row, step, dim]:g} after {step} steps, {what}", advice)


def _check_restored(played: dict[str, np.ndarray], row: int, length: int, fault: _Fault) -> None:
    """States are what they were after the way through a vector, and what is observed of one is what step has returned."""

    def differs(one: str, other: str, scale: float = 1.0) -> tuple[int, ...] | None:
        first, second = (played[name][row, :length].astype(np.float64) for name in (one, other))
        wrong = ~np.isclose(first, second, rtol=scale * _TOLERANCE, atol=scale * _TOLERANCE, equal_nan=True)
        return tuple(np.argwhere(wrong)[0]) if wrong.any() else None

    same = np.allclose(played["first"][row], played["first observed"][row], rtol=_TOLERANCE, atol=_TOLERANCE)
    fault.unless(same, "reset returns another observation than observe(state)", "return self.observe(state) in both")
    if found := differs("observation", "observed"):
        step, dim = found
        pair = [played[name][row, step, dim] for name in ("observation", "observed")]
        what = f"observation[{dim}] of step {step + 1} is {pair[0]:g}, and observe(state) says {pair[1]:g}"
        raise fault(what, "return self.observe(state) of the new state in step")
    if found := differs("vector", "restored vector"):
        step, dim = found
        pair = [played[name][row, step, dim] for name in ("vector", "restored vector")]
        what = f"entry {dim} of a state's vector is {pair[0]:g}, and {pair[1]:g} of the state that vector_to_state makes of it"
        raise fault(what, "make vector_to_state the inverse of state_to_vector")
    for name in ("observation", "reward", "terminated", "truncated"):
        if found := differs(name, f"restored {name}", 10.0):
            entry = name if name != "observation" else f"observation[{found[1]}]"
            pair = [played[which][(row, *found)] for which in (name, f"restored {name}")]
            what = f"{entry} after step {found[0] + 1} is {pair[0]:g}, and {pair[1]:g} where the state before has gone through its vector"
            raise fault(what, "write all of the state but its key into state_to_vector, the number of steps included")
