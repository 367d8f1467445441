"""Learning in environments that are stepped outside JAX."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny
from host_env import HostCorridor
from PIL import Image
from point_env import CONFIG, SPEED, to_goal
from toy_env import corridor_demonstrations

import hindrl_jax as hindrl
from hindrl_jax import cli
from hindrl_jax.base.errors import UserError
from hindrl_jax.base.steppers import SimulationFailed
from hindrl_jax.core.batch import rows_of_demonstrations
from hindrl_jax.core.hindsight import NEARBY_GOAL
from hindrl_jax.core.imitation import NOISES, NUM_STARTS
from hindrl_jax.runs.checkpoints import Checkpoints
from hindrl_jax.tasks.simulators import Simulators
from hindrl_jax.training import imitating
from hindrl_jax.training.host_playing import play, record, with_noise
from hindrl_jax.training.judging import as_judged_by
from hindrl_jax.training.recording import record_gymnasium

POINT = "gymnasium:point_env:PointGoal-v0"


@pytest.fixture(scope="module")
def env():
    return hindrl.make(POINT)


@pytest.fixture(scope="module")
def demonstrations(env):
    return record_gymnasium(env, to_goal, 5, seed=1)


def with_batch(config, **values):
    return dataclasses.replace(config, batch=dataclasses.replace(config.batch, **values))


def test_demonstrations_are_what_the_policy_did_up_to_the_goal(env, demonstrations):
    assert demonstrations.observations.shape == (5, 11, 5)
    assert demonstrations.actions.shape == (5, 10, 2)
    for i, length in enumerate(demonstrations.lengths):
        places = demonstrations.observations[i, : length + 1, :2]
        np.testing.assert_allclose(np.diff(places, axis=0), SPEED * demonstrations.actions[i, :length], atol=1e-6)  # actions in [-1, 1]
        distance = np.linalg.norm(places - demonstrations.desired_goals[i], axis=1)
        assert (distance[:-1] > 0.2).all() or length == 1  # an episode may begin at its goal, and is judged after its first step
        assert distance[-1] <= 0.2
        np.testing.assert_array_equal(demonstrations.rewards[i], np.arange(10) == length - 1)
    assert demonstrations.terminated.all()
    again = record_gymnasium(env, to_goal, 5, seed=1)
    np.testing.assert_array_equal(again.observations, demonstrations.observations)


def test_demonstrations_that_stay_at_their_goal_serve_where_the_episode_ends_there(env):
    recorded = record_gymnasium(dataclasses.replace(env, success="held"), to_goal, 5, seed=1)
    assert recorded.lengths.tolist() == [10] * 5
    assert recorded.rewards[:, -1].all()
    assert (np.diff(recorded.rewards, axis=1) >= 0.0).all()  # none leaves its goal
    cut = as_judged_by(env, recorded)
    assert cut.lengths.tolist() == (np.argmax(recorded.rewards, axis=1) + 1).tolist()
    np.testing.assert_array_equal(cut.rewards, np.arange(10) == cut.lengths[:, None] - 1)
    np.testing.assert_array_equal(cut.observations, recorded.observations)
    hindrl.fit(env, recorded, dataclasses.replace(CONFIG, steps=60, eval_every=20))  # the same in memory


def towards_goal(observation, goal):
    """A policy that walks straight to its goal, not as fast as it may, in the environment's own units."""
    return np.clip(np.asarray(goal) - observation[:, :2], -0.5 * SPEED, 0.5 * SPEED)


def test_recorded_episodes_are_what_the_environment_makes_of_their_actions(env):
    """Noisy ones, with equal seeds from equal starts."""
    stepper, generators, seeds = env.stepper(3), [np.random.default_rng(0)], np.arange(3, dtype=np.uint32)
    try:
        first, second = (record(stepper, env, seeds, with_noise(towards_goal, env, noise, generators)) for noise in (0.0, 0.3))
    finally:
        stepper.close()
    np.testing.assert_array_equal(first.observations[:, 0], second.observations[:, 0])
    np.testing.assert_array_equal(first.desired_goals, second.desired_goals)
    assert (first.actions != second.actions).any()
    for episodes in (first, second):
        assert np.abs(episodes.actions).max() <= 1.0
        for row, length in enumerate(episodes.lengths):
            places = episodes.observations[row, : length + 1, :2]
            np.testing.assert_allclose(np.diff(places, axis=0), SPEED * episodes.actions[row, :length], atol=1e-5)
            reached = np.linalg.norm(places[1:] - episodes.desired_goals[row], axis=1) <= 0.2
            np.testing.assert_array_equal(episodes.rewards[row, :length] > 0.0, reached)
            assert episodes.terminated[row] == reached[-1]
            assert not episodes.rewards[row, length:].any()


PRACTISING = dataclasses.replace(CONFIG, imitation_steps=90, practice_rounds=2, num_envs=7, steps=120)


@pytest.mark.parametrize("success", ["reached", "held"])
def test_a_clone_practises_where_environments_are_stepped_outside_jax(env, success, monkeypatch):
    """Seven environments for each run, so that the last starts of a round are fewer than these."""
    monkeypatch.setattr(imitating, "PRACTISABLE", 0.0)  # both seeds
    judged = dataclasses.replace(env, success=success)
    with jax.debug_key_reuse(success == "reached"):  # no random key is consumed twice
        result = hindrl.fit(judged, record_gymnasium(judged, to_goal, 5, seed=1), PRACTISING, seeds=[0, 1])
    assert (result.practised_success >= 0.5).any()
    attempts = NUM_STARTS * len(NOISES)
    assert ((result.practice_steps >= attempts) & (result.practice_steps <= 2 * 10 * attempts)).all()
    assert success == "reached" or (result.practice_steps % (10 * attempts) == 0).all()  # held to the horizon
    for name, value in (("practised_success", result.practised_success), ("practice_steps", result.practice_steps)):
        assert [getattr(summary, name) for summary in result.summaries()] == value.tolist()


def test_practice_that_was_stopped_goes_on_where_environments_are_stepped_outside_jax(env, tmp_path, monkeypatch):
    monkeypatch.setattr(imitating, "PRACTISABLE", 0.0)
    demonstrations = record_gymnasium(env, to_goal, 5, seed=1)
    checkpoints, before = Checkpoints(tmp_path, seconds=0), []

    def stop(result):
        checkpoints.save_when_due(result)
        if result.practising is not None and result.practising.rounds == 1:
            before.append((result.cloned_success, result.practice_steps))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        hindrl.fit(env, demonstrations, PRACTISING, seeds=[0, 1], report=stop)
    assert checkpoints.newest == "after 1 round of practice"
    resumed = hindrl.fit(env, demonstrations, PRACTISING, seeds=[0, 1], restore=Checkpoints(tmp_path).restore)
    (success, steps), *_ = before
    assert resumed.cloned_success.tolist() == success.tolist()
    assert (resumed.practice_steps > steps).all()  # of the second round
    assert resumed.env_steps >= 120


@pytest.mark.parametrize("num_held", [1, 3])
def test_where_the_goal_is_to_be_held_episodes_go_on(env, num_held):
    """The demonstrations end at their goals, which is not the end of an episode here."""
    holds = dataclasses.replace(env, success="held")
    config = dataclasses.replace(CONFIG, action_hold=num_held, steps=120 * num_held)
    result = hindrl.fit(holds, record_gymnasium(env, to_goal, 5, seed=1), config)
    episodes = jax.device_get(result.state.replay).episodes
    assert set(episodes.lengths[0].tolist()) <= {0, -(-10 // num_held)}
    assert not episodes.terminated.any()
    assert episodes.rewards[0, :, :-1].any()
    assert episodes.rewards.max() == 1.0
    assert {row.episode_length for row in result.rows} == {10.0}


def test_demonstrations_of_goals_that_are_held_are_worth_what_rollouts_are(env):
    """Whether they ended at the goal or not, and whatever the number of control steps of a decision."""
    holds = dataclasses.replace(env, success="held")
    recorded = jax.tree.map(jnp.asarray, record_gymnasium(holds, to_goal, 5, seed=1))
    rows, steps = jnp.zeros(10, jnp.int32), jnp.arange(10)
    config = with_batch(CONFIG, gamma=0.5, n_step=2)
    following = np.append(recorded.rewards[0, 1:], 0.0)  # nothing follows the last step
    for table in (recorded, recorded.replace(terminated=jnp.zeros(5, bool))):
        batch = rows_of_demonstrations(table, rows, steps, holds, config)
        np.testing.assert_allclose(batch.reward, 0.5 * recorded.rewards[0] + 0.25 * following)
        np.testing.assert_allclose(batch.discount, np.where(np.arange(10) == 9, 0.5, 0.25))


def test_a_goal_that_moves_within_an_episode_is_no_goal_to_be_held():
    moving = Simulators(hindrl.make(POINT, success="held", moves=True), 2)
    moving.begin(np.array([1, 2]))
    with pytest.raises(SimulationFailed, match=r"changed the desired goal at step 1 of an episode that went on.*--success reached"):
        moving.step(np.zeros((2, 2)))
    moving.close()


def test_a_policy_that_reaches_nothing_is_told_so(env):
    with pytest.raises(UserError, match="only 0 of 3 episodes"):
        record_gymnasium(env, lambda observation, rng: [0.0, 0.0], 1, max_attempts=3, seed=3)


def test_every_environment_plays_as_many_episodes(env):
    """Of two environments, each three episodes; the policy of the second stands still, so that all its episodes last to the horizon."""
    two = Simulators(env, 2)
    success, length = play(two, np.array([1, 2]), lambda o, g: np.clip((g - o[:, 3:]) / SPEED, -1, 1) * 2 * np.array([[1], [0]]), 3)
    two.close()
    assert success[0].all()
    assert (length[0] <= 4).all()
    assert (length[1] == 10).all() or success[1].any()
    assert success.shape == length.shape == (2, 3)


@pytest.fixture(scope="module")
def trained(env, demonstrations):
    return hindrl.fit(env, demonstrations, CONFIG, seeds=[0, 7])


def check_replay(replay, *, at_least):
    """Moves follow from actions, goals stay for an episode, and rewards are where goals are reached: for each environment of each seed."""
    episodes, num_complete = replay.episodes, 0
    for seed, lengths in enumerate(episodes.lengths):
        for row in np.flatnonzero(lengths):
            length = lengths[row]
            places, actions = episodes.observations[seed, row, : length + 1, :2], episodes.actions[seed, row, :length]
            np.testing.assert_allclose(places[1:], np.clip(places[:-1] + SPEED * actions, -1, 1), atol=1e-5)
            reached = np.linalg.norm(places[1:] - episodes.desired_goals[seed, row], axis=1) <= 0.2 + 1e-6
            np.testing.assert_array_equal(episodes.rewards[seed, row, :length], reached)
            np.testing.assert_array_equal(reached, (np.arange(length) == length - 1) & episodes.terminated[seed, row])
            assert length == 10 or episodes.terminated[seed, row]
            num_complete += 1
    assert num_complete >= at_least


def test_the_replay_holds_what_the_environments_went_through(trained):
    replay = jax.device_get(trained.state.replay)
    check_replay(replay, at_least=40)
    assert not np.array_equal(*replay.episodes.observations)  # each seed has its own episodes


def test_a_run_is_told_like_others(trained):
    assert trained.env_steps >= 240
    assert trained.updates == 2 * (trained.env_steps - 40) // 4
    assert [row.seed for row in trained.rows] == [0, 7] * (len(trained.rows) // 2)
    assert {"critic/loss", "batch/relabelled"} <= trained.rows[0].metrics.keys()
    assert trained.final_success.shape == (2,)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(jax.device_get(trained.state.agent)))


def test_a_seed_gives_the_same_run_alone_and_goes_on_after_a_stop(env, demonstrations, trained, tmp_path):
    checkpoints = Checkpoints(tmp_path, seconds=0.0)

    def stop_half_way(result):
        checkpoints.save_when_due(result)
        if result.env_steps > 120:
            raise KeyboardInterrupt

    stopped = []
    with pytest.raises(KeyboardInterrupt):
        hindrl.fit(env, demonstrations, CONFIG, seeds=[7], report=lambda result: (stopped.append(result), stop_half_way(result)))
    alone, beside = stopped[-1].rows[0], trained.rows[1]
    assert alone.episode_length == beside.episode_length
    np.testing.assert_allclose(alone.metrics["critic/loss"], beside.metrics["critic/loss"], rtol=1e-2)

    resumed = hindrl.fit(env, demonstrations, CONFIG, seeds=[7], restore=checkpoints.restore)
    assert resumed.rows[0] == alone
    assert resumed.env_steps == trained.env_steps
    check_replay(jax.device_get(resumed.state.replay), at_least=20)


def test_a_run_by_the_command_line_can_be_played_and_filmed(env, demonstrations, tmp_path, capsys):
    file, out = tmp_path / "demos.hdf5", tmp_path / "run"
    hindrl.save_demonstrations(file, demonstrations, env=env, env_args=dataclasses.asdict(env))
    flags = "--steps 120 --num-envs 4 --learning-starts 40 --eval-every 60 --eval-episodes 3 --net-arch 8 --batch-size 16 --buffer-size 400"
    cli.main(["train", "--env", POINT, "--horizon", "8", "--demos", str(file), "--out", str(out), *flags.split()])
    run = hindrl.load_run(out)
    assert run.spec.env == hindrl.make(POINT, horizon=8)
    assert run.spec.config.goal.epsilon == pytest.approx(0.1414)
    assert {"config.json", "parameters.npz", "episode.gif", "curve.png"} <= {path.name for path in out.iterdir()}
    outcomes = run.evaluate(episodes=5)
    assert run.evaluate(episodes=5) == outcomes
    assert [outcome["seed"] for outcome in outcomes] == [0]
    assert outcomes[0]["episode_length"] <= 8
    cli.main(["render", str(out), "--to", str(tmp_path / "film.gif")])
    with Image.open(tmp_path / "film.gif") as film:
        assert film.size == (20, 20)
    cli.main(["eval", str(out), "--episodes", "3", "--noise", "1"])
    assert POINT in capsys.readouterr().out
    for refused, message in [
        (["demos", "render", str(file)], "hold no states"),
        (["train", "--env", POINT, "--demos", "1"], "no expert is known"),
        (["demos", "record", "--env", POINT, "--demos", "1", "--out", str(tmp_path / "x.hdf5")], "no expert is known"),
        (
            ["train", "--env", POINT, "--demos", str(file), "--demo-reset-ratio", "0.5"],
            "it has no restorable states in JAX: set",
        ),
        (["eval", str(out), "--backend", "robosuite"], "one back end"),
    ]:
        with pytest.raises(SystemExit):
            cli.main(refused)
        assert message in capsys.readouterr().err


def test_cloning_needs_no_environment_but_to_be_judged(env):
    config = dataclasses.replace(
        hindrl.preset("bc", env=env), steps=600, eval_every=300, num_envs=4, agent=dataclasses.replace(CONFIG.agent, net_arch=(32, 32))
    )
    result = hindrl.fit(env, record_gymnasium(env, to_goal, 40), config)
    assert result.env_steps == 0
    assert result.final_success[0] > 0.6


def test_other_options_work_as_well(env, demonstrations):
    """All at once, since each would be compiled for long."""
    config = dataclasses.replace(
        with_batch(CONFIG, hindrl_sampling_strategy="joint_intersection"), imitation_steps=3, imitation_proposal=True, steps=120
    )
    result = hindrl.fit(env, demonstrations, config)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(jax.device_get(result.state.agent)))
    replay = jax.device_get(result.state.replay)
    assert result.updates == 2 * (result.env_steps - 40) // 4
    assert (replay.notes[NEARBY_GOAL] >= 0).any()
    complete = replay.episodes.lengths[0] > 0
    assert len(np.unique(replay.episodes.desired_goals[0, complete], axis=0)) == complete.sum()


def test_what_cannot_be_had_is_refused(env, demonstrations):
    own = hindrl.make("FixedGridPickAndPlace")
    for where, config, message in [
        (env, dataclasses.replace(CONFIG, demo_reset_ratio=0.5), "cannot begin in demonstrated states: it has no restorable states in JAX"),
        (env, dataclasses.replace(CONFIG, goal=dataclasses.replace(CONFIG.goal, behavioural_goals="task")), "choose environment"),
        (own, CONFIG, "gives its episodes no goals"),
    ]:
        table = demonstrations if where is env else hindrl.record_demonstrations(own, 1)
        with pytest.raises(UserError, match=message):
            hindrl.fit(where, table, config)
    with pytest.raises(UserError, match="no expert is known"):
        hindrl.record_demonstrations(env, 1)
    with pytest.raises(UserError, match="choose default"):
        hindrl.preset("hindrl", "thesis", env=env)


CORRIDOR = dataclasses.replace(tiny.CONFIG, steps=120, learning_starts=10, num_envs=3, buffer_size=300)


def check_goals(result, goals):
    """Each episode aims at one of the goals, in every seed; and each of the goals is aimed at."""
    episodes = jax.device_get(result.state.replay.episodes)
    for seed, lengths in enumerate(episodes.lengths):
        found = episodes.desired_goals[seed, lengths > 0, 0]
        assert set(np.unique(found)) == set(np.float32(goals))


def test_goals_are_behavioural_ones_where_an_environment_gives_none(tmp_path):
    """An environment of one's own, whose episodes only say what they observe: aimed at the ends of the demonstrations, or at the task's goal."""
    env, demonstrations = HostCorridor(), corridor_demonstrations(speeds=(1.0, 1.75))
    result = hindrl.fit(env, demonstrations, CORRIDOR, seeds=[3, 4])
    check_goals(result, [4.0, 3.5])
    episodes = jax.device_get(result.state.replay.episodes)
    starts = episodes.observations[..., 0][episodes.lengths > 0]
    for row, length in enumerate(episodes.lengths[episodes.lengths > 0]):
        assert len(np.unique(starts[row, : length + 1])) == 1  # the start of an episode stays as it is
    assert result.final_success.shape == (2,)
    assert all(stepper.closed for stepper in HostCorridor.made)

    task = dataclasses.replace(CORRIDOR, goal=dataclasses.replace(CORRIDOR.goal, behavioural_goals="task"))
    checkpoints = Checkpoints(tmp_path, seconds=0.0)

    def stop(report):
        checkpoints.save_when_due(report)
        if report.env_steps > 60:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        hindrl.fit(env, demonstrations, task, report=stop)
    assert all(stepper.closed for stepper in HostCorridor.made)
    resumed = hindrl.fit(env, demonstrations, task, restore=checkpoints.restore)
    replay = jax.device_get(resumed.state.replay)
    assert (replay.episodes.desired_goals[0, replay.episodes.lengths[0] > 0] == 3.0).all()
