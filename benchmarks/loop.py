"""The project's own training loop, brought to where it learns: what most of the benchmark times."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

import hindrl_jax
from hindrl_jax.base.types import Array, Transition
from hindrl_jax.config import TrainConfig
from hindrl_jax.core import train as training
from hindrl_jax.core.batch import sample_batch
from hindrl_jax.core.guidance import Guidance, guidance
from hindrl_jax.core.train import TrainState
from hindrl_jax.training.devices import over_seeds, spread

_RUN_ONCE = {"xla_backend_optimization_level": 0}  # for a program whose compilation takes longer than its one run


class Loop:
    """Training on FixedGridPickAndPlace."""

    def __init__(self, config: TrainConfig, *, num_demonstrations: int = 1, num_seeds: int = 1, num_devices: int = 1, full: bool = False):
        """Steps the environments at random: as long as `hindrl_jax.fit` does before it learns, or until the replay is full.

        Args:
          config: of the run.
          num_demonstrations: the same for all seeds.
          num_seeds, num_devices: seeds side by side and how many devices share them, as in `fit`.
          full: fill the replay.
        """
        self.config = config
        self.num_seeds = num_seeds
        self._mesh = Mesh(np.asarray(jax.devices()[:num_devices]), ("seed",))
        self.env = hindrl_jax.make("FixedGridPickAndPlace")
        demonstrations = hindrl_jax.record_demonstrations(self.env, num_demonstrations)
        demonstrations = jax.tree.map(lambda leaf: np.stack([leaf] * num_seeds), jax.device_get(demonstrations))
        demonstrations, seeds = spread((demonstrations, np.arange(num_seeds, dtype=np.uint32)), self._mesh)
        key = jax.jit(over_seeds(jax.random.key, self._mesh))(seeds)
        self.data: Guidance = jax.jit(self._program(guidance))(demonstrations)
        self.state: TrainState = jax.jit(self._program(training.init)).lower(key, self.data).compile(_RUN_ONCE)(key, self.data)
        num_iterations = self.capacity // config.num_envs if full else training.warm_up_iterations(self.env, config)
        collect = jax.jit(self._program(training.collect, num_iterations=num_iterations), donate_argnums=0)
        self.state = jax.block_until_ready(collect(self.state, self.data))

    @property
    def capacity(self) -> int:
        """Transitions that the replay of one seed has room for."""
        return self.state.replay.episodes.rewards.size // self.num_seeds

    def learner(self, num_updates: int) -> Callable[[], None]:
        """Compiles `train.learn` for `num_updates` gradient steps, whole iterations of the loop; each call of the result goes on from the last."""
        num_iterations, rest = divmod(num_updates, self.config.num_updates)
        if rest:
            raise ValueError(f"{num_updates} gradient steps are no multiple of the {self.config.num_updates} of an iteration")
        learn = jax.jit(self._program(training.learn, num_iterations=num_iterations), donate_argnums=0).lower(self.state, self.data).compile()

        def call() -> None:
            self.state, metrics = learn(self.state, self.data)
            jax.block_until_ready((self.state, metrics))

        return call

    def _program(self, function: Callable[..., Any], **static: Any) -> Callable[..., Any]:
        return over_seeds(functools.partial(function, env=self.env, config=self.config, **static), self._mesh)


def whole_episodes(size: int, num_envs: int) -> int:
    """The nearest buffer size that is whole episodes of every environment, and two of each at least."""
    horizon = hindrl_jax.make("FixedGridPickAndPlace").horizon
    return max(2, round(size / (num_envs * horizon))) * num_envs * horizon


def first_seed(tree: Any) -> Any:
    """Leaves (S, ...) -> those of the first seed; inside a program this costs nothing."""
    return jax.tree.map(lambda leaf: leaf[0], tree)


def sampler(loop: Loop, config: TrainConfig, num_batches: int) -> Callable[[], Transition]:
    """Compiles the drawing of `num_batches` batches, one after the other, from the replay that the loop (of one seed) has at each call."""

    @jax.jit
    def draw(key: Array, state: TrainState, data: Guidance) -> Transition:
        state, data = first_seed((state, data))
        keys = jax.random.split(key, num_batches)
        return jax.lax.map(lambda key: sample_batch(key, state.replay, data, state.env_steps, loop.env, config), keys)

    key = jax.random.key(0)
    return lambda: jax.block_until_ready(draw(key, loop.state, loop.data))
