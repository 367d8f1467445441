"""The scripted, human-like expert of the grid worlds (thesis section 4.2.1): exact when it grabs, noisy when it moves.

Differences from the thesis: none by default. The original code moves at random on the step that releases a delivered object;
`random_move_on_release=True` gives that, and with it the original's episode lengths.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from hindrl_jax.base.checks import check_types
from hindrl_jax.base.types import Array
from hindrl_jax.envs.grid import GridState, GridTask


@dataclass(frozen=True)
class GridExpert:
    """Fetches the objects in order. Unbatched and pure: apply `jax.vmap` over keys and states."""

    random_action_probability: float = 0.2
    """Probability of replacing the movement by a uniformly random one; grabbing is always exact."""
    random_move_on_release: bool = False
    """Move at random, instead of towards the next object, on the step that releases a delivered object (the original code)."""

    def __post_init__(self):
        check_types(self)
        if not 0.0 <= self.random_action_probability <= 1.0:
            raise ValueError(f"random_action_probability must be in [0, 1], got {self.random_action_probability}.")

    def act(self, key: Array, env: GridTask, state: GridState) -> Array:
        """Chooses an action from the state.

        The movement is uniform over those that bring the agent closer to its target: the next object, or the goal while that object is held or
        about to be grabbed. Having carried an object to the goal, the expert releases it and heads for the following one. An object that is
        held out of order is released with a random movement.

        Args:
          key: random key.
          env: the environment that `state` belongs to.
          state: unbatched state.

        Returns:
          (5,) float32 action in the environment's own units [0, 1]: one-hot movement and the grab switch.
        """
        wanted = state.num_delivered
        holds_wanted = state.held == wanted
        finds_wanted = (state.held < 0) & jnp.all(state.agent == _object(env, state, wanted))
        delivers = holds_wanted & jnp.all(state.agent == state.goal) & (wanted < env.num_objects - 1)
        drops_wrong = (state.held >= 0) & ~holds_wanted
        grab = (holds_wanted | finds_wanted) & ~delivers

        target = jnp.where(grab, state.goal, _object(env, state, wanted + delivers))
        offset = target - state.agent
        closer = jnp.concatenate([offset > 0, offset < 0])  # movements +x, +y, -x, -y

        noise = jax.random.uniform(key, (5,))
        at_random = (noise[4] < self.random_action_probability) | drops_wrong | ~jnp.any(closer)
        if self.random_move_on_release:
            at_random = at_random | delivers
        movement = jnp.argmax(jnp.where(closer | at_random, noise[:4], -1.0))
        return jnp.append(jax.nn.one_hot(movement, 4), grab.astype(jnp.float32))


def _object(env: GridTask, state: GridState, index: Array) -> Array:
    """(2,) int32 cell of object `index`; elementwise, because gathers are slow under `jax.vmap`."""
    chosen = jnp.arange(env.num_objects) == index
    return jnp.sum(jnp.where(chosen[:, None], state.objects, 0), axis=0, dtype=jnp.int32)
