"""What every environment must satisfy. A new one is added to ENVIRONMENTS, with one line."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.grid import FixedGridPickAndPlace, GridPickAndPlace
from hindrl_jax.types import Environment

ENVIRONMENTS = [
    GridPickAndPlace(),
    GridPickAndPlace(num_objects=3, strict_order=False),
    FixedGridPickAndPlace(),
    FixedGridPickAndPlace(num_objects=3),
]
every_environment = pytest.mark.parametrize("env", ENVIRONMENTS, ids=repr)


def rollout(env, key, num_steps):
    """One episode of uniformly random actions, not reset at its end: first observation and stacked time steps."""
    key_reset, key_actions = jax.random.split(key)
    state, observation = env.reset(key_reset)
    actions = jax.random.uniform(key_actions, (num_steps, env.action_dim), minval=env.action_low, maxval=env.action_high)
    return observation, jax.lax.scan(env.step, state, actions)[1]


@every_environment
def test_satisfies_the_protocol(env):
    assert isinstance(env, Environment)
    assert isinstance(hash(env), int)
    assert isinstance(env.name, str)
    assert env.name
    assert env.action_low < env.action_high


@every_environment
def test_random_episodes_have_the_promised_shapes_and_finite_values(env):
    num_episodes, num_steps = 3, 20
    first, steps = jax.jit(jax.vmap(lambda key: rollout(env, key, num_steps)))(jax.random.split(jax.random.key(0), num_episodes))
    assert first.shape == (num_episodes, env.observation_dim)
    assert steps.observation.shape == (num_episodes, num_steps, env.observation_dim)
    assert first.dtype == steps.observation.dtype == jnp.float32
    for array, dtype in [(steps.reward, jnp.float32), (steps.terminated, bool), (steps.truncated, bool)]:
        assert array.shape == (num_episodes, num_steps)
        assert array.dtype == dtype
    assert np.isfinite(first).all()
    assert np.isfinite(steps.observation).all()
    assert (np.ptp(np.asarray(steps.observation), axis=1) > 0).any()  # something moves


@every_environment
def test_goals_have_the_promised_shapes(env):
    observations = jnp.zeros((3, 2, env.observation_dim))
    assert env.achieved_goal(observations).shape == (3, 2, env.goal_dim)
    assert env.task_goal().shape == (env.goal_dim,)
    assert env.task_goal().dtype == jnp.float32
    assert np.isfinite(env.task_goal()).all()


@every_environment
def test_state_keeps_its_structure_so_that_it_can_be_scanned(env):
    state, _ = jax.eval_shape(env.reset, jax.random.key(0))
    after, _ = jax.eval_shape(env.step, state, jnp.zeros(env.action_dim))
    assert jax.tree.map(lambda a: (a.shape, a.dtype), state) == jax.tree.map(lambda a: (a.shape, a.dtype), after)


@every_environment
def test_an_episode_ends_at_the_horizon_or_before(env):
    _, steps = jax.jit(lambda key: rollout(env, key, env.horizon))(jax.random.key(1))
    ended = np.asarray(steps.terminated | steps.truncated)
    assert ended.any()
    assert not (steps.terminated & steps.truncated).any()
    assert not np.asarray(steps.truncated)[:-1].any()
    np.testing.assert_array_equal(steps.reward, np.asarray(steps.terminated, np.float32))


@every_environment
def test_actions_are_clipped_to_the_bounds(env):
    state, _ = jax.jit(env.reset)(jax.random.key(2))
    sign = jnp.where(jnp.arange(env.action_dim) % 2 == 0, 1.0, -1.0)
    bound = jnp.where(sign > 0, env.action_high, env.action_low)
    step = jax.jit(env.step)
    _, clipped = step(state, 100.0 * sign)
    _, exact = step(state, bound)
    np.testing.assert_array_equal(clipped.observation, exact.observation)


@every_environment
def test_the_same_key_gives_the_same_episode_and_another_key_another(env):
    run = jax.jit(lambda key: rollout(env, key, 5))
    first, again, other = (run(jax.random.key(seed)) for seed in (0, 0, 1))
    np.testing.assert_array_equal(first[1].observation, again[1].observation)
    assert not np.array_equal(first[1].observation, other[1].observation)
