"""Networks: shapes, the density of the squashed Gaussian, and an ensemble whose members differ."""

import dataclasses
import math

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen as nn

from hindrl_jax.base.errors import UserError
from hindrl_jax.config import AgentConfig
from hindrl_jax.core.networks import (
    LOG_STD_MAX,
    LOG_STD_MIN,
    ActionDistribution,
    apply_actor,
    apply_critics,
    init_actor,
    init_critics,
    mean_return,
    mean_returns,
)

CONFIG = AgentConfig(net_arch=(16, 12), num_critics=3, num_quantiles=5, layer_norm=True)
B, INPUT_DIM, ACTION_DIM = 4, 3, 2


def jitted(init):
    return jax.jit(lambda key: init(key, CONFIG, input_dim=INPUT_DIM, action_dim=ACTION_DIM))


@pytest.fixture(scope="module")
def actor():
    return jitted(init_actor)(jax.random.key(0))


@pytest.fixture(scope="module")
def critics():
    return jitted(init_critics)(jax.random.key(1))


INPUTS = jnp.asarray(np.random.default_rng(0).normal(size=(INPUT_DIM, B)), jnp.float32)


def test_actor(actor):
    distribution = apply_actor(actor, INPUTS, CONFIG, action_dim=ACTION_DIM)
    chex.assert_shape([distribution.mean, distribution.log_std, distribution.mode], (ACTION_DIM, B))
    np.testing.assert_allclose(distribution.mode, np.tanh(distribution.mean), rtol=1e-5)
    action, log_prob = distribution.sample(jax.random.key(0))
    chex.assert_shape(action, (ACTION_DIM, B))
    chex.assert_shape(log_prob, (B,))
    assert len(np.unique(np.asarray(distribution.mean))) == B * ACTION_DIM  # every column and dimension has its own output


def test_net_arch_and_layer_norm_are_obeyed(actor, critics):
    assert [layer["kernel"].shape for layer in actor["params"].values()] == [(3, 16), (16, 12), (12, 4)]  # no layer norm in the actor
    assert critics["params"]["Dense_0"]["kernel"].shape == (3, INPUT_DIM + ACTION_DIM, 16)
    assert critics["params"]["LayerNorm_1"]["scale"].shape == (3, 12)
    plain = jax.eval_shape(lambda key: init_critics(key, AgentConfig(net_arch=(8,), layer_norm=False), input_dim=3, action_dim=2), jax.random.key(0))
    assert sorted(plain["params"]) == ["Dense_0", "Dense_1"]


def test_log_std_is_clamped(actor):
    distribution = apply_actor(actor, 1e6 * INPUTS, CONFIG, action_dim=ACTION_DIM)
    assert set(np.unique(distribution.log_std).tolist()) == {LOG_STD_MIN, LOG_STD_MAX} == {-20.0, 2.0}


def test_critics(critics):
    action = jnp.tanh(INPUTS[:ACTION_DIM])
    quantiles = apply_critics(critics, INPUTS, action, CONFIG)
    chex.assert_shape(quantiles, (3, 5, B))
    for i in range(3):
        for j in range(i):
            assert np.abs(quantiles[i] - quantiles[j]).max() > 1e-2  # members start apart
    # One column at a time gives the same: columns do not mix, and axes are not confused.
    for column in range(B):
        alone = apply_critics(critics, INPUTS[:, column : column + 1], action[:, column : column + 1], CONFIG)
        np.testing.assert_allclose(alone[..., 0], quantiles[..., column], atol=1e-5)
    # The action matters.
    assert np.abs(apply_critics(critics, INPUTS, -action, CONFIG) - quantiles).max() > 1e-2


def test_networks_are_what_flax_makes_of_the_same_parameters(actor, critics):
    """The features-first layers against flax.linen's own, row by row."""

    class Reference(nn.Module):
        out_dim: int
        layer_norm: bool

        @nn.compact
        def __call__(self, rows):
            for width in CONFIG.net_arch:
                rows = nn.Dense(width)(rows)
                rows = nn.relu(nn.LayerNorm()(rows) if self.layer_norm else rows)
            return nn.Dense(self.out_dim)(rows)

    action = jnp.tanh(INPUTS[:ACTION_DIM])
    distribution = apply_actor(actor, INPUTS, CONFIG, action_dim=ACTION_DIM)
    expected = Reference(2 * ACTION_DIM, layer_norm=False).apply(actor, INPUTS.T)
    np.testing.assert_allclose(jnp.concatenate([distribution.mean, distribution.log_std]).T, expected, atol=1e-5)
    for n in range(CONFIG.num_critics):
        parameters = jax.tree.map(lambda leaf, n=n: leaf[n], critics)
        expected = Reference(CONFIG.num_quantiles, layer_norm=True).apply(parameters, jnp.concatenate([INPUTS, action]).T)
        np.testing.assert_allclose(apply_critics(critics, INPUTS, action, CONFIG)[n].T, expected, atol=1e-5)


def test_mean_return_is_the_mean_of_the_quantiles(critics):
    action = jnp.tanh(INPUTS[:ACTION_DIM])

    def by_definition(critics, action):
        return jnp.mean(apply_critics(critics, INPUTS, action, CONFIG), axis=(0, 1))

    np.testing.assert_allclose(mean_return(critics, INPUTS, action, CONFIG), by_definition(critics, action), atol=1e-6)
    given, expected = (
        jax.grad(lambda *arguments, f=f: jnp.sum(jnp.sin(f(*arguments))), argnums=(0, 1))(critics, action)
        for f in (lambda critics, action: mean_return(critics, INPUTS, action, CONFIG), by_definition)
    )
    chex.assert_trees_all_close(given, expected, atol=1e-5)


@pytest.fixture(scope="module")
def residual():
    """The config of residual networks, and critics whose biases and normalisations are not what they begin with."""
    config = dataclasses.replace(CONFIG, net_arch=(6, 6), residual=True)
    critics = jax.jit(lambda key: init_critics(key, config, input_dim=INPUT_DIM, action_dim=ACTION_DIM))(jax.random.key(2))
    leaves, tree = jax.tree.flatten(critics)
    keys = jax.random.split(jax.random.key(3), len(leaves))
    return config, jax.tree.unflatten(tree, [leaf + 0.3 * jax.random.normal(key, leaf.shape) for leaf, key in zip(leaves, keys, strict=True)])


def normalised(rows, layer):
    centred = rows - rows.mean(axis=0)
    return centred / np.sqrt((centred**2).mean(axis=0) + 1e-6) * layer["scale"][:, None] + layer["bias"][:, None]


def dense(rows, layer):
    return layer["kernel"].T @ rows + layer["bias"][:, None]


def test_residual_networks_are_the_blocks_of_simba(residual):
    """Written down once more, layer by layer: embedding, two blocks x + W2 relu(W1 LN(x)), layer normalisation, output."""
    config, critics = residual
    action = np.tanh(INPUTS[:ACTION_DIM])
    found = apply_critics(critics, INPUTS, action, config)
    chex.assert_shape(found, (3, 5, B))
    for n in range(3):
        layers = jax.tree.map(lambda leaf, n=n: np.asarray(leaf[n], np.float64), critics)["params"]
        x = dense(np.concatenate([INPUTS, action]), layers["Dense_0"])
        for block, (first, second) in enumerate([("Dense_1", "Dense_2"), ("Dense_3", "Dense_4")]):
            assert layers[first]["kernel"].shape == (6, 24)
            x = x + dense(np.maximum(dense(normalised(x, layers[f"LayerNorm_{block}"]), layers[first]), 0.0), layers[second])
        np.testing.assert_allclose(found[n], dense(normalised(x, layers["LayerNorm_2"]), layers["Dense_5"]), atol=1e-4)
        assert len(layers) == 9


def test_mean_return_of_residual_critics_is_the_mean_of_their_quantiles(residual):
    config, critics = residual
    action = jnp.tanh(INPUTS[:ACTION_DIM])
    quantiles = apply_critics(critics, INPUTS, action, config)
    np.testing.assert_allclose(mean_return(critics, INPUTS, action, config), jnp.mean(quantiles, axis=(0, 1)), atol=1e-5)
    np.testing.assert_allclose(mean_returns(critics, INPUTS, action, config), jnp.mean(quantiles, axis=1), atol=1e-5)


def test_the_residual_actor_has_blocks_too(residual):
    config, _ = residual
    actor = jax.eval_shape(lambda key: init_actor(key, config, input_dim=INPUT_DIM, action_dim=ACTION_DIM), jax.random.key(0))["params"]
    assert [actor[f"Dense_{i}"]["kernel"].shape for i in range(6)] == [(3, 6), (6, 24), (24, 6), (6, 24), (24, 6), (6, 4)]


def test_residual_blocks_have_one_width():
    with pytest.raises(ValueError, match=r"net_arch = \(16, 12\): give equal ones"):
        dataclasses.replace(CONFIG, residual=True)


def numeric_log_density(action, mean, std):
    """Log density at `action` of tanh(mean + std * noise), by the derivative of its distribution function."""

    def cumulative(a):
        return 0.5 * (1.0 + math.erf((math.atanh(a) - mean) / (std * math.sqrt(2.0))))

    step = 1e-4 * (1.0 - abs(action))
    return math.log((cumulative(action + step) - cumulative(action - step)) / (2.0 * step))


def test_log_prob_is_that_of_the_change_of_variables():
    mean, log_std = np.array([[0.0, 0.5], [-1.0, 1.0], [0.3, -0.2]]), np.array([[0.0, -1.0], [-0.5, 0.3], [-2.0, -0.7]])
    distribution = ActionDistribution(mean=jnp.asarray(mean.T, jnp.float32), log_std=jnp.asarray(log_std.T, jnp.float32))
    action, log_prob = (np.asarray(part, np.float64) for part in distribution.sample(jax.random.key(1)))
    assert np.abs(action).max() < 0.999  # beyond that, float32 actions are too coarse for this check
    for row in range(3):
        expected = sum(numeric_log_density(action[i, row], mean[row, i], math.exp(log_std[row, i])) for i in range(2))
        assert log_prob[row] == pytest.approx(expected, abs=2e-3)


def test_samples_follow_the_distribution():
    mean, std, num = 0.3, 0.5, 20_000
    distribution = ActionDistribution(mean=jnp.full((1, num), mean), log_std=jnp.full((1, num), math.log(std)))
    pre_tanh = np.arctanh(np.asarray(distribution.sample(jax.random.key(0))[0], np.float64))
    assert pre_tanh.mean() == pytest.approx(mean, abs=5 * std / num**0.5)
    assert pre_tanh.std() == pytest.approx(std, abs=5 * std / (2 * num) ** 0.5)


def test_extreme_distributions_are_finite_and_have_finite_gradients():
    mean, log_std = (grid.reshape(1, -1) for grid in jnp.meshgrid(jnp.array([-1e3, -20.0, 0.0, 20.0, 1e3]), jnp.array([-20.0, 2.0])))

    def total(mean, log_std):
        action, log_prob = ActionDistribution(mean=mean, log_std=log_std).sample(jax.random.key(0))
        return jnp.sum(action) + jnp.sum(log_prob), (action, log_prob)

    gradient, (action, log_prob) = jax.jit(jax.grad(total, argnums=(0, 1), has_aux=True))(mean, log_std)
    chex.assert_tree_all_finite((gradient, action, log_prob))
    assert np.abs(action).max() <= 1.0


class Own(nn.Module):
    """The built-in network without layer normalisation, written as flax modules are: with the batch first."""

    out_dim: int

    @nn.compact
    def __call__(self, inputs):
        for width in CONFIG.net_arch:
            inputs = nn.relu(nn.Dense(width)(inputs))
        return nn.Dense(self.out_dim)(inputs)


def test_networks_of_ones_own_are_ordinary_modules():
    """Given the parameters of the built-in ones, which have the same names, they compute the same."""
    theirs = dataclasses.replace(CONFIG, layer_norm=False)
    own = dataclasses.replace(theirs, actor_network=Own, critic_network=Own)
    dims = dict(input_dim=INPUT_DIM, action_dim=ACTION_DIM)
    actor, critics = (init(jax.random.key(0), own, **dims) for init in (init_actor, init_critics))
    chex.assert_trees_all_equal_shapes(actor, init_actor(jax.random.key(0), theirs, **dims))
    chex.assert_trees_all_equal_shapes(critics, init_critics(jax.random.key(0), theirs, **dims))
    modes = [apply_actor(actor, INPUTS, config, action_dim=ACTION_DIM).mode for config in (own, theirs)]
    np.testing.assert_allclose(*modes, atol=1e-5)
    action = jnp.ones((ACTION_DIM, B))
    for function in (apply_critics, mean_returns, mean_return):
        np.testing.assert_allclose(function(critics, INPUTS, action, own), function(critics, INPUTS, action, theirs), atol=1e-5)


def test_a_network_of_ones_own_that_gives_another_shape_is_named():
    own = dataclasses.replace(CONFIG, actor_network=lambda out_dim: Own(out_dim + 1))
    params = init_actor(jax.random.key(0), own, input_dim=INPUT_DIM, action_dim=ACTION_DIM)
    with pytest.raises(UserError, match=r"Own gives \(4, 5\) for inputs of shape \(4, 3\): let it give \(B, out_dim\) = \(4, 4\)"):
        apply_actor(params, INPUTS, own, action_dim=ACTION_DIM)
