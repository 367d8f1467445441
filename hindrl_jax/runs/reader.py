"""A finished run, read back from its directory: its policies, to be played and filmed."""

from __future__ import annotations

import dataclasses
import io
import itertools
import os
import shlex
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax.traverse_util import unflatten_dict

from hindrl_jax.base.compilation import in_float32
from hindrl_jax.base.environments import Environment, Restorable, compiler_options
from hindrl_jax.base.errors import UserError, one_line
from hindrl_jax.base.files import DAMAGED_ARCHIVE, check_can_write, disk_trouble, read_arrays, write_atomically
from hindrl_jax.base.steppers import can_be_watched
from hindrl_jax.base.types import Episodes
from hindrl_jax.core.agent import Params, Policy, init, policy
from hindrl_jax.core.goals import GoalTable
from hindrl_jax.core.holding import hold
from hindrl_jax.core.inputs import InputScale
from hindrl_jax.plotting.films import check_film, save_film, save_pictures
from hindrl_jax.runs import numpy_policy
from hindrl_jax.runs.acting import TrainedPolicy, TrainedValue, numpy_form
from hindrl_jax.runs.numpy_policy import NumpyPolicy
from hindrl_jax.runs.numpy_policy import save as save_numpy_policy
from hindrl_jax.runs.shipped import run_directory
from hindrl_jax.runs.spec import CONFIG, PARAMETERS, RunSpec, read_spec
from hindrl_jax.tasks.registry import checked
from hindrl_jax.training.playing import TrainedPolicies


@dataclasses.dataclass(frozen=True)
class Run:
    """A finished run, read back from its directory."""

    path: Path
    spec: RunSpec
    policies: Policy
    """Leaves (S, ...)."""
    behavioural_goals: GoalTable
    """Leaves (S, ...)."""
    critics: Params | None = None
    """Leaves (S, C, ...), as they are at the end of the run; None for behaviour cloning, which has none."""

    def policy(self, seed: int | None = None) -> TrainedPolicy:
        """One seed's policy as a function, observation and goal -> action, in the task's own units; compiled.

            policy = run.policy()
            action = policy(observation, goal)  # (D,), (G,) -> (A,); or with leading axes

        Where no goal is given, it is the run's first behavioural goal; where each episode has a goal of its own, one has to be given. It is the mean
        action, or with a key one with the noise that the run has found to be best. Each action is to be held for `policy.action_hold` control steps.

        Args:
          seed: one of the run's seeds; the first by default.

        Raises:
          UserError: if the run has no such seed.
        """
        index, (env, config) = self._index_of(seed), (self.spec.env, self.spec.config)
        policy, goals = jax.tree.map(lambda leaf: leaf[index], (self.policies, self.behavioural_goals))
        own_goals = getattr(env, "gives_goals", False) or config.own_goals
        return TrainedPolicy(env, config, policy, None if own_goals else goals.goals[0])

    def value(self, seed: int | None = None) -> TrainedValue:
        """One seed's critics as a function, observation and goal -> expected return of the policy's action, or of another one; compiled.

        The critics are those at the end of the run, and the policy is the best that it has seen: read the run with `last` for those of one time.

        Args:
          seed: one of the run's seeds; the first by default.

        Raises:
          UserError: if the run has no such seed, or no critics.
        """
        trained, index = self.policy(seed), self._index_of(seed)
        if self.critics is None:
            raise UserError(f"{self.path} holds no critics, since {self.spec.config.algo} trains none: choose a run of another algo")
        return TrainedValue(trained, jax.tree.map(lambda leaf: leaf[index], self.critics))

    def numpy_policy(self, seed: int | None = None) -> NumpyPolicy:
        """As `policy`, in NumPy alone: the same function to float32's rounding, which needs no JAX.

        Raises:
          UserError: if the run has no such seed, or its policies have no form in NumPy.
        """
        return NumpyPolicy(*numpy_form(self.policy(seed)))

    def export_policy(self, folder: str | os.PathLike[str], seed: int | None = None, *, overwrite: bool = False) -> Path:
        """Writes one seed's policy for a computer without JAX: policy.npz, and numpy_policy.py, which plays it with NumPy alone.

        Args:
          folder: where; made if it is not there.
          seed: one of the run's seeds; the first by default.
          overwrite: replace files of these names.

        Returns:
          The path of policy.npz.

        Raises:
          UserError: as `numpy_policy`, or if the files are there or cannot be written.
        """
        content = io.BytesIO()
        save_numpy_policy(content, *numpy_form(self.policy(seed)))
        path = Path(folder) / "policy.npz"
        code = Path(numpy_policy.__file__)
        for file in (path, path.with_name(code.name)):
            check_can_write(file, overwrite=overwrite)
        write_atomically(path, content.getvalue(), overwrite=overwrite)
        write_atomically(path.with_name(code.name), code.read_bytes(), overwrite=overwrite)
        return path

    def in_backend(self, backend: str) -> Run:
        """The same policies, with the task simulated by another back end.

        Raises:
          UserError: if the task has no such back end.
        """
        env = self.spec.env
        if not hasattr(env, "backend"):
            raise UserError(f"{env.name} has one back end only: drop the choice of {backend!r}")
        return dataclasses.replace(self, spec=dataclasses.replace(self.spec, env=checked(lambda: dataclasses.replace(env, backend=backend))))

    @in_float32
    def evaluate(
        self,
        *,
        episodes: int = 100,
        key: jax.Array | None = None,
        noise: float | None = None,
        report: Callable[[int], None] = lambda played: None,
    ) -> list[dict[str, float]]:
        """Plays fresh episodes with each seed's policy: a list of {seed, success, episode_length}, in order of the seeds.

        Args:
          episodes: how many, per seed.
          key: which.
          noise: of the actions, 0 for the mean ones, 1 for sampled ones; None for what the run has found to be best. A clone's are mean ones.
          report: called with the number of episodes played so far, all seeds together, where they are played one by one: in robosuite.
        """
        keys = jax.random.split(jax.random.key(0) if key is None else key, len(self.spec.seeds))
        result = self._trained(noise).evaluate(keys, episodes, report)
        return [
            {"seed": seed, "success": float(result.success[i].mean()), "episode_length": float(result.length[i].mean())}
            for i, seed in enumerate(self.spec.seeds)
        ]

    @in_float32
    def render(self, path: Path, *, seed: int | None = None, key: jax.Array | None = None, noise: float | None = None) -> int:
        """Films fresh episodes of one seed's policy (the first seed's by default); returns how many of them solved the task.

        Args:
          path: a .gif or .mp4 file, or a .png file for the last state alone.
          seed: one of the run's seeds.
          key: which episode, or (N,) keys of N episodes to be shown one after the other.
          noise: of the actions, 0 for the mean ones, 1 for sampled ones; None for what the run has found to be best. A clone's are mean ones.

        Raises:
          UserError: if the run has no such seed, or the film cannot be drawn.
        """
        env = self.spec.env
        keys = jnp.atleast_1d(jax.random.key(0) if key is None else key)
        check_film(path, len(keys))
        index = self._index_of(seed)
        trained = self._trained(noise)
        if can_be_watched(env):
            pictures, num_solved = trained.film(keys, index)
            with disk_trouble(path):
                save_pictures(pictures, [1.0 / env.render_fps] * len(pictures), path)
            return num_solved
        play_episode = trained.player(index, 1)
        played = [jax.device_get(play_episode(key_episode)) for key_episode in keys]
        draw_episodes(path, env, [episodes.states[0, : int(episodes.lengths[0]) + 1] for episodes in played])
        return sum(bool(episodes.terminated[0]) for episodes in played)

    @in_float32
    def play(self, episodes: int = 1, *, seed: int | None = None, key: jax.Array | None = None, noise: float | None = None) -> Episodes:
        """Plays fresh episodes with one seed's policy (the first seed's by default), to be looked at step by step; solved or not.

        Each episode aims at a behavioural goal that is drawn for it, as in `evaluate`: the end of a demonstration, say, or the episode's own.

        Args:
          episodes: N, how many.
          seed: one of the run's seeds.
          key: which.
          noise: of the actions, 0 for the mean ones, 1 for sampled ones; None for what the run has found to be best. A clone's are mean ones.

        Returns:
          A table of N episodes. Where JAX steps the environment, with their states; rows after the end repeat the last one, and `desired_goals` are
          what was achieved at the end. Of Gymnasium's environments without states; rows after the end are 0, and `desired_goals` were aimed at.

        Raises:
          UserError: if the run has no such seed.
        """
        return self._trained(noise).play(jax.random.key(0) if key is None else key, self._index_of(seed), episodes)

    def _trained(self, noise: float | None) -> TrainedPolicies:
        if noise is not None and not 0.0 <= noise < float("inf"):
            raise UserError(f"noise = {noise} is not usable: give 0 for the mean actions, 1 for sampled ones, or another finite number above 0")
        policies = self.policies if noise is None else self.policies.replace(noise=jnp.full_like(self.policies.noise, noise))
        return TrainedPolicies(self.spec.env, self.spec.config, policies, self.behavioural_goals)

    def _index_of(self, seed: int | None) -> int:
        """Where a seed, the first one by default, stands among those of the run."""
        seed = self.spec.seeds[0] if seed is None else seed
        if seed not in self.spec.seeds:
            raise UserError(f"{self.path} has no seed {seed}: choose one of {', '.join(map(str, self.spec.seeds))}")
        return self.spec.seeds.index(seed)


@in_float32
def draw_episodes(path: Path, env: Environment, episodes: Sequence[np.ndarray]) -> None:
    """Draws episodes from their states (length + 1, S each): a film of them, one after the other, or as a PNG the last state.

    Raises:
      UserError: for another kind of file, a place that cannot be written, states of another environment, or one that nothing draws.
    """
    check_film(path, len(episodes))
    if not isinstance(env, Restorable):
        raise UserError(f"demonstrations of {env.name} hold no states, so they cannot be drawn; `hindrl render` films the policies of a run")
    for vectors in episodes:
        if vectors.shape[-1] != env.state_dim:
            raise UserError(f"states of {vectors.shape[-1]} numbers are not those of {env.name}, which has {env.state_dim}: record them again")
    if path.suffix == ".png":
        episodes = [episodes[-1][-1:]]
    unpacked = iter(_unpacked(env, np.concatenate(episodes)))
    with disk_trouble(path):
        save_film(env, [list(itertools.islice(unpacked, len(episode))) for episode in episodes], path)


def _unpacked(env: Restorable, vectors: np.ndarray) -> list[Any]:
    """The states that vectors (T, S) give, with numpy leaves and all with the same key, by one program."""
    key = jax.random.key(0)
    unpack = jax.jit(jax.vmap(lambda vector: env.vector_to_state(key, vector)), compiler_options=compiler_options(env))
    leaves, structure = jax.tree.flatten(unpack(vectors))
    leaves = [[key] * len(vectors) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else np.asarray(leaf) for leaf in leaves]
    return [jax.tree.unflatten(structure, [leaf[step] for leaf in leaves]) for step in range(len(vectors))]


@in_float32
def load_run(path: str | os.PathLike[str], *, last: bool = False) -> Run:
    """Reads a run's directory.

    Args:
      path: the directory; or "policy:FixedParameterizedReach", a trained policy that comes with the package (`hindrl policies` lists them).
      last: take the policies at the end of the run, instead of the best that each seed has seen.

    Raises:
      UserError: if it is not the directory of a finished run, or there is no such policy.
    """
    path = run_directory(path)
    spec = read_spec(path)
    file = path / PARAMETERS
    if not file.exists():
        raise UserError(f"{path} holds no {PARAMETERS}: the run did not finish; go on with it by `hindrl train --resume {shlex.quote(str(path))}`")
    try:
        tree = unflatten_dict({name: jnp.asarray(array) for name, array in read_arrays(file).items()}, sep="/")
        goals = GoalTable(goals=tree["behavioural_goals"]["goals"], count=tree["behavioural_goals"]["count"])
        # Runs from before policies were kept have one, the last; its mean actions are played.
        actor = tree["last_policy" if last and "last_policy" in tree else "policy"]
        mean_actions = jnp.zeros(len(spec.seeds))
        noise = mean_actions if last else tree.get("policy_noise", mean_actions)
        policies = Policy(actor=actor, scale=_input_scale(tree["input_scale"]), noise=noise)
    except (*DAMAGED_ARCHIVE, AttributeError, IndexError) as error:
        raise UserError(f"{file} is damaged ({one_line(error)}): train again") from error
    critics = tree.get("critics") if spec.config.learns_from_rollouts else None
    _check_parameters(file, spec, (policies, goals, critics))
    return Run(path=path, spec=spec, policies=policies, behavioural_goals=goals, critics=critics)


class _Shape(tuple[int | None, ...]):
    """A shape as a leaf of a tree; None where any number will do."""


def _check_parameters(file: Path, spec: RunSpec, found: tuple[Policy, GoalTable, Params | None]) -> None:
    """Makes sure that the parameters are those of the configuration, and numbers.

    Raises:
      UserError: naming the first array that is not.
    """
    policies, goals, critics = _shapes_of(spec)
    shapes = (policies, goals, None if found[2] is None else critics)
    expected = jax.tree_util.tree_leaves_with_path(shapes, is_leaf=lambda leaf: type(leaf) is _Shape)
    arrays = {jax.tree_util.keystr(path): leaf for path, leaf in jax.tree_util.tree_leaves_with_path(found)}
    for path, shape in expected:
        name = jax.tree_util.keystr(path)
        array = arrays.pop(name, None)
        wanted = tuple(there if known is None else known for known, there in zip(shape, getattr(array, "shape", shape), strict=False))
        if array is None or array.shape != wanted or len(wanted) != len(shape):
            there = "none" if array is None else f"one of shape {array.shape}"
            raise UserError(
                f"{file} does not fit {CONFIG} beside it: that asks for an array {tuple('any' if n is None else n for n in shape)} in {name}, and "
                f"there is {there}; put back the {CONFIG} of the run, or train again"
            )
        real = jnp.issubdtype(array.dtype, jnp.floating) or jnp.issubdtype(array.dtype, jnp.integer)
        if not real or not bool(jnp.isfinite(array).all()):
            raise UserError(f"{file} holds what is no finite number in {name}, so its policies cannot be played: train again")
    if arrays:
        raise UserError(f"{file} does not fit {CONFIG} beside it: that asks for no array in {next(iter(arrays))}; put back the {CONFIG} of the run")
    count, num_goals = found[1].count, found[1].goals.shape[1]
    if not bool(((count >= 1) & (count <= num_goals)).all()):
        raise UserError(f"{file} is damaged (it counts {count.tolist()} of {num_goals} behavioural goals): train again")


def _shapes_of(spec: RunSpec) -> tuple[Policy, GoalTable, Params]:
    """The shapes of a run's policies, behavioural goals and critics, leaves tuples (S, ...); None where any number will do."""
    num_seeds, env = len(spec.seeds), hold(spec.env, spec.config.num_held, chunks=spec.config.action_chunks)
    dims = dict(observation=env.observation_dim, goal=env.goal_dim, observation_centre=env.observation_dim, goal_centre=env.goal_dim)
    vectors: dict[str, Any] = {name: jax.ShapeDtypeStruct((dim,), jnp.float32) for name, dim in dims.items()}

    def fresh(key: jax.Array, scale: InputScale) -> tuple[Policy, Params]:
        agent = init(key, scale, spec.config, action_dim=env.action_dim)
        return policy(agent, spec.config, average=True), agent.critics

    of_one = jax.eval_shape(fresh, jax.random.key(0), InputScale(**vectors))
    policies, critics = jax.tree.map(lambda leaf: _Shape((num_seeds, *leaf.shape)), of_one)
    table: dict[str, Any] = dict(goals=_Shape((num_seeds, None, env.goal_dim)), count=_Shape((num_seeds,)))
    return policies, GoalTable(**table), critics


def _input_scale(saved: dict[str, jax.Array]) -> InputScale:
    """The scale as it was saved. Runs from before inputs had a centre have theirs at 0."""
    observation, goal = saved["observation"], saved["goal"]
    centres = [saved.get(f"{name}_centre", jnp.zeros_like(saved[name])) for name in ("observation", "goal")]
    return InputScale(observation=observation, goal=goal, observation_centre=centres[0], goal_centre=centres[1])
