"""What the networks see: encodings and their scale, by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hindrl_jax.config import AgentConfig, GoalConfig, QuirksConfig, TrainConfig
from hindrl_jax.core import agent as agents
from hindrl_jax.core.inputs import InputScale, input_scale, network_inputs

# Observation (1, 2) less (0, 4) over (2, 4) is (1/2, -1/2); achieved goal 3 less 0 over 6 is 1/2, too, and desired goal 0 is 0.
# Where inputs are seen twice, they are also seen around 0: 1 over 2 and 2 over the root of 4^2 + 4^2, and 3 over 6.
HALF, AROUND_0 = [0.5, np.tanh(2.0)], [np.tanh(2.0), np.tanh(2.0**0.5)]


@pytest.mark.parametrize(
    ("encoding", "achieved_goal_input", "expected"),
    [
        ("raw", False, [1.0, 2.0, 0.0]),
        ("raw", True, [3.0, 0.0, 1.0, 2.0]),
        ("multiscale", False, [0.5, -0.5, *AROUND_0, 0.0, 0.0]),
        ("multiscale", True, [*HALF, 0.0, 0.0, 0.5, -0.5, *AROUND_0]),
        ("standardised", False, [0.5, -0.5, 0.0]),
        ("standardised", True, [0.5, 0.0, 0.5, -0.5]),
    ],
)
def test_network_inputs_by_hand(encoding, achieved_goal_input, expected):
    scale = InputScale(observation=jnp.array([2.0, 4.0]), goal=jnp.array([6.0]), observation_centre=jnp.array([0.0, 4.0]), goal_centre=jnp.zeros(1))
    quirks = QuirksConfig(achieved_goal_input=achieved_goal_input)
    config = TrainConfig(agent=AgentConfig(input_encoding=encoding, net_arch=(3,)), quirks=quirks)
    parts = (jnp.array([[1.0, 2.0]]), jnp.array([[3.0]]), jnp.array([[0.0]]))
    np.testing.assert_allclose(network_inputs(*parts, scale, config), [expected], rtol=1e-6)
    unbatched = network_inputs(*(part[0] for part in parts), scale, config)
    np.testing.assert_allclose(unbatched, expected, rtol=1e-6)
    state = jax.eval_shape(lambda key: agents.init(key, scale, config, action_dim=1), jax.random.key(0))
    assert state.actor["params"]["Dense_0"]["kernel"].shape == (len(expected), 3)


@pytest.mark.parametrize(
    ("encoding", "expected"), [("raw", [1.0, 2.0, -3.0]), ("multiscale", [0.5, -0.5, *AROUND_0, -2 / 3, -np.tanh(12 / 37**0.5)])]
)
def test_goals_of_the_environments_own_are_seen_from_where_one_is(encoding, expected):
    # 5 less 8 is -3; less 1 over 6 it is -2/3.
    scale = InputScale(observation=jnp.array([2.0, 4.0]), goal=jnp.array([6.0]), observation_centre=jnp.array([0.0, 4.0]), goal_centre=jnp.ones(1))
    config = TrainConfig(agent=AgentConfig(input_encoding=encoding), goal=GoalConfig(behavioural_goals="environment"))
    np.testing.assert_allclose(network_inputs(jnp.array([1.0, 2.0]), jnp.array([8.0]), jnp.array([5.0]), scale, config), expected, rtol=1e-6)


@pytest.mark.parametrize(("encoding", "seen"), [("standardised", [100.0, -100.0, 99.0]), ("multiscale", [100.0, -100.0, 99.0, 1.0, -1.0, 1.0])])
def test_what_lies_far_outside_the_demonstrations_is_seen_at_a_hundred_deviations(encoding, seen):
    scale = InputScale(observation=jnp.full(3, 1e-6), goal=jnp.ones(0), observation_centre=jnp.zeros(3), goal_centre=jnp.zeros(0))
    config = TrainConfig(agent=AgentConfig(input_encoding=encoding))
    inputs = network_inputs(jnp.array([0.7, -0.7, 99e-6]), jnp.zeros(0), jnp.zeros(0), scale, config)
    np.testing.assert_allclose(inputs, seen, rtol=1e-5)


@pytest.mark.parametrize("padding", [7.0, np.nan])
@pytest.mark.parametrize(
    ("encoding", "centre", "size"),
    [
        # Three states count: (3, 0, 2), (4, 0, 2) and (5, 0, 2). Means 4, 0 and 2; standard deviations sqrt(2 / 3); always zero, 1; and always
        # equal, a tenth of the root mean square 2.
        ("multiscale", [4.0, 0.0, 2.0], [(2 / 3) ** 0.5, 1.0, 0.2]),
        ("standardised", [4.0, 0.0, 2.0], [(2 / 3) ** 0.5, 1.0, 0.2]),
        ("raw", [0.0, 0.0, 0.0], [1.0, 1.0, 1.0]),
    ],
)
def test_input_scale_by_hand(encoding, centre, size, padding):
    observations = jnp.array([[[3.0, 0.0, 2.0], [4.0, 0.0, 2.0]], [[5.0, 0.0, 2.0], [padding, padding, padding]]])
    config = AgentConfig(input_encoding=encoding)
    scale = input_scale(observations, observations[..., :1], jnp.array([[True, True], [True, False]]), config)
    np.testing.assert_allclose(scale.observation, size, rtol=1e-6)
    np.testing.assert_allclose(scale.observation_centre, centre, rtol=1e-6)
    np.testing.assert_allclose([scale.goal, scale.goal_centre], [size[:1], centre[:1]], rtol=1e-6)


def test_standardised_inputs_have_mean_0_and_deviation_1_over_what_was_visited():
    rng = np.random.default_rng(0)
    observations = rng.normal([0.4, -20.0, 1e-3], [0.2, 5.0, 1e-3], (4, 30, 3)).astype(np.float32)
    observations = np.concatenate([observations, np.full((4, 30, 1), 0.1, np.float32)], axis=2)  # and one dimension that never changes
    visited = np.arange(30)[None] < np.array([[30], [7], [12], [1]])
    padded = jnp.asarray(np.where(visited[..., None], observations, np.nan))
    config = TrainConfig(agent=AgentConfig(input_encoding="standardised"))
    scale = input_scale(padded, padded[..., :2], jnp.asarray(visited), config.agent)
    seen = jnp.asarray(observations[visited])
    inputs = np.asarray(network_inputs(seen, seen[:, :2], seen[:, :2], scale, config))
    np.testing.assert_allclose(inputs.mean(axis=0), 0.0, atol=1e-3)
    np.testing.assert_allclose(inputs[:, [0, 1, 2, 4, 5]].std(axis=0), 1.0, rtol=1e-3)
    np.testing.assert_allclose(inputs[:, 3], 0.0, atol=1e-4)
    # Elsewhere, that dimension counts by its difference over a tenth of its size.
    elsewhere = network_inputs(seen[0] + 0.5, seen[0, :2], seen[0, :2], scale, config)
    np.testing.assert_allclose(elsewhere[3], 50.0, rtol=1e-4)
