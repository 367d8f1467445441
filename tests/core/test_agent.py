"""The agent on probe problems with known values: batches made by hand, a few hundred updates, small networks."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probe import (
    ACTIONS,
    CONFIG,
    NUM_UPDATES,
    SCHEDULE,
    UNIT_SCALE,
    B,
    fresh_agent,
    last,
    make_batch,
    mean_action,
    one_update,
    schedule_of,
    train,
    values,
    with_agent,
    with_constant_critics,
    with_quirks,
)

from hindrl_jax.core import agent as agents


def test_value_of_a_constant_reward_is_the_reward():
    batch = make_batch(action=ACTIONS, reward=1.0, discount=0.0)
    states, metrics = train(0, batch)
    np.testing.assert_allclose(values(last(states), batch.observation, batch.action), 1.0, atol=0.05)
    np.testing.assert_allclose(metrics["critic/value"][-1], 1.0, atol=0.05)
    np.testing.assert_allclose(metrics["critic/target"], 1.0, atol=1e-6)
    np.testing.assert_allclose(metrics["batch/reward"], B)


@pytest.mark.parametrize(
    ("num_dropped", "expected"),
    [
        (0, 6.5),  # the mean of 0, 1, 2, 3 and 10, 11, 12, 13
        (2, 1.5),  # two per critic are four in all, and all of them go from the second critic
    ],
)
def test_largest_atoms_of_all_critics_together_are_dropped(num_dropped, expected):
    start = fresh_agent(jax.random.key(2))
    start = with_constant_critics(start, [[0.0, 1.0, 2.0, 3.0], [10.0, 11.0, 12.0, 13.0]])
    batch = make_batch(action=ACTIONS, reward=0.0, discount=1.0)
    _, metrics = train(2, batch, with_agent(top_quantiles_to_drop_per_net=num_dropped), start)
    np.testing.assert_allclose(metrics["critic/target"][0], expected, atol=1e-3)  # alpha is 1e-4


@pytest.mark.parametrize(("bc_loss", "bc_action"), [("squared", "mean"), ("norm", "sample")])
def test_behaviour_cloning_follows_demonstrations_alone(bc_loss, bc_action):
    # Demonstrations play 0.4 in (0, 0) and -0.6 in (1, 1); every other row plays 0.9 and is rewarded for it.
    kind = np.arange(B) % 4
    batch = make_batch(
        action=np.choose(kind, [0.4, -0.6, 0.9, 0.9])[:, None],
        reward=np.where(kind >= 2, 1.0, 0.0),
        discount=0.0,
        observation=(kind % 2)[:, None] * np.ones(2),
        is_demonstration=kind < 2,
    )
    config = with_quirks(with_agent(bc_weight=100.0), bc_loss=bc_loss, bc_action=bc_action)
    start = fresh_agent(jax.random.key(4))
    states, metrics = train(4, batch, config, start)
    actions = mean_action(last(states), jnp.array([[0.0, 0.0], [1.0, 1.0]]))
    np.testing.assert_allclose(actions[:, 0], [0.4, -0.6], atol=0.1)
    # The first loss says whether the mean action was compared, or one with noise on it.
    distance = np.abs(mean_action(start, batch.observation) - batch.action)[:, 0] * (kind < 2)
    of_mean = np.mean(distance**2 if bc_loss == "squared" else distance)
    assert (float(metrics["actor/bc_loss"][0]) == pytest.approx(of_mean, rel=1e-4)) == (bc_action == "mean")


@pytest.mark.parametrize("rises", [True, False])
def test_entropy_coefficient_moves_towards_minus_the_action_dimensions(rises):
    # The target is -1 here. A fresh policy has an entropy near log 2; with log_std lowered by 5 it is near -3.6.
    start = fresh_agent(jax.random.key(5)).replace(log_alpha=jnp.asarray(np.log(0.5), jnp.float32))
    start.actor["params"]["Dense_1"]["bias"] = jnp.array([0.0, -5.0 if rises else 0.0])
    batch = make_batch(action=ACTIONS, reward=0.0, discount=0.0)
    states, metrics = train(5, batch, with_agent(target_entropy=-1.0), start)
    alphas = np.append(0.5, np.exp(states.log_alpha[:10]))
    np.testing.assert_allclose(metrics["alpha/value"][:11], alphas, rtol=1e-5)
    # Adam's steps are one learning rate long in log alpha while the gradient keeps its sign.
    np.testing.assert_allclose(np.diff(np.log(alphas)), 0.01 if rises else -0.01, rtol=0.2)
    # The loss log alpha * (entropy - target) tells which target it was.
    np.testing.assert_allclose(metrics["alpha/loss"][0], np.log(0.5) * (metrics["actor/entropy"][0] + 1.0), rtol=1e-4)


def test_entropy_bonus_enters_the_target():
    # With alpha = 1/2 the target of a rewardless step with discount 1 is Z' - alpha log pi = Z' + alpha * entropy.
    batch = make_batch(action=ACTIONS, reward=0.0, discount=1.0)
    target, entropy = {}, {}
    for alpha in (0.5, 1e-4):
        _, metrics = train(6, batch, start=fresh_agent(jax.random.key(6)).replace(log_alpha=jnp.asarray(np.log(alpha), jnp.float32)))
        target[alpha], entropy[alpha] = float(metrics["critic/target"][0]), float(metrics["actor/entropy"][0])
    # Two independent samples of 32 actions estimate the same entropy.
    assert target[0.5] - target[1e-4] == pytest.approx(0.5 * entropy[0.5], abs=0.15)
    assert entropy[0.5] > 0.3


def test_target_critics_and_average_actor_move_by_their_rates():
    before = fresh_agent(jax.random.key(7))
    chex.assert_trees_all_equal(before.target_critics, before.critics)
    chex.assert_trees_all_equal(before.average_actor, before.actor)
    states, _ = train(7, make_batch(action=ACTIONS, reward=1.0, discount=0.5), start=before)
    chex.assert_trees_all_equal_dtypes(before, states)
    after = jax.tree.map(lambda leaf: leaf[0], states)
    chex.assert_trees_all_equal_shapes(before, after)
    moved = jax.tree.map(lambda old, new: 0.9 * old + 0.1 * new, before.target_critics, after.critics)
    chex.assert_trees_all_close(after.target_critics, moved, rtol=1e-5, atol=1e-7)
    moved = jax.tree.map(lambda old, new: 0.8 * old + 0.2 * new, before.average_actor, after.actor)
    chex.assert_trees_all_close(after.average_actor, moved, rtol=1e-5, atol=1e-7)
    assert max(np.abs(a - b).max() for a, b in zip(*map(jax.tree.leaves, (before.critics, after.critics)), strict=True)) > 1e-3


@pytest.mark.parametrize(
    ("clip", "expected"),
    # Targets are 0.4 + 0.5 (-1, 0, 1, 2) = (-0.1, 0.4, 0.9, 1.4), with a mean of 0.65, in every row.
    [(False, 0.65), (True, (0.0 + 0.4 + 0.9 + 1.0) / 4)],
)
def test_bounds_of_the_targets_by_hand(clip, expected):
    start = fresh_agent(jax.random.key(8)).replace(log_alpha=jnp.asarray(-30.0))
    start = with_constant_critics(start, 2 * [[-1.0, 0.0, 1.0, 2.0]])
    batch = make_batch(action=ACTIONS, reward=0.4, discount=0.5)
    metrics = one_update(jax.random.key(0), start, batch, with_agent(clip_targets=clip))[1]
    np.testing.assert_allclose(metrics["critic/target"], expected, atol=1e-5)


def test_actions_by_hand():
    shapes = jax.eval_shape(lambda key: agents.init(key, UNIT_SCALE, CONFIG, action_dim=2), jax.random.key(0)).actor
    actor = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape), shapes)
    actor["params"]["Dense_1"]["bias"] = jnp.array([0.5, -1.0, np.log(0.1), np.log(2.0)])  # means, and logarithms of the deviations
    mode, sampled = (
        agents.select_action(jax.random.key(1), agents.Policy(actor=actor, scale=UNIT_SCALE, noise=noise), jnp.ones((3, 3)), CONFIG, action_dim=2)
        for noise in (0.0, 0.5)
    )
    np.testing.assert_allclose(mode, np.tanh([[0.5, -1.0]] * 3), atol=1e-6)
    noise = np.asarray(jax.random.normal(jax.random.key(1), (2, 3))).T  # one column per row of the batch
    np.testing.assert_allclose(sampled, np.tanh([0.5, -1.0] + 0.5 * np.array([0.1, 2.0]) * noise), atol=1e-6)


def test_initial_alpha():
    np.testing.assert_allclose(fresh_agent(jax.random.key(0)).log_alpha, np.log(1e-4), rtol=1e-6)


def test_update_bc_overfits_a_tiny_batch_and_touches_only_the_actor():
    observation = np.random.default_rng(0).normal(size=(B, 2))
    batch = make_batch(action=0.8 * np.sin(observation[:, :1]), reward=0.0, discount=0.0, observation=observation, is_demonstration=True)

    @jax.jit
    def clone(start):
        keys = jax.random.split(jax.random.key(0), NUM_UPDATES)
        return jax.lax.scan(lambda state, key: agents.update_bc(key, state, batch, SCHEDULE, CONFIG), start, keys)

    start = fresh_agent(jax.random.key(9))
    end, metrics = clone(start)
    chex.assert_tree_all_finite((end, metrics))
    first, final = metrics["actor/bc_loss"][0], metrics["actor/bc_loss"][-1]
    np.testing.assert_allclose(first, np.mean((mean_action(start, batch.observation) - batch.action) ** 2), rtol=1e-4)  # over all rows
    assert final < 0.01 < 0.1 < first
    chex.assert_trees_all_close(end.average_actor, end.actor, atol=0.05)  # it has followed
    assert np.abs(end.average_actor["params"]["Dense_0"]["kernel"] - start.actor["params"]["Dense_0"]["kernel"]).max() > 0.1
    for name in ("critics", "target_critics", "log_alpha", "critic_optimiser", "alpha_optimiser", "scale"):
        chex.assert_trees_all_equal(getattr(start, name), getattr(end, name))


def with_constant_policy(state, modes, log_std):
    """The state with an actor that has the same modes (A,) and logarithms of the deviations everywhere, whatever it sees."""
    last_layer = state.actor["params"]["Dense_1"]
    bias = jnp.concatenate([jnp.arctanh(jnp.asarray(modes)), jnp.full(len(modes), log_std)])
    last_layer = {"kernel": jnp.zeros_like(last_layer["kernel"]), "bias": bias}
    return state.replace(actor={"params": {**state.actor["params"], "Dense_1": last_layer}})


# The policy plays (0.6, 0.8). Demonstrations play (0, 0), at a distance of 1, and (0.6, 0.2), at a distance of 0.6.
PLAYED, DEMONSTRATED = np.array([0.6, 0.8]), np.tile([[0.0, 0.0], [0.6, 0.2]], (B // 2, 1))


@pytest.mark.parametrize(
    ("bc_loss", "expected", "slope"),
    # The mean of 1 and 0.36, or of 1 and 0.6, over two action dimensions. The derivatives by the two modes are the means of twice the differences
    # (0.6, 0.8) and (0, 0.6), or of the differences over their lengths, (0.6, 0.8) and (0, 1), again over two.
    [("squared", 0.34, [0.3, 0.7]), ("norm", 0.4, [0.15, 0.45])],
)
@pytest.mark.parametrize("bc_action", ["mean", "sample"])
def test_update_bc_by_hand(bc_loss, bc_action, expected, slope):
    config = with_quirks(bc_loss=bc_loss, bc_action=bc_action)
    start = jax.jit(lambda key: agents.init(key, UNIT_SCALE, config, action_dim=2))(jax.random.key(0))
    start = with_constant_policy(start, PLAYED, -0.5)
    batch = make_batch(action=0.0, reward=0.0, discount=0.0, is_demonstration=True).replace(action=jnp.asarray(DEMONSTRATED, jnp.float32))
    after, metrics = jax.jit(lambda key: agents.update_bc(key, start, batch, SCHEDULE, config))(jax.random.key(1))
    # Adam's first moment is a tenth of its first gradient; the derivative of tanh is 1 less its square.
    given = 10.0 * after.actor_optimiser.mu["params"]["Dense_1"]["bias"]
    if bc_action == "mean":
        np.testing.assert_allclose(metrics["actor/bc_loss"], expected, rtol=1e-5)
        np.testing.assert_allclose(given, [*(slope * (1.0 - PLAYED**2)), 0.0, 0.0], rtol=1e-4, atol=1e-7)
        return
    noise = np.asarray(jax.random.normal(jax.random.key(1), (2, B))).T  # one column per row of the batch
    squared = np.sum((np.tanh(np.arctanh(PLAYED) + np.exp(-0.5) * noise) - DEMONSTRATED) ** 2, axis=1)
    of_samples = np.mean(squared if bc_loss == "squared" else np.sqrt(squared)) / 2
    np.testing.assert_allclose(metrics["actor/bc_loss"], of_samples, rtol=1e-5)
    assert abs(of_samples - expected) > 0.01
    assert np.abs(given[2:]).min() > 1e-4  # the deviations are trained, too


def test_policy_is_the_actor_or_its_average_with_the_scale():
    state = fresh_agent(jax.random.key(0)).replace(average_actor="average", actor="actor")
    assert agents.policy(state, CONFIG, average=False) == agents.Policy(actor="actor", scale=state.scale, noise=1.0)
    assert agents.policy(state, CONFIG, average=True) == agents.Policy(actor="average", scale=state.scale, noise=0.0)


def test_networks_see_both_ends_of_a_transition_at_its_goal():
    # Everything is halved by the scale. Of the goals, the desired one is the same at both ends.
    config = with_quirks(with_agent(input_encoding="standardised"), achieved_goal_input=True)
    scale = UNIT_SCALE.replace(observation=jnp.full(2, 2.0), goal=jnp.full(1, 2.0))
    start = jax.jit(lambda key: agents.init(key, scale, config, action_dim=1))(jax.random.key(0))
    chex.assert_trees_all_equal(start.scale, scale)
    batch = make_batch(action=ACTIONS, reward=0.0, discount=0.0, observation=[2.0, 4.0], next_observation=[6.0, 8.0])
    batch = batch.replace(achieved_goal=jnp.full((B, 1), 10.0), next_achieved_goal=jnp.full((B, 1), 12.0), desired_goal=jnp.full((B, 1), 14.0))
    columns, _ = agents._prepare(jax.random.key(1), start, batch, config)
    np.testing.assert_array_equal(columns.inputs, np.tile([[5.0], [7.0], [1.0], [2.0]], (1, B)))
    np.testing.assert_array_equal(columns.next_inputs, np.tile([[6.0], [7.0], [3.0], [4.0]], (1, B)))


def test_an_update_in_blocks_is_the_same_update(monkeypatch):
    config = with_agent(net_arch=(5, 10), bc_weight=0.5, num_critics=3, top_quantiles_to_drop_per_net=1)
    rng = np.random.default_rng(0)
    batch = make_batch(
        action=rng.uniform(-1, 1, (B, 1)),
        reward=rng.normal(size=B),
        discount=0.9,
        observation=rng.normal(size=(B, 2)),
        next_observation=rng.normal(size=(B, 2)),
        is_demonstration=np.arange(B) < 5,
    )
    start = fresh_agent(jax.random.key(0), config)
    asked = []

    def update(num_blocks):
        def say(*size):
            asked.append(size)
            return num_blocks

        monkeypatch.setattr(agents, "num_blocks", say)
        return jax.jit(lambda key: agents.update(key, start, batch, schedule_of(config), config))(jax.random.key(1))

    whole, cut = update(1), update(4)
    assert asked == [(B, 10)] * 2  # the rows, and the widest layer
    # Adam's first step is the gradient's sign times the step size, so the moments are what must agree closely.
    for given, expected in ((cut[0].critic_optimiser, whole[0].critic_optimiser), (cut[0].actor_optimiser, whole[0].actor_optimiser)):
        chex.assert_trees_all_close(given, expected, rtol=1e-3, atol=1e-6)
        assert min(np.abs(leaf).max() for leaf in jax.tree.leaves(expected.mu)) > 1e-5
    chex.assert_trees_all_close(cut[1], whole[1], rtol=1e-3, atol=1e-5)
