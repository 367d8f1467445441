"""Playing episodes, with an expert or with trained policies, on whatever steps the environment."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import itertools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hindrl_jax.base.environments import (
    Environment,
    RestorableEnvironment,
    Steppable,
    action_from_env,
    action_to_env,
    can_step,
    command_of,
    compiler_options,
)
from hindrl_jax.base.errors import UserError
from hindrl_jax.base.steppers import HostStepped, Watchable, WatchedStepper, can_be_watched, can_step_on_host
from hindrl_jax.base.types import Array, Episodes, tree_where
from hindrl_jax.config import TrainConfig
from hindrl_jax.core import rollout
from hindrl_jax.core.agent import Policy
from hindrl_jax.core.goals import GoalTable, sample_goals
from hindrl_jax.core.holding import hold, in_control_steps
from hindrl_jax.core.rollout import Evaluation
from hindrl_jax.core.train import make_policy
from hindrl_jax.tasks.registry import Act, task
from hindrl_jax.training import host_playing
from hindrl_jax.training.devices import seed_mesh


def play(key: Array, env: RestorableEnvironment, act: Act, num_episodes: int, num_held: int = 1) -> Episodes:
    """Plays episodes to their end, solved or not, and notes the states on the way, which are repeated after the end.

    The desired goal of an episode is the goal that it reached at its end.

    Args:
      key: random key.
      env: static.
      act: the policy.
      num_episodes: N, played side by side.
      num_held: steps for which each action is held, or actions in what `act` returns.
    """

    def step(carry: tuple[Array, Any, Array, Array, Array], index: Array) -> tuple[tuple[Array, Any, Array, Array, Array], tuple[Array, ...]]:
        key, state, observation, over, held = carry
        key, key_act = jax.random.split(key)
        decision = act(key_act, state, observation)
        if num_held > 1:
            decision = jnp.where(index % num_held == 0, decision, held)
        action = command_of(decision, index % num_held, env.action_dim)
        next_state, time_step = env.step(state, action)
        next_state = tree_where(over, state, next_state)
        next_observation = jnp.where(over, observation, time_step.observation)
        done = jnp.clip(action_from_env(action, env), -1.0, 1.0)  # what the environment makes of an action beyond its bounds
        row = (observation, env.state_to_vector(state), done, time_step.reward, over, time_step.terminated)
        return (key, next_state, next_observation, over | time_step.terminated | time_step.truncated, decision), row

    def episode(key: Array) -> Episodes:
        key_reset, key_play = jax.random.split(key)
        state, observation = env.reset(key_reset)
        nothing = jnp.zeros(jax.eval_shape(act, key_play, state, observation).shape)
        start = (key_play, state, observation, jnp.asarray(False), nothing)
        (_, state, observation, _, _), rows = jax.lax.scan(step, start, jnp.arange(env.horizon))
        observations, states, actions, rewards, over, terminated = rows
        return Episodes(
            observations=jnp.concatenate([observations, observation[None]]),
            actions=actions,
            rewards=jnp.where(over, 0.0, rewards),
            lengths=jnp.sum(~over),
            terminated=jnp.any(terminated & ~over),
            desired_goals=env.achieved_goal(observation),
            states=jnp.concatenate([states, env.state_to_vector(state)[None]]),
        )

    return jax.vmap(episode)(jax.random.split(key, num_episodes))


def plays_one_by_one(env: Environment) -> bool:
    """Whether episodes are played one after the other, by code of the task's own, since the back end steps neither in JAX nor many at once."""
    return not can_step(env) and not can_step_on_host(env)


def player(env: Environment, act: Act, num_episodes: int, num_held: int = 1) -> Callable[[Array], Episodes]:
    """`play` as a program, key -> episodes, on whatever steps the environment. It is compiled once.

    Args:
      env, act, num_episodes, num_held: as for `play`.

    Raises:
      UserError: if nothing plays episodes of this environment with their states; from the program, if its back end is missing or unusable.
    """
    if can_step(env):
        steppable: Any = env
        return jax.jit(lambda key: play(key, steppable, act, num_episodes, num_held), compiler_options=compiler_options(env))
    play_one_by_one = task(env.name).player
    if play_one_by_one is None:
        raise UserError(f"{env.name} cannot be played with its states: it has no step in JAX")
    return lambda key: play_one_by_one(key, env, act, num_episodes, num_held)


@dataclasses.dataclass(frozen=True)
class TrainedPolicies:
    """The policies of S runs, and what it takes to play them."""

    env: Environment
    config: TrainConfig
    policies: Policy
    """Leaves (S, ...)."""
    behavioural_goals: GoalTable
    """Leaves (S, ...)."""

    @property
    def num_held(self) -> int:
        """Steps for which each action is held."""
        return self.config.num_held

    @property
    def _decisions(self) -> Environment:
        """The environment as the policies see it, one step of which is one decision."""
        return hold(self.env, self.num_held, chunks=self.config.action_chunks)

    def evaluate(self, keys: Array, num_episodes: int, report: Callable[[int], None] = lambda played: None) -> Evaluation:
        """Plays fresh episodes with each policy; leaves (S, num_episodes).

        Args:
          keys: (S,) which.
          num_episodes: of each policy.
          report: called with the number of episodes played so far, all policies together, where they are played one by one.
        """
        env = self._decisions
        if can_step(env):
            return jax.device_get(in_control_steps(self._evaluate_in_jax(env, keys, num_episodes), self.env, self.num_held))
        if can_step_on_host(env):
            return jax.device_get(in_control_steps(self._evaluate_on_host(env, keys, num_episodes), self.env, self.num_held))
        return self._evaluate_one_by_one(keys, num_episodes, report)

    def play(self, key: Array, index: int, num_episodes: int) -> Episodes:
        """Plays fresh episodes with one policy, to be looked at step by step. Each aims at a behavioural goal that is drawn, as in evaluations.

        Raises:
          UserError: as `player`.
        """
        return self.player(index, num_episodes)(key)

    def player(self, index: int, num_episodes: int) -> Callable[[Array], Episodes]:
        """`player` of one policy. Each episode aims at a behavioural goal that is drawn for it."""
        env = self._decisions
        if can_be_watched(self.env):
            watched: Watchable = self.env
            return lambda key: self._play_on_host(watched, jax.random.split(key, num_episodes), index)[0]
        policy, goals = jax.tree.map(lambda leaf: leaf[index], (self.policies, self.behavioural_goals))
        choose = make_policy(policy, env, self.config)

        def act(key: Array, state: Any, observation: Array) -> Array:
            # The state's key is constant within an episode, and so is the goal drawn with it.
            goal = sample_goals(jax.random.fold_in(state.key, 0), goals, 1)
            return action_to_env(choose(key, observation[None], goal)[0], env)

        return player(self.env, act, num_episodes, self.num_held)

    def film(self, keys: Array, index: int) -> tuple[list[np.ndarray], int]:
        """Plays episodes in an environment that draws itself: pictures (H, W, 3) uint8 of all states, and how many episodes are solved.

        Args:
          keys: (N,) which episodes.
          index: of the policy.

        Raises:
          UserError: if the environment draws no pictures.
        """
        if not can_be_watched(self.env):
            raise UserError(f"{self.env.name} does not draw itself: play it, and draw the states")
        of_one = jnp.concatenate([jax.random.split(key, 1) for key in keys])  # as `play` has it, so that a film is of the episode that is played
        episodes, pictures = self._play_on_host(self.env, of_one, index, with_pictures=True)
        return pictures, int(episodes.terminated.sum())

    @functools.cached_property
    def _one_on_host(self) -> host_playing.HostPolicies:
        """What acts for any one of the policies outside JAX, compiled once."""
        return host_playing.HostPolicies(self.env, self.config, seed_mesh(1))

    def _play_on_host(self, env: Watchable, keys: Array, index: int, *, with_pictures: bool = False) -> tuple[Episodes, list[np.ndarray]]:
        """An episode for each of the keys (N,) with one policy, outside JAX, and pictures of all their states."""
        policy = jax.tree.map(lambda leaf: leaf[index : index + 1], self.policies)
        goals = jax.tree.map(lambda leaf: leaf[index], self.behavioural_goals)
        played = []
        for key in keys:
            key_seed, key_act = jax.random.split(key)
            act = self._one_on_host.acting(key_act[None], policy)
            goal = np.asarray(sample_goals(jax.random.fold_in(key_act, 0), goals, 1))
            with contextlib.closing(env.watched(with_pictures=with_pictures)) as stepper:
                played.append(self._play_one(stepper, int(jax.random.bits(key_seed)), act, goal, with_pictures=with_pictures))
        episodes, pictures = zip(*played, strict=True)
        return jax.tree.map(lambda *leaves: np.stack(leaves), *episodes), list(itertools.chain(*pictures))

    def _play_one(
        self, stepper: WatchedStepper, seed: int, act: host_playing.HostAct, behavioural_goal: np.ndarray, *, with_pictures: bool
    ) -> tuple[Episodes, list[np.ndarray]]:
        """One episode, and pictures of its states; the behavioural goal (1, G) is for environments that give none."""
        observation, own_goal = stepper.begin(np.array([seed]))
        goal = behavioural_goal if own_goal is None else own_goal
        observations, solved, ended = [observation], [], False
        actions: list[np.ndarray] = []
        pictures = [stepper.picture()] if with_pictures else []
        while not ended:
            if len(actions) % self.num_held == 0:
                action = act(observations[-1], goal)
            outcome = stepper.step(action, autoreset=False)
            if with_pictures:
                pictures.append(stepper.picture())
            observations.append(outcome.next_observation)
            actions.append(host_playing.played_action(self.env, action))
            solved.append(outcome.success[0])
            ended = outcome.ended[0]
        episode = host_playing.as_episode(self.env, np.concatenate(observations), np.concatenate(actions), np.array(solved), goal[0])
        return episode, pictures

    def _evaluate_in_jax(self, env: Steppable, keys: Array, num_episodes: int) -> Evaluation:
        """All episodes of all policies in one compiled program."""

        @jax.vmap
        def play_episodes(key: Array, policy: Policy, goals: GoalTable) -> Evaluation:
            return rollout.evaluate(key, env, goals, make_policy(policy, env, self.config), num_episodes)

        program = jax.jit(play_episodes, compiler_options=compiler_options(env))
        return jax.device_get(program(keys, self.policies, self.behavioural_goals))

    def _evaluate_on_host(self, env: HostStepped, keys: Array, num_episodes: int) -> Evaluation:
        """Episodes of all policies side by side, up to `num_envs` for each."""
        policies = host_playing.HostPolicies(env, self.config, seed_mesh(len(keys)))
        with contextlib.closing(env.stepper(len(keys) * min(self.config.num_envs, num_episodes))) as stepper:
            with_goals = host_playing.with_goals_of(stepper, env, self.behavioural_goals)
            return host_playing.evaluate(keys, with_goals, policies, self.policies, num_episodes)

    def _evaluate_one_by_one(self, keys: Array, num_episodes: int, report: Callable[[int], None]) -> Evaluation:
        success: Any = np.zeros((len(keys), num_episodes), bool)
        length: Any = np.zeros((len(keys), num_episodes), np.int32)
        for index, key in enumerate(keys):
            play_episode = self.player(index, 1)
            for number, key_episode in enumerate(jax.random.split(key, num_episodes)):
                outcome = play_episode(key_episode)
                success[index, number], length[index, number] = outcome.terminated[0], outcome.lengths[0]
                report(index * num_episodes + number + 1)
        return Evaluation(success=success, length=length)
