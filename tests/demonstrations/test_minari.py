"""Datasets of Minari, written by Minari here: read as what they mean, trained on, and given back as they were."""

import dataclasses
import gc
import importlib
import os
import warnings
from pathlib import Path

import gymnasium
import jax
import minari
import numpy as np
import pytest
from flat_env import to_corner
from foreign_files import TINY, refusal

from hindrl_jax import cli
from hindrl_jax.base.environments import action_to_env
from hindrl_jax.base.errors import UserError
from hindrl_jax.demonstrations.convert import load, read, write
from hindrl_jax.demonstrations.foreign import Interpretation
from hindrl_jax.demonstrations.hdf5 import read_recording
from hindrl_jax.tasks.registry import make


class GridGym(gymnasium.Env):
    """A grid task for Gymnasium: goal observations, actions in [-1, 1]."""

    def __init__(self, name, horizon=100, **arguments):
        self.env = make(name, horizon=horizon, **arguments)
        box = gymnasium.spaces.Box(-np.inf, np.inf, (self.env.observation_dim,), np.float32)
        self.observation_space = gymnasium.spaces.Dict(observation=box, achieved_goal=box, desired_goal=box)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (self.env.action_dim,), np.float32)
        self._step = jax.jit(self.env.step)

    def _observe(self, observation):
        observation = np.asarray(observation)
        return {"observation": observation, "achieved_goal": observation, "desired_goal": np.asarray(self.env.task_goal())}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state, observation = self.env.reset(jax.random.key(seed or 0))
        return self._observe(observation), {"steps": 0}

    def start_at(self, state):
        self.state = self.env.vector_to_state(jax.random.key(0), state)

    def step(self, action):
        self.state, time_step = self._step(self.state, action_to_env(jax.numpy.asarray(action), self.env))
        return (
            self._observe(time_step.observation),
            float(time_step.reward),
            bool(time_step.terminated),
            bool(time_step.truncated),
            {"steps": int(self.state.step)},
        )


def play_and_collect(demos, env_id):
    collector = minari.DataCollector(gymnasium.make(env_id, disable_env_checker=True), record_infos=True)
    for number, demo in enumerate(demos):
        collector.reset(seed=number)
        collector.unwrapped.start_at(demo.states[0])
        for action in demo.actions:
            collector.step(action)
    collector.reset(seed=5, options={"why": "unsolved"})
    for _ in range(3):
        collector.step(np.zeros(5, np.float32))
    about = dict(algorithm_name="expert", author="A", author_email="a@b.c", code_permalink="here", description="test", eval_env=env_id)
    dataset = collector.create_dataset("grid/collected-v0", **about)
    collector.close()
    return dataset


@pytest.fixture
def collected(recorded, monkeypatch):
    """A dataset that Minari's collector wrote, of the recorded demonstrations played in Gymnasium, and an unsolved episode of 3 steps."""
    spec = gymnasium.envs.registration.EnvSpec("hindrl/FixedGridPickAndPlace-v0", GridGym, max_episode_steps=100)
    spec.kwargs["name"] = "FixedGridPickAndPlace"
    monkeypatch.setitem(gymnasium.registry, spec.id, dataclasses.replace(spec, entry_point=f"{__name__}:GridGym"))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)  # Minari leaves a temporary folder to the garbage collector
        dataset = play_and_collect(read_recording(recorded).demonstrations, spec.id)
        gc.collect()
    return dataset


def assert_same_dataset(first, second):
    assert (second.env_spec, second.observation_space, second.action_space) == (first.env_spec, first.observation_space, first.action_space)
    assert second.total_steps == first.total_steps
    for one, other in zip(first.iterate_episodes(), second.iterate_episodes(), strict=True):
        for field in ("observations", "actions", "rewards", "terminations", "truncations", "infos"):
            before, after = jax.tree.leaves_with_path(getattr(one, field)), jax.tree.leaves_with_path(getattr(other, field))
            assert [path for path, _ in before] == [path for path, _ in after], field
            for (_, array), (_, same) in zip(before, after, strict=True):
                np.testing.assert_array_equal(same, array)
                assert same.dtype == array.dtype, field
    metadata = [list(dataset.storage.get_episode_metadata(dataset.episode_indices)) for dataset in (first, second)]
    assert metadata[0] == metadata[1]
    names = ("algorithm_name", "author", "author_email", "code_permalink", "description", "eval_env_spec")
    assert all(first.storage.metadata[name] == second.storage.metadata[name] for name in names)


def test_minari_dataset_loads_trains_and_comes_back(collected, recorded, env, tmp_path, capsys):
    recording = read("minari:grid/collected-v0")
    assert (recording.env_name, recording.env_kwargs) == ("FixedGridPickAndPlace", dataclasses.asdict(env))
    assert [demo.terminated for demo in recording.demonstrations] == [True, True, False]
    for demo, original in zip(recording.demonstrations, read_recording(recorded).demonstrations, strict=False):
        np.testing.assert_array_equal(demo.observations[1:], original.observations[1:])
        np.testing.assert_array_equal(demo.actions, original.actions)
        np.testing.assert_array_equal(demo.rewards, original.rewards)
        np.testing.assert_array_equal(demo.desired_goal, env.task_goal())
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        cli.main(["train", "--demos", "minari:grid/collected-v0", "--out", str(tmp_path / "run"), "--demo-reset-ratio", "0", *TINY])
    assert "dropped 1 of 3 demonstrations that do not solve" in capsys.readouterr().err
    assert (tmp_path / "run" / "summary.json").exists()
    ours = tmp_path / "ours.hdf5"
    cli.main(["demos", "convert", "minari:grid/collected-v0", str(ours)])
    capsys.readouterr()
    cli.main(["demos", "convert", str(ours), "minari:grid/back-v0"])
    assert "left out" not in capsys.readouterr().out
    assert_same_dataset(collected, minari.load_dataset("grid/back-v0"))
    assert sorted(minari.list_local_datasets()) == ["grid/back-v0", "grid/collected-v0"]


def collect_two_flat_episodes(name):
    """One into the corner, and one that ends elsewhere: how long the first is, and the observations where it begins and ends."""
    collector = minari.DataCollector(gymnasium.make("PointFlat-v0", says="last", disable_env_checker=True))
    observation, _ = collector.reset(seed=3)
    begun, length, ended = observation, 0, False
    while not ended:
        observation, _, ended, _, _ = collector.step(to_corner(observation, np.random.default_rng(0)).astype(np.float32))
        length += 1
    collector.reset(seed=4)
    collector.step(np.zeros(2, np.float32))
    about = dict(algorithm_name="expert", author="A", author_email="a@b.c", code_permalink="here", description="test", eval_env="PointFlat-v0")
    collector.create_dataset(name, **about)
    collector.close()
    return length, begun, observation


def test_flat_observations_are_learned_from_where_they_were_recorded():
    """The dataset knows the environment without the module that registers it."""
    env = make("gymnasium:flat_env:PointFlat-v0", says="last", achieved_goal_indices=(0, 1))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)  # Minari leaves a temporary folder to the garbage collector
        length, begun, observation = collect_two_flat_episodes("flat/point-v0")
        gc.collect()
    table = load("minari:flat/point-v0", env)
    assert table.lengths.tolist() == [length, 1]
    assert table.terminated.tolist() == [True, False]
    np.testing.assert_array_equal(table.observations[0, [0, length]], [begun, observation])
    np.testing.assert_array_equal(table.desired_goals[0], observation[:2])
    assert "was recorded in gymnasium:PointFlat-v0, not in gymnasium:Pendulum-v1" in refusal(
        lambda: load("minari:flat/point-v0", make("gymnasium:Pendulum-v1"))
    )


def test_dataset_of_an_environment_that_is_not_ours(tmp_path):
    """A flat Gymnasium task of goals: rewards of -1 and 0, actions beyond [-1, 1], success in the infos, which goes on."""
    rows = np.arange(5.0)[:, None]
    buffer = importlib.import_module("minari.data_collector").EpisodeBuffer(
        observations={"observation": rows, "achieved_goal": 10 * rows, "desired_goal": np.full((5, 1), 20.0)},
        actions=np.array([[2.0], [1.0], [0.0], [-2.0]], np.float32),
        rewards=np.array([-1.0, 0.0, 0.0, 0.0]),
        terminations=np.zeros(4, bool),
        truncations=np.arange(4) == 3,
        infos={"success": np.array([False, False, True, True, True]), "text": ["a", "b", "c", "d", "e"]},
    )
    box = gymnasium.spaces.Box(-np.inf, np.inf, (1,), np.float64)
    spec = gymnasium.envs.registration.EnvSpec("Reach-v3", "nowhere:Reach", max_episode_steps=4, kwargs={"wide": True})
    storage = importlib.import_module("minari.dataset.minari_storage").MinariStorage
    folder = tmp_path / "minari" / "reach-v0" / "data"
    folder.mkdir(parents=True)
    storage = storage.new(
        folder,
        observation_space=gymnasium.spaces.Dict(observation=box, achieved_goal=box, desired_goal=box),
        action_space=gymnasium.spaces.Box(-2.0, 2.0, (1,), np.float32),
        env_spec=spec,
    )
    storage.update_metadata({"dataset_id": "reach-v0", "minari_version": minari.__version__, "author": {"A"}})
    storage.update_episodes([buffer])
    dataset = minari.load_dataset("reach-v0")

    assert "is done after 2 of 4 steps and goes on" in refusal(lambda: read("minari:reach-v0"))
    (demo,) = read("minari:reach-v0", Interpretation(cut=True, sparse_rewards=True)).demonstrations
    assert demo.observations.tolist() == [[0, 0], [1, 10], [2, 20]]  # [observation, achieved_goal], as `--env gymnasium:ID` has it
    assert (demo.achieved_goals.tolist(), demo.desired_goal.tolist()) == ([[0], [10], [20]], [20])
    assert (demo.actions.tolist(), demo.rewards.tolist(), demo.terminated) == ([[1.0], [0.5]], [0, 1], True)

    recording = read("minari:reach-v0", Interpretation(solved="all"))
    assert (recording.env_name, recording.env_kwargs) == ("gymnasium:Reach-v3", {"make_kwargs": ["wide=true"]})
    write(str(tmp_path / "ours.hdf5"), recording)
    write("minari:back-v0", read(str(tmp_path / "ours.hdf5")))
    back = minari.load_dataset("back-v0")
    assert (back.env_spec, back.action_space) == (dataset.env_spec, dataset.action_space)
    one, other = dataset[0], back[0]
    jax.tree.map(np.testing.assert_array_equal, dataclasses.asdict(one), dataclasses.asdict(other))


def test_names_and_places_of_minari(recorded, minari_folder, monkeypatch):
    assert "write minari:NAME-v0" in refusal(lambda: read("minari:grid"))
    assert "minari download grid-v0" in refusal(lambda: read("minari:grid-v0"))
    assert not minari_folder.exists()
    recording = read_recording(recorded)
    write("minari:grid-v0", recording)
    assert refusal(lambda: write("minari:grid-v0", recording)).startswith(f"minari:grid-v0 in {minari_folder}: exists already; ")
    short = dataclasses.replace(recording, demonstrations=recording.demonstrations[:1])
    write("minari:grid-v0", short, overwrite=True)
    assert minari.load_dataset("grid-v0").total_episodes == 1
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(recorded / "inside_a_file"))
    assert "is a file" in refusal(lambda: write("minari:grid-v0", recording))


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
@pytest.mark.parametrize("existing", [False, True])
def test_failing_write_leaves_the_dataset_as_it_was(recorded, minari_folder, monkeypatch, error, existing):
    recording = read_recording(recorded)
    if existing:
        write("minari:group/grid-v0", dataclasses.replace(recording, demonstrations=recording.demonstrations[:1]))
    before = sorted(minari_folder.rglob("*"))

    def fail(*_args):
        raise error

    storage = importlib.import_module("minari.dataset.minari_storage").MinariStorage
    monkeypatch.setattr(storage, "update_metadata", fail)
    with pytest.raises(KeyboardInterrupt if isinstance(error, KeyboardInterrupt) else UserError):
        write("minari:group/grid-v0", recording, overwrite=True)
    assert sorted(minari_folder.rglob("*")) == before
    if existing:
        assert minari.load_dataset("group/grid-v0").total_episodes == 1


def test_without_minari(monkeypatch):
    monkeypatch.setitem(importlib.import_module("sys").modules, "minari", None)
    (Path(os.environ["MINARI_DATASETS_PATH"]) / "grid-v0" / "data").mkdir(parents=True)
    assert "hindrl-jax[minari]" in refusal(lambda: read("minari:grid-v0"))
