"""Files of other tools as they come: links, texts, names, infos of any shape, numbers that are not finite where nobody looks."""

import dataclasses
import importlib
import json

import gymnasium
import h5py
import minari
import numpy as np
import pytest
from foreign_files import KEYS, MEANING, archive, assert_same_file, refusal

from hindrl_jax import cli
from hindrl_jax.demonstrations.convert import load, read, restore, write
from hindrl_jax.demonstrations.hdf5 import read_recording
from hindrl_jax.demonstrations.recording import Recording
from hindrl_jax.tasks.registry import make

CONVERT = ("--observation-keys", *KEYS)


def converted_back(source, tmp_path):
    """Through a file of ours, and through an archive."""
    ours, flat, back = tmp_path / "ours.hdf5", tmp_path / "flat.npz", tmp_path / "back.hdf5"
    write(str(ours), read(str(source), MEANING))
    write(str(flat), read(str(ours)))
    for through in (ours, flat):
        restore(back, read(str(through)), source=str(through), overwrite=True)
        yield back


def same_content(first, second):
    """All datasets, what links lead to included, and the attributes of the file, the group `data` and the demonstrations."""
    with h5py.File(first) as one, h5py.File(second) as other:

        def compare(here, there, path):
            assert sorted(here) == sorted(there), path
            for name in here:
                if isinstance(here[name], h5py.Group):
                    compare(here[name], there[name], f"{path}{name}/")
                else:
                    np.testing.assert_array_equal(there[name][()], here[name][()], err_msg=path + name)
                    assert there[name].dtype == here[name].dtype, path + name

        compare(one, other, "")
        for place in ("/", "data", *(f"data/{name}" for name in one["data"] if isinstance(one["data"][name], h5py.Group))):
            assert {name: str(value) for name, value in one[place].attrs.items()} == {name: str(value) for name, value in other[place].attrs.items()}


def test_links_of_all_kinds_are_followed_and_restored_as_copies(low_dim, tmp_path):
    expected = read(str(low_dim), MEANING)
    with h5py.File(tmp_path / "beside.hdf5", "w") as beside, h5py.File(low_dim, "r+") as file:
        for name, demo in file["data"].items():
            for group in ("obs", "next_obs"):
                file.copy(demo[f"{group}/goal"], beside, name=f"{name}/{group}/goal")
                del demo[f"{group}/goal"]
                demo[f"{group}/goal"] = h5py.ExternalLink("beside.hdf5", f"/{name}/{group}/goal")
                demo[f"{group}/objects_again"] = h5py.SoftLink(f"/data/{name}/{group}/objects")
                demo[f"{group}/held_again"] = demo[f"{group}/held"]
        file["linked"] = h5py.SoftLink("/data/demo_1/actions")
    recording = read(str(low_dim), MEANING)
    for demo, wanted in zip(recording.demonstrations, expected.demonstrations, strict=True):
        np.testing.assert_array_equal(demo.observations, wanted.observations)
    for key in ("objects_again", "held_again"):
        assert key in refusal(lambda: read(str(low_dim), dataclasses.replace(MEANING, observation_keys=("nothing",))))
    for back in converted_back(low_dim, tmp_path):
        same_content(low_dim, back)


@pytest.mark.parametrize(
    ("link", "message"),
    [
        (h5py.SoftLink("/nowhere"), "is a link to /nowhere, where there is nothing"),
        (h5py.ExternalLink("missing.hdf5", "/x"), "is a link to missing.hdf5:/x, where there is nothing"),
        (h5py.SoftLink("/data/demo_1"), "is a link to a group that it lies in"),
    ],
)
@pytest.mark.parametrize("place", ["data/demo_1/obs/x", "data/demo_1/x"])
def test_links_that_lead_nowhere_are_named(low_dim, link, message, place):
    with h5py.File(low_dim, "r+") as file:
        file[place] = link
    message_here = refusal(lambda: read(str(low_dim), MEANING))
    assert message in message_here
    assert place.removeprefix("data/demo_1/") in message_here


def test_restoring_gives_back_what_stood_at_the_root_and_texts_of_any_length(low_dim, tmp_path):
    with h5py.File(low_dim, "r+") as file:
        file.attrs.update({"date": "today", "version": 3})
        file["root"] = np.arange(3, dtype=np.int16)
        file["data/alone"] = np.arange(2.0)
        file["words"] = np.array(["ein", "längeres", ""], object)
        del file["mask/train"]
        file["mask/train"] = np.array(["demo_1"], object)
        file["data/demo_1/obs/task"] = np.array(["reach"] * 58, object)
    for back in converted_back(low_dim, tmp_path):
        same_content(low_dim, back)
    (demo,) = read(str(low_dim), dataclasses.replace(MEANING, filter_key="train")).demonstrations
    assert demo.name == "demo_1"


def test_what_is_not_used_may_be_anything(low_dim, tmp_path):
    """NaN, misaligned rows and texts in modalities, rewards or dones that are of no use; they are given back."""
    with h5py.File(low_dim, "r+") as file:
        for demo in file["data"].values():
            length = len(demo["actions"])
            for group in ("obs", "next_obs"):
                demo[f"{group}/depth"] = np.full((length, 2), np.nan)
                demo[f"{group}/shuffled"] = np.random.default_rng(len(group)).normal(size=(length, 2))
            demo["rewards"][0] = np.nan
    assert "rewards is not finite in row 0; put others in their place with --sparse-rewards" in refusal(lambda: read(str(low_dim), MEANING))
    sparse = dataclasses.replace(MEANING, sparse_rewards=True)
    write(str(tmp_path / "ours.hdf5"), read(str(low_dim), sparse))
    restore(tmp_path / "back.hdf5", read(str(tmp_path / "ours.hdf5")), source="ours")
    same_content(low_dim, tmp_path / "back.hdf5")
    for key, message in (("depth", "depth is not finite in row 0; name others with --observation-keys"), ("shuffled", "the rows are misaligned")):
        assert message in refusal(lambda key=key: read(str(low_dim), dataclasses.replace(sparse, observation_keys=(*KEYS[:-1], key))))
    assert "say --solved otherwise" in refusal(lambda: read(str(low_dim), dataclasses.replace(sparse, solved="reward")))


def test_next_observations_of_another_precision_are_the_same_observations(low_dim):
    expected = read(str(low_dim), MEANING).demonstrations[0].observations
    with h5py.File(low_dim, "r+") as file:
        for demo in file["data"].values():
            rows = demo["obs/objects"][()] + 0.1
            after = demo["next_obs/objects"][()] + 0.1
            del demo["obs/objects"], demo["next_obs/objects"]
            demo["obs/objects"], demo["next_obs/objects"] = rows.astype(np.float32), after.astype(np.float64)
    found = dataclasses.replace(MEANING, achieved_goal_keys=("delivered", "held"), observation_keys=("objects",))
    with h5py.File(low_dim, "r+") as file:
        file["data"].attrs["env_args"] = json.dumps({"env_name": "Lift", "type": 1, "env_kwargs": {}})
    np.testing.assert_allclose(read(str(low_dim), found).demonstrations[0].observations, expected[:, :4] + 0.1, rtol=1e-6)


def test_demonstrations_of_other_names_and_masks_that_name_missing_ones(low_dim, tmp_path):
    with h5py.File(low_dim, "r+") as file:
        data = file["data"]
        names = sorted(data)
        data.move(names[0], "episode_b")
        data.move(names[1], "demo_10")
        file["mask/some"] = np.array([b"episode_b", b"demo_99"])
        file["mask/one"] = np.bytes_(b"demo_10")
    recording = read(str(low_dim), MEANING)
    assert [demo.name for demo in recording.demonstrations] == ["demo_10", "episode_b"]
    write(str(tmp_path / "ours.hdf5"), recording)
    assert [demo.name for demo in read_recording(tmp_path / "ours.hdf5").demonstrations] == ["demo_10", "episode_b"]
    with pytest.warns(UserWarning, match="filter key 'some' names demo_99, which the file does not hold"):
        (demo,) = read(str(low_dim), dataclasses.replace(MEANING, filter_key="some")).demonstrations
    assert demo.name == "episode_b"
    (demo,) = read(str(low_dim), dataclasses.replace(MEANING, filter_key="one")).demonstrations  # not every name within "demo_10"
    assert demo.name == "demo_10"


def dataset(name, infos, *, steps=4, action_space=None, actions=None, text=False):
    """A Minari dataset of one episode, which ends by falling over."""
    cell = gymnasium.spaces.Box(-9, 9, (2,), np.float32)
    keys = ("observation", "achieved_goal", "desired_goal")
    spaces = {key: cell for key in keys} | ({"text": gymnasium.spaces.Text(9)} if text else {})
    observations = {key: np.zeros((steps + 1, 2), np.float32) for key in keys} | ({"text": ["word"] * (steps + 1)} if text else {})
    episode = importlib.import_module("minari.data_collector").EpisodeBuffer(
        observations=observations,
        actions=np.zeros((steps, 1), np.float32) if actions is None else actions,
        rewards=np.zeros(steps),
        terminations=np.arange(steps) == steps - 1,
        truncations=np.zeros(steps, bool),
        infos=infos,
    )
    about = dict(algorithm_name="none", author="none", author_email="none", code_permalink="none")
    about |= dict(observation_space=gymnasium.spaces.Dict(spaces), action_space=action_space or gymnasium.spaces.Box(-1, 1, (1,), np.float32))
    minari.create_dataset_from_buffers(name, [episode], **about)
    return f"minari:{name}"


FALLEN, SOLVED = [False] * 4, [False, False, False, True]


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("key", ["success", "is_success"])
@pytest.mark.parametrize(
    ("rows", "solved"),
    [
        (FALLEN, False),
        ([False, *FALLEN], False),
        ([True, *FALLEN], False),  # the first row of T + 1 is that of the reset
        (SOLVED, True),
        ([False, *SOLVED], True),
        ([[value] for value in FALLEN], False),
        ([[value] for value in SOLVED], True),
        ([[[float(value)]] for value in [False, *SOLVED]], True),
    ],
)
def test_success_of_minari_is_read_from_its_own_row(key, rows, solved):
    (demo,) = read(dataset("fell-v0", {key: np.array(rows)})).demonstrations
    assert demo.terminated == solved


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("rows", [[False] * 3, [False] * 6, [[False, True]] * 4, [np.nan] * 4, ["no"] * 4])
def test_success_of_minari_that_does_not_fit_is_said_where_it_is_used(rows):
    source = dataset("odd-v0", {"success": np.array(rows) if not isinstance(rows[0], str) else rows})
    message = refusal(lambda: read(source))
    assert "the infos success do not say of each of its 4 steps whether it solves the task" in message
    assert "--solved all" in message
    cli.main(["demos", "info", source, "--solved", "all"])


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_minari_texts_beside_the_observations_are_kept(tmp_path):
    write(str(tmp_path / "ours.hdf5"), read(dataset("text-v0", None, text=True)))
    write("minari:back-v0", read(str(tmp_path / "ours.hdf5")))
    assert list(minari.load_dataset("back-v0")[0].observations["text"]) == ["word"] * 5


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_whole_actions_of_minari_are_those_of_the_policy():
    space = gymnasium.spaces.Box(np.array([-3, 2]), np.array([3, 2]), dtype=np.int64)
    actions = np.array([[-3, 2], [0, 2], [1, 2], [3, 2]])
    (demo,) = read(dataset("whole-v0", None, action_space=space, actions=actions)).demonstrations
    np.testing.assert_allclose(demo.actions, [[-6 / 7, 0], [0, 0], [2 / 7, 0], [6 / 7, 0]], atol=1e-6)


def test_exported_spaces_are_those_of_the_environment(recorded):
    write("minari:ours-v0", read_recording(recorded))
    exported, env = minari.load_dataset("ours-v0"), gymnasium.make("hindrl/FixedGridPickAndPlace-v0")
    assert exported.observation_space == env.observation_space
    assert exported.action_space == env.action_space


def test_observations_out_of_bounds_are_said(recorded, env, tmp_path):
    recording = read_recording(recorded)
    assert isinstance(recording, Recording)
    far = [dataclasses.replace(demo, observations=demo.observations + 50.0) for demo in recording.demonstrations]
    far = [dataclasses.replace(demo, achieved_goals=np.asarray(env.achieved_goal(demo.observations))) for demo in far]
    write(str(tmp_path / "far.hdf5"), dataclasses.replace(recording, demonstrations=tuple(far)))
    with pytest.warns(UserWarning, match=r"demo_0: observation\[0\] = 59 in row 0 lies outside the bounds of FixedGridPickAndPlace, -9 to 9"):
        load(str(tmp_path / "far.hdf5"), make("FixedGridPickAndPlace"))


@pytest.mark.parametrize("kind", [np.uint8, np.int8, np.uint16, np.int32, np.uint64])
def test_lengths_of_any_width(tmp_path, kind):
    """The sum of the lengths, and each plus 1, is more than the type holds."""
    lengths = np.array([127, 127, 127], kind) if kind == np.int8 else np.array([255, 254, 3], kind) if kind == np.uint8 else np.array([3, 4], kind)
    total, number = int(lengths.astype(int).sum()), len(lengths)
    arrays = dict(observations=np.zeros((total + number, 2)), actions=np.zeros((total, 1)), achieved_goals=np.zeros((total + number, 1)))
    recording = read(archive(tmp_path / "wide.npz", lengths=lengths, **arrays))
    assert [len(demo) for demo in recording.demonstrations] == lengths.tolist()
    assert "lengths" in refusal(lambda: read(archive(tmp_path / "huge.npz", lengths=np.array([2**63, 1], np.uint64))))


def test_a_number_of_samples_that_is_no_whole_number(recorded, tmp_path):
    path = tmp_path / "copy.hdf5"
    path.write_bytes(recorded.read_bytes())
    with h5py.File(path, "r+") as file:
        file["data/demo_0"].attrs["num_samples"] = 5.5
    assert "num_samples is no whole number" in refusal(lambda: read_recording(path))


def test_a_file_that_was_not_touched_comes_back_as_it_was(low_dim, tmp_path):
    for back in converted_back(low_dim, tmp_path):
        assert_same_file(low_dim, back)
