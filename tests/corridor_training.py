"""Training on the toy corridor, at a size for tests."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from toy_env import Corridor, corridor_demonstrations

from hindrl_jax.config import AgentConfig, BatchConfig, GoalConfig, TrainConfig
from hindrl_jax.core.guidance import guidance

NUM_ENVS, HORIZON, COLLECT_STEPS, LEARN_STEPS = 3, 7, 14, 3
SPEEDS = (1.0, 1.25, 0.9)  # of the demonstrations, which so have 5, 4 and 5 steps


def make_env():
    return Corridor(horizon=HORIZON, width=4.0)


def make_config(**changes):
    """Relabels from both sources. The last of the 4 demonstration rows goes at step 50, within the first call of `learn`: 4 (1 - 50 / 66) < 1."""
    config = TrainConfig(
        num_envs=NUM_ENVS,
        updates_per_iteration=2,
        learning_starts=NUM_ENVS * HORIZON,
        buffer_size=30_000,
        steps=102,
        batch=BatchConfig(batch_size=16, max_demo_ratio=0.25, hindrl_sampling_strategy="joint_union", reach_zero=66),
        goal=GoalConfig(epsilon_steps=1, epsilon_deviations=1.0, epsilon_filtering=True),
        agent=AgentConfig(
            net_arch=(8,),
            layer_norm=False,
            num_quantiles=5,
            top_quantiles_to_drop_per_net=1,
            target_entropy=-500.0,
            final_target_entropy=500.0,
        ),
    )
    return dataclasses.replace(config, **changes)


def make_data(config, speeds=SPEEDS):
    """What training with this config takes from demonstrations that walk at these speeds."""
    return guidance(corridor_demonstrations(speeds, env=make_env()), make_env(), config)


def with_output_bias(state, bias):
    """The state with an actor that has the same (mean, log_std) everywhere, whatever it sees."""
    last = state.agent.actor["params"]["Dense_1"]
    last = {"kernel": jnp.zeros_like(last["kernel"]), "bias": jnp.array(bias)}
    actor = {"params": {**state.agent.actor["params"], "Dense_1": last}}
    return state.replace(agent=state.agent.replace(actor=actor))


def recorded_episodes(replay):
    """(row, length, episode) of the complete episodes that a replay still holds whole, oldest first in each environment."""
    episodes = jax.device_get(replay.episodes)
    for row in np.flatnonzero(episodes.lengths):
        yield row, int(episodes.lengths[row]), jax.tree.map(lambda leaf, row=row: leaf[row], episodes)
