"""Learning in environments that are stepped outside JAX: decide, step, remember, improve.

The programs are the pieces of `hindrl_jax.core.train`, compiled and mapped over the seeds; the loop between them is here. Only one thing differs from
`train.learn`: the gradient steps of an iteration are under way while the environments take their step, so they do not see that step yet. They would
hardly use it, since only complete episodes are learned from.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.sharding import Mesh

from hindrl_jax.base.environments import action_from_env, action_to_env, compiler_options
from hindrl_jax.base.errors import UserError
from hindrl_jax.base.types import Array, Episodes, TimeStep
from hindrl_jax.config import TrainConfig, with_traced_values
from hindrl_jax.core import train as training
from hindrl_jax.core.agent import Metrics, Policy, policy
from hindrl_jax.core.guidance import Guidance
from hindrl_jax.core.guidance import guidance as guidance_of
from hindrl_jax.core.rollout import Evaluation, RolloutState
from hindrl_jax.core.train import TrainState
from hindrl_jax.tasks.from_gymnasium import GymnasiumEnv, Outcome, Simulators
from hindrl_jax.training.devices import by_seed, over_seeds, seed_mesh, shapes_on
from hindrl_jax.training.prioritised import sampler_for

FRESH_EPISODES = 100
"""By which a finished run is judged."""
Act = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""(observations (N, D), desired goals (N, G)) -> actions (N, A) in the environment's own units."""
Demonstrator = Callable[[dict[str, np.ndarray], np.random.Generator], np.ndarray]
"""(an observation as Gymnasium's environment gives it, randomness) -> action (A,) in the environment's own units."""


@struct.dataclass(kw_only=True)
class Plan:
    """What E environments are to do next, and the keys for what follows."""

    action: Array  # (E, A) in [-1, 1]
    env_action: Array  # (E, A) in the environment's own units
    key_goals: Array
    key_nearby: Array
    key_batch: Array
    key_updates: Array


class HostPrograms:
    """The programs of an experiment and the environments that go with them. Arguments and results have leaves (S, ...), S seeds."""

    def __init__(
        self,
        env: GymnasiumEnv,
        configs: Sequence[TrainConfig],
        demonstrations: Episodes,
        values: dict[str, np.ndarray],
        *,
        chunk: int,
        warm_up: int,
    ):
        """Compiles all programs, then starts the environments.

        Args:
          env, configs, demonstrations: what is learned, and how and from what by each seed.
          values: the swept fields of the configs.
          chunk: iterations of `learn`.
          warm_up: iterations of `collect`.

        Raises:
          UserError: if there are several hosts.
        """
        if jax.process_count() > 1:
            raise UserError(f"{env.name} is stepped by one host only: drop --distributed")
        self.env, self.config, self.values, self.chunk, self.warm_up = env, configs[0], values, chunk, warm_up
        self.mesh, self.steps_at_random = seed_mesh(len(configs)), warm_up * self.config.num_envs
        self._shape = (len(configs), self.config.num_envs)
        self._act = Policies(env, self.config, self.mesh, stochastic=False)
        self._compile(demonstrations)
        num_envs = len(configs) * self.config.num_envs
        # They end when they are no longer referred to, so the compiled functions above must not refer to this object.
        self._fresh = Simulators(env, num_envs)  # for evaluations
        self.simulators = None if self.config.algo == "bc" else Simulators(env, num_envs)
        self._begun = False  # whether the state's episodes are those of `simulators`

    def _compile(self, demonstrations: Episodes) -> None:
        """Traces everything from shapes; each program is compiled while the next one is being traced."""
        env, config, chunk, cloning = self.env, self.config, self.chunk, self.config.algo == "bc"

        def start(seed: Array, demonstrations: Episodes, begun: RolloutState, values: dict[str, Array]) -> tuple[Guidance, TrainState, Array]:
            actual = with_traced_values(config, values)
            key_init, key_evaluate = jax.random.split(jax.random.key(seed))
            guidance = guidance_of(demonstrations, env, actual)
            state = training.init(key_init, guidance, env, actual, sampler=sampler_for(env, actual), begun=begun)
            return guidance, state, key_evaluate

        def decide(key: Array, explorer: Policy, rollout: RolloutState, *, at_random: bool) -> tuple[Array, Plan]:
            key, key_act, key_goals, key_nearby, key_batch, key_updates = jax.random.split(key, 6)
            act = training.act_at_random(env) if at_random else training.make_policy(explorer, env, config, stochastic=True)
            action = act(key_act, rollout.observation, rollout.desired_goal)
            keys = dict(key_goals=key_goals, key_nearby=key_nearby, key_batch=key_batch, key_updates=key_updates)
            return key, Plan(action=action, env_action=action_to_env(action, env), **keys)

        def remember(
            state: TrainState, plan: Plan, time_step: TimeStep, begun: RolloutState, guidance: Guidance, values: dict[str, Array]
        ) -> TrainState:
            ended, before = time_step.terminated | time_step.truncated, state.rollout
            goal = jnp.where(ended[:, None], begun.desired_goal, before.desired_goal)  # within an episode it may be one that was chosen here
            after = begun.replace(desired_goal=goal, notes={name: noted & ~ended for name, noted in before.notes.items()})
            actual = with_traced_values(config, values)
            recorded = training.record(plan.key_nearby, state, (plan.action, time_step), guidance, env, actual)
            kept = sampler_for(env, actual).record(state.sampler, state.replay, recorded.replay)
            return training.continue_from(plan.key_goals, recorded.replace(sampler=kept), after, time_step, env, actual)

        def improve(state: TrainState, plan: Plan, guidance: Guidance, values: dict[str, Array]) -> tuple[TrainState, Metrics]:
            actual = with_traced_values(config, values)
            sampler = sampler_for(env, actual)
            batches, drawn = sampler.draw(plan.key_batch, state, guidance)
            state, metrics = training.gradient_steps(plan.key_updates, state, batches, env, actual)
            return state.replace(sampler=sampler.learned(state, batches, drawn)), metrics

        def pretrain(state: TrainState, guidance: Guidance, values: dict[str, Array]) -> TrainState:
            actual = with_traced_values(config, values)
            return training.clone(state, guidance, env=env, config=actual, num_iterations=config.bc_warm_start)[0]

        def clone(state: TrainState, guidance: Guidance, values: dict[str, Array]) -> tuple[TrainState, Metrics]:
            return training.clone(state, guidance, env=env, config=with_traced_values(config, values), num_iterations=chunk)

        with ThreadPoolExecutor() as pool:

            def compiled(function: Callable[..., Any], *arguments: Any, donate: bool = False) -> tuple[Any, Any]:
                """The program, still to come, and the shapes of what it returns."""
                traced = jax.jit(over_seeds(function, self.mesh), donate_argnums=0 if donate else ()).trace(*arguments)
                return pool.submit(traced.lower().compile, compiler_options(env)), shapes_on(traced.out_info, self.mesh)

            values = shapes_on(self.values, self.mesh)
            seeds = jax.ShapeDtypeStruct(self._shape[:1], np.uint32)
            begun = jax.eval_shape(lambda: _episodes(*(jnp.zeros((*self._shape, dim)) for dim in (env.observation_dim, env.goal_dim))))
            seeds, demonstrations, begun = shapes_on((seeds, demonstrations, begun), self.mesh)
            starting, (guidance, state, key) = compiled(start, seeds, demonstrations, begun, values)
            self.shapes = {"guidance": guidance, "state": state, "key": key}
            if cloning:
                programs = {"clone": compiled(clone, state, guidance, values, donate=True)[0]}
            else:
                planning = (state.key, policy(state.agent, average=False), state.rollout)
                deciding, (_, plan) = compiled(functools.partial(decide, at_random=False), *planning)
                flags = jax.ShapeDtypeStruct(self._shape, bool)
                step = TimeStep(
                    observation=begun.observation, reward=jax.ShapeDtypeStruct(self._shape, np.float32), terminated=flags, truncated=flags
                )
                programs = {
                    "improve": compiled(improve, state, plan, guidance, values, donate=True)[0],
                    "remember": compiled(remember, state, plan, shapes_on(step, self.mesh), begun, guidance, values, donate=True)[0],
                    "decide": deciding,
                    "decide_at_random": compiled(functools.partial(decide, at_random=True), *planning)[0],
                }
                if config.bc_warm_start > 0:
                    programs["pretrain"] = compiled(pretrain, state, guidance, values, donate=True)[0]
            self._start = starting.result()
            self._programs = {name: program.result() for name, program in programs.items()}
        self.pretrain = self._programs.get("pretrain")

    def start(self, seeds: Array, demonstrations: Episodes, values: dict[str, Array]) -> tuple[Guidance, TrainState, Array]:
        """What a run begins with: the guidance, the state with its first episodes, and keys for evaluations."""
        observation, goal = (np.zeros((*self._shape, dim), np.float32) for dim in (self.env.observation_dim, self.env.goal_dim))
        if self.simulators is not None:
            seeds_of_each = [np.random.SeedSequence(int(seed)).generate_state(self._shape[1]) for seed in np.asarray(seeds)]
            observation, goal = self._begin(np.concatenate(seeds_of_each))
        return self._start(seeds, demonstrations, self._put(_episodes(observation, goal)), values)

    def collect(self, state: TrainState, guidance: Guidance, values: dict[str, Array]) -> TrainState:
        """As `train.collect`, for `warm_up` iterations."""
        for _ in range(self.warm_up):
            state, plan = self._planned(state, guidance, at_random=True)
            state = self._live(state, plan, guidance, values)
        return state

    def learn(self, state: TrainState, guidance: Guidance, values: dict[str, Array]) -> tuple[TrainState, Metrics]:
        """As `train.learn` or, for bc, `train.clone`, for `chunk` iterations."""
        if self.simulators is None:
            return self._programs["clone"](state, guidance, values)
        if not self._begun:
            state = self._with_new_episodes(state)
        of_each = []
        for _ in range(self.chunk):
            state, plan = self._planned(state, guidance, at_random=False)
            state, metrics = self._programs["improve"](state, plan, guidance, values)  # comes back at once, and computes while the environments step
            state = self._live(state, plan, guidance, values)
            of_each.append(metrics)
        return state, jax.tree.map(lambda *values: np.mean(values, axis=0), *jax.device_get(of_each))

    def evaluate(self, key: Array, actor: Any, guidance: Guidance, values: dict[str, Array]) -> tuple[Array, Evaluation]:
        """Plays the config's number of fresh episodes."""
        return self._evaluated(key, actor, guidance, self.config.eval_episodes)

    def evaluate_fresh(self, key: Array, actor: Any, guidance: Guidance, values: dict[str, Array]) -> tuple[Array, Evaluation]:
        """Plays the episodes by which a finished run is judged."""
        return self._evaluated(key, actor, guidance, FRESH_EPISODES)

    def _evaluated(self, key: Array, actor: Any, guidance: Guidance, num_episodes: int) -> tuple[Array, Evaluation]:
        both = jax.vmap(jax.random.split)(key)
        return both[:, 0], evaluate(both[:, 1], self._fresh, self._act, actor, num_episodes)

    def _planned(self, state: TrainState, guidance: Guidance, *, at_random: bool) -> tuple[TrainState, Plan]:
        key, plan = self._programs["decide_at_random" if at_random else "decide"](state.key, policy(state.agent, average=False), state.rollout)
        return state.replace(key=key), plan

    def _live(self, state: TrainState, plan: Plan, guidance: Guidance, values: dict[str, Array]) -> TrainState:
        """Takes the planned step in all environments and remembers it."""
        outcome = self.simulators.step(np.asarray(plan.env_action).reshape(-1, self.env.action_dim))
        return self._programs["remember"](state, plan, *self._put(self._told(outcome)), guidance, values)

    def _told(self, outcome: Outcome) -> tuple[TimeStep, RolloutState]:
        step = (outcome.next_observation, outcome.success.astype(np.float32), outcome.terminated, outcome.truncated)
        names = ("observation", "reward", "terminated", "truncated")
        return TimeStep(**dict(zip(names, self._by_seed(step), strict=True))), _episodes(*self._by_seed((outcome.observation, outcome.desired_goal)))

    def _begin(self, seeds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Begins an episode in each environment: seeds (S * E,) -> observations (S, E, D), desired goals (S, E, G)."""
        self._begun = True
        return self._by_seed(self.simulators.begin(seeds))

    def _with_new_episodes(self, state: TrainState) -> TrainState:
        """The state of a run that goes on from a checkpoint, where nobody knows how its environments stood: their episodes are lost."""
        keys = jax.vmap(functools.partial(jax.random.fold_in, data=0))(state.key)
        seeds = np.asarray(jax.vmap(lambda key: jax.random.bits(key, self._shape[1:]))(keys))
        observation, goal = self._begin(seeds.reshape(-1))
        replay = state.replay.replace(step=jnp.zeros_like(state.replay.step))
        return self._put(state.replace(replay=replay, rollout=_episodes(observation, goal)))

    def _by_seed(self, arrays: Sequence[np.ndarray]) -> tuple[np.ndarray, ...]:
        """(S * E, ...) -> (S, E, ...)"""
        return tuple(array.reshape(*self._shape, *array.shape[1:]) for array in arrays)

    def _put(self, tree: Any) -> Any:
        return jax.device_put(tree, by_seed(self.mesh))


def _episodes(observation: np.ndarray, desired_goal: np.ndarray) -> RolloutState:
    return RolloutState(env_state=(), observation=observation, desired_goal=desired_goal, notes={})


class Policies:
    """The policies of S seeds as one compiled program, for any number of environments each."""

    def __init__(self, env: GymnasiumEnv, config: TrainConfig, mesh: Mesh, *, stochastic: bool):
        def act(key: Array, actor: Policy, observation: Array, desired_goal: Array) -> tuple[Array, Array]:
            key, key_act = jax.random.split(key)
            action = training.make_policy(actor, env, config, stochastic=stochastic)(key_act, observation, desired_goal)
            return key, action_to_env(action, env)

        self._mesh, self._program = mesh, jax.jit(over_seeds(act, mesh))

    def acting(self, key: Array, actor: Policy) -> Act:
        """A function of what all environments observe, those of the first seed first; it draws from the keys (S,)."""

        def act(observation: np.ndarray, desired_goal: np.ndarray) -> np.ndarray:
            nonlocal key
            inputs = jax.device_put([array.reshape(len(key), -1, array.shape[1]) for array in (observation, desired_goal)], by_seed(self._mesh))
            key, action = self._program(key, actor, *inputs)
            return np.asarray(action).reshape(len(observation), -1)

        return act


def evaluate(key: Array, simulators: Simulators, policies: Policies, actor: Policy, num_episodes: int) -> Evaluation:
    """Plays fresh episodes with each seed's policy, numpy leaves (S, num_episodes).

    Args:
      key: (S,) keys; equal ones give equal episodes.
      simulators: as many environments for each seed.
      policies: what acts.
      actor: leaves (S, ...).
      num_episodes: for each seed; shared out evenly between its environments, whatever their lengths.
    """
    key_seeds, key_act = (jax.vmap(jax.random.fold_in, (0, None))(key, index) for index in (0, 1))
    num_envs = simulators.num_envs // len(key)
    seeds = np.asarray(jax.vmap(lambda key: jax.random.bits(key, (num_envs,)))(key_seeds))
    success, length = play(simulators, seeds.reshape(-1), policies.acting(key_act, actor), -(-num_episodes // num_envs))
    # Episode n of a seed is the (n // E)-th of its environment n % E.
    ordered = (array.reshape(len(key), num_envs, -1).swapaxes(1, 2).reshape(len(key), -1)[:, :num_episodes] for array in (success, length))
    return Evaluation(success=next(ordered), length=next(ordered))


def play(simulators: Simulators, seeds: np.ndarray, act: Act, num_episodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Plays that many episodes in each environment.

    Args:
      simulators: N environments.
      seeds: (N,) uint32.
      act: the policy.
      num_episodes: K; what an environment does after its K-th, while others are not done, does not count.

    Returns:
      (N, K) bool, whether the goal was reached, and (N, K) int32, how many steps it took.
    """
    success, length = (np.zeros((simulators.num_envs, num_episodes), kind) for kind in (bool, np.int32))
    played, steps = (np.zeros(simulators.num_envs, np.int32) for _ in range(2))
    observation, goal = simulators.begin(seeds)
    while (played < num_episodes).any():
        outcome = simulators.step(act(observation, goal))
        observation, goal = outcome.observation, outcome.desired_goal
        steps += 1
        over = np.flatnonzero(outcome.ended & (played < num_episodes))
        success[over, played[over]], length[over, played[over]] = outcome.success[over], steps[over]
        played[over] += 1
        steps[outcome.ended] = 0
    return success, length


def film(env: GymnasiumEnv, seed: int, act: Act) -> tuple[list[np.ndarray], bool]:
    """Plays one episode: a picture (H, W, 3) uint8 of each state, and whether it reached its goal.

    Raises:
      UserError: if the environment draws no pictures.
    """
    simulators = Simulators(env, 1, render_mode="rgb_array")
    try:
        observation, goal = simulators.begin(np.array([seed]))
        pictures = [simulators.picture()]
        while True:
            outcome = simulators.step(act(observation, goal), begin_anew=False)
            pictures.append(simulators.picture())
            if outcome.ended[0]:
                return pictures, bool(outcome.success[0])
            observation, goal = outcome.observation, outcome.desired_goal
    finally:
        simulators.close()


def record_gymnasium(env: GymnasiumEnv, policy: Demonstrator, num_demos: int, *, seed: int = 0, max_attempts: int | None = None) -> Episodes:
    """Records demonstrations that reach their goals, each cut where it does; others are discarded.

    Args:
      env: from `hindrl_jax.make("gymnasium:...")`.
      policy: from an observation, as the environment gives it, and a numpy generator, the action in the environment's own units.
      num_demos: N, at least 1.
      seed: equal seeds give equal demonstrations.
      max_attempts: episodes to play before giving up; by default 100 times `num_demos`.

    Raises:
      UserError: if `num_demos` is below 1, or the policy reaches too few goals.
    """
    if num_demos < 1:
        raise UserError(f"num_demos = {num_demos} is too few: record at least 1 demonstration")
    max_attempts = 100 * num_demos if max_attempts is None else max_attempts
    rng = np.random.default_rng(seed)
    simulators = Simulators(dataclasses.replace(env, vectorization="sync"), 1)
    kept: list[Episodes] = []
    with contextlib.closing(simulators):
        simulators.begin(rng.integers(2**32, size=1))
        for _ in range(max_attempts):
            observations, goal = simulators.now()
            observations, actions, ended = [observations], [], False
            while not ended:
                action = np.asarray(policy(simulators.told(), rng), np.float32)
                actions.append(np.clip(action, env.action_low, env.action_high))
                outcome = simulators.step(action[None])
                observations.append(outcome.next_observation)
                ended = outcome.ended[0]
            if outcome.success[0]:
                kept.append(_demonstration(env, np.concatenate(observations), np.stack(actions), goal[0]))
            if len(kept) == num_demos:
                return jax.tree.map(lambda *leaves: np.stack(leaves), *kept)
    raise UserError(
        f"the policy reached its goal in only {len(kept)} of {max_attempts} episodes of {env.name}, but {num_demos} demonstrations are wanted: "
        "ask for fewer, or give a better one"
    )


def _demonstration(env: GymnasiumEnv, observations: np.ndarray, actions: np.ndarray, goal: np.ndarray) -> Episodes:
    """A solved episode of L steps, padded: observations (L + 1, D), actions (L, A) in the environment's own units, goal (G,)."""
    length = len(actions)

    def padded(rows: np.ndarray, size: int) -> np.ndarray:
        return np.concatenate([rows, np.zeros((size - len(rows), *rows.shape[1:]), np.float32)])

    return Episodes(
        observations=padded(observations, env.horizon + 1),
        actions=padded(np.asarray(action_from_env(jnp.asarray(actions), env)), env.horizon),
        rewards=np.eye(env.horizon, dtype=np.float32)[length - 1],
        lengths=np.int32(length),
        terminated=np.bool_(True),
        desired_goals=goal,
        states=np.zeros((env.horizon + 1, 0), np.float32),
    )
