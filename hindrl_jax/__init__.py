"""hindrl_jax: learning sparse-reward tasks from a handful of demonstrations, in pure functional JAX.

    import hindrl_jax as hindrl

    env = hindrl.make("FixedGridPickAndPlace")
    demonstrations = hindrl.record_demonstrations(env, num_demos=1)
    result = hindrl.fit(env, demonstrations, hindrl.preset("hindrl"), seeds=[0])
    print(result.returned.success)

The algorithm is in `hindrl_jax.core`: pure functions that know no task by name. Everything in `__all__` is public.
"""

from __future__ import annotations

import importlib
import time
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"
STARTED = time.perf_counter()  # this package loads before the large ones it uses: `hindrl train` says how long its start took

# Loaded on first use, since most of them load JAX. A test holds this table and the imports below it together.
_EXPORTS = {
    "Checkpoints": "hindrl_jax.runs.checkpoints",
    "ProgressBar": "hindrl_jax.training.progress",
    "Result": "hindrl_jax.training.result",
    "TensorBoardReporter": "hindrl_jax.reporting.reporters",
    "TimeStep": "hindrl_jax.base.types",
    "UserError": "hindrl_jax.base.errors",
    "WandbReporter": "hindrl_jax.reporting.reporters",
    "check_environment": "hindrl_jax.tasks.checking",
    "fit": "hindrl_jax.training.experiment",
    "load_demonstrations": "hindrl_jax.demonstrations.hdf5",
    "load_run": "hindrl_jax.runs.reader",
    "make": "hindrl_jax.tasks.registry",
    "preset": "hindrl_jax.tasks.presets",
    "record_demonstrations": "hindrl_jax.training.recording",
    "record_gymnasium": "hindrl_jax.training.recording",
    "register": "hindrl_jax.tasks.registry",
    "save_demonstrations": "hindrl_jax.demonstrations.hdf5",
    "save_run": "hindrl_jax.runs.writer",
}

__all__ = ["__version__", *_EXPORTS]


if TYPE_CHECKING:
    from hindrl_jax.base.errors import UserError as UserError
    from hindrl_jax.base.types import TimeStep as TimeStep
    from hindrl_jax.demonstrations.hdf5 import load_demonstrations as load_demonstrations
    from hindrl_jax.demonstrations.hdf5 import save_demonstrations as save_demonstrations
    from hindrl_jax.reporting.reporters import TensorBoardReporter as TensorBoardReporter
    from hindrl_jax.reporting.reporters import WandbReporter as WandbReporter
    from hindrl_jax.runs.checkpoints import Checkpoints as Checkpoints
    from hindrl_jax.runs.reader import load_run as load_run
    from hindrl_jax.runs.writer import save_run as save_run
    from hindrl_jax.tasks.checking import check_environment as check_environment
    from hindrl_jax.tasks.presets import preset as preset
    from hindrl_jax.tasks.registry import make as make
    from hindrl_jax.tasks.registry import register as register
    from hindrl_jax.training.experiment import fit as fit
    from hindrl_jax.training.progress import ProgressBar as ProgressBar
    from hindrl_jax.training.recording import record_demonstrations as record_demonstrations
    from hindrl_jax.training.recording import record_gymnasium as record_gymnasium
    from hindrl_jax.training.result import Result as Result
else:  # a type checker that saw this would believe in every name

    def __getattr__(name: str) -> Any:
        if name in _EXPORTS:
            return getattr(importlib.import_module(_EXPORTS[name]), name)
        raise AttributeError(f"module 'hindrl_jax' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(set(globals()) | set(__all__))


importlib.import_module("hindrl_jax.tasks.ids").register()  # so that `gymnasium.make("hindrl/...")` finds our environments
