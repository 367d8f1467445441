"""Every option of training, as frozen dataclasses: hashable, passed whole, static under `jax.jit`.

`TrainConfig` holds the others. The line under each field is its documentation and its help text on the command line. The defaults are the project's
own recipe; the thesis's settings and the original code's are presets (`hindrl_jax.tasks.presets`).
"""

from hindrl_jax.config.agent import IMITATION_NET_ARCH, RESIDUAL_EXPANSION, AgentConfig
from hindrl_jax.config.batch import BatchConfig, Source, Strategy
from hindrl_jax.config.conditions import without_effect
from hindrl_jax.config.goal import GoalConfig
from hindrl_jax.config.quirks import QuirksConfig
from hindrl_jax.config.sweeps import SWEEPABLE, sweepable_value, with_traced_values, with_values
from hindrl_jax.config.train import Algorithm, TrainConfig

__all__ = [
    "AgentConfig",
    "Algorithm",
    "BatchConfig",
    "GoalConfig",
    "IMITATION_NET_ARCH",
    "QuirksConfig",
    "RESIDUAL_EXPANSION",
    "SWEEPABLE",
    "Source",
    "Strategy",
    "TrainConfig",
    "sweepable_value",
    "with_traced_values",
    "with_values",
    "without_effect",
]
