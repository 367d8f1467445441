"""The arm in robosuite: how far the closed form is from it, episodes that mean the same as those of `play`, and what is refused.

Tests that need robosuite are skipped where it is not installed.
"""

import dataclasses
import importlib.util
import os
import subprocess
import sys
from importlib import metadata
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from commands import refusal
from kinematic_arm import KinematicArm, KinematicReach

from hindrl_jax import cli
from hindrl_jax.base.environments import action_to_env
from hindrl_jax.base.errors import UserError
from hindrl_jax.config import AgentConfig, TrainConfig
from hindrl_jax.core import agent as agents
from hindrl_jax.core.goals import GoalTable
from hindrl_jax.core.train import make_policy
from hindrl_jax.demonstrations.hdf5 import describe_demonstrations, load_demonstrations, save_demonstrations
from hindrl_jax.envs.reach import FixedParameterizedReach, panda, rotations
from hindrl_jax.experts import robosuite_arm
from hindrl_jax.experts.reach import ReachExpert
from hindrl_jax.experts.robosuite_arm import RobosuiteArm, check_versions, play_episode, play_in_robosuite, shared_arm, stacked
from hindrl_jax.runs import writer as runs
from hindrl_jax.runs.reader import Run, load_run
from hindrl_jax.runs.spec import RunSpec
from hindrl_jax.tasks.registry import make
from hindrl_jax.training.experiment import fit
from hindrl_jax.training.recording import play, record

ENV = FixedParameterizedReach(num_waypoints=2, backend="robosuite")
IN_CLOSED_FORM = dataclasses.replace(ENV, backend="closed_form")
STEADY = ReachExpert(randomness_scale=0.02)
COARSE = FixedParameterizedReach(num_waypoints=1, position_tolerance=0.1, rotation_tolerance=0.3, horizon=100, backend="robosuite")


def expert_act(expert, env):
    return lambda key, state, observation: expert.act(key, env, state)


@pytest.fixture(scope="module")
def arm():
    """The arm that `play_in_robosuite` uses as well, since building one takes seconds."""
    if importlib.util.find_spec("robosuite") is None:  # importorskip would import it, with all its side effects
        pytest.skip("robosuite is not installed")
    return shared_arm(2)


# --- the motion


def commands(name):
    """(100, 6) commands in m and rad."""
    rng = np.random.default_rng(0)
    limits = np.array(3 * [panda.MAX_TRANSLATION] + 3 * [panda.MAX_ROTATION])
    direction = {"zero": np.zeros(6), "forward": np.eye(6)[0], "down": -np.eye(6)[2], "roll": np.eye(6)[3], "yaw": np.eye(6)[5]}.get(name)
    if name == "random":
        return rng.uniform(-limits, limits, (100, 6))
    if name == "expert":  # two straight lines with the noise of the expert, several times the limits
        lines = np.repeat(rng.uniform(-1, 1, (2, 6)), 50, axis=0)
        return np.clip(lines + rng.normal(size=(100, 6)), -1, 1) * limits
    return np.tile(direction * limits, (100, 1))


@jax.jit
def in_closed_form(joints, sequence):
    """(100, 7) joints after each command, by the closed form."""

    def step(carry, command):
        carry = panda.control_step(*carry, joints, command)
        return carry, carry[0]

    return jax.lax.scan(step, (joints, jnp.zeros(7)), sequence)[1]


hands = jax.jit(jax.vmap(lambda joints: panda.posture(joints)[3:]))  # positions and rotations
angles = jax.jit(jax.vmap(lambda a, b: jnp.linalg.norm(rotations.between(a, b))))


@pytest.mark.parametrize(
    ("name", "millimetres", "milliradians"),
    # About twice what was measured.
    [
        ("zero", 0.001, 0.001),
        ("forward", 0.02, 0.04),
        ("down", 0.03, 0.1),
        ("roll", 0.1, 0.3),
        ("yaw", 0.3, 4.0),
        ("random", 0.2, 1.0),
        ("expert", 0.7, 3.0),
    ],
)
def test_closed_form_stays_close_to_robosuite(arm, name, millimetres, milliradians):
    sequence = commands(name)
    start = np.float32(panda.INITIAL_JOINTS) + np.float32(np.random.default_rng(1).normal(0, 0.02, 7))
    joints, velocities = arm.reset(start)
    np.testing.assert_array_equal(joints, start)
    np.testing.assert_array_equal(velocities, 0.0)
    theirs = np.stack([arm.step(command)[0] for command in sequence])
    ours = in_closed_form(start, jnp.asarray(sequence, jnp.float32))
    (our_position, our_rotation), (position, rotation) = hands(ours), hands(jnp.asarray(theirs, jnp.float32))
    distance, angle = jnp.linalg.norm(our_position - position, axis=1).max() * 1e3, angles(our_rotation, rotation).max() * 1e3
    assert distance < millimetres
    assert angle < milliradians


def test_a_reset_leaves_nothing_behind(arm):
    start, command = np.array(panda.INITIAL_JOINTS), np.array([0.02, -0.01, 0.01, 0.03, 0.0, -0.05])
    runs = []
    for _ in range(2):
        arm.reset(start)
        runs.append(np.stack([np.concatenate(arm.step(command)) for _ in range(5)]))
        arm.step(-command)
    np.testing.assert_array_equal(*runs)


# --- episodes


def test_host_loop_plays_as_the_compiled_one_does():
    """With the same arm on both sides: every row, the padding included, but for actions, whose padding is 0 on the host."""
    env = KinematicReach(num_waypoints=1, position_tolerance=0.1, rotation_tolerance=0.3, horizon=19)
    act = expert_act(ReachExpert(randomness_scale=0.05), env)
    expected = jax.jit(lambda key: play(key, env, act, 6))(jax.random.key(4))
    arm, jitted = KinematicArm(), jax.jit(act)
    found = stacked([play_episode(key_episode, env, arm, jitted) for key_episode in jax.random.split(jax.random.key(4), 6)])
    lengths = np.asarray(expected.lengths)
    assert set(np.asarray(expected.terminated).tolist()) == {False, True}
    padding = np.arange(env.horizon)[None] >= lengths[:, None]
    actions = jnp.where(padding[..., None], 0.0, expected.actions)
    expected = expected.replace(actions=actions)
    assert jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), found) == jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), expected)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=2e-4), found, expected)


class Spy:
    """The arm, and what robosuite's own environment makes of the episode."""

    def __init__(self, arm):
        self.arm, self.rewards, self.reached, self.commands = arm, [], [], []

    def reset(self, *arguments):
        return self.arm.reset(*arguments)

    def step(self, command):
        outcome = self.arm.step(command)
        self.commands.append(command)
        self.rewards.append(self.arm.environment.reward())
        self.reached.append(self.arm.environment._get_observations()["waypoints_reached"])
        return outcome


@pytest.fixture(scope="module")
def played(arm):
    """A solved episode of the expert in robosuite, and its spy."""
    spy = Spy(arm)
    episode = play_episode(jax.random.key(0), ENV, spy, jax.jit(expert_act(STEADY, ENV)))
    assert episode.terminated
    return episode, spy


def test_robosuites_own_environment_agrees_about_rewards_and_progress(played):
    episode, spy = played
    length = int(episode.lengths)
    np.testing.assert_array_equal(spy.rewards, episode.rewards[:length])
    assert np.flatnonzero(spy.rewards).tolist() == [length - 1]
    np.testing.assert_array_equal(spy.reached, episode.observations[1 : length + 1, -2:])


def test_an_episode_in_robosuite_reaches_the_same_waypoints_in_closed_form(played):
    episode, spy = played
    length = int(episode.lengths)
    actions = action_to_env(jnp.asarray(episode.actions), IN_CLOSED_FORM)
    np.testing.assert_allclose(actions[:length], spy.commands, atol=1e-6)
    # An episode ends as soon as the hand is within the tolerance, so a hair's breadth more is granted to the replay.
    env = dataclasses.replace(IN_CLOSED_FORM, position_tolerance=0.0205, rotation_tolerance=0.054)
    start = env.vector_to_state(jax.random.key(0), episode.states[0])
    replay = jax.jit(lambda state, actions: jax.lax.scan(env.step, state, actions))
    state, _ = replay(start, actions[:length])
    assert int(state.num_reached) == 2
    np.testing.assert_allclose(state.joints, episode.states[-1][:7], atol=1e-3)  # 2e-4 was measured


def test_actions_are_clipped_for_robosuite_and_recorded_as_they_are(arm):
    spy, env = Spy(arm), dataclasses.replace(ENV, horizon=2)
    episode = play_episode(jax.random.key(0), env, spy, lambda key, state, observation: 3.0 * jnp.asarray(env.action_high))
    np.testing.assert_allclose(spy.commands, np.tile(env.action_high, (2, 1)))
    np.testing.assert_allclose(episode.actions, 3.0, rtol=1e-6)


@pytest.fixture(scope="module")
def recording(arm):
    return record(jax.random.key(0), COARSE, STEADY, 2)


def test_recording_keeps_solved_episodes_and_repeats_itself(recording):
    episodes = recording
    assert np.asarray(episodes.terminated).all()
    assert episodes.observations.shape == (2, COARSE.horizon + 1, COARSE.observation_dim)
    np.testing.assert_array_equal(episodes.rewards.sum(axis=1), 1.0)
    again = record(jax.random.key(0), COARSE, STEADY, 1)
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a, b[:1]), again, recording)


def test_playing_compiles_once(arm):
    traces = []

    def act(key, state, observation):
        traces.append(1)
        return STEADY.act(key, COARSE, state)

    env = dataclasses.replace(COARSE, horizon=2)
    for seed in range(2):
        assert play_in_robosuite(jax.random.key(seed), env, act, 2).lengths.tolist() == [2, 2]
    assert len(traces) == 1


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
    for name in ("import_robosuite", "environment_class", "shared_arm", "RobosuiteArm"):
        monkeypatch.setattr(robosuite_arm, name, lambda *_, name=name: pytest.fail(f"{name} was called"))
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
    assert "invalid choice" in refusal(capsys, *arguments, "--env", COARSE.name, "--device", "joystick")
    assert "drop --backend mjx" in refusal(capsys, *arguments, "--env", COARSE.name, "--backend", "mjx")
    assert "expert's options" in refusal(capsys, *arguments, "--env", COARSE.name, "--randomness-scale", "0.05")


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
    dims = dict(observation_dim=env.observation_dim, goal_dim=env.goal_dim, action_dim=env.action_dim)
    make_agents = jax.jit(jax.vmap(lambda key: agents.init(key, config.agent, **dims)))
    goals = GoalTable(goals=jnp.ones((2, 3, env.goal_dim)), count=jnp.full(2, 3))
    scale = {
        field.name: jnp.ones((2, env.observation_dim if field.name.startswith("observation") else env.goal_dim))
        for field in dataclasses.fields(agents.InputScale)
    }
    result = SimpleNamespace(
        guidance=SimpleNamespace(behavioural_goals=goals, epsilon=jnp.ones((2, env.goal_dim)), scale=agents.InputScale(**scale)),
        state=SimpleNamespace(agent=make_agents(jax.random.split(jax.random.key(0), 2))),
    )
    path = tmp_path_factory.mktemp("runs") / "untrained"
    runs.RunWriter(path, RunSpec(env=env, config=config, demos="2", seeds=(0, 1)), overwrite=False).start()
    runs._save_parameters(path / runs.PARAMETERS, result)
    return path


def test_evaluation_in_robosuite(run, capsys):
    cli.main(["eval", str(run), "--backend", "robosuite", "--episodes", "2", "--stochastic"])
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

    def stub_player(env, act, num_episodes):
        @jax.jit
        def act_twice(key):
            key_reset, *keys_act = jax.random.split(key, 3)
            with jax.debug_key_reuse(False):  # the episode's goal is drawn at every step, always with the key in the state
                state, observation = env.reset(key_reset)
                return jnp.stack([act(key_act, state, observation) for key_act in keys_act])

        def play_one(key):
            acted.append(np.asarray(act_twice(key)))
            return SimpleNamespace(lengths=np.ones(num_episodes), terminated=np.ones(num_episodes, bool))

        return play_one

    monkeypatch.setattr(runs, "player", stub_player)
    loaded.evaluate(episodes=4)
    assert len(acted) == 8
    observation = env.reset(jax.random.key(0))[1][None]
    for seed in range(2):
        actor, table, scale = jax.tree.map(lambda leaf, seed=seed: leaf[seed], (loaded.policies, loaded.behavioural_goals, loaded.scale))
        policy = make_policy(actor, scale, env, config, stochastic=False)
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
    grid = Run(tmp_path, RunSpec(make("GridPickAndPlace"), TrainConfig(), "1", (0,)), None, None, None)
    with pytest.raises(UserError, match="GridPickAndPlace has one back end only"):
        grid.in_backend("robosuite")


# --- an installation that does not work


def installed(**versions):
    def version(name):
        if name not in versions:
            raise metadata.PackageNotFoundError(name)
        return versions[name]

    return version


@pytest.mark.parametrize(
    ("versions", "message"),
    [
        (dict(mujoco="3.9.0"), r"needs robosuite, which is not installed: .*-m pip install robosuite==1.5.1 'mujoco==3.9.\*'$"),
        (dict(mujoco="3.10.0", robosuite="1.5.1"), r"needs robosuite 1.5.1 with mujoco 3.9, but robosuite 1.5.1 and mujoco 3.10.0 are installed"),
        (
            dict(mujoco="3.9.0", robosuite="1.5.2"),
            r"but robosuite 1.5.2 and mujoco 3.9.0 are installed: .*-m pip install robosuite==1.5.1 'mujoco==3.9.\*'$",
        ),
        (dict(mujoco="3.90.0", robosuite="1.5.1"), r"mujoco 3.90.0"),
    ],
)
def test_other_versions_are_refused(versions, message, monkeypatch):
    monkeypatch.setattr(metadata, "version", installed(**versions))
    with pytest.raises(UserError, match=message):
        check_versions()


def test_versions_that_go_together_are_accepted(monkeypatch):
    monkeypatch.setattr(metadata, "version", installed(mujoco="3.9.2", robosuite="1.5.1"))
    check_versions()


@pytest.mark.parametrize(
    ("error", "message"),
    [
        ("libGL.so.1: cannot open shared object file: No such file or directory", "apt-get install libgl1 libglib2.0-0"),
        ("libgthread-2.0.so.0: cannot open shared object file", "apt-get install libgl1 libglib2.0-0"),
        ("No module named 'termcolor'", "-m pip install robosuite==1.5.1"),
    ],
)
def test_an_import_that_fails_says_what_to_install(error, message, monkeypatch):
    def import_module(name):
        os.environ["MUJOCO_GL"] = "egl"  # as robosuite does
        raise ImportError(error)

    monkeypatch.setattr(metadata, "version", installed(mujoco="3.9.0", robosuite="1.5.1"))
    monkeypatch.setattr(robosuite_arm, "importlib", SimpleNamespace(import_module=import_module))
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    with pytest.raises(UserError, match=message):
        robosuite_arm.import_robosuite.__wrapped__()
    assert os.environ["MUJOCO_GL"] == "osmesa"


def test_missing_files_of_robosuite_are_named(arm, tmp_path, monkeypatch):
    monkeypatch.setattr("robosuite.models.assets_root", str(tmp_path))
    with pytest.raises(UserError, match=f"{tmp_path}.*pip install --force-reinstall --no-deps robosuite==1.5.1"):
        RobosuiteArm(1)


def test_robosuite_says_nothing(arm):
    """In a process of its own, where it is imported for the first time and warnings are errors."""
    code = (
        "import numpy as np, os\n"
        "from hindrl_jax.experts.robosuite_arm import RobosuiteArm\n"
        "arm = RobosuiteArm(1)\n"
        "arm.reset(np.zeros(7)), arm.step(np.zeros(6))\n"
        "print('MUJOCO_GL' in os.environ)"
    )
    environment = {name: value for name, value in os.environ.items() if name != "MUJOCO_GL"}
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=True, env=environment)
    assert (done.stdout, done.stderr) == ("False\n", "")
