"""Demonstrations of other tools: read as what they mean, trained on, and given back as they were.

tests/data/robomimic_low_dim.hdf5 was written by robomimic 0.3.0 (see tests/interop/robomimic_grid.py): its dataset_states_to_obs, with --done_mode 0,
and its split_train_val, on two demonstrations of FixedGridPickAndPlace. Minari datasets are written by Minari here.
"""

import dataclasses
import gc
import importlib
import json
import os
import shlex
import shutil
import warnings
from pathlib import Path

import gymnasium
import h5py
import jax
import minari
import numpy as np
import pytest
from commands import refusal as command_refusal

from hindrl_jax import cli
from hindrl_jax.base.environments import action_to_env
from hindrl_jax.base.errors import UserError
from hindrl_jax.base.types import Episodes
from hindrl_jax.demonstrations.convert import Interpretation, load, read, restore, write
from hindrl_jax.demonstrations.hdf5 import load_demonstrations, read_recording
from hindrl_jax.tasks.registry import make

ROBOMIMIC_FILE = Path(__file__).parent.parent / "data" / "robomimic_low_dim.hdf5"
KEYS = ("objects", "goal", "delivered", "held")  # in this order they are the observation of the grid tasks
MEANING = Interpretation(observation_keys=KEYS)
TINY = shlex.split(
    "--num-envs 2 --learning-starts 200 --steps 240 --eval-every 40 --eval-episodes 1 --updates-per-iteration 1 "
    "--batch-size 16 --net-arch 8 --buffer-size 2000"
)


@pytest.fixture(scope="module")
def env():
    return make("FixedGridPickAndPlace")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A file of ours with two demonstrations."""
    path = tmp_path_factory.mktemp("recorded") / "demos.hdf5"
    cli.main(["demos", "record", "--env", "FixedGridPickAndPlace", "--demos", "2", "--seed", "7", "--out", str(path)])
    return path


@pytest.fixture(autouse=True)
def minari_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    return tmp_path / "minari"


@pytest.fixture
def low_dim(tmp_path):
    """A copy of robomimic's file, to be changed."""
    return Path(shutil.copy(ROBOMIMIC_FILE, tmp_path / "low_dim.hdf5"))


def content(path):
    """All datasets and attributes of an HDF5 file."""
    found = {}
    with h5py.File(path) as file:
        file.visititems(lambda name, item: found.update({name: (item[()] if isinstance(item, h5py.Dataset) else None, dict(item.attrs))}))
    return found


def assert_same_file(first, second):
    first, second = content(first), content(second)
    assert first.keys() == second.keys()
    for name, (array, attributes) in first.items():
        if array is not None:
            np.testing.assert_array_equal(second[name][0], array, err_msg=name)
            assert second[name][0].dtype == array.dtype, name
        assert {key: str(value) for key, value in second[name][1].items()} == {key: str(value) for key, value in attributes.items()}, name


def assert_same_episodes(first, second):
    for field in dataclasses.fields(Episodes):
        np.testing.assert_array_equal(getattr(first, field.name), getattr(second, field.name), err_msg=field.name)


def refusal(call) -> str:
    with pytest.raises(UserError) as error:
        call()
    message = str(error.value)
    assert "\n" not in message
    return message


# robomimic


def test_robomimic_file_means_what_it_says(env, tmp_path):
    recording = read(str(ROBOMIMIC_FILE), MEANING)
    assert (recording.env_name, recording.env_kwargs) == ("FixedGridPickAndPlace", dataclasses.asdict(env))
    assert [(demo.name, len(demo), demo.terminated) for demo in recording.demonstrations] == [("demo_1", 58, True), ("demo_2", 54, True)]
    with h5py.File(ROBOMIMIC_FILE) as file:
        for demo in recording.demonstrations:
            group = file[f"data/{demo.name}"]
            parts = [np.concatenate([group[f"obs/{key}"], group[f"next_obs/{key}"][-1:]]) for key in KEYS]
            np.testing.assert_array_equal(demo.observations, np.concatenate(parts, axis=1))
            np.testing.assert_array_equal(demo.achieved_goals, demo.observations)  # what the grid tasks derive
            np.testing.assert_array_equal(demo.desired_goal, demo.observations[-1])
            np.testing.assert_array_equal(demo.actions, group["actions"])
            assert demo.rewards.tolist() == [0.0] * (len(demo) - 1) + [1.0]
            # robomimic has no last state; it is found by the last action, and looks as the last observation
            np.testing.assert_array_equal(demo.states[:-1], group["states"])
            np.testing.assert_array_equal(env.observe(env.vector_to_state(jax.random.key(0), demo.states[-1])), demo.observations[-1])
    write(str(tmp_path / "ours.hdf5"), recording)
    loaded = load_demonstrations(tmp_path / "ours.hdf5", env)
    assert loaded.observations.shape == (2, 101, 10)
    assert loaded.states is not None


def test_converted_robomimic_file_trains_and_comes_back(tmp_path, capsys):
    ours, back, archive = tmp_path / "ours.hdf5", tmp_path / "back.hdf5", tmp_path / "ours.npz"
    cli.main(["demos", "convert", str(ROBOMIMIC_FILE), str(ours), "--observation-keys", *KEYS])
    assert "2 demonstrations of FixedGridPickAndPlace, 2 solved, 112 transitions" in capsys.readouterr().out
    # the source's own modalities and filter keys are still there for robomimic
    with h5py.File(ours) as file:
        assert file["data/demo_1/next_obs/objects"].shape == (58, 4)
        assert file["mask/train"][()].tolist() == [b"demo_1"]
    cli.main(["train", "--demos", str(ours), "--out", str(tmp_path / "run"), *TINY])
    assert (tmp_path / "run" / "summary.json").exists()
    cli.main(["demos", "convert", str(ours), str(back), "--restore"])
    assert_same_file(ROBOMIMIC_FILE, back)
    cli.main(["demos", "convert", str(ours), str(archive)])
    cli.main(["demos", "convert", str(archive), str(back), "--restore", "--overwrite"])
    assert_same_file(ROBOMIMIC_FILE, back)


def test_filter_key(tmp_path):
    meaning = dataclasses.replace(MEANING, filter_key="valid")
    assert [demo.name for demo in read(str(ROBOMIMIC_FILE), meaning).demonstrations] == ["demo_2"]
    message = refusal(lambda: read(str(ROBOMIMIC_FILE), dataclasses.replace(MEANING, filter_key="test")))
    assert "no filter key 'test'; it has train, valid" in message


def test_task_that_is_not_ours(low_dim, tmp_path):
    """Goals are then taken from modalities, whole or some of their columns; the file keeps the name of the task and has no states for us."""
    with h5py.File(low_dim, "r+") as file:
        file["data"].attrs["env_args"] = json.dumps({"env_name": "Lift", "type": 1, "env_kwargs": {"robots": ["Panda"]}})
    meaning = Interpretation(observation_keys=("goal", "objects"), achieved_goal_keys=("objects[2:4]", "goal[1]"))
    write(str(tmp_path / "ours.hdf5"), read(str(low_dim), meaning))
    recording = read_recording(tmp_path / "ours.hdf5")
    assert (recording.env_name, recording.env_kwargs) == ("Lift", {"robots": ["Panda"]})
    first = recording.demonstrations[0]
    with h5py.File(low_dim) as file:
        np.testing.assert_array_equal(first.observations[:-1, 2:], file["data/demo_1/obs/objects"])
        np.testing.assert_array_equal(first.achieved_goals[:-1, :2], file["data/demo_1/obs/objects"][:, 2:4])
        np.testing.assert_array_equal(first.achieved_goals[:-1, 2], file["data/demo_1/obs/goal"][:, 1])
    np.testing.assert_array_equal(first.desired_goal, first.achieved_goals[-1])
    assert first.states is None
    with h5py.File(tmp_path / "ours.hdf5") as file:  # robomimic can still play the states back in its own environment
        assert json.loads(file["data"].attrs["env_args"])["type"] == 1
        assert file["data/demo_1/states"].shape == (58, 11)
    restore(tmp_path / "back.hdf5", recording, source="ours.hdf5")
    assert_same_file(low_dim, tmp_path / "back.hdf5")


def change(path, name, function):
    """Replaces a dataset of both demonstrations."""
    with h5py.File(path, "r+") as file:
        for demo in file["data"].values():
            array = function(demo[name][()])
            del demo[name]
            if array is not None:
                demo[name] = array


def remove_next_obs(path):
    with h5py.File(path, "r+") as file:
        for demo in file["data"].values():
            del demo["next_obs"]


def with_entry(index, value):
    def changed(array):
        array[index] = value
        return array

    return changed


@pytest.mark.parametrize(
    ("damage", "meaning", "words"),
    [
        (None, {"observation_keys": ()}, ["no modality 'observation'", "--observation-keys", "delivered (2), goal (2), held (2), objects (4)"]),
        (None, {"observation_keys": ("object",)}, ["--observation-keys object: there is no such modality"]),
        (None, {"observation_keys": ("objects",)}, ["have 4 numbers, but FixedGridPickAndPlace has 10"]),
        (None, {"observation_keys": (*KEYS[:3], "held[0:3]")}, ["held[0:3]: has no such columns", "from 0 to 2"]),
        (None, {"desired_goal_keys": KEYS}, ["demo_1", "the desired goal changes"]),
        (None, {"action_low": (0.0,)}, ["demo_1", "actions go from -1", "--action-low"]),
        (None, {"action_low": (0.0, 0.0)}, ["5 actions, but 2 bounds"]),
        (None, {"action_low": (1.0,)}, ["the lowest action must be below the highest"]),
        (lambda path: change(path, "actions", lambda a: 3 * a), {}, ["demo_1", "from -3 to 3", "--action-low and --action-high"]),
        (lambda path: change(path, "actions", with_entry((4, 1), np.nan)), {}, ["demo_1", "actions is not finite in row 4"]),
        (lambda path: change(path, "actions", lambda a: a[:-1]), {}, ["demo_1", "57 actions", "inconsistent"]),
        (lambda path: change(path, "actions", lambda a: None), {}, ["demo_1", "actions is missing"]),
        (lambda path: change(path, "dones", lambda a: None), {}, ["demo_1", "no dones", "--solved reward or --solved all"]),
        (lambda path: change(path, "dones", with_entry(40, 1)), {}, ["demo_1", "is done after 41 of 58 steps and goes on", "--cut"]),
        (lambda path: change(path, "next_obs/held", with_entry((3, 0), 9)), {}, ["demo_1", "row 3 of next_obs/held is not row 4 of obs/held"]),
        (remove_next_obs, {}, ["demo_1", "next_obs is missing", "--repeat-last-observation"]),
    ],
)
def test_what_does_not_fit_is_named(low_dim, damage, meaning, words, tmp_path):
    read(str(low_dim), MEANING)
    if damage:
        damage(low_dim)
    message = refusal(lambda: read(str(low_dim), dataclasses.replace(MEANING, **meaning)))
    assert message.startswith(str(low_dim))
    for word in words:
        assert word in message, message


def test_options_that_mend_a_file(low_dim):
    change(low_dim, "dones", with_entry(40, 1))
    change(low_dim, "actions", lambda actions: 0.3 * actions.astype(np.float64) + 0.1)
    meaning = dataclasses.replace(MEANING, cut=True, sparse_rewards=True, action_low=(-0.2,), action_high=(0.4,))
    recording = read(str(low_dim), meaning)
    original = read(str(ROBOMIMIC_FILE), MEANING)
    for demo, whole in zip(recording.demonstrations, original.demonstrations, strict=True):
        assert (len(demo), demo.terminated) == (41, True)
        np.testing.assert_array_equal(demo.observations, whole.observations[:42])
        np.testing.assert_array_equal(demo.states, whole.states[:42])
        np.testing.assert_allclose(demo.actions, whole.actions[:41], atol=1e-6)  # -0.2 is -1, and 0.4 is 1
        assert demo.rewards.tolist() == [0.0] * 40 + [1.0]
        np.testing.assert_allclose(demo.extras["source/actions"], 0.3 * whole.actions[:41] + 0.1, atol=1e-7)
        assert demo.extras["source/rewards"].tolist() == [0.0] * 41


def test_what_a_reward_means_is_settled_by_the_whole_file(tmp_path):
    """In a file of rewards 0 and 1, a demonstration without any has failed; in one of -1 and 0, a 0 is the success."""
    for rewards, expected in (([[0, 0, 1], [0, 0, 0]], [True, False]), ([[-1, -1, 0], [-1, -1, -1]], [True, False]), ([[0, 0, 0]], [False])):
        path = tmp_path / f"{len(rewards)}{rewards[0][0]}.npz"
        given = dict(lengths=[3] * len(rewards), observations=np.zeros((4 * len(rewards), 1)), achieved_goals=np.zeros((4 * len(rewards), 1)))
        np.savez(path, actions=np.zeros((3 * len(rewards), 1)), rewards=np.concatenate(rewards).astype(float), **given)
        recording = read(str(path), Interpretation(solved="reward"))
        assert [demo.terminated for demo in recording.demonstrations] == expected


@pytest.mark.parametrize("about", [{"names": ["a"]}, {"names": ["a", "a"]}, {"names": "ab"}, {"env_kwargs": [1]}, {"env_name": 3}])
def test_what_an_archive_says_about_itself_is_checked(tmp_path, about):
    given = dict(lengths=[1, 1], observations=np.zeros((4, 1)), achieved_goals=np.zeros((4, 1)), actions=np.zeros((2, 1)))
    np.savez(tmp_path / "demos.npz", about=json.dumps(about), **given)
    with pytest.raises(UserError, match="about"):
        read(str(tmp_path / "demos.npz"), Interpretation(solved="all"))


def test_every_damaged_byte_of_an_archive_is_one_line(tmp_path):
    path, rng = tmp_path / "demos.npz", np.random.default_rng(0)
    np.savez_compressed(path, lengths=[2], observations=np.arange(6.0).reshape(3, 2), actions=np.zeros((2, 1)), achieved_goals=np.zeros((3, 1)))
    intact, refused = path.read_bytes(), 0
    for _ in range(150):
        damaged = bytearray(intact)
        damaged[rng.integers(len(damaged))] = rng.integers(256)
        path.write_bytes(damaged)
        try:
            read(str(path), Interpretation(solved="all"))
        except UserError:
            refused += 1
    assert refused > 50
    np.save(tmp_path / "alone.npy", np.zeros(3))
    (tmp_path / "alone.npy").rename(path)
    with pytest.raises(UserError, match="is not an archive"):
        read(str(path), Interpretation(solved="all"))


def test_demonstrations_that_count_as_solved_whole_are_not_cut():
    with pytest.raises(UserError, match="cut = True needs solved to be 'dones' or 'reward'"):
        Interpretation(solved="all", cut=True)


@pytest.mark.parametrize(
    ("dones", "rewards", "solved", "expected"),
    [
        ([0, 0, 1], [0, 0, 0], "dones", True),
        ([0, 0, 0], [0, 0, 1], "dones", False),
        ([0, 0, 0], [0, 0, 0.5], "reward", True),
        ([0, 0, 1], [0, 0, 0.0], "reward", False),
        ([0, 0, 1], [-1, -1, 0], "reward", True),
        ([0, 0, 1], [-1, -1, -1], "reward", False),
        ([0, 1, 0], [0, 0, 0], "all", True),
    ],
)
def test_which_demonstrations_are_solved(tmp_path, dones, rewards, solved, expected):
    path = tmp_path / "demos.hdf5"
    with h5py.File(path, "w") as file:
        demo = file.create_group("data/demo_0")
        file["data"].attrs["env_args"] = json.dumps({"env_name": "Line", "type": 2, "env_kwargs": {}})
        demo["obs/x"], demo["next_obs/x"] = np.arange(3.0), np.arange(1.0, 4.0)
        demo["actions"], demo["dones"], demo["rewards"] = np.zeros((3, 1)), np.array(dones), np.array(rewards, np.float64)
    meaning = Interpretation(observation_keys=("x",), achieved_goal_keys=("x",), solved=solved)
    if expected is None:
        assert "rewarded after 1 of 3 steps" in refusal(lambda: read(str(path), meaning))
    else:
        assert read(str(path), meaning).demonstrations[0].terminated is expected


def test_repeated_last_observation(low_dim):
    remove_next_obs(low_dim)
    demo = read(str(low_dim), dataclasses.replace(MEANING, repeat_last_observation=True)).demonstrations[0]
    np.testing.assert_array_equal(demo.observations[-1], demo.observations[-2])
    assert demo.states is None  # the state after the last action does not look like that


def test_file_without_observations(low_dim):
    """As robosuite's own collecting script leaves it."""
    with h5py.File(low_dim, "r+") as file:
        del file["data"].attrs["env_args"]
        file["data"].attrs["env"] = "Lift"
        for demo in file["data"].values():
            for name in ("obs", "next_obs", "rewards", "dones"):
                del demo[name]
            del demo.attrs["num_samples"]
    message = refusal(lambda: read(str(low_dim), MEANING))
    assert "holds no observations" in message
    assert "dataset_states_to_obs" in message


def test_foreign_file_given_to_train_points_to_convert(env):
    message = refusal(lambda: load(str(ROBOMIMIC_FILE), env))
    assert "--observation-keys" in message
    assert "hindrl demos convert" in message


# Minari


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
    assert "exists already" in refusal(lambda: write("minari:grid-v0", recording))
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


# Round trips and npz


@pytest.mark.parametrize("through", ["demos.npz", "minari:there-v0"])
def test_round_trip_gives_back_the_same_bytes(recorded, through, tmp_path, env):
    through = through if through.startswith("minari:") else str(tmp_path / through)
    write(through, read(str(recorded)))
    assert_same_episodes(load(through, env), load_demonstrations(recorded, env))
    write(str(tmp_path / "back.hdf5"), read(through))
    assert (tmp_path / "back.hdf5").read_bytes() == recorded.read_bytes()


def test_layout_of_the_archive(recorded, tmp_path):
    write(str(tmp_path / "demos.npz"), read_recording(recorded))
    demos = read_recording(recorded).demonstrations
    with np.load(tmp_path / "demos.npz", allow_pickle=False) as archive:
        assert archive["lengths"].tolist() == [len(demo) for demo in demos]
        assert archive["terminated"].tolist() == [True, True]
        for name, field, row in (("observations", "observations", -1), ("actions", "actions", 0), ("states", "states", 3)):
            np.testing.assert_array_equal(archive[name], np.concatenate([getattr(demo, field) for demo in demos]))
            np.testing.assert_array_equal(archive[name][row], getattr(demos[row if row < 0 else 0], field)[row])
        np.testing.assert_array_equal(archive["desired_goals"], [demo.desired_goal for demo in demos])
        assert json.loads(str(archive["about"]))["env_name"] == "FixedGridPickAndPlace"


def archive(path, **changes):
    """An archive as somebody else would write it: two demonstrations, of 1 and 2 transitions."""
    arrays = {
        "lengths": [1, 2],
        "observations": np.arange(10.0).reshape(5, 2),
        "actions": np.zeros((3, 1)),
        "achieved_goals": np.arange(5.0)[:, None],
    }
    np.savez(path, **{name: np.asarray(value) for name, value in (arrays | changes).items() if value is not None})
    return str(path)


def test_archive_of_somebody_else(tmp_path):
    first, second = read(archive(tmp_path / "a.npz")).demonstrations
    assert first.observations.tolist() == [[0, 1], [2, 3]]
    assert second.observations.tolist() == [[4, 5], [6, 7], [8, 9]]
    assert (second.achieved_goals.tolist(), second.desired_goal.tolist()) == ([[2], [3], [4]], [4])
    assert (second.rewards.tolist(), second.terminated, second.states) == ([0, 1], True, None)
    about = json.dumps({"env_name": "Line"})
    changed = archive(tmp_path / "b.npz", terminated=[True, False], desired_goals=[[7], [8]], rewards=[1, 2, 3], about=about)
    recording = read(changed)
    assert recording.env_name == "Line"
    assert [demo.terminated for demo in recording.demonstrations] == [True, False]
    assert [demo.desired_goal.tolist() for demo in recording.demonstrations] == [[7], [8]]
    assert recording.demonstrations[1].rewards.tolist() == [2, 3]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"lengths": None}, "no array 'lengths'"),
        ({"lengths": [1, 0]}, "at least 1"),
        ({"lengths": [1, 3]}, "observations has shape (5, 2), expected (6, any)"),
        ({"actions": np.full((3, 1), 2.0)}, "actions go from 2 to 2"),
        ({"rewards": [0, np.nan, 0]}, "rewards does not hold finite numbers only"),
        ({"achieved_goals": None}, "--achieved-goal-keys"),
        ({"about": "[]"}, "about"),
        ({"about": json.dumps({"format_version": 1})}, "damaged"),
        ({"observations": np.array([None] * 5)}, "not an archive"),
    ],
)
def test_archives_that_do_not_fit(tmp_path, changes, words):
    message = refusal(lambda: read(archive(tmp_path / "a.npz", **changes)))
    assert words in message, message


def test_what_is_no_archive(tmp_path):
    (tmp_path / "a.npz").write_text("not an archive")
    assert "not an archive" in refusal(lambda: read(str(tmp_path / "a.npz")))
    assert "no such file" in refusal(lambda: read(str(tmp_path / "b.npz")))


# The command line


def test_refusals_write_nothing(recorded, tmp_path, capsys):
    ours, other = tmp_path / "ours.hdf5", tmp_path / "other.npz"
    other.write_text("mine")
    convert = ("demos", "convert")
    assert "exists already" in command_refusal(capsys, *convert, recorded, other)
    assert "does not say a format" in command_refusal(capsys, *convert, recorded, tmp_path / "demos")
    assert "leave out --env" in command_refusal(capsys, *convert, recorded, ours, "--env", "GridPickAndPlace")
    assert "leave out --env" in command_refusal(capsys, *convert, ROBOMIMIC_FILE, ours, "--env", "GridPickAndPlace", "--observation-keys", *KEYS)
    assert "leave out the options" in command_refusal(capsys, *convert, recorded, ours, "--solved", "all")
    assert "not converted from a robomimic file" in command_refusal(capsys, *convert, recorded, ours, "--restore")
    assert "no such file" in command_refusal(capsys, *convert, tmp_path / "missing.hdf5", ours)
    assert "--observation-keys" in command_refusal(capsys, *convert, ROBOMIMIC_FILE, ours)
    assert [path.name for path in tmp_path.iterdir()] == ["other.npz"]
    assert other.read_text() == "mine"


def test_environment_named_on_the_command_line(recorded, tmp_path):
    """For a file that does not say which of our environments it is of; the goals are then derived, and the environment's options are flags."""
    recording = read_recording(recorded)
    arrays = dict(
        lengths=[len(demo) for demo in recording.demonstrations],
        observations=np.concatenate([demo.observations for demo in recording.demonstrations]),
        actions=np.concatenate([demo.actions for demo in recording.demonstrations]),
        achieved_goals=None,
    )
    source = archive(tmp_path / "bare.npz", **arrays)
    cli.main(["demos", "convert", source, str(tmp_path / "ours.hdf5"), "--env", "FixedGridPickAndPlace", "--horizon", "200"])
    converted = read_recording(tmp_path / "ours.hdf5")
    assert (converted.env_name, converted.env_kwargs["horizon"]) == ("FixedGridPickAndPlace", 200)
    np.testing.assert_array_equal(converted.demonstrations[1].achieved_goals, recording.demonstrations[1].achieved_goals)


def test_info_and_plot_of_foreign_files(recorded, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    cli.main(["demos", "info", str(ROBOMIMIC_FILE)])
    printed = capsys.readouterr().out
    for words in (
        "robomimic, FixedGridPickAndPlace, 2 demonstrations, 112 transitions",
        "filter key train: 1 demonstration",
        "objects",
        "--observation-keys",
    ):
        assert words in printed
    cli.main(["demos", "info", str(ROBOMIMIC_FILE), "--observation-keys", *KEYS, "--m", "5"])
    assert "2 demonstrations, 2 solved, 112 transitions" in capsys.readouterr().out
    write("minari:group/grid-v0", read_recording(recorded))
    keeps = []
    for source in (str(recorded), "minari:group/grid-v0"):
        cli.main(["demos", "info", source, "--m", "3"])
        keeps.append(next(line for line in capsys.readouterr().out.splitlines() if line.startswith("the filter keeps")))
    assert keeps[0] == keeps[1]
    cli.main(["demos", "plot", "minari:group/grid-v0", "--m", "3"])
    assert (tmp_path / "grid-v0.png").read_bytes().startswith(b"\x89PNG")
