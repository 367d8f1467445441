"""What the names and numbers of other tools' files mean: what does not fit is named, with the option that helps."""

import dataclasses
import json

import h5py
import numpy as np
import pytest
from foreign_files import KEYS, MEANING, ROBOMIMIC_FILE, change, refusal, remove_next_obs, with_entry

from hindrl_jax.base.errors import UserError
from hindrl_jax.demonstrations.convert import read
from hindrl_jax.demonstrations.foreign import Interpretation


def test_filter_key(tmp_path):
    meaning = dataclasses.replace(MEANING, filter_key="valid")
    assert [demo.name for demo in read(str(ROBOMIMIC_FILE), meaning).demonstrations] == ["demo_2"]
    message = refusal(lambda: read(str(ROBOMIMIC_FILE), dataclasses.replace(MEANING, filter_key="test")))
    assert "no filter key 'test'; it has train, valid" in message


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
