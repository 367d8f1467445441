"""An experiment small enough to be run as a whole, again and again."""

import hindrl_jax as hindrl
from hindrl_jax.config import AgentConfig, BatchConfig, TrainConfig

ENV = hindrl.make("FixedGridPickAndPlace", size=4, random_box_size=1, horizon=20)
CONFIG = TrainConfig(
    steps=60,
    num_envs=2,
    updates_per_iteration=1,
    learning_starts=40,
    buffer_size=200,
    eval_every=20,
    eval_episodes=4,
    batch=BatchConfig(batch_size=8, n_step=2),
    agent=AgentConfig(net_arch=(4,), num_quantiles=3, top_quantiles_to_drop_per_net=1),
)
