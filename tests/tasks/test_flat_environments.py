"""Environments of Gymnasium with flat observations and a sparse reward or a success flag, as tasks to learn."""

import dataclasses
import json
import shlex
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from commands import refusal
from flat_env import CONFIG, CORNER, SPEED, to_corner

import hindrl_jax as hindrl
from hindrl_jax import cli
from hindrl_jax.base.environments import Environment, action_to_env
from hindrl_jax.base.errors import UserError
from hindrl_jax.base.steppers import SimulationFailed
from hindrl_jax.cli.training import advice
from hindrl_jax.demonstrations.convert import load
from hindrl_jax.runs.checkpoints import Checkpoints
from hindrl_jax.tasks.success import SuccessRule

FLAT = "gymnasium:flat_env:PointFlat-v0"
TINY = shlex.split(
    "--steps 120 --num-envs 4 --learning-starts 40 --eval-every 60 --eval-episodes 3 --net-arch 8 --batch-size 16 --buffer-size 400 "
    "--updates-per-iteration 1"
)


def test_it_is_an_environment_without_goals_whose_observation_is_the_achieved_goal():
    env = hindrl.make(FLAT)
    assert isinstance(env, Environment)
    assert (env.horizon, env.observation_dim, env.goal_dim, env.action_dim, env.gives_goals) == (20, 4, 4, 2, False)
    observations = jnp.arange(8.0).reshape(2, 4)
    np.testing.assert_array_equal(env.achieved_goal(observations), observations)
    goal = hindrl.preset(env=env).goal
    assert (goal.behavioural_goals, goal.epsilon) == ("task", None)


@pytest.mark.parametrize("indices", [(1,), [1], (2, 0)])
def test_the_achieved_goal_is_what_is_named_in_that_order(indices):
    env = hindrl.make(FLAT, achieved_goal_indices=indices)
    assert env.goal_dim == len(indices)
    np.testing.assert_array_equal(env.achieved_goal(np.arange(8.0).reshape(2, 4)), np.array([indices, np.add(indices, 4)]))
    assert hindrl.make(FLAT, **json.loads(json.dumps(dataclasses.asdict(env)))) == env
    assert hash(env) != hash(hindrl.make(FLAT))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"actions": "discrete"}, r"its actions are Discrete\(4\), which are discrete"),
        ({"actions": "several"}, "which are discrete, and only vectors of numbers with bounds can be learnt"),
        ({"actions": "matrix"}, r"Box\(-1.0, 1.0, \(2, 2\), float32\); only vectors"),
        ({"high": [np.inf, 1.0]}, "only vectors of numbers with bounds can be learnt: wrap it in a gymnasium.wrappers.TransformAction"),
        ({"observes": "picture"}, "observes Box.* and only vectors of numbers.* wrap it in gymnasium.wrappers.FlattenObservation"),
        ({"observes": "dictionary"}, "observes Dict.* and only vectors of numbers.* wrap it in gymnasium.wrappers.FlattenObservation"),
        ({"fault": "shape"}, r"gives float32 of shape \(3,\) as observation, and its space says float32 of shape \(4,\)"),
        ({"says": "two"}, "does not say whether the goal is reached"),
        ({"achieved_goal_indices": (4,)}, r"achieved_goal_indices = \[4\] is not usable: .* observes 4 numbers, give different ones from 0 to 3"),
        ({"achieved_goal_indices": (-1,)}, "give different ones from 0 to 3"),
        ({"achieved_goal_indices": (1, 1)}, "give different ones from 0 to 3"),
        ({"achieved_goal_indices": 1}, "achieved_goal_indices = 1 is not usable: it must be a list, each item a whole number"),
        ({"achieved_goal_indices": ("place",)}, "it must be a list, each item a whole number"),
        ({"success_reward": float("nan")}, "success_reward = nan is not usable"),
        ({"success_reward": 1.0, "says": "success"}, "success_reward is of no use in .* whose info says 'success' at each step"),
    ],
)
def test_what_cannot_be_learnt_in_is_refused_in_a_line(arguments, message):
    with pytest.raises(UserError, match=message) as error:
        _ = hindrl.make(FLAT, **arguments).description
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("option", [{"achieved_goal_indices": (0,)}, {"success_reward": 0.0}])
def test_environments_with_goals_have_no_such_options(option):
    with pytest.raises(UserError, match=f"{next(iter(option))} is for flat observations"):
        hindrl.make("gymnasium:point_env:PointGoal-v0", **option)


def played(env, moves, num_held=1):
    """The outcomes of two environments that take the same moves (T, 2), in [-1, 1], from the same start."""
    stepper = env.stepper(2, num_held=num_held)
    observation, goal = stepper.begin(np.array([3, 3], np.uint32))
    assert goal is None
    np.testing.assert_array_equal(observation[0], observation[1])
    outcomes = [stepper.step(np.asarray(action_to_env(np.array([move, move], np.float32), env))) for move in moves]
    stepper.close()
    return observation[0], outcomes


UP = np.ones((8, 2), np.float32)


@pytest.mark.parametrize(
    "arguments",
    [{"says": "reward"}, {"says": "success"}, {"says": "is_success"}, {"says": "last"}, {"says": "zero", "success_reward": 0.0}],
    ids=lambda arguments: arguments["says"],
)
@pytest.mark.parametrize("num_held", [1, 3])
@pytest.mark.parametrize("bounds", [{}, {"low": [-3.0, 10.0], "high": [1.0, 30.0]}], ids=["unit", "odd"])
def test_an_episode_is_solved_at_the_corner_however_the_environment_says_it(arguments, num_held, bounds):
    env = hindrl.make(FLAT, **arguments, **bounds)
    start, outcomes = played(env, UP, num_held)
    steps = int(np.ceil((CORNER - 0.2 - start[:2]).max() / SPEED - 1e-6))
    decisions = -(-steps // num_held)
    for outcome in outcomes[: decisions - 1]:
        assert not outcome.ended.any()
        assert not outcome.success.any()
    last = outcomes[decisions - 1]
    assert last.success.tolist() == last.terminated.tolist() == [True, True]
    np.testing.assert_allclose(last.next_observation[0, :2], start[:2] + steps * SPEED, atol=1e-6)
    assert (last.observation[:, :2] < 0.0).all()  # in a new episode


@pytest.mark.parametrize(
    ("arguments", "solved"),
    [
        ({"says": "reward"}, False),
        ({"says": "reward", "fall": -1.0}, False),
        ({"says": "reward", "fall": 0.5}, True),  # nobody can tell this from success
        ({"says": "last", "fall": 0.5}, False),  # the info can
        ({"says": "success", "fall": 0.5}, False),
        ({"says": "reward", "fall": 0.5, "success_reward": 1.0}, False),
    ],
)
def test_an_end_elsewhere_is_a_failure(arguments, solved):
    _, outcomes = played(hindrl.make(FLAT, **arguments), -UP)
    ended = next(outcome for outcome in outcomes if outcome.ended.any())
    assert ended.terminated.all()
    assert ended.success.tolist() == [solved, solved]


def test_the_rules_of_success_by_hand():
    rewards, terminated = np.array([0.0, 1.0, 1.0]), np.array([True, True, False])
    assert SuccessRule().solved({}, rewards, terminated).tolist() == [False, True, False]
    assert SuccessRule(reward=1.0).solved({}, rewards, terminated).tolist() == [False, True, True]
    info = {"is_success": np.array([True, False, False]), "_is_success": np.array([True, False, False])}  # said of the first alone
    assert SuccessRule().solved(info, rewards, terminated).tolist() == [True, True, False]
    with pytest.raises(ValueError, match="info has no 'is_success', which it had at the first step"):
        SuccessRule("is_success").solved(info, rewards, terminated)
    assert SuccessRule().solved({"is_success": False}, 1.0, True).tolist() is False
    assert SuccessRule().solved({}, 1.0, True).tolist() is True


def test_an_observation_that_is_no_number_is_one_line():
    stepper = hindrl.make(FLAT).stepper(2)
    stepper.begin(np.array([1, 2], np.uint32))
    stepper._envs.envs[1].unwrapped.fault = "nan"
    with pytest.raises(SimulationFailed, match=r"gave observation\[1\] = nan after 1 steps of an episode"):
        stepper.step(np.zeros((2, 2)))
    stepper.close()


@pytest.mark.parametrize("vectorization", ["sync", "async"])
def test_a_module_is_found_in_the_working_directory(tmp_path, monkeypatch, vectorization):
    """The one that registers, and the one where the environment is, which is imported only to make it."""
    (tmp_path / "here_registered.py").write_text("import gymnasium\ngymnasium.register('Here-v0', 'here_made:Here', max_episode_steps=4)\n")
    (tmp_path / "here_made.py").write_text("from flat_env import PointFlat\nclass Here(PointFlat):\n    pass\n")
    monkeypatch.chdir(tmp_path)
    path = list(sys.path)
    stepper = hindrl.make("gymnasium:here_registered:Here-v0", vectorization=vectorization).stepper(1)
    assert stepper.begin(np.array([0], np.uint32))[0].shape == (1, 4)
    stepper.close()
    assert sys.path == path


def test_processes_of_their_own_give_equal_episodes():
    env = hindrl.make(FLAT, says="last")
    outcomes = [played(dataclasses.replace(env, vectorization=kind), UP[:6])[1] for kind in ("sync", "async")]
    for one, other in zip(*outcomes, strict=True):
        for field in ("next_observation", "success", "terminated", "truncated", "observation"):
            np.testing.assert_array_equal(getattr(one, field), getattr(other, field), err_msg=field)


@pytest.fixture(scope="module")
def env():
    return hindrl.make(FLAT, achieved_goal_indices=(0, 1))


@pytest.fixture(scope="module")
def demonstrations(env):
    return hindrl.record_gymnasium(env, to_corner, 5, seed=1)


@pytest.fixture
def file(env, demonstrations, tmp_path):
    path = tmp_path / "demos.hdf5"
    hindrl.save_demonstrations(path, demonstrations, env=env, env_args=dataclasses.asdict(env))
    return path


def test_demonstrations_end_in_the_corner_and_aim_at_where_they_end(demonstrations):
    assert demonstrations.observations.shape == (5, 21, 4)
    for i, length in enumerate(demonstrations.lengths):
        end = demonstrations.observations[i, length, :2]
        assert np.abs(end - CORNER).max() <= 0.2 + 1e-6
        np.testing.assert_array_equal(demonstrations.desired_goals[i], end)
        np.testing.assert_array_equal(demonstrations.rewards[i], np.arange(20) == length - 1)
        moves = np.diff(demonstrations.observations[i, : length + 1, :2], axis=0)
        np.testing.assert_allclose(moves, SPEED * demonstrations.actions[i, :length], atol=1e-6)


@pytest.mark.parametrize("indices", [(), (0, 1), (1,)])
def test_a_file_serves_whatever_part_is_the_goal(file, demonstrations, indices):
    other = hindrl.make(FLAT, achieved_goal_indices=indices)
    table = hindrl.load_demonstrations(file, other)
    np.testing.assert_array_equal(table.observations, demonstrations.observations)
    ends = np.stack([demonstrations.observations[i, length] for i, length in enumerate(demonstrations.lengths)])
    np.testing.assert_array_equal(table.desired_goals, ends[:, list(indices) or slice(None)])


def test_training_gives_the_environments_own_reward_and_goes_on_after_a_stop(tmp_path):
    env = hindrl.make(FLAT, achieved_goal_indices=(0, 1), near=0.9)  # which actions at random reach now and then
    demonstrations = hindrl.record_gymnasium(env, to_corner, 3, seed=1)
    checkpoints = Checkpoints(tmp_path, seconds=0.0)

    def stop_half_way(result):
        checkpoints.save_when_due(result)
        if result.env_steps > 120:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        hindrl.fit(env, demonstrations, CONFIG, seeds=[0, 7], report=stop_half_way)
    resumed = hindrl.fit(env, demonstrations, CONFIG, seeds=[0, 7], restore=checkpoints.restore)
    assert resumed.env_steps >= 240
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(jax.device_get(resumed.state.agent)))
    episodes, rewarded = jax.device_get(resumed.state.replay.episodes), 0
    goals = demonstrations.desired_goals
    for seed, lengths in enumerate(episodes.lengths):
        for row in np.flatnonzero(lengths):
            length = lengths[row]
            places = episodes.observations[seed, row, 1 : length + 1, :2]
            solved = np.abs(places - CORNER).max(axis=1) <= 0.9
            np.testing.assert_array_equal(episodes.rewards[seed, row, :length], solved)
            assert (np.abs(goals - episodes.desired_goals[seed, row]).max(axis=1) < 1e-6).any()  # one of the demonstrations' ends
            rewarded += solved.sum()
    assert 0 < rewarded < np.count_nonzero(episodes.lengths)


def test_the_commands_train_evaluate_film_and_say(file, tmp_path, capsys):
    out = tmp_path / "run"
    cli.main(["train", "--demos", str(file), "--out", str(out), "--achieved-goal-indices", "0", "1", "--horizon", "9", *TINY])
    assert json.loads((out / "config.json").read_text())["env_args"]["achieved_goal_indices"] == [0, 1]
    run = hindrl.load_run(out)
    assert run.spec.env == hindrl.make(FLAT, achieved_goal_indices=(0, 1), horizon=9)
    assert {"parameters.npz", "episode.gif", "curve.png"} <= {path.name for path in out.iterdir()}
    capsys.readouterr()
    cli.main(["eval", str(out), "--episodes", "3"])
    assert "3 episodes per seed" in capsys.readouterr().out
    cli.main(["render", str(out), "--to", str(tmp_path / "film.gif")])
    assert (tmp_path / "film.gif").stat().st_size > 0
    cli.main(["demos", "info", str(file)])
    assert "5 demonstrations, 5 solved" in capsys.readouterr().out
    said = " ".join(advice(run.spec, [{"returned_success": 0.0}], tmp_path))
    assert "a longer run: --steps" in said
    assert "--demo-reset-ratio" not in said  # which would be refused
    assert "give different ones from 0 to 3" in refusal(capsys, "train", "--demos", file, "--achieved-goal-indices", "0", "9")
    assert "which are discrete" in refusal(capsys, "train", "--env", "gymnasium:CartPole-v1")


def test_other_formats_are_learned_from(env, file, demonstrations, tmp_path):
    archive = tmp_path / "foreign.npz"
    lengths = demonstrations.lengths
    np.savez(
        archive,
        lengths=lengths,
        observations=np.concatenate([demonstrations.observations[i, : length + 1] for i, length in enumerate(lengths)]),
        actions=np.concatenate([demonstrations.actions[i, :length] for i, length in enumerate(lengths)]),
    )
    table = load(str(archive), env)
    np.testing.assert_array_equal(table.actions, demonstrations.actions)
    np.testing.assert_array_equal(table.desired_goals, demonstrations.desired_goals)
    own = tmp_path / "own.npz"
    cli.main(["demos", "convert", str(file), str(own)])
    np.testing.assert_array_equal(load(str(own), hindrl.make(FLAT)).observations, demonstrations.observations)


@pytest.mark.slow
def test_the_corner_is_learned_from_five_demonstrations(env, demonstrations):
    config = dataclasses.replace(hindrl.preset(env=env), stop_at=0.95)
    config = dataclasses.replace(config, steps=6_000, imitation_steps=0, agent=dataclasses.replace(config.agent, net_arch=(64, 64)))
    result = hindrl.fit(env, demonstrations, config, seeds=[0])
    assert result.returned.success[0] >= 0.9
