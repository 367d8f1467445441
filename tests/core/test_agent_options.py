"""The agent's other algorithms and options, on probe problems with known values."""

import itertools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probe import (
    ACTIONS,
    CONFIG,
    SCHEDULE,
    B,
    fresh_agent,
    inputs_of,
    last,
    make_batch,
    mean_action,
    one_update,
    train,
    values,
    with_agent,
    with_constant_critics,
)

from hindrl_jax.base.errors import UserError
from hindrl_jax.config import AgentConfig
from hindrl_jax.core import agent as agents
from hindrl_jax.core import losses
from hindrl_jax.core.networks import apply_actor

BASES = {"tqc": CONFIG, "sac": with_agent(base="sac")}


def with_constant_action(actor, action):
    """An actor whose mode is `action` everywhere, with a deviation of e^-5."""
    last_layer = actor["params"]["Dense_1"]
    last_layer = {"kernel": jnp.zeros_like(last_layer["kernel"]), "bias": jnp.array([np.arctanh(action), -5.0], jnp.float32)}
    return {"params": {**actor["params"], "Dense_1": last_layer}}


def columns(**given):
    """A batch of B columns of zeros, but for what is given."""
    zero, row = jnp.zeros(B), jnp.zeros((1, B))
    zeros = dict(inputs=jnp.zeros((3, B)), next_inputs=jnp.zeros((3, B)), action=row, noise=row, next_noise=row, reward=zero, discount=zero)
    return agents._Columns(**(zeros | dict(is_demonstration=jnp.zeros(B, bool)) | given))


@pytest.mark.parametrize("base", BASES)
def test_value_before_the_reward_is_discounted(base):
    # Rows of state (0, 0) lead to (1, 1) without reward and with discount 0.7; rows of (1, 1) end with reward 1. Values 0.7 and 1.
    first = np.arange(B) < B // 2
    batch = make_batch(
        action=np.tile(ACTIONS[: B // 2] * 2 + 1, (2, 1)),
        reward=np.where(first, 0.0, 1.0),
        discount=np.where(first, 0.7, 0.0),
        observation=np.where(first[:, None], 0.0, 1.0) * np.ones(2),
        next_observation=np.ones(2),
    )
    states, _ = train(1, batch, BASES[base])
    found = values(last(states), batch.observation, batch.action, BASES[base])
    np.testing.assert_allclose(found, np.where(first, 0.7, 1.0), atol=0.08)


@pytest.mark.parametrize("base", BASES)
def test_policy_picks_the_rewarded_action(base):
    batch = make_batch(action=ACTIONS, reward=1.0 - (ACTIONS[:, 0] - 0.5) ** 2, discount=0.0)
    states, _ = train(3, batch, BASES[base])
    np.testing.assert_allclose(mean_action(last(states), batch.observation), 0.5, atol=0.2)


def test_targets_without_quantiles_by_hand():
    # 1 + 0.5 * (the least critic, 1), but for alpha = e^-30 times the entropy.
    start = fresh_agent(jax.random.key(0), BASES["sac"]).replace(log_alpha=jnp.asarray(-30.0))
    batch = make_batch(action=ACTIONS, reward=1.0, discount=0.5)
    metrics = one_update(jax.random.key(0), with_constant_critics(start, [3.0, 1.0]), batch, BASES["sac"])[1]
    np.testing.assert_allclose(metrics["critic/target"], 1.5, atol=1e-5)


@pytest.mark.parametrize(("base", "value"), [("tqc", 2.0), ("sac", 1.0)])
def test_the_value_that_the_actor_climbs(base, value):
    # The mean of the critics, or the least one. One step of Adam moves a constant by the learning rate, 0.01.
    start = with_constant_critics(fresh_agent(jax.random.key(0), BASES[base]), [3.0, 1.0], target=False)
    metrics = one_update(jax.random.key(0), start, make_batch(action=ACTIONS, reward=0.0, discount=0.0), BASES[base])[1]
    np.testing.assert_allclose(metrics["actor/value"], value, atol=0.15)


@pytest.mark.parametrize(
    ("config", "constants", "expected"),
    # Rows have rewards 0.5 and 4.5, and discount 0.5. Half of (-1, 0, 1, 2) is 0.25 on average, which is added to the reward: 0.75 and 4.75.
    # Clipped to [0, 1] these targets are (0, 0.5, 1, 1) = 0.625 and 1; with the four largest of eight dropped -0.25 is added.
    [
        (CONFIG, [[-1.0, 0.0, 1.0, 2.0]] * 2, (0.75, 4.75)),
        (with_agent(clip_targets=True), [[-1.0, 0.0, 1.0, 2.0]] * 2, (0.625, 1.0)),
        (with_agent(top_quantiles_to_drop_per_net=2), [[-1.0, 0.0, 1.0, 2.0]] * 2, (0.25, 4.25)),
        (BASES["sac"], [-1.0, 5.0], (0.0, 4.0)),  # the least of the two critics
    ],
)
def test_targets_of_each_row_by_hand(config, constants, expected):
    start = fresh_agent(jax.random.key(0), config).replace(log_alpha=jnp.asarray(-30.0))
    start = with_constant_critics(start, constants)
    block = columns(reward=jnp.tile(jnp.array([0.5, 4.5]), B // 2), discount=jnp.full(B, 0.5))
    targets = agents._targets(start, start.target_critics, config, block)
    np.testing.assert_allclose(jnp.mean(targets, axis=0), np.tile(expected, B // 2), atol=1e-5)


def test_a_random_subset_of_the_target_critics_is_asked():
    config = with_agent(num_critics=4, num_target_critics=2)
    start = with_constant_critics(fresh_agent(jax.random.key(0), config), [0.0, 1.0, 2.0, 4.0])
    batch = make_batch(action=ACTIONS, reward=0.0, discount=1.0)
    targets = [round(float(one_update(jax.random.key(key), start, batch, config)[1]["critic/target"]), 2) for key in range(40)]
    # Means of the six pairs: 0.5, 1, 2, 1.5, 2.5 and 3; alpha is 1e-4. All six are missed together by 40 draws with probability 6 (5/6)^40 = 0.4%.
    assert set(targets) == {0.5, 1.0, 1.5, 2.0, 2.5, 3.0}


@pytest.mark.parametrize("base", BASES)
def test_every_step_moves_the_actor_its_average_and_the_critics(base):
    # All rows are cloned, and hardly anything else counts; their mean action is 0, as is the deviation's gradient. The first steps of Adam are one
    # learning rate long, so the mode before tanh falls from 0.9 by 0.01.
    config = with_agent(BASES[base], bc_weight=1e4)
    batch = make_batch(action=ACTIONS, reward=ACTIONS[:, 0], discount=0.0, is_demonstration=True)
    start = fresh_agent(jax.random.key(0), config)
    actor = with_constant_action(start.actor, np.tanh(0.9))
    states = [start.replace(actor=actor, average_actor=actor)]
    for step in range(4):
        states.append(one_update(jax.random.key(step), states[-1], batch, config)[0])

    def modes(name):
        return [float(getattr(state, name)["params"]["Dense_1"]["bias"][0]) for state in states]

    # Of each step, 0.2 moves into the average: 0.9 - 0.2 (0.01) = 0.898, and 0.898 - 0.2 (0.018) = 0.8944.
    np.testing.assert_allclose(modes("actor")[:3], [0.9, 0.89, 0.88], atol=1e-4)
    np.testing.assert_allclose(modes("average_actor")[:3], [0.9, 0.898, 0.8944], atol=1e-4)
    assert [int(state.actor_optimiser.count) for state in states] == [0, 1, 2, 3, 4]
    for name in ("critics", "target_critics"):
        kernels = [np.asarray(getattr(state, name)["params"]["Dense_0"]["kernel"]) for state in states]
        assert all(np.any(after != before) for before, after in itertools.pairwise(kernels)), name


def test_the_filter_clones_only_what_is_better_than_the_policys_own_action():
    # The value is 1 - |action|. Demonstrations play 0.9 in (0, 0), which is bad, and 0 in (1, 1), which is best.
    kind = np.arange(B) % 4
    other = np.linspace(-1, 1, B)
    action = np.choose(kind, [0.9 + 0 * other, 0 * other, other, other])[:, None]
    batch = make_batch(
        action=action, reward=1.0 - np.abs(action[:, 0]), discount=0.0, observation=(kind % 2)[:, None] * np.ones(2), is_demonstration=kind < 2
    )
    found = {}
    for q_filter in ("off", "hard", "smooth"):
        states, metrics = train(4, batch, with_agent(bc_weight=100.0, q_filter=q_filter))
        found[q_filter] = mean_action(last(states), jnp.array([[0.0, 0.0], [1.0, 1.0]]))[:, 0]
        assert metrics["actor/bc_loss"].shape == (400,)
    np.testing.assert_allclose(found["off"], [0.9, 0.0], atol=0.15)
    np.testing.assert_allclose(found["hard"], [0.0, 0.0], atol=0.3)
    np.testing.assert_allclose(found["smooth"], [0.0, 0.0], atol=0.3)


@pytest.mark.parametrize(
    ("base", "q_filter", "expected"),
    # The first critic says the action, the second three times it. Demonstrated is 0.5, the policy's own is 0.2: means 1 and 0.4, variances 0.25 and
    # 0.04 (one standard deviation is half of the difference): Phi(0.6 / sqrt(0.29) = 1.1142) = 0.8674. Rows of the replay are never cloned.
    [("tqc", "off", 1.0), ("tqc", "hard", 1.0), ("tqc", "smooth", 0.8674), ("sac", "smooth", 0.8674)],
)
def test_how_much_is_cloned_by_hand(base, q_filter, expected, monkeypatch):
    def quantiles(params, inputs, action, config):
        return action * jnp.array([[1.0], [3.0]])

    monkeypatch.setattr(agents, "mean_returns", quantiles)
    monkeypatch.setattr(agents, "_value", lambda critics, inputs, action, config: jnp.mean(quantiles(critics, inputs, action, config), axis=0))
    config, is_demonstration = with_agent(BASES[base], q_filter=q_filter), np.arange(B) % 2 == 0
    block = columns(action=jnp.full((1, B), 0.5), is_demonstration=jnp.asarray(is_demonstration))
    weight = agents._cloning_weight({}, block, jnp.full((1, B), 0.2), config)
    np.testing.assert_allclose(weight, np.where(is_demonstration, expected, 0.0), atol=1e-4)


def test_a_smooth_filter_needs_an_ensemble():
    with pytest.raises(ValueError, match="num_critics = 1: raise it, or choose hard"):
        AgentConfig(q_filter="smooth", num_critics=1)


def test_weight_of_cloning_by_hand():
    # Demonstrations at a distance d add weight * d^2.
    batch, losses = make_batch(action=ACTIONS, reward=0.0, discount=0.0, is_demonstration=True), []
    start = fresh_agent(jax.random.key(0))
    for weight in (0.0, 2.0):
        metrics = one_update(jax.random.key(0), start, batch, with_agent(bc_weight=weight))[1]
        losses.append(float(metrics["actor/loss"]))
    np.testing.assert_allclose(losses[1] - losses[0], 2.0 * metrics["actor/bc_loss"], rtol=1e-3)


def test_relative_value_weighs_every_row_by_its_own_size(monkeypatch):
    given = np.tile([0.5, 0.002, -0.3, 0.5], B // 4)  # the second and the third are below the least size, 0.01

    def value(critics, inputs, action, config):
        return jnp.asarray(given, jnp.float32) + action[0] - jax.lax.stop_gradient(action[0])

    monkeypatch.setattr(agents, "_value", value)
    start = fresh_agent(jax.random.key(0)).replace(log_alpha=jnp.asarray(-30.0))
    start = start.replace(actor=with_constant_action(start.actor, 0.6))
    gradient, metrics = agents._actor_gradient(start, SCHEDULE, with_agent(relative_value=True), columns())
    np.testing.assert_allclose(metrics["actor/loss"], -(1.0 + 0.2 - 30.0 + 1.0) / 4, rtol=1e-5)
    np.testing.assert_allclose(metrics["actor/value"], np.mean(given), rtol=1e-5)
    # The gradient of v / max(v, 0.01), the divisor being constant: here dv = da, and a = tanh m has the derivative 1 - 0.6^2 = 0.64.
    np.testing.assert_allclose(gradient["params"]["Dense_1"]["bias"][0], -0.64 * (2 / 0.5 + 2 / 0.01) / 4, rtol=1e-5)


@pytest.mark.parametrize("base", BASES)
def test_relative_value_leaves_entropy_out_of_targets(base):
    # The critics are constant, rewards 0 and alpha 1: by hand a target is 0.7 (0.5 - log pi), or 0.7 times 0.5 where entropy does not count.
    state = fresh_agent(jax.random.key(0), BASES[base]).replace(log_alpha=jnp.asarray(0.0))
    critics = with_constant_critics(state, (0.5, 0.5), target=True).target_critics
    block = columns(discount=jnp.full(B, 0.7))
    relative, absolute = (
        agents._targets(state, critics, with_agent(BASES[base], relative_value=relative_value), block) for relative_value in (True, False)
    )
    np.testing.assert_allclose(relative, np.full(relative.shape, 0.35), rtol=1e-5)
    _, log_prob = apply_actor(state.actor, block.next_inputs, BASES[base].agent, action_dim=1).at(block.next_noise)
    np.testing.assert_allclose(absolute, np.broadcast_to(0.7 * (0.5 - log_prob), absolute.shape), rtol=1e-5)


def test_with_subsets_sac_climbs_the_mean_of_all_critics():
    config = with_agent(BASES["sac"], num_critics=3, num_target_critics=2)
    start = with_constant_critics(fresh_agent(jax.random.key(0), config), (0.0, 1.0, 5.0), target=False)
    metrics = one_update(jax.random.key(0), start, make_batch(action=ACTIONS, reward=0.0, discount=0.0), config)[1]
    np.testing.assert_allclose(metrics["actor/value"], 2.0, atol=0.15)


OWN_BATCH = make_batch(action=ACTIONS, reward=ACTIONS[:, 0], discount=0.5, is_demonstration=np.arange(B) < 8)


def test_losses_of_ones_own_take_the_place_of_the_built_in_ones():
    config = with_agent(bc_weight=0.3, num_critics=2)
    start = fresh_agent(jax.random.key(0), config)
    expected, _ = one_update(jax.random.key(1), start, OWN_BATCH, config)
    same = with_agent(config, actor_loss=lambda *given: losses.actor_loss(*given), critic_loss=lambda *given: losses.critic_loss(*given))
    chex.assert_trees_all_equal(one_update(jax.random.key(1), start, OWN_BATCH, same)[0], expected)

    # Where nothing has a gradient, nothing moves; the other one is as it was.
    for name, frozen in (("actor", with_agent(config, actor_loss=lambda terms, _: terms.alpha)), ("critics", None)):
        frozen = frozen or with_agent(config, critic_loss=lambda terms, _: jnp.mean(terms.targets))
        moved, metrics = one_update(jax.random.key(1), start, OWN_BATCH, frozen)
        chex.assert_trees_all_equal(getattr(moved, name), getattr(start, name))
        value = metrics["actor/loss"] - metrics["alpha/value"] if name == "actor" else metrics["critic/loss"] - metrics["critic/target"]
        assert float(value) == pytest.approx(0.0, abs=1e-6)


def test_terms_of_losses_are_those_of_the_batch():
    def actor(terms, config):
        assert terms.value.shape == terms.log_prob.shape == terms.is_demonstration.shape == (B,)
        assert terms.action.shape == terms.mode.shape == terms.taken_action.shape == (1, B)
        assert terms.critics(terms.mode).shape == (2, config.num_quantiles, B)
        return jnp.mean(jnp.where(terms.is_demonstration[None], jnp.square(terms.mode - terms.taken_action), 0.0))

    def critics(terms, config):
        assert terms.quantiles.shape == (2, config.num_quantiles, B)
        return jnp.mean(jnp.square(terms.quantiles - terms.critics(terms.taken_action))) + jnp.mean(terms.critics(-terms.taken_action))

    config = with_agent(num_critics=2, actor_loss=actor, critic_loss=critics)
    start = fresh_agent(jax.random.key(0), config)
    for key in range(3):
        start, metrics = one_update(jax.random.key(key), start, OWN_BATCH, config)
    clone = behaviour_cloning_of(start, config)
    assert float(metrics["actor/loss"]) != 0.0
    assert clone < behaviour_cloning_of(fresh_agent(jax.random.key(0), config), config)


def behaviour_cloning_of(state, config):
    """Mean squared distance of the actor's mean action to those of the demonstrations."""
    inputs = inputs_of(OWN_BATCH.observation, config).T
    mode = apply_actor(state.actor, inputs, config.agent, action_dim=1).mode
    return float(jnp.mean(jnp.square(mode - OWN_BATCH.action.T)[:, :8]))


def test_a_loss_of_ones_own_that_is_no_number_is_named():
    config = with_agent(actor_loss=lambda terms, _: terms.value)
    with pytest.raises(UserError, match=r"actor_loss gives an array of shape \(32,\): let it give one number, as jnp.mean does"):
        one_update(jax.random.key(0), fresh_agent(jax.random.key(0), config), OWN_BATCH, config)
