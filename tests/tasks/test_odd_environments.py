"""Environments of other people: what is odd in them is handled rightly or refused in one line, with the step at which it happened."""

import dataclasses
import functools
import os
import re
import shlex
import signal
import subprocess
import sys

import gymnasium
import numpy as np
import pytest
from commands import refusal
from odd_env import to_goal

import hindrl_jax as hindrl
from hindrl_jax.base.environments import action_from_env, action_to_env
from hindrl_jax.base.errors import UserError
from hindrl_jax.base.steppers import SimulationFailed
from hindrl_jax.cli.train_options import parse_train
from hindrl_jax.tasks.presets import preset
from hindrl_jax.tasks.simulators import Simulators
from hindrl_jax.training.recording import record_gymnasium

TINY = shlex.split(
    "--num-envs 2 --learning-starts 48 --steps 2000 --eval-every 500 --eval-episodes 2 --updates-per-iteration 1 "
    "--batch-size 16 --net-arch 8 --buffer-size 400"
)
ODD = "gymnasium:odd_env:Odd-v0"


def recorded(env, num_demos=2):
    return record_gymnasium(env, functools.partial(to_goal, env=env), num_demos, seed=1)


def stand_still(simulators):
    """To the end of an episode and beyond."""
    for _ in range(13):
        simulators.step(np.zeros((simulators.num_envs, 1)))


def moves(simulators):
    """(T, A) what the first environment was given, as it came."""
    return np.stack(simulators._envs.envs[0].unwrapped.moves)


def test_whole_numbers_are_rounded_and_all_equally_likely():
    env = hindrl.make(ODD, action="int64", low=-5, high=5)
    np.testing.assert_array_equal([env.action_low, env.action_high], [[-5.5], [5.5]])
    one = Simulators(env, 1)
    one.begin(np.array([0]))
    policy = np.random.default_rng(0).uniform(-1.0, 1.0, (2_200, 1)).astype(np.float32)
    for action in np.asarray(action_to_env(policy, env)):
        one.step(action[None])
    given = moves(one)
    one.close()
    assert given.dtype == np.int64
    values, counts = np.unique(given, return_counts=True)
    assert values.tolist() == list(range(-5, 6))
    assert 150 < counts.min() <= counts.max() < 250  # 200 of each, and a standard deviation of 13.5


def test_recorded_whole_numbers_are_those_that_were_played():
    env = hindrl.make(ODD, action="int8", low=[-3, 2], high=[3, 2], dims=2, threshold=5.0)
    demos = record_gymnasium(env, lambda observation, rng: np.array([0.6, 2.0]), 1, seed=0)
    np.testing.assert_allclose(demos.actions[0, 0], [2 / 7, 0.0], atol=1e-6)  # 1 of -3.5 to 3.5, and nothing to choose
    np.testing.assert_allclose(action_to_env(demos.actions[0, 0], env), [1.0, 2.0], atol=1e-6)


def test_an_action_whose_bounds_are_equal_stays_there():
    env = hindrl.make(ODD, dims=2, low=[-1.0, 0.5], high=[1.0, 0.5], threshold=5.0)
    assert np.asarray(action_from_env(np.array([0.5, 0.5], np.float32), env)).tolist() == [0.5, 0.0]
    assert np.isfinite(recorded(env).actions).all()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"action": "int64", "low": -(2**63), "high": 2**63 - 1}, "cannot be told apart"),
        ({"low": -3e38, "high": 3e38}, "only vectors of numbers with bounds"),
        ({"signature": "old_reset"}, "its reset is that of old Gym"),
        ({"signature": "no_seed"}, "its reset is that of old Gym"),
        ({"signature": "no_options"}, "its reset is that of old Gym"),
        ({"signature": "old_step"}, "its step is that of old Gym"),
        ({"fault": "raise", "when": 1}, "fails at its first step .RuntimeError: the arm fell off"),
        ({"fault": "wrong_shape", "when": 1}, r"gives float32 of shape \(1,\) as observation, and its space says float32 of shape \(2,\)"),
        ({"fault": "success_none", "when": 1}, "does not say whether the goal is reached"),
    ],
)
def test_what_cannot_be_learnt_in_is_refused_before_anything_is_computed(arguments, message):
    with pytest.raises(UserError, match=message) as error:
        _ = hindrl.make(ODD, **arguments).description
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("arguments", [{"truth": kind} for kind in ("bool", "float", "array", "int", "numpy")] + [{"says": "success"}])
@pytest.mark.parametrize("num_held", [1, 2])
def test_success_is_read_however_it_is_said(arguments, num_held):
    plain, odd = (hindrl.make(ODD, **given).stepper(3, num_held=num_held) for given in ({}, arguments))
    for one in (plain, odd):
        one.begin(np.array([1, 2, 3]))
    for step in range(8):
        outcomes = [one.step(np.full((3, 1), np.sin(step), np.float32)) for one in (plain, odd)]
        assert outcomes[0].success.shape == (3,)
        for field in dataclasses.fields(outcomes[0]):
            np.testing.assert_array_equal(*(getattr(outcome, field.name) for outcome in outcomes), err_msg=field.name)


@pytest.mark.parametrize("reward", ["float", "float32", "array"])
def test_a_reward_of_another_precision_than_that_of_the_goal_is_success(reward):
    """0.1 as float32 is above 0.1 as float64, and -0.9 below."""
    env = hindrl.make(ODD, says="reward", reward=reward)
    demos = recorded(env)
    distance = np.abs(demos.observations[0, : demos.lengths[0] + 1, 2] - demos.desired_goals[0, 0])
    assert distance[-1] <= 0.35
    assert (distance[1:-1] > 0.35).all()


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("raise", "failed at step 3 of an episode: it raised RuntimeError: the arm fell off"),
        ("nan", r"gave achieved_goal\[0\] = nan after 3 steps of an episode"),
        ("nan_goal", r"gave desired_goal\[0\] = nan after 3 steps of an episode"),
        ("infinite", r"gave achieved_goal\[0\] = inf after 3 steps of an episode"),
        ("no_success", "failed at step 3 of an episode: it raised ValueError: info has no 'is_success', which it had at the first step"),
        ("success_none", "does not say whether the goal is reached"),
        ("success_nan", "does not say whether the goal is reached"),
        ("no_reset", "when the next one was to begin: it raised RuntimeError: the door is shut"),
    ],
)
@pytest.mark.parametrize("vectorization", ["sync"])
def test_a_fault_in_mid_episode_is_one_line_with_its_step(fault, message, vectorization):
    env = hindrl.make(ODD, fault=fault, threshold=1e-9, vectorization=vectorization)
    two = Simulators(env, 2)
    two.begin(np.array([1, 2]))
    with pytest.raises(SimulationFailed, match=message) as error:
        stand_still(two)
    assert "\n" not in str(error.value)
    two.close()


def test_a_process_that_dies_is_one_line_and_the_others_end(capfd):
    env = hindrl.make(ODD, fault="die", threshold=1e-9, vectorization="async")
    two = Simulators(env, 2)
    processes = two._envs.processes
    two.begin(np.array([1, 2]))
    with pytest.raises(SimulationFailed, match="failed at step 3 of an episode: a process of it died"):
        stand_still(two)
    two.close()
    assert not any(process.is_alive() for process in processes)
    assert capfd.readouterr().err == ""


@pytest.fixture
def odd_demonstrations(tmp_path):
    env = hindrl.make(ODD)
    path = tmp_path / "demos.hdf5"
    hindrl.save_demonstrations(path, recorded(env), env=env, env_args=dataclasses.asdict(env) | {"make_kwargs": []})
    return path


def test_a_fault_in_training_is_one_line_and_the_last_checkpoint_stands(tmp_path, odd_demonstrations, monkeypatch, capsys):
    """An environment that nobody has told the demonstrations of: its arguments are not compared here."""
    monkeypatch.setattr("hindrl_jax.tasks.from_gymnasium.GymnasiumEnv.interchangeable", ("vectorization", "make_kwargs"))
    out = tmp_path / "run"
    arguments = ["--make-kwargs", "fault=raise", "episode=12", "--demos", odd_demonstrations, "--out", out, "--checkpoint-every", "0.05"]
    arguments += ["--practice-rounds", "0"]  # the twelfth episode is to be one of learning
    line = refusal(capsys, "train", "--env", ODD, *arguments, *TINY)
    assert re.search(
        "failed at step 3( to [0-9]+)? of an episode: it raised RuntimeError: the arm fell off; the last good checkpoint, of step ", line
    )
    assert any(path.name.isdecimal() for path in (out / "checkpoint").iterdir())


def test_options_of_an_environment_are_read_before_it_is_built(odd_demonstrations, capsys):
    forever = "gymnasium:odd_env:OddForever-v0"
    assert "give a horizon" in refusal(capsys, "train", "--env", forever)
    spec, _ = parse_train(["--env", forever, "--horizon=9", "--make_kwargs", "dims=3", "threshold=0.1", "--demos", "x.hdf5"])
    assert (spec.env.horizon, spec.env.goal_dim, spec.config.goal.epsilon) == (9, 3, 0.05773)
    assert "RuntimeError: the arm fell off" in refusal(capsys, "train", "--env", forever, "--make-kwargs", "fault=raise", "when=1", "--horizon", "5")


def test_actions_of_another_shape_are_an_error():
    env = hindrl.make(ODD, dims=3)
    two = Simulators(env, 2)
    two.begin(np.array([1, 2]))
    for shape in ((2, 1), (2, 2), (2, 4), (1, 3), (3,), ()):
        with pytest.raises(UserError, match="are not those of 2 environments"):
            two.step(np.zeros(shape))
    two.close()
    for action in (0.5, [0.5], [0.5] * 4, [np.nan] * 3):
        with pytest.raises(UserError, match="takes 3 finite numbers"):
            record_gymnasium(env, lambda observation, rng, action=action: action, 1, seed=0)


@pytest.mark.parametrize("name", ["FixedGridPickAndPlace", "FixedParameterizedReach"])
def test_our_own_environments_take_no_action_of_another_shape(name):
    single = gymnasium.make(f"hindrl/{name}-v0").unwrapped
    with pytest.raises(gymnasium.error.ResetNeeded):
        single.step(single.action_space.sample())
    single.reset(seed=0)
    several = gymnasium.make_vec(f"hindrl/{name}-v0", num_envs=2)
    several.reset(seed=0)
    length = single.action_space.shape[0]
    for shape in ((), (1,), (length - 1,), (length + 1,), (1, length)):
        with pytest.raises(UserError, match="has shape"):
            single.step(np.zeros(shape))
        with pytest.raises(UserError, match="has shape"):
            several.step(np.zeros((2, *shape)))
    with pytest.raises(UserError, match="not a number in dimension 1"):
        single.step(np.array([0.0, np.nan] + [0.0] * (length - 2)))


@pytest.mark.parametrize(("threshold", "dims", "epsilon"), [(0.05, 3, 0.02886), (2e-5, 1, 2e-5), (0.7, 1, 0.7), (1e-12, 2, 7.071e-13), (0.0, 1, 0.0)])
def test_epsilon_is_never_above_the_tasks_own_nor_rounded_to_nothing(threshold, dims, epsilon):
    env = hindrl.make(ODD, threshold=threshold, dims=dims)
    chosen = preset("hindrl", env=env).goal.epsilon
    assert chosen == epsilon
    assert chosen <= threshold / dims**0.5


@pytest.mark.parametrize("threshold", ["wide", [0.1, 0.2], None])
def test_a_threshold_that_is_no_number_is_none(threshold):
    assert preset("hindrl", env=hindrl.make(ODD, threshold=threshold)).goal.epsilon is None


def test_processes_that_are_forked_say_that_jax_hangs_in_them():
    """In place of hanging; the limit of time is the test."""
    script = """if True:
        import gymnasium, hindrl_jax
        envs = gymnasium.make_vec("hindrl/FixedGridPickAndPlace-v0", num_envs=2, vectorization_mode="async", vector_kwargs={"context": "fork"})
        try:
            envs.reset(seed=0)
        except hindrl_jax.UserError as error:
            print(error)
        envs.close(terminate=True)
    """
    command, pipe = [sys.executable, "-W", "ignore", "-c", script], subprocess.PIPE
    process = subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, start_new_session=True)
    try:
        said, _ = process.communicate(timeout=60)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        pytest.fail("it hangs")
    assert "'context': 'spawn'" in said
    assert said.count("\n") == 1
