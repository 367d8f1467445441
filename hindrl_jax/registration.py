"""Our environments in Gymnasium's registry, as hindrl/NAME-v0. Imported with the package, so nothing but Gymnasium is imported here.

Gymnasium looks for no plug-ins; a package registers its environments when it is imported. `hindrl_jax.as_gymnasium` is what they lead to.
"""

from __future__ import annotations

import gymnasium

NAMESPACE = "hindrl"
MAX_EPISODE_STEPS = {
    "GridPickAndPlace": 100,
    "FixedGridPickAndPlace": 100,
    "ParameterizedReach": 300,
    "FixedParameterizedReach": 300,
}
"""The names of `hindrl_jax.registry.TASKS` and their horizons, written out, since reading them there would import JAX."""


def gymnasium_id(name: str) -> str:
    """The id of one of our environments, for `gymnasium.make`."""
    return f"{NAMESPACE}/{name}-v0"


def register() -> None:
    """Registers all environments; what is registered already stays."""
    for name, max_episode_steps in MAX_EPISODE_STEPS.items():
        if gymnasium_id(name) not in gymnasium.registry:
            gymnasium.register(
                id=gymnasium_id(name),
                entry_point="hindrl_jax.as_gymnasium:GoalEnv",
                vector_entry_point="hindrl_jax.as_gymnasium:GoalVectorEnv",
                max_episode_steps=max_episode_steps,
                kwargs={"name": name},
            )
