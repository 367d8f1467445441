"""What every environment must satisfy. A new one is added to ENVIRONMENTS, with one line."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hindrl_jax.base.environments import RestorableEnvironment
from hindrl_jax.envs import BringNear, CableInsertion, FixedGridPickAndPlace, FixedParameterizedReach, GridPickAndPlace, ParameterizedReach

ENVIRONMENTS = [
    GridPickAndPlace(),
    GridPickAndPlace(num_objects=3, strict_order=False),
    FixedGridPickAndPlace(),
    FixedGridPickAndPlace(num_objects=3),
    FixedParameterizedReach(horizon=25),
    ParameterizedReach(horizon=25, num_waypoints=3, orientation="axis_angle"),
    BringNear(horizon=25),
    CableInsertion(horizon=25, observation="thesis", randomised=True),
    CableInsertion(horizon=25, backend="mujoco", num_links=3),
]
every_environment = pytest.mark.parametrize("env", ENVIRONMENTS, ids=[f"{env.name}-{i}" for i, env in enumerate(ENVIRONMENTS)])


def bounds(env, shape):
    """Lower and upper bounds of actions of this shape, in the environment's units."""
    return [jnp.broadcast_to(jnp.asarray(bound, jnp.float32), shape) for bound in (env.action_low, env.action_high)]


def rollout(env, key):
    """One episode of uniformly random actions as long as the horizon, not reset at its end: first observation, stacked time steps, and what
    is observed of each state after a way through a vector."""
    key_reset, key_actions = jax.random.split(key)
    state, observation = env.reset(key_reset)
    low, high = bounds(env, (env.horizon, env.action_dim))
    actions = jax.random.uniform(key_actions, low.shape, minval=low, maxval=high)

    def step(state, action):
        state, time_step = env.step(state, action)
        return state, (time_step, env.observe(env.vector_to_state(state.key, env.state_to_vector(state))))

    return observation, *jax.lax.scan(step, state, actions)[1]


@functools.cache
def episodes(env):
    """Three episodes, side by side; the first two with the same key."""
    keys = jax.vmap(jax.random.key)(jnp.array([0, 0, 1]))
    return jax.device_get(jax.jit(jax.vmap(lambda key: rollout(env, key)))(keys))


@every_environment
def test_satisfies_the_protocol(env):
    assert isinstance(env, RestorableEnvironment)
    assert isinstance(hash(env), int)
    assert isinstance(env.name, str)
    assert env.name
    low, high = bounds(env, (env.action_dim,))
    assert (low < high).all()


@every_environment
def test_random_episodes_have_the_promised_shapes_and_finite_values(env):
    first, steps, _ = episodes(env)
    assert first.shape == (3, env.observation_dim)
    assert steps.observation.shape == (3, env.horizon, env.observation_dim)
    assert first.dtype == steps.observation.dtype == jnp.float32
    for array, dtype in [(steps.reward, jnp.float32), (steps.terminated, bool), (steps.truncated, bool)]:
        assert array.shape == (3, env.horizon)
        assert array.dtype == dtype
    assert np.isfinite(first).all()
    assert np.isfinite(steps.observation).all()
    assert (np.ptp(steps.observation, axis=1) > 0).any()  # something moves


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
    _, steps, _ = episodes(env)
    ended = steps.terminated | steps.truncated
    assert ended.any(axis=1).all()
    assert not (steps.terminated & steps.truncated).any()
    assert not steps.truncated[:, :-1].any()
    np.testing.assert_array_equal(steps.reward, steps.terminated.astype(np.float32))


@every_environment
def test_actions_are_clipped_to_the_bounds(env):
    sign = jnp.where(jnp.arange(env.action_dim) % 2 == 0, 1.0, -1.0)
    low, high = bounds(env, sign.shape)
    actions = jnp.stack([100.0 * sign, jnp.where(sign > 0, high, low)])

    def steps(key):
        state, _ = env.reset(key)
        return jax.vmap(lambda action: env.step(state, action)[1].observation)(actions)

    clipped, exact = jax.jit(steps)(jax.random.key(2))
    np.testing.assert_array_equal(clipped, exact)


@every_environment
def test_the_same_key_gives_the_same_episode_and_another_key_another(env):
    _, steps, _ = episodes(env)
    first, again, other = steps.observation
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


@every_environment
def test_a_state_survives_the_way_through_a_vector(env):
    _, steps, restored = episodes(env)
    np.testing.assert_allclose(restored, steps.observation, atol=1e-6)
    state, _ = jax.eval_shape(env.reset, jax.random.key(0))
    vector = jax.eval_shape(env.state_to_vector, state)
    assert (vector.shape, vector.dtype) == ((env.state_dim,), jnp.float32)


@every_environment
def test_observations_stay_within_their_bounds(env):
    first, steps, _ = episodes(env)
    low, high = env.observation_low, env.observation_high
    assert low.shape == high.shape == (env.observation_dim,)
    assert low.dtype == high.dtype == np.float32
    for observations in (first, steps.observation):
        assert (observations >= low - 1e-5).all()
        assert (observations <= high + 1e-5).all()
