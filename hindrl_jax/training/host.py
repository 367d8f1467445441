"""Learning in environments that are stepped outside JAX: decide, step, remember, improve.

The programs are the pieces of `hindrl_jax.core.train`, compiled and mapped over the seeds; the loop between them is here. Only one thing differs from
`train.learn`: the gradient steps of an iteration are under way while the environments take their step, so they do not see that step yet. They would
hardly use it, since only complete episodes are learned from.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from hindrl_jax.base.environments import Environment, action_to_env
from hindrl_jax.base.errors import UserError
from hindrl_jax.base.steppers import HostStepped, Outcome, Stepper
from hindrl_jax.base.types import Array, Episodes, TimeStep
from hindrl_jax.config import TrainConfig
from hindrl_jax.core import train as training
from hindrl_jax.core.agent import Metrics, Params, Policy, policy
from hindrl_jax.core.goals import sample_goals
from hindrl_jax.core.guidance import Guidance
from hindrl_jax.core.imitation import NOISES, NUM_STARTS, Attempts, Practice, with_attempt
from hindrl_jax.core.rollout import Evaluation, RolloutState
from hindrl_jax.core.train import TrainState
from hindrl_jax.training.devices import by_seed, shapes_on
from hindrl_jax.training.host_playing import HostPolicies, evaluate, record, with_goals_of, with_noise
from hindrl_jax.training.programs import Programs, start


@struct.dataclass(kw_only=True)
class Plan:
    """What E environments are to do next, and the keys for what follows."""

    action: Array  # (E, A) in [-1, 1]
    env_action: Array  # (E, A) in the environment's own units
    key_goals: Array
    key_nearby: Array
    key_batch: Array
    key_updates: Array


class HostPrograms(Programs):
    """The programs of an experiment, and the environments that go with them: E for each of S runs."""

    env: HostStepped

    def __init__(self, env: HostStepped, configs: Sequence[TrainConfig], demonstrations: Episodes):
        """Compiles all programs, then starts the environments, which `close` ends.

        Args:
          env, configs, demonstrations: as for `Programs`.

        Raises:
          UserError: as there, and if there are several hosts.
        """
        if jax.process_count() > 1:
            raise UserError(f"{env.name} is stepped by one host only: drop --distributed")
        self._shape = (len(configs), configs[0].num_envs)
        super().__init__(env, configs, demonstrations)
        self._policies = HostPolicies(env, self.config, self.mesh)
        num_envs = self._shape[0] * self._shape[1]
        self._fresh = env.stepper(num_envs)  # for evaluations
        self.stepper: Stepper | None = env.stepper(num_envs) if self.config.learns_from_rollouts else None
        self._begun = False  # whether the state's episodes are those of `stepper`

    def close(self) -> None:
        for stepper in (self._fresh, self.stepper):
            if stepper is not None:
                stepper.close()

    def _compile(self, given: tuple[Any, Any], values: Any) -> None:
        env, config = self.env, self.config
        begun = shapes_on(self._nowhere(), self.mesh)
        with self._compiler() as compile_:
            starting, guidance, state, _ = self._trace_start(begin, *given, begun, values)
            rest = (guidance, values)
            pending = {"start": compile_(starting)}
            if not config.learns_from_rollouts:
                pending["clone"] = compile_(self._trace(training.clone, state, *rest, donate=True, num_iterations=self.chunk), learns=True)
            else:
                planning = (state.key, policy(state.agent, config, average=False), state.rollout, values)
                deciding = self._trace(decide, *planning, at_random=False)
                _, plan = shapes_on(deciding.out_info, self.mesh)
                step = shapes_on(_time_step_shapes(self._shape, env.observation_dim), self.mesh)
                pending["improve"] = compile_(self._trace(improve, state, plan, *rest, donate=True), learns=True)
                pending["remember"] = compile_(self._trace(remember, state, plan, (step, begun), *rest, donate=True))
                pending["decide"] = compile_(deciding)
                pending["decide_at_random"] = compile_(self._trace(decide, *planning, at_random=True))
            if config.imitation_steps > 0:
                pending |= {name: compile_(program) for name, program in self._trace_imitation(state, *rest).items()}
            self._programs = {name: program.result() for name, program in pending.items()}

    def start(self, seeds: Array, demonstrations: Episodes) -> tuple[Guidance, TrainState, Array]:
        begun = self._nowhere()
        if self.stepper is not None:
            seeds_of_each = [np.random.SeedSequence(int(seed)).generate_state(self._shape[1]) for seed in np.asarray(seeds)]
            begun = self._begin(np.concatenate(seeds_of_each))
        return self._programs["start"](seeds, demonstrations, self._put(begun), self.values)

    def collect(self, state: TrainState, guidance: Guidance) -> TrainState:
        if not self._begun:
            state = self._with_new_episodes(state, guidance)
        for _ in range(self.warm_up):
            state, plan = self._planned(state, at_random=True)
            state = self._stepped(state, plan, guidance)
        return state

    def imitate(self, state: TrainState, guidance: Guidance, practice: Practice) -> tuple[TrainState, list[Params]]:
        return self._programs["imitate"](state, guidance, practice, self.values)

    def practise(self, state: TrainState, guidance: Guidance, practice: Practice) -> tuple[Practice, Attempts]:
        """As `core.imitation.practise`, a few starts after the other: as many as there are environments for each run."""
        num_envs = self._shape[1]
        stepper = with_goals_of(self._fresh, self.env, guidance.behavioural_goals)
        imitating, key = policy(state.agent, self.config, average=True, imitates=True), _practice_keys(state.key, practice.num_rounds)
        batches: list[list[Episodes]] = []
        for _ in range(-(-NUM_STARTS // num_envs)):
            key, key_seeds, key_act = jnp.moveaxis(jax.vmap(functools.partial(jax.random.split, num=3))(key), 1, 0)
            seeds = np.asarray(jax.vmap(lambda key: jax.random.bits(key, (num_envs,)))(key_seeds))
            act = self._policies.acting(key_act, imitating)
            of_batch: list[Episodes] = []
            for attempt, noise in enumerate(NOISES, start=1):  # which makes these numbers other ones than those of goals
                generators = [np.random.default_rng([attempt, *of_run]) for of_run in seeds]
                of_batch.append(self._by_seed(record(stepper, self.env, seeds.reshape(-1), with_noise(act, self.env, noise, generators))))
            batches.append(of_batch)
        best, of_each = jax.device_get(self.no_practice()).replace(num_rounds=np.asarray(practice.num_rounds) + 1), []
        for index in range(len(NOISES)):
            of_attempt = [batch[index] for batch in batches]
            episodes = jax.tree.map(lambda *leaves: np.concatenate(leaves, axis=1)[:, :NUM_STARTS], *of_attempt)
            best, attempts = jax.vmap(with_attempt)(best, episodes)
            of_each.append(attempts)
        return self._put(best), jax.tree.map(lambda *leaves: np.stack(leaves, axis=1), *of_each)

    def learn(self, state: TrainState, guidance: Guidance) -> tuple[TrainState, Metrics]:
        if self.stepper is None:
            return self._programs["clone"](state, guidance, self.values)
        if not self._begun:
            state = self._with_new_episodes(state, guidance)
        of_each = []
        for _ in range(self.chunk):
            state, plan = self._planned(state, at_random=False)
            state, metrics = self._programs["improve"](state, plan, guidance, self.values)  # comes back at once; computes while environments step
            state = self._stepped(state, plan, guidance)
            of_each.append(metrics)
        return state, jax.tree.map(lambda *values: np.mean(values, axis=0), *jax.device_get(of_each))

    def evaluate(self, key: Array, policy: Policy, guidance: Guidance, num_episodes: int) -> tuple[Array, Evaluation]:
        both = jax.vmap(jax.random.split)(key)
        stepper = with_goals_of(self._fresh, self.env, guidance.behavioural_goals)
        return both[:, 0], evaluate(both[:, 1], stepper, self._policies, policy, num_episodes)

    def _planned(self, state: TrainState, *, at_random: bool) -> tuple[TrainState, Plan]:
        explorer = policy(state.agent, self.config, average=False)
        key, plan = self._programs["decide_at_random" if at_random else "decide"](state.key, explorer, state.rollout, self.values)
        return state.replace(key=key), plan

    def _stepped(self, state: TrainState, plan: Plan, guidance: Guidance) -> TrainState:
        """Takes the planned step in all environments and remembers it."""
        outcome = self.stepper.step(np.asarray(plan.env_action).reshape(-1, self.env.action_dim))
        return self._programs["remember"](state, plan, self._put(self._taken(outcome)), guidance, self.values)

    def _taken(self, outcome: Outcome) -> tuple[TimeStep, RolloutState]:
        """The step that an outcome tells of, and where the environments are now; leaves (S, E, ...)."""
        step = dict(
            observation=outcome.next_observation,
            reward=outcome.success.astype(np.float32),
            terminated=outcome.terminated,
            truncated=outcome.truncated,
        )
        return TimeStep(**self._by_seed(step)), _episodes(*self._by_seed((outcome.observation, outcome.desired_goal)))

    def _nowhere(self) -> RolloutState:
        """In the place of episodes that have not begun."""
        goal = np.zeros((*self._shape, self.env.goal_dim), np.float32) if self.env.gives_goals else None
        return _episodes(np.zeros((*self._shape, self.env.observation_dim), np.float32), goal)

    def _begin(self, seeds: np.ndarray) -> RolloutState:
        """Begins an episode in each environment: seeds (S * E,) -> leaves (S, E, ...)."""
        self._begun = True
        return _episodes(*self._by_seed(self.stepper.begin(seeds)))

    def _with_new_episodes(self, state: TrainState, guidance: Guidance) -> TrainState:
        """The state of a run that goes on from a checkpoint, where nobody knows how its environments stood: their episodes are lost."""
        keys = jax.vmap(functools.partial(jax.random.fold_in, data=7))(state.key)  # 7, and 6 below: `decide` splits this key in six
        seeds = np.asarray(jax.vmap(lambda key: jax.random.bits(key, self._shape[1:]))(keys))
        begun = self._begin(seeds.reshape(-1))
        if begun.desired_goal is None:
            key_goals = jax.vmap(functools.partial(jax.random.fold_in, data=6))(state.key)
            begun = jax.vmap(with_goals)(key_goals, begun, guidance)
        return self._put(state.replace(replay=state.replay.replace(step=jnp.zeros_like(state.replay.step)), rollout=begun))

    def _by_seed(self, arrays: Any) -> Any:
        """(S * E, ...) -> (S, E, ...)"""
        return jax.tree.map(lambda array: array.reshape(*self._shape, *array.shape[1:]), arrays)

    def _put(self, tree: Any) -> Any:
        return jax.device_put(tree, by_seed(self.mesh))


def _episodes(observation: Any, desired_goal: Any) -> RolloutState:
    return RolloutState(env_state=(), observation=observation, desired_goal=desired_goal)


def _practice_keys(key: Array, rounds: Array) -> Array:
    """(S,) keys of a round of practice, from the runs' own ones."""
    return jax.vmap(lambda key, count: jax.random.fold_in(jax.random.fold_in(key, 8), count))(key, rounds)  # 8: see `_with_new_episodes`


def _time_step_shapes(shape: tuple[int, ...], observation_dim: int) -> TimeStep:
    number, flag = jax.ShapeDtypeStruct(shape, np.float32), jax.ShapeDtypeStruct(shape, bool)
    return TimeStep(observation=jax.ShapeDtypeStruct((*shape, observation_dim), np.float32), reward=number, terminated=flag, truncated=flag)


# ------------------------------------------------------------------------------------------------------------------- what they do for one run


def begin(seed: Array, demonstrations: Episodes, begun: RolloutState, *, env: Environment, config: TrainConfig) -> tuple[Guidance, TrainState, Array]:
    """As `programs.start`, with the first episodes, which have begun outside JAX."""
    guidance, state, key = start(seed, demonstrations, begun, env=env, config=config)
    return guidance, state.replace(rollout=with_goals(jax.random.fold_in(key, 2), state.rollout, guidance)), key  # 2: evaluations split it in two


def with_goals(key: Array, episodes: RolloutState, guidance: Guidance) -> RolloutState:
    """Episodes that come without goals of their own are given behavioural ones."""
    if episodes.desired_goal is not None:
        return episodes
    return episodes.replace(desired_goal=sample_goals(key, guidance.behavioural_goals, episodes.observation.shape[0]))


def decide(key: Array, explorer: Policy, episodes: RolloutState, *, env: Environment, config: TrainConfig, at_random: bool) -> tuple[Array, Plan]:
    """What the environments are to do, and the key of the next iteration."""
    key, key_act, key_goals, key_nearby, key_batch, key_updates = jax.random.split(key, 6)
    act = training.act_at_random(env) if at_random else training.make_policy(explorer, env, config)
    action = act(key_act, episodes.observation, episodes.desired_goal)
    keys = dict(key_goals=key_goals, key_nearby=key_nearby, key_batch=key_batch, key_updates=key_updates)
    return key, Plan(action=action, env_action=action_to_env(action, env), **keys)


def remember(
    state: TrainState, plan: Plan, taken: tuple[TimeStep, RolloutState], guidance: Guidance, *, env: Environment, config: TrainConfig
) -> TrainState:
    """Stores a step that was taken outside JAX: the time step, and where the environments are now."""
    (time_step, now), before = taken, state.rollout
    now = with_goals(plan.key_goals, now, guidance)
    ended = time_step.terminated | time_step.truncated
    goal = jnp.where(ended[:, None], now.desired_goal, before.desired_goal)
    return training.record(plan.key_nearby, state, (plan.action, time_step, now.replace(desired_goal=goal)), guidance, env, config)


def improve(state: TrainState, plan: Plan, guidance: Guidance, *, env: Environment, config: TrainConfig) -> tuple[TrainState, Metrics]:
    """The gradient steps of an iteration."""
    batches = training.draw_batches(plan.key_batch, state, guidance, env, config)
    return training.gradient_steps(plan.key_updates, state, batches, env, config)
