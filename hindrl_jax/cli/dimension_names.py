"""Names of the dimensions of observations, goals and actions of this project's own tasks, for tables and pictures."""

from __future__ import annotations

import dataclasses

from hindrl_jax.base.environments import Environment
from hindrl_jax.envs.cable.rules import CableTask
from hindrl_jax.envs.grid.rules import GridTask
from hindrl_jax.envs.reach.parameterized_reach import FixedParameterizedReach, ParameterizedReach
from hindrl_jax.envs.reach.rules import ReachTask


@dataclasses.dataclass(frozen=True)
class DimensionNames:
    """A name for each number; nothing where they are not known."""

    observation: tuple[str, ...] = ()
    goal: tuple[str, ...] = ()
    action: tuple[str, ...] = ()


def dimension_names(env: Environment | None) -> DimensionNames:
    """The names for a task; none for a task of the user's own, one of Gymnasium, or an unknown one."""
    if isinstance(env, GridTask):
        return _grid(env)
    if isinstance(env, ReachTask):
        return _reach(env)
    return _cable(env) if isinstance(env, CableTask) else DimensionNames()


def _axes(what: str, axes: str = "xyz") -> list[str]:
    return [f"{what}, {axis}" for axis in axes]


def _grid(env: GridTask) -> DimensionNames:
    objects = range(env.num_objects)
    observation = [name for number in objects for name in _axes(f"object {number} from agent", "xy")] + _axes("goal from agent", "xy")
    observation += [f"object {number} delivered" for number in objects] + [f"object {number} held" for number in objects]
    return DimensionNames(tuple(observation), tuple(observation), ("move +x", "move +y", "move -x", "move -y", "grab"))


def _reach(env: ReachTask) -> DimensionNames:
    pose = _axes("hand") + [f"hand's orientation {number}" for number in range(1, env.pose_dim - 2)]
    waypoints = range(1, env.num_waypoints + 1)
    reached = [f"waypoint {number} reached" for number in waypoints]
    action = (*_axes("move hand"), *_axes("turn hand"))
    if isinstance(env, FixedParameterizedReach):
        return DimensionNames((*pose, *reached), (*pose, *reached), action)
    if not isinstance(env, ParameterizedReach):
        return DimensionNames(action=action)
    turns = ["next waypoint", *(f"waypoint {number} places on" for number in waypoints[:-1])]
    remaining = [name for turn in turns for name in (*_axes(f"to {turn}"), *_axes(f"turn to {turn}"))]
    return DimensionNames((*pose, *reached, *remaining), (*_axes("to last waypoint"), *_axes("turn to last waypoint"), *reached), action)


def _cable(env: CableTask) -> DimensionNames:
    heads = ("plug", "socket")
    observation = []
    for head in heads:
        observation += _axes(f"{head}'s hand") + [f"{head}'s hand, orientation {number}" for number in range(1, 7)]
    for head in heads:
        observation += _axes(f"{head} from its hand")
    observation += [*_axes("plug's tip from its place"), *(f"{head} held" for head in heads), *(f"{head}'s gripper, opening" for head in heads)]
    if env.observation == "full":
        observation += [name for head in heads for name in _axes(f"axis of the {head}")] + ["solved"]
    action = [name for head in heads for name in (*_axes(f"move {head}'s hand"), *_axes(f"turn {head}'s hand"), f"{head}'s gripper")]
    return DimensionNames(tuple(observation), tuple(observation), tuple(action))
