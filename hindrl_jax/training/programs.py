"""The compiled programs of an experiment: start, imitate, practise, collect, learn, evaluate; each for all its runs at once.

`Programs` is what they have in common. `JaxPrograms` hold the whole loop, environments included; `host.HostPrograms` are the pieces between which
environments are stepped outside JAX.
"""

from __future__ import annotations

import abc
import contextlib
import functools
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import jax
import numpy as np

from hindrl_jax.base.environments import Environment, Steppable, compiler_options
from hindrl_jax.base.errors import UserError
from hindrl_jax.base.types import Array, Episodes
from hindrl_jax.config import TrainConfig, sweepable_value, with_traced_values
from hindrl_jax.core import imitation
from hindrl_jax.core import train as training
from hindrl_jax.core.agent import Metrics, Params, Policy, policy
from hindrl_jax.core.guidance import Guidance
from hindrl_jax.core.guidance import guidance as guidance_of
from hindrl_jax.core.imitation import Attempts, Practice
from hindrl_jax.core.rollout import Evaluation, RolloutState
from hindrl_jax.core.train import TrainState
from hindrl_jax.training.checks import steps_to_learn, swept_fields
from hindrl_jax.training.devices import free_memory, over_seeds, seed_mesh, shapes_on, spread, tree_bytes

FRESH_EPISODES = 100
"""Episodes of the evaluation of a finished run."""
CHUNKS_PER_EVALUATION = 10
Values = dict[str, Array]
"""The swept fields of the config, and their values: of one run, or (S,)."""
Compile = Callable[..., Future[Any]]
_RUN_ONCE = {"xla_backend_optimization_level": 0}  # for programs whose compilation takes longer than their one run


class Programs(abc.ABC):
    """The programs of an experiment. What they take and return has leaves (S, ...), S runs.

    A config may have swept fields, in which its runs differ; the programs hold the values.
    """

    env: Environment
    config: TrainConfig
    chunk: int
    """Iterations of `learn`."""
    steps_at_random: int
    """Environment steps of `collect`."""
    shapes: dict[str, Any]
    """Of guidance, state and key, as `start` returns them."""

    def __init__(self, env: Environment, configs: Sequence[TrainConfig], demonstrations: Episodes):
        """Compiles everything.

        Args:
          env: the task.
          configs: (S,) of the runs, which differ only in swept fields.
          demonstrations: leaves (S, ...).

        Raises:
          UserError: if the experiment does not fit into the memory, or asks for what cannot be had.
        """
        self.env, self.config, num_seeds = env, configs[0], len(configs)
        self.warm_up, self.chunk = extent(env, self.config)
        self.steps_at_random = self.warm_up * self.config.steps_per_iteration
        self.mesh = seed_mesh(num_seeds)
        values = {name: np.asarray([sweepable_value(config, name) for config in configs], np.float32) for name in swept_fields(configs)}
        self._compile(shapes_on((jax.ShapeDtypeStruct((num_seeds,), np.uint32), demonstrations), self.mesh), shapes_on(values, self.mesh))
        self.values: Values = spread(values, self.mesh)
        self._reset: Any = None

    @abc.abstractmethod
    def _compile(self, given: tuple[Any, Any], values: Any) -> None:
        """Compiles everything from shapes: those of seeds and demonstrations, and of the swept values."""

    @abc.abstractmethod
    def start(self, seeds: Array, demonstrations: Episodes) -> tuple[Guidance, TrainState, Array]:
        """What the runs begin with: guidance, state, and the keys of their evaluations."""

    @abc.abstractmethod
    def collect(self, state: TrainState, guidance: Guidance) -> TrainState:
        """Fills the replay by random actions; the state is donated."""

    @abc.abstractmethod
    def imitate(self, state: TrainState, guidance: Guidance, practice: Practice) -> tuple[TrainState, list[Params]]:
        """Clones a second policy, see `core.imitation.imitate`; the state is donated."""

    @abc.abstractmethod
    def practise(self, state: TrainState, guidance: Guidance, practice: Practice) -> tuple[Practice, Attempts]:
        """Lets that policy play, see `core.imitation.practise`."""

    def no_practice(self, num_rounds: int = 0) -> Practice:
        """What a round of practice begins with: no episodes, and the number of rounds so far, on which its random numbers depend."""
        of_one_run = jax.device_get(imitation.no_practice(self.env)).replace(num_rounds=np.int32(num_rounds))
        return spread(jax.tree.map(lambda leaf, shape: np.broadcast_to(leaf, shape.shape), of_one_run, self._practice), self.mesh)

    @abc.abstractmethod
    def learn(self, state: TrainState, guidance: Guidance) -> tuple[TrainState, Metrics]:
        """`chunk` iterations of learning, from rollouts or, for behaviour cloning, from demonstrations alone; the state is donated."""

    def compile_reset(self, state: TrainState) -> None:
        """Compiles what `reset_networks` needs, if that is not done: not at the beginning with all else, as most runs never need it."""
        if self._reset is None:
            is_stuck = spread(np.zeros(len(state.env_steps), bool), self.mesh)
            with self._compiler() as compile_:
                self._reset = compile_(self._trace(training.reset_networks, state, is_stuck, self.values, donate=True)).result()

    def reset_networks(self, state: TrainState, is_stuck: np.ndarray) -> TrainState:
        """A fresh agent in the place of each that `is_stuck`, (S,) bool, after `compile_reset`; the state is donated."""
        return self._reset(state, spread(is_stuck, self.mesh), self.values)

    @abc.abstractmethod
    def evaluate(self, key: Array, policy: Policy, guidance: Guidance, num_episodes: int) -> tuple[Array, Evaluation]:
        """Plays fresh episodes: `eval_episodes` of the config, or `FRESH_EPISODES`. Returns the keys of later ones, too."""

    def close(self) -> None:  # noqa: B027, there is nothing to end where JAX steps the environments
        """Closes the environments."""

    @contextlib.contextmanager
    def _compiler(self) -> Iterator[Compile]:
        """A function compile(traced, learns, options) that hands a program to a thread, which compiles it while the next one is being traced.

        `learns` says that it is what a run spends most of its gradient steps in.
        """
        with ThreadPoolExecutor() as pool:

            def compile_(traced: Any, *, learns: bool = False, **options: Any) -> Future[Any]:
                return pool.submit(traced.lower().compile, compiler_options(self.env, learns=learns) | options)

            yield compile_

    def _trace(self, function: Callable[..., Any], *shapes: Any, donate: bool = False, **static: Any) -> Any:
        """A function of one run, traced for all of them. The last shapes are those of the swept values, which it finds in its config."""
        env, config = self.env, self.config

        def of_one_run(*given: Any) -> Any:
            *arguments, values = given
            return function(*arguments, env=env, config=with_traced_values(config, values), **static)

        return jax.jit(over_seeds(of_one_run, self.mesh), donate_argnums=0 if donate else ()).trace(*shapes)

    def _trace_imitation(self, state: Any, guidance: Any, values: Any) -> dict[str, Any]:
        """The traced programs of the imitating policy that take place in JAX, whatever steps the environment."""
        of_one_run = jax.eval_shape(functools.partial(imitation.no_practice, self.env))
        num_runs = state.env_steps.shape[0]
        self._practice = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((num_runs, *leaf.shape), leaf.dtype), of_one_run)
        return {"imitate": self._trace(imitation.imitate, state, guidance, shapes_on(self._practice, self.mesh), values, donate=True)}

    def _trace_start(self, function: Callable[..., Any], *shapes: Any) -> tuple[Any, Any, Any, Any]:
        """The traced start, and the shapes of guidance, state and key, which fit into the memory.

        Raises:
          UserError: if they do not.
        """
        traced = self._trace(function, *shapes)
        guidance, state, key = shapes_on(traced.out_info, self.mesh)
        self.shapes = {"guidance": guidance, "state": state, "key": key}
        self._check_fits_into_memory(state)
        return traced, guidance, state, key

    def _check_fits_into_memory(self, state: Any) -> None:
        """Compares the size of the state, nearly all of it replay, with the memory there is, before any of it is taken."""
        needed, free = tree_bytes(state) / jax.process_count(), free_memory(self.mesh)
        if free is not None and needed > free:
            raise UserError(
                f"{state.env_steps.shape[0]} runs side by side take {needed / 2**30:,.1f} GiB of memory, "
                f"{tree_bytes(state.replay) / tree_bytes(state):.0%} of it for the replay, and {free / 2**30:,.1f} GiB are free: lower buffer_size "
                "or the number of seeds"
            )


class JaxPrograms(Programs):
    """The programs of an experiment whose environments are stepped in JAX."""

    env: Steppable

    def _compile(self, given: tuple[Any, Any], values: Any) -> None:
        config = self.config
        with self._compiler() as compile_:
            starting, guidance, state, key = self._trace_start(start, *given, None, values)
            actor, rest = policy(state.agent, config, average=True), (guidance, values)
            function = training.learn if config.learns_from_rollouts else training.clone
            pending = {"learn": compile_(self._trace(function, state, *rest, donate=True, num_iterations=self.chunk), learns=True)}
            pending["start"] = compile_(starting, **_RUN_ONCE)
            for num_episodes in {config.eval_episodes, FRESH_EPISODES}:
                pending[f"evaluate {num_episodes}"] = compile_(self._trace(evaluate, key, actor, *rest, num_episodes=num_episodes))
            if config.learns_from_rollouts:
                pending["collect"] = compile_(self._trace(training.collect, state, *rest, donate=True, num_iterations=self.warm_up), **_RUN_ONCE)
            if config.imitation_steps > 0:
                traced = self._trace_imitation(state, *rest)
                if config.practice_rounds > 0:
                    traced["practise"] = self._trace(imitation.practise, state, guidance, shapes_on(self._practice, self.mesh), values)
                pending |= {name: compile_(program) for name, program in traced.items()}
            self._programs = {name: program.result() for name, program in pending.items()}

    def start(self, seeds: Array, demonstrations: Episodes) -> tuple[Guidance, TrainState, Array]:
        return self._programs["start"](seeds, demonstrations, None, self.values)

    def collect(self, state: TrainState, guidance: Guidance) -> TrainState:
        return self._programs["collect"](state, guidance, self.values)

    def imitate(self, state: TrainState, guidance: Guidance, practice: Practice) -> tuple[TrainState, list[Params]]:
        return self._programs["imitate"](state, guidance, practice, self.values)

    def practise(self, state: TrainState, guidance: Guidance, practice: Practice) -> tuple[Practice, Attempts]:
        return self._programs["practise"](state, guidance, practice, self.values)

    def learn(self, state: TrainState, guidance: Guidance) -> tuple[TrainState, Metrics]:
        return self._programs["learn"](state, guidance, self.values)

    def evaluate(self, key: Array, policy: Policy, guidance: Guidance, num_episodes: int) -> tuple[Array, Evaluation]:
        return self._programs[f"evaluate {num_episodes}"](key, policy, guidance, self.values)


def extent(env: Environment, config: TrainConfig) -> tuple[int, int]:
    """Random iterations at the start, and iterations of a chunk: a tenth of the steps between evaluations, at most what is left to learn, at least 1.

    Raises:
      UserError: if nothing is left to learn in.
    """
    warm_up, per_iteration = (training.warm_up_iterations(env, config), config.steps_per_iteration) if config.learns_from_rollouts else (0, 1)
    return warm_up, max(1, min(config.eval_every // CHUNKS_PER_EVALUATION, steps_to_learn(env, config)) // per_iteration)


# ------------------------------------------------------------------------------------------------------------------- what they do for one run


def start(
    seed: Array, demonstrations: Episodes, begun: RolloutState | None, *, env: Environment, config: TrainConfig
) -> tuple[Guidance, TrainState, Array]:
    """Guidance, state, and the key of evaluations; `begun` are the first episodes where they have begun outside JAX."""
    key_init, key_evaluate = jax.random.split(jax.random.key(seed))
    guidance = guidance_of(demonstrations, env, config)
    return guidance, training.init(key_init, guidance, env, config, begun=begun), key_evaluate


def evaluate(key: Array, policy: Policy, guidance: Guidance, *, env: Steppable, config: TrainConfig, num_episodes: int) -> tuple[Array, Evaluation]:
    """Fresh episodes with the policy's own noise, and the key of later ones."""
    key, key_play = jax.random.split(key)
    return key, training.evaluate(key_play, policy, guidance, env=env, config=config, num_episodes=num_episodes)
