"""hindrl_jax: learning sparse-reward tasks from a handful of demonstrations, in pure functional JAX.

    import hindrl_jax as hindrl

    env = hindrl.make("FixedGridPickAndPlace")
    demonstrations = hindrl.record_demonstrations(env, num_demos=1)
    result = hindrl.fit(env, demonstrations, hindrl.preset("hindrl"), seeds=[0])
    print(result.final_success)

The algorithm is in `goals`, `relabel`, `replay`, `networks`, `losses`, `agent`, `rollout` and `train`: pure functions that know no task by name.
"""

from __future__ import annotations

import importlib
import time
from typing import Any

__version__ = "0.1.0"
STARTED = time.perf_counter()  # this package loads before the large ones it uses: `hindrl train` says how long its start took

# Loaded on first use: `envs` and `experts` import the core below this package, and the names here import `envs` and `experts`.
_EXPORTS = {
    "Checkpoints": "hindrl_jax.runs.checkpoints",
    "ProgressBar": "hindrl_jax.reporting.progress",
    "Result": "hindrl_jax.training.experiment",
    "TensorBoardReporter": "hindrl_jax.reporting.reporters",
    "UserError": "hindrl_jax.base.errors",
    "WandbReporter": "hindrl_jax.reporting.reporters",
    "fit": "hindrl_jax.training.experiment",
    "load_demonstrations": "hindrl_jax.demonstrations.hdf5",
    "load_run": "hindrl_jax.runs.reader",
    "make": "hindrl_jax.tasks.registry",
    "preset": "hindrl_jax.tasks.presets",
    "record_demonstrations": "hindrl_jax.training.experiment",
    "record_gymnasium": "hindrl_jax.training.host",
    "register": "hindrl_jax.tasks.registry",
    "save_demonstrations": "hindrl_jax.demonstrations.hdf5",
    "save_run": "hindrl_jax.runs.writer",
}

__all__ = ["__version__", *_EXPORTS]


importlib.import_module("hindrl_jax.tasks.ids").register()  # so that `gymnasium.make("hindrl/...")` finds our environments


def __getattr__(name: str) -> Any:
    if name in _EXPORTS:
        return getattr(importlib.import_module(_EXPORTS[name]), name)
    raise AttributeError(f"module 'hindrl_jax' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(set(globals()) | set(__all__))
