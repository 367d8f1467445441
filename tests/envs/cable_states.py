"""States of the cable tasks on the way of the expert, in C MuJoCo, and what becomes of them under given commands."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.cable_parity import as_closed_form, situations
from hindrl_jax.envs.cable import BringNear, CableInsertion

BOTH_TASKS = pytest.mark.parametrize("task", [BringNear, CableInsertion])
IN_C, IN_CLOSED_FORM = CableInsertion(backend="mujoco"), CableInsertion()
SHUT = np.tile(np.array([0, 0, 0, 0, 0, 0, 1], np.float32), 2)
"""(14,) stand still, and hold what is held."""


@functools.cache
def on_the_way():
    """Two states of C MuJoCo in each situation, leaves (2, ...), and the expert's commands (2, 20, 14) from there on."""
    return situations(jax.random.key(0), 2)


def state_in_c(situation, index=0):
    states = on_the_way()[0][situation].replace(key=None)
    return jax.tree.map(lambda leaf: leaf[index], states).replace(key=jax.random.key(index))


def in_closed_form(state):
    return jax.jit(as_closed_form)(state)


@functools.partial(jax.jit, static_argnums=0)
def roll(env, state, commands):
    """The last state, and the scenes, leaves (T, ...), after each of the commands (T, 14)."""

    def step(state, command):
        state, _ = env.step(state, command)
        return state, state.scene

    return jax.lax.scan(step, state, commands)


def repeated(command, times):
    return jnp.asarray(np.tile(np.asarray(command, np.float32), (times, 1)))


@functools.partial(jax.jit, static_argnums=0)
def step(env, state, action):
    return env.step(state, action)


@functools.partial(jax.jit, static_argnums=0)
def reset(env, key):
    return env.reset(key)
