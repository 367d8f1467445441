"""The robosuite back end from the command line: its files, what cannot be trained or recorded there, and evaluation in it.

Tests that need robosuite are skipped where it is not installed.
"""

import dataclasses
import importlib.util
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from commands import refusal

from hindrl_jax import cli
from hindrl_jax.base.environments import action_to_env
from hindrl_jax.base.errors import UserError
from hindrl_jax.config import AgentConfig, TrainConfig
from hindrl_jax.core import agent as agents
from hindrl_jax.core.goals import GoalTable
from hindrl_jax.core.inputs import InputScale
from hindrl_jax.core.train import make_policy
from hindrl_jax.demonstrations.hdf5 import describe_demonstrations, load_demonstrations, save_demonstrations
from hindrl_jax.envs.reach import FixedParameterizedReach
from hindrl_jax.experts.reach import ReachExpert
from hindrl_jax.experts.robosuite_arm import arm as arms
from hindrl_jax.experts.robosuite_arm import installation, playing, scene, shared_scene
from hindrl_jax.runs import writer as runs
from hindrl_jax.runs.reader import Run, load_run
from hindrl_jax.runs.spec import RunSpec
from hindrl_jax.tasks.registry import make
from hindrl_jax.training import playing as trained_playing
from hindrl_jax.training.experiment import fit
from hindrl_jax.training.recording import record

ENV = FixedParameterizedReach(num_waypoints=2, backend="robosuite")
STEADY = ReachExpert(randomness_scale=0.02)
COARSE = FixedParameterizedReach(num_waypoints=1, position_tolerance=0.1, rotation_tolerance=0.3, horizon=100, backend="robosuite")


@pytest.fixture(scope="module")
def arm():
    """The arm that evaluation uses as well, since building one takes seconds."""
    if importlib.util.find_spec("robosuite") is None:  # importorskip would import it, with all its side effects
        pytest.skip("robosuite is not installed")
    return shared_scene(ENV)


@pytest.fixture(scope="module")
def recording(arm):
    return record(jax.random.key(0), COARSE, STEADY, 2)


# --- files


def save(path, recording, env):
    save_demonstrations(path, recording, env=env, env_args=dataclasses.asdict(env))


def test_back_ends_share_their_files_and_nothing_else_may_differ(recording, tmp_path):
    for there, here in (("robosuite", "closed_form"), ("closed_form", "robosuite"), ("robosuite", "mjx")):
        path = tmp_path / f"{there}_{here}.hdf5"
        save(path, recording, dataclasses.replace(COARSE, backend=there))
        assert describe_demonstrations(path).env_kwargs["backend"] == there
        loaded = load_demonstrations(path, dataclasses.replace(COARSE, backend=here))
        lengths = np.asarray(recording.lengths)
        np.testing.assert_array_equal(loaded.lengths, lengths)
        for n, length in enumerate(lengths):
            np.testing.assert_array_equal(loaded.actions[n, :length], recording.actions[n, :length])
    other = dataclasses.replace(COARSE, num_waypoints=2, backend="closed_form")
    with pytest.raises(UserError, match=r"recorded with num_waypoints = 1, but FixedParameterizedReach here has num_waypoints = 2; use equal"):
        load_demonstrations(path, other)


def test_files_are_described_and_drawn_without_robosuite(tmp_path, capsys, monkeypatch):
    for module, name in (
        (installation, "import_robosuite"),
        (scene, "import_robosuite"),
        (scene, "environment_class"),
        (arms, "environment_class"),
        (arms, "RobosuiteArm"),
        (playing, "shared_scene"),
    ):
        monkeypatch.setattr(module, name, lambda *_, name=name: pytest.fail(f"{name} was called"))
    path = tmp_path / "demos.hdf5"
    save(path, record(jax.random.key(0), dataclasses.replace(COARSE, backend="closed_form"), STEADY, 2), COARSE)
    cli.main(["demos", "info", str(path)])
    printed = capsys.readouterr().out
    assert "2 demonstrations, 2 solved" in printed
    assert "backend=robosuite" in printed
    cli.main(["demos", "render", str(path), "--to", str(tmp_path / "last.png")])
    assert (tmp_path / "last.png").read_bytes().startswith(b"\x89PNG")


def test_recorded_from_the_command_line(arm, tmp_path, capsys):
    path = tmp_path / "demos.hdf5"
    coarse = ["--num-waypoints", "1", "--position-tolerance", "0.1", "--rotation-tolerance", "0.3", "--horizon", "100", "--randomness-scale", "0.02"]
    cli.main(["demos", "record", "--env", COARSE.name, "--backend", "robosuite", *coarse, "--demos", "1", "--out", str(path)])
    assert "wrote" in capsys.readouterr().out
    assert load_demonstrations(path, dataclasses.replace(COARSE, backend="closed_form")).terminated.tolist() == [True]


# --- training and evaluating


@pytest.mark.parametrize("command", [["train"], ["sweep", "--over", "gamma=0.9,0.8"]], ids=lambda command: command[0])
def test_training_in_robosuite_is_refused_before_anything_happens(command, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    arguments = [*command, "--env", "FixedParameterizedReach", "--backend", "robosuite"]
    assert "train with backend closed_form or mjx" in refusal(capsys, *arguments)
    assert list(tmp_path.iterdir()) == []


def test_fit_refuses_it_as_well():
    with pytest.raises(UserError, match="train with backend closed_form or mjx"):
        fit(ENV, [], TrainConfig())


def test_a_device_needs_a_robot(tmp_path, capsys):
    out = tmp_path / "demos.hdf5"
    arguments = ["demos", "record", "--device", "keyboard", "--demos", "1", "--out", out]
    assert "GridPickAndPlace has none" in refusal(capsys, *arguments, "--env", "GridPickAndPlace")
    assert "--device joystick is not usable: choose one of " in refusal(capsys, *arguments, "--env", COARSE.name, "--device", "joystick")
    assert "drop --backend mjx" in refusal(capsys, *arguments, "--env", COARSE.name, "--backend", "mjx")
    assert "expert's options" in refusal(capsys, *arguments, "--env", COARSE.name, "--randomness-scale", "0.05")
    assert "randomised" in refusal(capsys, *arguments, "--env", "BringNear", "--randomised")


def test_a_place_that_cannot_be_written_is_refused_before_anybody_plays(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("hindrl_jax.cli.demonstrations.record_by_hand", lambda *_, **__: pytest.fail("somebody played for nothing"))
    (tmp_path / "file").touch()
    arguments = ["demos", "record", "--env", COARSE.name, "--device", "keyboard", "--demos", "1", "--overwrite", "--out"]
    assert "is a folder" in refusal(capsys, *arguments, tmp_path)
    assert "is a file; choose another place" in refusal(capsys, *arguments, tmp_path / "file" / "demos.hdf5")


@pytest.fixture(scope="module")
def run(arm, tmp_path_factory):
    """A run's directory with two policies that nobody trained."""
    env = dataclasses.replace(COARSE, horizon=4, joint_noise=0.0, backend="closed_form")
    config = TrainConfig(algo="bc", agent=AgentConfig(net_arch=(4,)))
    make_agents = jax.jit(jax.vmap(lambda key, scale: agents.init(key, scale, config, action_dim=env.action_dim)))
    goals = GoalTable(goals=jnp.ones((2, 3, env.goal_dim)), count=jnp.full(2, 3))
    scale = {
        field.name: jnp.ones((2, env.observation_dim if field.name.startswith("observation") else env.goal_dim))
        for field in dataclasses.fields(InputScale)
    }
    policies = make_agents(jax.random.split(jax.random.key(0), 2), InputScale(**scale))
    result = SimpleNamespace(
        configs=(config, config),
        returned=SimpleNamespace(actor=policies.average_actor, noise=np.zeros(2)),
        guidance=SimpleNamespace(behavioural_goals=goals, epsilon=jnp.ones((2, env.goal_dim))),
        state=SimpleNamespace(agent=policies),
    )
    path = tmp_path_factory.mktemp("runs") / "untrained"
    runs.RunWriter(path, RunSpec(env=env, config=config, demos="2", seeds=(0, 1)), overwrite=False).start()
    runs._save_parameters(path / runs.PARAMETERS, result)
    return path


def test_evaluation_in_robosuite(run, capsys):
    cli.main(["eval", str(run), "--backend", "robosuite", "--episodes", "2", "--noise", "1"])
    printed = capsys.readouterr().out
    assert "FixedParameterizedReach in robosuite, 2 episodes per seed" in printed
    played = []
    outcomes = load_run(run).in_backend("robosuite").evaluate(episodes=2, report=played.append)
    assert outcomes == [{"seed": seed, "success": 0.0, "episode_length": 4.0} for seed in (0, 1)]
    assert played == [1, 2, 3, 4]


def test_each_seed_plays_its_own_policy_towards_one_of_its_goals_per_episode(run, monkeypatch):
    loaded = load_run(run)
    goals = GoalTable(goals=jax.random.normal(jax.random.key(1), loaded.behavioural_goals.goals.shape), count=jnp.full(2, 3))
    loaded = dataclasses.replace(loaded, behavioural_goals=goals).in_backend("robosuite")
    env, config = loaded.spec.env, loaded.spec.config
    acted = []

    def stub_player(env, act, num_episodes, num_held):
        @jax.jit
        def act_twice(key):
            key_reset, *keys_act = jax.random.split(key, 3)
            state, observation = env.reset(key_reset)
            return jnp.stack([act(key_act, state, observation) for key_act in keys_act])

        def play_one(key):
            acted.append(np.asarray(act_twice(key)))
            return SimpleNamespace(lengths=np.ones(num_episodes), terminated=np.ones(num_episodes, bool))

        return play_one

    monkeypatch.setattr(trained_playing, "player", stub_player)
    loaded.evaluate(episodes=4)
    assert len(acted) == 8
    observation = env.reset(jax.random.key(0))[1][None]
    for seed in range(2):
        policy_of_seed, table = jax.tree.map(lambda leaf, seed=seed: leaf[seed], (loaded.policies, loaded.behavioural_goals))
        policy = make_policy(policy_of_seed.replace(noise=0.0), env, config)
        possible = [np.asarray(action_to_env(policy(jax.random.key(0), observation, goal[None])[0], env)) for goal in table.goals]
        chosen = set()
        for actions in acted[4 * seed : 4 * seed + 4]:
            np.testing.assert_array_equal(actions[0], actions[1])
            distances = [np.abs(actions[0] - action).max() for action in possible]
            assert min(distances) < 1e-6
            chosen.add(int(np.argmin(distances)))
        assert len(chosen) > 1


def test_evaluation_counts_what_is_solved(run):
    loaded = load_run(run).in_backend("robosuite")
    easy = dataclasses.replace(loaded.spec.env, position_tolerance=9.0, rotation_tolerance=3.2)  # anything the arm does will do
    loaded = dataclasses.replace(loaded, spec=dataclasses.replace(loaded.spec, env=easy))
    assert [outcome["success"] for outcome in loaded.evaluate(episodes=1)] == [1.0, 1.0]
    assert [outcome["episode_length"] for outcome in loaded.evaluate(episodes=1)] == [1.0, 1.0]


def test_evaluation_elsewhere_is_refused(run, tmp_path, capsys):
    assert "backend = 'gazebo' is not usable: it must be one of closed_form, mjx, robosuite" in refusal(capsys, "eval", run, "--backend", "gazebo")
    grid = Run(tmp_path, RunSpec(make("GridPickAndPlace"), TrainConfig(), "1", (0,)), None, None)
    with pytest.raises(UserError, match="GridPickAndPlace has one back end only"):
        grid.in_backend("robosuite")
