"""Our environments seen through Gymnasium."""

import subprocess
import sys

import gymnasium
import jax
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

import hindrl_jax as hindrl
from hindrl_jax.base.environments import action_from_env
from hindrl_jax.base.errors import UserError
from hindrl_jax.experts.cable import CableExpert
from hindrl_jax.experts.grid import GridExpert
from hindrl_jax.experts.reach import ReachExpert
from hindrl_jax.tasks.as_gymnasium import GoalVectorEnv
from hindrl_jax.tasks.ids import MAX_EPISODE_STEPS, gymnasium_id
from hindrl_jax.tasks.registry import TASKS

GRID = "hindrl/FixedGridPickAndPlace-v0"
ARMS = ("ParameterizedReach", "FixedParameterizedReach", "BringNear", "CableInsertion")
EXPERTS = {
    GridExpert: GridExpert(random_action_probability=0.0),
    ReachExpert: ReachExpert(randomness_scale=0.0),
    CableExpert: CableExpert(translation_noise=0.0, rotation_noise=0.0, insertion_noise=0.0),
}


def test_every_environment_is_registered_with_its_horizon():
    assert {name: task.environment().horizon for name, task in TASKS.items()} == MAX_EPISODE_STEPS
    for name, steps in MAX_EPISODE_STEPS.items():
        assert gymnasium.spec(f"hindrl/{name}-v0").max_episode_steps == steps


def test_importing_the_package_registers_and_loads_neither_jax_nor_anything_of_ours_that_does():
    code = "import sys, hindrl_jax, gymnasium; print('jax' in sys.modules, 'hindrl/GridPickAndPlace-v0' in gymnasium.registry)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split() == ["False", "True"]


@pytest.mark.parametrize("name", TASKS)
def test_gymnasium_finds_no_fault(name):
    env = gymnasium.make(gymnasium_id(name)).unwrapped
    check_env(env, skip_render_check=name in ARMS)  # the arms' pictures need OpenGL
    assert env.metadata["render_fps"] == (20 if name in ARMS else 7)


@pytest.mark.parametrize("name", TASKS)
def test_the_expert_is_rewarded_where_and_only_where_compute_reward_says_so(name):
    env = gymnasium.make(gymnasium_id(name), max_episode_steps=1000)
    task, expert = env.unwrapped._task.env, EXPERTS[TASKS[name].expert]
    act = jax.jit(lambda seed, state: action_from_env(expert.act(jax.random.key(seed), task, state), task))
    env.reset(seed=3)
    steps, terminated = 0, False
    while not terminated and steps < 400:
        observation, reward, terminated, truncated, info = env.step(np.asarray(act(steps, env.unwrapped._state)))
        assert (
            reward == terminated == info["is_success"] == env.unwrapped.compute_reward(observation["achieved_goal"], observation["desired_goal"], {})
        )
        np.testing.assert_allclose(observation["achieved_goal"], task.achieved_goal(observation["observation"]))
        np.testing.assert_array_equal(observation["desired_goal"], task.task_goal())
        assert not truncated
        steps += 1
    assert terminated


@pytest.mark.parametrize("name", TASKS)
def test_a_continuing_task_rewards_each_step_at_the_goal(name):
    env = gymnasium.make(gymnasium_id(name), max_episode_steps=400, continuing_task=True)
    task, expert = env.unwrapped._task.env, EXPERTS[TASKS[name].expert]
    act = jax.jit(lambda seed, state: action_from_env(expert.act(jax.random.key(seed), task, state), task))
    env.reset(seed=3)
    rewards, truncated = [], False
    while not truncated:
        action = np.asarray(act(len(rewards), env.unwrapped._state)) if not any(rewards) else np.zeros(task.action_dim, np.float32)
        observation, reward, terminated, truncated, info = env.step(action)
        assert not terminated
        assert reward == info["is_success"] == env.unwrapped.compute_reward(observation["achieved_goal"], observation["desired_goal"], {})
        rewards.append(reward)
    assert len(rewards) == 400
    assert 0 < sum(rewards) < 400


def test_rewards_are_those_of_goals_within_the_tolerance():
    env = gymnasium.make("hindrl/FixedParameterizedReach-v0").unwrapped
    goal = env.observation_space["desired_goal"].sample()
    offsets = np.zeros((2, 3, 11), np.float32)
    offsets[0, 1, 0] = 0.0199  # of a position, whose tolerance is 0.02 m
    offsets[0, 2, 0] = 0.0201
    offsets[1, 0, 4] = -0.0499  # of a rotation, 0.05
    offsets[1, 1, 4] = -0.0501
    offsets[1, 2, 10] = 1.0  # a waypoint that is not reached
    rewards = env.compute_reward(goal + offsets, np.broadcast_to(goal, offsets.shape), [{}] * 6)
    assert rewards.dtype == np.float32
    np.testing.assert_array_equal(rewards, [[1, 1, 0], [1, 0, 0]])


def random_actions(env, steps):
    rng = np.random.default_rng(0)
    return rng.uniform(-1, 1, (steps, *env.action_space.shape)).astype(np.float32)


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_side_by_side_they_live_the_episodes_of_single_ones(mode):
    """With few steps to an episode, each begins several."""
    together = gymnasium.make_vec(GRID, 3, max_episode_steps=4, autoreset_mode=mode)
    apart = gymnasium.make_vec(GRID, 3, vectorization_mode="sync", vector_kwargs={"autoreset_mode": mode}, max_episode_steps=4)
    assert together.metadata["autoreset_mode"] is AutoresetMode(mode)
    assert together.single_observation_space == apart.single_observation_space
    assert together.action_space == apart.action_space
    assert_same(together.reset(seed=7), apart.reset(seed=7))
    num_ended = 0
    for action in random_actions(together, 13):
        results = together.step(action)
        assert_same(results, apart.step(action))
        assert results[0] in together.observation_space
        num_ended += results[3].sum()
    assert num_ended == (6 if mode == "NextStep" else 9)  # a new episode takes a step, or none
    assert_same(together.reset(), apart.reset())
    assert_same(together.reset(seed=[5, 2, 9]), apart.reset(seed=[5, 2, 9]))


# The agent starts at (0, 0), the only object lies at (1, 0), and the goal is (0, 1).
TINY = dict(num_objects=1, size=2, random_box_size=1)
SOLUTION = np.array([[1, -1, -1, -1, -1], [-1, 1, -1, -1, 1], [-1, -1, 1, -1, 1], [-1, -1, 1, -1, 1]], np.float32)  # the last one stays at the goal


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
@pytest.mark.parametrize("continuing_task", [False, True])
@pytest.mark.parametrize("max_episode_steps", [3, 4])  # with 3 the step that solves the task is the last one
def test_side_by_side_they_solve_the_episodes_of_single_ones(mode, continuing_task, max_episode_steps):
    task = dict(max_episode_steps=max_episode_steps, continuing_task=continuing_task, **TINY)
    together = gymnasium.make_vec(GRID, 2, autoreset_mode=mode, **task)
    apart = gymnasium.make_vec(GRID, 2, vectorization_mode="sync", vector_kwargs={"autoreset_mode": mode}, **task)
    assert_same(together.reset(seed=7), apart.reset(seed=7))
    step, begins, rewards = 0, False, []
    for _ in range(13):
        actions = np.stack(2 * [SOLUTION[step]])
        results = together.step(actions)
        assert_same(results, apart.step(actions))
        rewards.append(results[1][0])
        ended = bool((results[2] | results[3])[0])
        step = 0 if ended or begins else step + 1
        begins = ended and mode == "NextStep"
    one_episode = [0.0, 0.0, 1.0] + (max_episode_steps == 4 and continuing_task) * [1.0] + (mode == "NextStep") * [0.0]
    assert rewards == (5 * one_episode)[:13]


def assert_same(a, b):
    """That two results are equal in what they hold, also deep within."""
    if isinstance(a, dict):
        assert a.keys() == b.keys()
        for key in a:
            assert_same(a[key], b[key])
    elif isinstance(a, tuple) or (isinstance(a, np.ndarray) and a.dtype.hasobject):
        for one, other in zip(a, b, strict=True):
            assert_same(one, other)
    else:
        np.testing.assert_array_equal(a, b)
        assert getattr(a, "dtype", None) == getattr(b, "dtype", None)


def test_without_autoreset_only_the_chosen_are_reset():
    env = gymnasium.make_vec(GRID, 2, autoreset_mode="Disabled")
    env.reset(seed=0)
    before, *_ = env.step(random_actions(env, 1)[0])
    after, _ = env.reset(options={"reset_mask": np.array([False, True])})
    np.testing.assert_array_equal(after["observation"][0], before["observation"][0])
    other, _ = gymnasium.make_vec(GRID, 2).reset(seed=0)
    assert not np.array_equal(after["observation"][1], other["observation"][1])  # the seed's second episode, not its first


def test_a_solved_episode_gives_way_to_the_next():
    env = gymnasium.make_vec(GRID, 1, **TINY)
    env.reset(seed=0)
    results = [env.step(action[None]) for action in (*SOLUTION[:3], SOLUTION[0])]
    assert [bool(terminated[0]) for _, _, terminated, _, _ in results] == [False, False, True, False]
    assert [float(reward[0]) for _, reward, *_ in results] == [0.0, 0.0, 1.0, 0.0]
    assert [bool(info["is_success"][0]) for *_, info in results] == [False, False, True, False]
    np.testing.assert_array_equal(results[2][0]["achieved_goal"], results[2][0]["desired_goal"])
    np.testing.assert_array_equal(results[3][0]["observation"], [[1, 0, 0, 1, 0, 0]])  # reset; its action was not taken


def test_a_continuing_task_is_cut_by_the_horizon_alone():
    env = gymnasium.make_vec(GRID, 1, max_episode_steps=4, continuing_task=True, **TINY)
    env.reset(seed=0)
    results = [env.step(action[None]) for action in SOLUTION]
    assert [float(reward[0]) for _, reward, *_ in results] == [0.0, 0.0, 1.0, 1.0]
    assert [bool(info["is_success"][0]) for *_, info in results] == [False, False, True, True]
    assert [(bool(terminated[0]), bool(truncated[0])) for _, _, terminated, truncated, _ in results] == 3 * [(False, False)] + [(False, True)]


def test_the_horizon_truncates_and_does_not_terminate():
    env = gymnasium.make(GRID, max_episode_steps=3)
    env.reset(seed=0)
    ends = [env.step(np.array([1, -1, -1, -1, -1], np.float32))[2:4] for _ in range(3)]
    assert ends == [(False, False), (False, False), (False, True)]


def test_pictures_show_the_present_state():
    env = gymnasium.make(GRID, render_mode="rgb_array")
    env.reset(seed=0)
    before = env.render()
    env.step(np.array([1, -1, -1, -1, -1], np.float32))
    assert before.dtype == np.uint8
    assert (before != env.render()).any()
    together = gymnasium.make_vec(GRID, 2, render_mode="rgb_array")
    together.reset(seed=0)
    np.testing.assert_array_equal(together.render()[0], before)


@pytest.mark.parametrize(
    ("name", "arguments", "message"),
    [
        ("FixedGridPickAndPlace", {"horizon": 50}, "max_episode_steps"),
        ("FixedGridPickAndPlace", {"strict_order": False}, "compute_reward cannot be had"),
        ("FixedGridPickAndPlace", {"num_objectss": 3}, "did you mean 'num_objects'"),
        ("FixedParameterizedReach", {"backend": "robosuite"}, "closed_form"),
        ("FixedParameterizedReach", {"orientation": "axis_angle"}, "compute_reward cannot be had"),
        ("BringNear", {"observation": "thesis"}, "compute_reward cannot be had"),
        ("FixedGridPickAndPlace", {"continuing_task": "false"}, "continuing_task = 'false' is not usable"),
    ],
)
def test_what_cannot_be_is_refused(name, arguments, message):
    for make in (gymnasium.make, gymnasium.make_vec):
        with pytest.raises(UserError, match=message):
            make(gymnasium_id(name), **arguments)


@pytest.mark.parametrize("steps", [0, -2, 2.5])
def test_a_vector_environment_refuses_a_horizon_that_is_none(steps):
    with pytest.raises(UserError, match=r"max_episode_steps = .* is not usable"):
        GoalVectorEnv("FixedGridPickAndPlace", max_episode_steps=steps)


def test_a_vector_environment_may_have_no_horizon():
    for steps in (None, -1):
        env = GoalVectorEnv("FixedGridPickAndPlace", max_episode_steps=steps)
        env.reset(seed=0)
        assert not any(env.step(action)[3].any() for action in random_actions(env, 5))


def test_seeds_must_be_as_many_as_environments():
    with pytest.raises(UserError, match="2 seeds for 3 environments"):
        gymnasium.make_vec(GRID, 3).reset(seed=[1, 2])


def test_the_environment_is_the_one_that_python_makes():
    env = gymnasium.make(GRID, num_objects=3).unwrapped
    assert env._task.env == hindrl.make("FixedGridPickAndPlace", num_objects=3, horizon=2**31 - 1)


def test_a_vector_environment_asks_for_its_reset_and_takes_any_whole_number_as_seed():
    envs = gymnasium.make_vec(gymnasium_id("FixedGridPickAndPlace"), num_envs=2, render_mode="rgb_array")
    for ask in (envs.render, lambda: envs.step(np.zeros((2, 3), np.float32))):
        with pytest.raises(gymnasium.error.ResetNeeded, match="call reset first"):
            ask()
    first, second = (envs.reset(seed=seed)[0]["observation"] for seed in (3, np.int64(3)))
    np.testing.assert_array_equal(first, second)
    assert len(envs.render()) == 2
