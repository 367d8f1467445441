"""The three sizes at which gradient steps are compared."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp

import hindrl_jax
from hindrl_jax.config import TrainConfig
from hindrl_jax.core.inputs import InputScale, network_inputs


@dataclasses.dataclass(frozen=True)
class Setting:
    """One size of batch and networks."""

    config: TrainConfig
    """What hindrl_jax trains with; the peers take their sizes from it."""
    steps_per_call: int
    """Gradient steps of hindrl_jax in one call of its compiled loop."""
    description: str

    def dims(self) -> dict[str, int]:
        """Sizes of the networks' inputs: `input_dim`, all but the action, and `action_dim`."""
        env = hindrl_jax.make("FixedGridPickAndPlace")
        observation, goal = jnp.ones(env.observation_dim), jnp.ones(env.goal_dim)
        scale = InputScale(observation=observation, goal=goal, observation_centre=observation, goal_centre=goal)
        return {"input_dim": network_inputs(observation, goal, goal, scale, self.config).shape[-1], "action_dim": env.action_dim}


def _reach() -> TrainConfig:
    """The thesis's networks and batch for the robot task; the environment and with it the inputs are still the grid's."""
    config = hindrl_jax.preset("hindrl", "thesis")
    return dataclasses.replace(
        config,
        batch=dataclasses.replace(config.batch, batch_size=12_000),
        agent=dataclasses.replace(config.agent, net_arch=(32,) * 8, top_quantiles_to_drop_per_net=8),
    )


SETTINGS = {
    "grid": Setting(
        hindrl_jax.preset("hindrl", "thesis"), 10, "the thesis's settings for the grid: batch 4096, four layers of 64, 2 quantiles dropped"
    ),
    "reach": Setting(_reach(), 10, "the thesis's sizes for reaching, on the grid's inputs: batch 12000, eight layers of 32, 8 quantiles dropped"),
    "default": Setting(hindrl_jax.preset("hindrl", "default"), 100, "the project's own recipe: batch 256, four layers of 64, 2 quantiles dropped"),
}
