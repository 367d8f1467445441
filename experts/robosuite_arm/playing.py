"""Playing episodes of the reach and the cable tasks in robosuite, one after the other, outside JAX.

robosuite only moves arms and cables. The start comes from `env.reset`; observation, reward and progress from `env.arrive`, as with the other back
ends.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hindrl_jax.base.environments import action_from_env, command_of
from hindrl_jax.base.types import Array, Episodes, TimeStep
from hindrl_jax.envs.cable import CableTask
from hindrl_jax.envs.reach import ReachTask
from hindrl_jax.experts.robosuite_arm.arm import RobosuiteArm, RobosuiteScene
from hindrl_jax.experts.robosuite_arm.cable_scene import RobosuiteCables

Task = ReachTask | CableTask
Act = Callable[[Array, Any, Array], Array]
"""(key, state, observation (D,)) -> action (A,) in the environment's own units."""


def build_scene(env: Task, *, on_screen: bool = False) -> Any:
    """The scene in which a task is played, with the methods `begin` and `step`.

    Raises:
      UserError: as `RobosuiteScene`.
    """
    return RobosuiteCables(env.num_links, on_screen=on_screen) if isinstance(env, CableTask) else RobosuiteArm(env.num_waypoints, on_screen=on_screen)


_shared: dict[Any, RobosuiteScene] = {}


def shared_scene(env: Task) -> Any:
    """One scene for all episodes of this process: building it takes seconds, and a reset takes milliseconds and leaves nothing behind."""
    kind = ("cables", env.num_links) if isinstance(env, CableTask) else ("arm", env.num_waypoints)
    if kind not in _shared:
        _shared[kind] = build_scene(env)
    return _shared[kind]


def play_in_robosuite(key: Array, env: Task, act: Act, num_episodes: int, num_held: int = 1) -> Episodes:
    """Plays episodes one after the other, with the arms in robosuite.

    Equal keys give the same starts and keys for `act` as in `hindrl_jax.training.recording.play`. `act` is compiled once, however often
    this is called with it.

    Args:
      key: random key.
      env: the task, of any back end.
      act: (key, state, observation (D,)) -> action (A,) in the environment's own units, clipped to its bounds before it goes to
        robosuite.
      num_episodes: N.
      num_held: steps for which each action is held.

    Returns:
      N episodes. Past the end of an episode observations and states are repeated, and actions are 0.

    Raises:
      UserError: if robosuite is missing or unusable.
    """
    scene = shared_scene(env)
    episodes = [play_episode(key, env, scene, functools.partial(_act, act), num_held) for key in jax.random.split(key, num_episodes)]
    return stacked(episodes)


def play_episode(key: Array, env: Task, scene: Any, act: Act, num_held: int = 1) -> Episodes:
    """Plays one episode on the host.

    Args:
      key: random key.
      env: the task.
      scene: from `build_scene`, or anything with its methods `begin` and `step`.
      act: as for `play_in_robosuite`, but any Python function.
      num_held: steps for which each action is held.

    Returns:
      The episode, NumPy leaves without the episode axis.
    """
    key_reset, key = jax.random.split(key)
    state, observation, vector = _start(env, key_reset)
    scene.begin(state)
    observations, states, actions, rewards = [observation], [vector], [], []
    for index in range(env.horizon):
        key, key_act = jax.random.split(key)
        if index % num_held == 0:
            decision = act(key_act, state, observation)
        command, normalised = _command(env, command_of(decision, index % num_held, env.action_dim))
        moved = jax.tree.map(np.float32, scene.step(np.asarray(command)))
        state, time_step, vector = _arrive(env, state, moved)
        observation = time_step.observation
        actions.append(normalised)
        rewards.append(time_step.reward)
        observations.append(observation)
        states.append(vector)
        if time_step.terminated or time_step.truncated:
            break

    def repeated(rows: list[Array]) -> Any:
        return np.stack(jax.device_get(rows + rows[-1:] * (env.horizon + 1 - len(rows))))

    def padded(rows: list[Array]) -> Any:
        array = np.stack(jax.device_get(rows))
        return np.concatenate([array, np.zeros((env.horizon - len(rows), *array.shape[1:]), array.dtype)])

    ends: dict[str, Any] = dict(lengths=np.int32(len(actions)), terminated=np.bool_(time_step.terminated))
    return Episodes(
        observations=repeated(observations),
        actions=padded(actions),
        rewards=padded(rewards),
        desired_goals=jax.device_get(env.achieved_goal(observation)),
        states=repeated(states),
        **ends,
    )


def stacked(episodes: list[Episodes]) -> Episodes:
    """Single episodes, leaves (...), as one table, leaves (N, ...)."""
    return jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *episodes)


@functools.partial(jax.jit, static_argnums=0)
def _act(act: Act, key: Array, state: Any, observation: Array) -> Array:
    return act(key, state, observation)


@functools.partial(jax.jit, static_argnums=0)
def _start(env: Any, key: Array) -> tuple[Any, Array, Array]:
    state, observation = env.reset(key)
    return state, observation, env.state_to_vector(state)


@functools.partial(jax.jit, static_argnums=0)
def _command(env: Task, action: Array) -> tuple[Array, Array]:
    """The action as robosuite gets it, and as it is recorded."""
    return jnp.clip(action, env.action_low, env.action_high), action_from_env(action, env)


@functools.partial(jax.jit, static_argnums=0)
def _arrive(env: Any, state: Any, moved: tuple[Any, Any]) -> tuple[Any, TimeStep, Array]:
    state, time_step = env.arrive(state, *moved)
    return state, time_step, env.state_to_vector(state)
