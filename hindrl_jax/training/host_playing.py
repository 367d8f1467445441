"""Playing with policies in environments that are stepped outside JAX, and what was played as a table of episodes."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from hindrl_jax.base.environments import Environment, action_from_env, action_to_env
from hindrl_jax.base.steppers import HostStepped, Outcome, Stepper
from hindrl_jax.base.types import Array, Episodes
from hindrl_jax.config import TrainConfig
from hindrl_jax.core.agent import Policy
from hindrl_jax.core.goals import GoalTable
from hindrl_jax.core.rollout import Evaluation
from hindrl_jax.core.train import make_policy
from hindrl_jax.training.devices import by_seed, over_seeds

HostAct = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""(observations (N, D), desired goals (N, G)) -> actions (N, A) in the environment's own units."""


class HostPolicies:
    """The policies of S seeds as one compiled program, for any number of environments each."""

    def __init__(self, env: Environment, config: TrainConfig, mesh: Mesh):
        def act(key: Array, policy: Policy, observation: Array, desired_goal: Array) -> tuple[Array, Array]:
            key, key_act = jax.random.split(key)
            action = make_policy(policy, env, config)(key_act, observation, desired_goal)
            return key, action_to_env(action, env)

        self._mesh, self._program = mesh, jax.jit(over_seeds(act, mesh))

    def acting(self, key: Array, actor: Policy) -> HostAct:
        """A function of what all environments observe, those of the first seed first; it draws from the keys (S,)."""

        def act(observation: np.ndarray, desired_goal: np.ndarray) -> np.ndarray:
            nonlocal key
            inputs = jax.device_put([array.reshape(len(key), -1, array.shape[1]) for array in (observation, desired_goal)], by_seed(self._mesh))
            key, action = self._program(key, actor, *inputs)
            return np.asarray(action).reshape(len(observation), -1)

        return act


class _BehaviouralGoals:
    """A stepper whose environments give no goals, which gives each episode one of its run's behavioural goals."""

    def __init__(self, stepper: Stepper, goals: GoalTable):
        self._stepper, self._goals, self._counts = stepper, np.asarray(goals.goals), np.asarray(goals.count)
        self.num_envs = stepper.num_envs

    def begin(self, seeds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        observation, _ = self._stepper.begin(seeds)
        self._randomness = [np.random.default_rng(of_run) for of_run in seeds.reshape(len(self._goals), -1)]
        self._now = self._draw()
        return observation, self._now

    def step(self, actions: np.ndarray) -> Outcome:
        outcome = self._stepper.step(actions)
        self._now = np.where(outcome.ended[:, None], self._draw(), self._now)
        return dataclasses.replace(outcome, desired_goal=self._now)

    def close(self) -> None:
        self._stepper.close()

    def _draw(self) -> np.ndarray:
        """(N, G)"""
        num_envs = self.num_envs // len(self._goals)
        tables = zip(self._goals, self._counts, self._randomness, strict=True)
        return np.concatenate([goals[rng.integers(count, size=num_envs)] for goals, count, rng in tables])


def with_goals_of(stepper: Stepper, env: HostStepped, goals: GoalTable) -> Stepper:
    """A stepper whose episodes have goals: their own, or else behavioural ones from the tables of S runs, leaves (S, ...)."""
    return stepper if env.gives_goals else _BehaviouralGoals(stepper, goals)


def evaluate(key: Array, stepper: Stepper, policies: HostPolicies, actor: Policy, num_episodes: int) -> Evaluation:
    """Plays fresh episodes with each seed's policy, numpy leaves (S, num_episodes).

    Args:
      key: (S,) keys; equal ones give equal episodes.
      stepper: as many environments for each seed.
      policies: what acts.
      actor: leaves (S, ...).
      num_episodes: for each seed; shared out evenly between its environments, whatever their lengths.
    """
    key_seeds, key_act = (jax.vmap(jax.random.fold_in, (0, None))(key, index) for index in (0, 1))
    num_envs = stepper.num_envs // len(key)
    seeds = np.asarray(jax.vmap(lambda key: jax.random.bits(key, (num_envs,)))(key_seeds))
    success, length = play(stepper, seeds.reshape(-1), policies.acting(key_act, actor), -(-num_episodes // num_envs))
    # Episode n of a seed is the (n // E)-th of its environment n % E.
    ordered = (array.reshape(len(key), num_envs, -1).swapaxes(1, 2).reshape(len(key), -1)[:, :num_episodes] for array in (success, length))
    return Evaluation(success=next(ordered), length=next(ordered))


def play(stepper: Stepper, seeds: np.ndarray, act: HostAct, num_episodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Plays that many episodes in each environment.

    Args:
      stepper: N environments.
      seeds: (N,) uint32.
      act: the policy.
      num_episodes: K; what an environment does after its K-th, while others are not done, does not count.

    Returns:
      (N, K) bool, whether the task was solved, and (N, K) int32, how many steps it took.
    """
    success, length = (np.zeros((stepper.num_envs, num_episodes), kind) for kind in (bool, np.int32))
    played, steps = (np.zeros(stepper.num_envs, np.int32) for _ in range(2))
    observation, goal = stepper.begin(seeds)
    while (played < num_episodes).any():
        outcome = stepper.step(act(observation, goal))
        observation, goal = outcome.observation, outcome.desired_goal
        steps += 1
        over = np.flatnonzero(outcome.ended & (played < num_episodes))
        success[over, played[over]], length[over, played[over]] = outcome.success[over], steps[over]
        played[over] += 1
        steps[outcome.ended] = 0
    return success, length


def with_noise(act: HostAct, env: Environment, noise: float, generators: Sequence[np.random.Generator]) -> HostAct:
    """The policies of S runs with Gaussian noise on their actions, whose deviation counts in the range [-1, 1]; each run has its own generator."""
    deviation = noise * (np.asarray(env.action_high) - np.asarray(env.action_low)) / 2.0

    def noisy(observation: np.ndarray, desired_goal: np.ndarray) -> np.ndarray:
        action = act(observation, desired_goal)
        of_run = (len(action) // len(generators), action.shape[1])
        drawn = np.concatenate([generator.standard_normal(of_run) for generator in generators])
        return np.clip(action + deviation * drawn, env.action_low, env.action_high).astype(np.float32)

    return noisy


def record(stepper: Stepper, env: Environment, seeds: np.ndarray, act: HostAct) -> Episodes:
    """Plays one episode in each of N environments and records it, numpy leaves (N, ...), without states.

    Args:
      stepper: N environments of `env`.
      env: the task, its actions held if they are.
      seeds: (N,) uint32; equal ones begin equal episodes.
      act: the policy.
    """
    observation, goal = stepper.begin(seeds)
    over, steps = np.zeros(stepper.num_envs, bool), []
    desired_goals, observations = goal, [observation]
    while not over.all():
        action = act(observation, goal)
        outcome = stepper.step(action)
        steps.append((played_action(env, action), outcome.success & ~over, ~over, outcome.terminated & ~over))
        observations.append(outcome.next_observation)
        over = over | outcome.ended
        observation, goal = outcome.observation, outcome.desired_goal
    actions, solved, taken, terminated = (np.stack(of_each, axis=1) for of_each in zip(*steps, strict=True))

    def padded(rows: np.ndarray, size: int) -> np.ndarray:
        return np.pad(rows, [(0, 0), (0, size - rows.shape[1]), *[(0, 0)] * (rows.ndim - 2)])

    return Episodes(
        observations=padded(np.stack(observations, axis=1), env.horizon + 1),
        actions=padded(np.asarray(action_from_env(jnp.asarray(actions), env)), env.horizon),
        rewards=padded(solved.astype(np.float32), env.horizon),
        lengths=taken.sum(axis=1, dtype=np.int32),
        terminated=terminated.any(axis=1),
        desired_goals=desired_goals,
    )


def played_action(env: Environment, action: np.ndarray) -> np.ndarray:
    """What an environment makes of an action (..., A): bounded, and whole where it takes whole numbers."""
    own = getattr(env, "played_action", None)
    return np.clip(action, env.action_low, env.action_high) if own is None else own(action)


def as_episode(env: Environment, observations: np.ndarray, actions: np.ndarray, solved: np.ndarray, goal: np.ndarray) -> Episodes:
    """An episode of L steps as a row of a table, padded, without states.

    Args:
      env: the task.
      observations: (L + 1, D)
      actions: (L, A) in the environment's own units.
      solved: (L,) bool, by each step.
      goal: (G,)
    """
    length = len(actions)

    def padded(rows: np.ndarray, size: int) -> np.ndarray:
        return np.concatenate([rows, np.zeros((size - len(rows), *rows.shape[1:]), np.float32)])

    return Episodes(
        observations=padded(observations, env.horizon + 1),
        actions=padded(np.asarray(action_from_env(jnp.asarray(actions), env)), env.horizon),
        rewards=padded(solved.astype(np.float32), env.horizon),
        lengths=np.int32(length),
        terminated=solved[-1],
        desired_goals=goal,
        states=np.zeros((env.horizon + 1, 0), np.float32),
    )
