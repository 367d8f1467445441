"""The scripted policies of the package `metaworld`, one for each of its tasks, as an expert of `gymnasium:metaworld:Meta-World/MT1`."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from hindrl_jax.base.checks import check, check_types
from hindrl_jax.base.errors import UserError
from hindrl_jax.base.extras import require


@dataclass(frozen=True)
class MetaWorldExpert:
    """The policy that belongs to the environment's `env_name`, with noise."""

    noise: float = 0.1
    """Standard deviation of the noise on each entry of an action, which lies in [-1, 1]."""

    def __post_init__(self) -> None:
        check_types(self)
        check(self, noise=(self.noise >= 0.0, "0 or more"))

    @classmethod
    def plays(cls, env_id: str) -> bool:
        """Whether it is an expert of the environment that Gymnasium knows by that id."""
        return env_id == "Meta-World/MT1"

    def acting_in(self, env: Any) -> Callable[[np.ndarray, np.random.Generator], np.ndarray]:
        """The policy of an environment (`tasks.from_gymnasium.GymnasiumEnv`): (observation (39,), randomness) -> action (4,).

        Raises:
          UserError: if metaworld is not installed, or has no policy of the environment's `env_name`.
        """
        policies = require("metaworld.policies", "give demonstrations from a file").policies.ENV_POLICY_MAP
        name = env.arguments.get("env_name")
        if name not in policies:
            raise UserError(f"metaworld has no scripted policy of env_name = {name!r}: choose one of {', '.join(sorted(policies))}")
        policy = policies[name]()

        def act(observation: np.ndarray, rng: np.random.Generator) -> np.ndarray:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # it warns of commands above 1, which are clipped here, too
                action = np.clip(policy.get_action(observation), -1.0, 1.0)
            return np.clip(action + self.noise * rng.standard_normal(action.shape), -1.0, 1.0).astype(np.float32)

        return act
