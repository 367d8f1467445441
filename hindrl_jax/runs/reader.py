"""A finished run, read back from its directory: its policies, to be played and filmed."""

from __future__ import annotations

import contextlib
import dataclasses
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from flax.traverse_util import unflatten_dict

from hindrl_jax.base.environments import RestorableEnvironment, action_to_env, compiler_options
from hindrl_jax.base.errors import UserError, one_line
from hindrl_jax.base.files import DAMAGED_ARCHIVE, disk_trouble, read_arrays
from hindrl_jax.base.types import Episodes
from hindrl_jax.core import rollout
from hindrl_jax.core import train as training
from hindrl_jax.core.agent import Policy
from hindrl_jax.core.goals import GoalTable, sample_goals
from hindrl_jax.core.inputs import InputScale
from hindrl_jax.plotting.films import check_film, save_film, save_pictures
from hindrl_jax.runs.spec import PARAMETERS, RunSpec, read_spec
from hindrl_jax.tasks.from_gymnasium import Simulators, is_gymnasium
from hindrl_jax.tasks.registry import checked
from hindrl_jax.training import host
from hindrl_jax.training.devices import seed_mesh
from hindrl_jax.training.recording import on_host, player

if TYPE_CHECKING:
    pass


@dataclasses.dataclass(frozen=True)
class Run:
    """A finished run, read back from its directory."""

    path: Path
    spec: RunSpec
    policies: Policy
    """Leaves (S, ...)."""
    behavioural_goals: GoalTable
    """Leaves (S, ...)."""

    def in_backend(self, backend: str) -> Run:
        """The same policies, with the task simulated by another back end.

        Raises:
          UserError: if the task has no such back end.
        """
        env = self.spec.env
        if not hasattr(env, "backend"):
            raise UserError(f"{env.name} has one back end only: drop the choice of {backend!r}")
        return dataclasses.replace(self, spec=dataclasses.replace(self.spec, env=checked(lambda: dataclasses.replace(env, backend=backend))))

    def evaluate(
        self,
        *,
        episodes: int = 100,
        key: jax.Array | None = None,
        stochastic: bool = False,
        report: Callable[[int], None] = lambda played: None,
    ) -> list[dict[str, float]]:
        """Plays fresh episodes with each seed's policy: a list of {seed, success, episode_length}, in order of the seeds.

        Args:
          episodes: how many, per seed.
          key: which.
          stochastic: sample the actions.
          report: called with the number of episodes played so far, all seeds together, where they are played one by one: in robosuite.
        """
        keys = jax.random.split(jax.random.key(0) if key is None else key, len(self.spec.seeds))
        if is_gymnasium(self.spec.env):
            result = self._play_in_gymnasium(keys, episodes, stochastic=stochastic)
        elif on_host(self.spec.env):
            result = self._play_one_by_one(keys, episodes, stochastic=stochastic, report=report)
        else:
            result = self._play_side_by_side(keys, episodes, stochastic=stochastic)
        return [
            {"seed": seed, "success": float(result.success[i].mean()), "episode_length": float(result.length[i].mean())}
            for i, seed in enumerate(self.spec.seeds)
        ]

    def _play_side_by_side(self, keys: jax.Array, episodes: int, *, stochastic: bool) -> rollout.Evaluation:
        """All episodes of all seeds in one compiled program; leaves (S, episodes)."""
        env, config = self.spec.env, self.spec.config

        @jax.vmap
        def play_episodes(key: jax.Array, policy: Policy, goals: GoalTable) -> rollout.Evaluation:
            return rollout.evaluate(key, env, goals, training.make_policy(policy, env, config, stochastic=stochastic), episodes)

        program = jax.jit(play_episodes, compiler_options=compiler_options(env))
        return jax.device_get(program(keys, self.policies, self.behavioural_goals))

    def _play_in_gymnasium(self, keys: jax.Array, episodes: int, *, stochastic: bool) -> rollout.Evaluation:
        """Episodes of all seeds side by side, up to `num_envs` for each; leaves (S, episodes)."""
        num_seeds = len(self.spec.seeds)
        env: Any = self.spec.env
        policies = host.Policies(env, self.spec.config, seed_mesh(num_seeds), stochastic=stochastic)
        with contextlib.closing(Simulators(env, num_seeds * min(self.spec.config.num_envs, episodes))) as simulators:
            return host.evaluate(keys, simulators, policies, self.policies, episodes)

    def _play_one_by_one(self, keys: jax.Array, episodes: int, *, stochastic: bool, report: Callable[[int], None]) -> rollout.Evaluation:
        """One episode after the other; leaves (S, episodes)."""
        success: Any = np.zeros((len(keys), episodes), bool)
        length: Any = np.zeros((len(keys), episodes), np.int32)
        for i, key in enumerate(keys):
            play_episode = player(self.spec.env, self._act(i, stochastic=stochastic, any_goal=True), 1)
            for n, key_episode in enumerate(jax.random.split(key, episodes)):
                outcome = play_episode(key_episode)
                success[i, n], length[i, n] = outcome.terminated[0], outcome.lengths[0]
                report(i * episodes + n + 1)
        return rollout.Evaluation(success=success, length=length)

    def _act(self, index: int, *, stochastic: bool, any_goal: bool) -> Callable[[jax.Array, Any, jax.Array], jax.Array]:
        """The policy of one seed, for `player`. It aims at the first behavioural goal, or with `any_goal` at one drawn for the episode."""
        env = self.spec.env
        policy_of_seed, goals = jax.tree.map(lambda leaf: leaf[index], (self.policies, self.behavioural_goals))
        policy = training.make_policy(policy_of_seed, env, self.spec.config, stochastic=stochastic)

        def act(key: jax.Array, state: Any, observation: jax.Array) -> jax.Array:
            # The state's key is constant within an episode, and so is the goal drawn with it.
            goal = sample_goals(jax.random.fold_in(state.key, 0), goals, 1) if any_goal else goals.goals[:1]
            return action_to_env(policy(key, observation[None], goal)[0], env)

        return act

    def render(self, path: Path, *, seed: int | None = None, key: jax.Array | None = None, stochastic: bool = False) -> int:
        """Films fresh episodes of one seed's policy (the first seed's by default); returns how many of them solved the task.

        Args:
          path: a .gif or .mp4 file, or a .png file for the last state alone.
          seed: one of the run's seeds.
          key: which episode, or (N,) keys of N episodes to be shown one after the other.
          stochastic: sample the actions.

        Raises:
          UserError: if the run has no such seed, or the film cannot be drawn.
        """
        env = self.spec.env
        keys = jnp.atleast_1d(jax.random.key(0) if key is None else key)
        check_film(path, len(keys))
        index = self._index_of(seed)
        if is_gymnasium(env):
            return self._film(path, index, keys, stochastic=stochastic)
        play_episode = player(env, self._act(index, stochastic=stochastic, any_goal=False), 1)
        played = [jax.device_get(play_episode(key_episode)) for key_episode in keys]
        draw_episodes(path, env, [episodes.states[0, : int(episodes.lengths[0]) + 1] for episodes in played])
        return sum(bool(episodes.terminated[0]) for episodes in played)

    def _film(self, path: Path, index: int, keys: jax.Array, *, stochastic: bool) -> int:
        """`render` of an environment of Gymnasium, which draws itself."""
        env: Any = self.spec.env
        policy_of_seed = jax.tree.map(lambda leaf: leaf[index : index + 1], self.policies)
        policies = host.Policies(env, self.spec.config, seed_mesh(1), stochastic=stochastic)
        pictures, num_solved = [], 0
        for key in keys:
            key_seed, key_act = jax.random.split(key)
            episode, solved = host.film(env, int(jax.random.bits(key_seed)), policies.acting(key_act[None], policy_of_seed))
            pictures += episode
            num_solved += solved
        with disk_trouble(path):
            save_pictures(pictures, [1.0 / env.description.render_fps] * len(pictures), path)
        return num_solved

    def play(self, episodes: int = 1, *, seed: int | None = None, key: jax.Array | None = None, stochastic: bool = False) -> Episodes:
        """Plays fresh episodes with one seed's policy (the first seed's by default), to be looked at step by step; solved or not.

        The policy aims at the first behavioural goal, the end of the first demonstration.

        Args:
          episodes: N, how many.
          seed: one of the run's seeds.
          key: which.
          stochastic: sample the actions.

        Returns:
          A table of N episodes with their states, repeated after the end.

        Raises:
          UserError: if the run has no such seed.
        """
        act = self._act(self._index_of(seed), stochastic=stochastic, any_goal=False)
        return player(self.spec.env, act, episodes)(jax.random.key(0) if key is None else key)

    def _index_of(self, seed: int | None) -> int:
        """Where a seed, the first one by default, stands among those of the run."""
        seed = self.spec.seeds[0] if seed is None else seed
        if seed not in self.spec.seeds:
            raise UserError(f"{self.path} has no seed {seed}: choose one of {', '.join(map(str, self.spec.seeds))}")
        return self.spec.seeds.index(seed)


def draw_episodes(path: Path, env: RestorableEnvironment, episodes: Sequence[np.ndarray]) -> None:
    """Draws episodes from their states (length + 1, S each): a film of them, one after the other, or as a PNG the last state.

    Raises:
      UserError: for another kind of file, a place that cannot be written, states of another environment, or one that nothing draws.
    """
    check_film(path, len(episodes))
    if is_gymnasium(env):
        raise UserError(f"demonstrations of {env.name} hold no states, so they cannot be drawn; `hindrl render` films the policies of a run")
    for states in episodes:
        if states.shape[-1] != env.state_dim:
            raise UserError(f"states of {states.shape[-1]} numbers are not those of {env.name}, which has {env.state_dim}: record them again")
    key = jax.random.key(0)
    unpacked = [[env.vector_to_state(key, jnp.asarray(state)) for state in states] for states in episodes]
    with disk_trouble(path):
        save_film(env, unpacked, path)


def load_run(path: str | os.PathLike[str]) -> Run:
    """Reads a run's directory.

    Raises:
      UserError: if it is not the directory of a finished run.
    """
    path = Path(path)
    spec = read_spec(path)
    file = path / PARAMETERS
    if not file.exists():
        raise UserError(f"{path} holds no {PARAMETERS}: the run did not finish; go on with it by `hindrl train --resume {path}`")
    try:
        tree = unflatten_dict({name: jnp.asarray(array) for name, array in read_arrays(file).items()}, sep="/")
        goals = GoalTable(goals=tree["behavioural_goals"]["goals"], count=tree["behavioural_goals"]["count"])
        scale = _input_scale(tree["input_scale"])
        policies = Policy(actor=tree["policy"], scale=scale)
    except DAMAGED_ARCHIVE as error:
        raise UserError(f"{file} is damaged ({one_line(error)}): train again") from error
    return Run(path=path, spec=spec, policies=policies, behavioural_goals=goals)


def _input_scale(saved: dict[str, jax.Array]) -> InputScale:
    """The scale as it was saved. Runs from before inputs had a centre have theirs at 0."""
    observation, goal = saved["observation"], saved["goal"]
    centres = [saved.get(f"{name}_centre", jnp.zeros_like(saved[name])) for name in ("observation", "goal")]
    return InputScale(observation=observation, goal=goal, observation_centre=centres[0], goal_centre=centres[1])
