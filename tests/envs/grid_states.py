"""Placed states of the grid worlds, and actions played from them."""

import functools

import jax
import jax.numpy as jnp
import pytest

from hindrl_jax.envs.grid import FixedGridPickAndPlace, GridPickAndPlace, GridState

RIGHT, DOWN, LEFT, UP = range(4)  # +x, +y, -x, -y
BOTH_TASKS = pytest.mark.parametrize("task", [GridPickAndPlace, FixedGridPickAndPlace])
EITHER_ORDER = pytest.mark.parametrize("strict_order", [True, False])


def place(agent, objects, goal, *, num_delivered=0, held=-1, step=0, seed=0):
    """A state with everything where the test wants it; cells are (x, y)."""
    integers = {"agent": agent, "objects": objects, "goal": goal, "num_delivered": num_delivered, "held": held, "step": step}
    return GridState(key=jax.random.key(seed), **{name: jnp.asarray(value, jnp.int32) for name, value in integers.items()})


def act(move, *, grab):
    """(5,) action that moves and sets the grab switch."""
    return jnp.zeros(5).at[move].set(1.0).at[4].set(float(grab))


@functools.partial(jax.jit, static_argnums=0)
def jitted_step(env, state, action):
    return env.step(state, action)


def play(env, state, *actions):
    """Takes all actions; returns the last state and the last time step."""
    for action in actions:
        state, time_step = jitted_step(env, state, action)
    return state, time_step


def cells(state):
    """Agent, objects and goal as tuples."""
    return tuple(state.agent.tolist()), [tuple(o) for o in state.objects.tolist()], tuple(state.goal.tolist())
