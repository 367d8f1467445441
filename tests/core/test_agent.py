"""The agent on probe problems with known values: batches made by hand, a few hundred updates, small networks."""

import dataclasses

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
    B,
    fresh_agent,
    inputs_of,
    last,
    make_batch,
    mean_action,
    train,
    values,
    with_constant_critics,
)

from hindrl_jax.config import AgentConfig
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
    _, metrics = train(2, batch, AgentConfig(**{**vars(CONFIG), "top_quantiles_to_drop_per_net": num_dropped}), start)
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
    config = AgentConfig(**{**vars(CONFIG), "bc_weight": 100.0, "bc_loss": bc_loss, "bc_action": bc_action})
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
    # The default target is -1 here. A fresh policy has an entropy near log 2; with log_std lowered by 5 it is near -3.6.
    start = fresh_agent(jax.random.key(5)).replace(log_alpha=jnp.asarray(np.log(0.5), jnp.float32))
    start.actor["params"]["Dense_1"]["bias"] = jnp.array([0.0, -5.0 if rises else 0.0])
    batch = make_batch(action=ACTIONS, reward=0.0, discount=0.0)
    states, metrics = train(5, batch, AgentConfig(**{**vars(CONFIG), "target_entropy": None}), start)
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


@pytest.mark.parametrize(
    ("start", "end", "entropies"),  # at the beginning, after a quarter, and at the end
    [(None, None, [-3.0, -3.0, -3.0]), (-1.0, None, [-1.0, -1.0, -1.0]), (None, 5.0, [-3.0, -1.0, 5.0]), (4.0, 0.0, [4.0, 3.0, 0.0])],
)
def test_target_entropy_by_hand(start, end, entropies):
    config = AgentConfig(target_entropy=start, final_target_entropy=end)
    assert [agents.schedule(progress, 0, config, action_dim=3).target_entropy for progress in (0.0, 0.25, 1.0)] == entropies


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


# Observation (1, 2) less (0, 4) over (2, 4) is (1/2, -1/2); achieved goal 3 less 0 over 6 is 1/2, too, and desired goal 0 is 0.
HALF = [0.5, np.tanh(2.0)]


@pytest.mark.parametrize(
    ("encoding", "form", "expected"),
    [
        ("raw", "observation_goal", [1.0, 2.0, 0.0]),
        ("raw", "achieved_desired_observation", [3.0, 0.0, 1.0, 2.0]),
        ("multiscale", "observation_goal", [0.5, -0.5, HALF[1], -HALF[1], 0.0, 0.0]),
        ("multiscale", "achieved_desired_observation", [*HALF, 0.0, 0.0, 0.5, -0.5, HALF[1], -HALF[1]]),
        ("standardised", "observation_goal", [0.5, -0.5, 0.0]),
        ("standardised", "achieved_desired_observation", [0.5, 0.0, 0.5, -0.5]),
    ],
)
def test_network_inputs_by_hand(encoding, form, expected):
    scale = agents.InputScale(
        observation=jnp.array([2.0, 4.0]), goal=jnp.array([6.0]), observation_centre=jnp.array([0.0, 4.0]), goal_centre=jnp.zeros(1)
    )
    config = AgentConfig(policy_input=form, input_encoding=encoding, net_arch=(3,))
    parts = (jnp.array([[1.0, 2.0]]), jnp.array([[3.0]]), jnp.array([[0.0]]))
    np.testing.assert_allclose(agents.network_inputs(*parts, scale, config), [expected], rtol=1e-6)
    unbatched = agents.network_inputs(*(part[0] for part in parts), scale, config)
    np.testing.assert_allclose(unbatched, expected, rtol=1e-6)
    state = jax.eval_shape(lambda key: agents.init(key, config, observation_dim=2, goal_dim=1, action_dim=1), jax.random.key(0))
    assert state.actor["params"]["Dense_0"]["kernel"].shape == (len(expected), 3)


@pytest.mark.parametrize("padding", [7.0, np.nan])
@pytest.mark.parametrize(
    ("encoding", "centre", "size"),
    [
        # Three states count: (3, 0, 2), (4, 0, 2) and (5, 0, 2); root mean squares sqrt(50 / 3), 2 and, always zero, 1.
        ("multiscale", [0.0, 0.0, 0.0], [(50 / 3) ** 0.5, 1.0, 2.0]),
        # Means 4, 0 and 2, standard deviations sqrt(2 / 3) and, always equal, 1.
        ("standardised", [4.0, 0.0, 2.0], [(2 / 3) ** 0.5, 1.0, 1.0]),
    ],
)
def test_input_scale_by_hand(encoding, centre, size, padding):
    observations = jnp.array([[[3.0, 0.0, 2.0], [4.0, 0.0, 2.0]], [[5.0, 0.0, 2.0], [padding, padding, padding]]])
    config = AgentConfig(input_encoding=encoding)
    scale = agents.input_scale(observations, observations[..., :1], jnp.array([[True, True], [True, False]]), config)
    np.testing.assert_allclose(scale.observation, size, rtol=1e-6)
    np.testing.assert_allclose(scale.observation_centre, centre, rtol=1e-6)
    np.testing.assert_allclose([scale.goal, scale.goal_centre], [size[:1], centre[:1]], rtol=1e-6)


def test_standardised_inputs_have_mean_0_and_deviation_1_over_what_was_visited():
    rng = np.random.default_rng(0)
    observations = rng.normal([0.4, -20.0, 1e-3], [1e-3, 5.0, 1e-5], (4, 30, 3)).astype(np.float32)
    observations = np.concatenate([observations, np.full((4, 30, 1), 0.1, np.float32)], axis=2)  # and one dimension that never changes
    visited = np.arange(30)[None] < np.array([[30], [7], [12], [1]])
    padded = jnp.asarray(np.where(visited[..., None], observations, np.nan))
    config = AgentConfig(input_encoding="standardised")
    scale = agents.input_scale(padded, padded[..., :2], jnp.asarray(visited), config)
    seen = jnp.asarray(observations[visited])
    inputs = np.asarray(agents.network_inputs(seen, seen[:, :2], seen[:, :2], scale, config))
    np.testing.assert_allclose(inputs.mean(axis=0), 0.0, atol=1e-3)
    np.testing.assert_allclose(inputs[:, [0, 1, 2, 4, 5]].std(axis=0), 1.0, rtol=1e-3)
    np.testing.assert_allclose(inputs[:, 3], 0.0, atol=1e-6)
    # Elsewhere, that dimension counts by its difference.
    elsewhere = agents.network_inputs(seen[0] + 0.5, seen[0, :2], seen[0, :2], scale, config)
    np.testing.assert_allclose(elsewhere[3], 0.5, atol=1e-6)


@pytest.mark.parametrize(
    ("clip", "obtained", "expected"),
    # Targets are 0.4 + 0.5 (-1, 0, 1, 2) = (-0.1, 0.4, 0.9, 1.4), with a mean of 0.65, in every row. Half of the rows went on to obtain 0.5.
    [
        (True, None, (0.0 + 0.4 + 0.9 + 1.0) / 4),
        (False, [0.0, 0.5], ((0.0 + 0.4 + 0.9 + 1.4) / 4 + (0.5 + 0.5 + 0.9 + 1.4) / 4) / 2),
        (True, [0.0, 0.5], ((0.0 + 0.4 + 0.9 + 1.0) / 4 + (0.5 + 0.5 + 0.9 + 1.0) / 4) / 2),
        (True, [1.0, 1.0], 1.0),  # the return of a solved task is what is left of it
    ],
)
def test_bounds_of_the_targets_by_hand(clip, obtained, expected):
    start = fresh_agent(jax.random.key(8)).replace(log_alpha=jnp.asarray(-30.0))
    start = with_constant_critics(start, 2 * [[-1.0, 0.0, 1.0, 2.0]])
    batch = make_batch(action=ACTIONS, reward=0.4, discount=0.5)
    batch = batch.replace(obtained_return=None if obtained is None else jnp.tile(jnp.array(obtained), B // 2))
    config = dataclasses.replace(CONFIG, clip_targets=clip)
    inputs = inputs_of(batch.observation, config)

    @jax.jit
    def target(key):
        return agents.update(key, start, batch, inputs=inputs, next_inputs=inputs, schedule=SCHEDULE, config=config)[1]["critic/target"]

    np.testing.assert_allclose(target(jax.random.key(0)), expected, atol=1e-5)


def test_actions_by_hand():
    shapes = jax.eval_shape(lambda key: agents.init(key, CONFIG, observation_dim=2, goal_dim=1, action_dim=2), jax.random.key(0)).actor
    actor = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape), shapes)
    actor["params"]["Dense_1"]["bias"] = jnp.array([0.5, -1.0, np.log(0.1), np.log(2.0)])  # means, and logarithms of the deviations
    mode, sampled = (
        agents.select_action(jax.random.key(1), actor, jnp.ones((3, 3)), CONFIG, action_dim=2, stochastic=stochastic) for stochastic in (False, True)
    )
    np.testing.assert_allclose(mode, np.tanh([[0.5, -1.0]] * 3), atol=1e-6)
    noise = np.asarray(jax.random.normal(jax.random.key(1), (2, 3))).T  # one column per row of the batch
    np.testing.assert_allclose(sampled, np.tanh([0.5, -1.0] + np.array([0.1, 2.0]) * noise), atol=1e-6)


def test_initial_alpha():
    np.testing.assert_allclose(fresh_agent(jax.random.key(0)).log_alpha, np.log(1e-4), rtol=1e-6)


def test_update_bc_overfits_a_tiny_batch_and_touches_only_the_actor():
    observation = np.random.default_rng(0).normal(size=(B, 2))
    batch = make_batch(action=0.8 * np.sin(observation[:, :1]), reward=0.0, discount=0.0, observation=observation)
    inputs = inputs_of(batch.observation, CONFIG)

    @jax.jit
    def clone(start):
        return jax.lax.scan(
            lambda state, _: agents.update_bc(state, batch, inputs=inputs, schedule=SCHEDULE, config=CONFIG), start, length=NUM_UPDATES
        )

    start = fresh_agent(jax.random.key(9))
    end, metrics = clone(start)
    chex.assert_tree_all_finite((end, metrics))
    first, final = metrics["actor/bc_loss"][0], metrics["actor/bc_loss"][-1]
    np.testing.assert_allclose(first, np.mean((mean_action(start, batch.observation) - batch.action) ** 2), rtol=1e-4)  # over all rows
    assert final < 0.01 < 0.1 < first
    chex.assert_trees_all_close(end.average_actor, end.actor, atol=0.05)  # it has followed
    assert np.abs(end.average_actor["params"]["Dense_0"]["kernel"] - start.actor["params"]["Dense_0"]["kernel"]).max() > 0.1
    for name in ("critics", "target_critics", "log_alpha", "critic_optimiser", "alpha_optimiser"):
        chex.assert_trees_all_equal(getattr(start, name), getattr(end, name))


def test_learning_rate_moves_linearly_or_not_at_all():
    moving = AgentConfig(learning_rate=1e-3, final_learning_rate=1e-4)
    assert np.allclose([agents.schedule(progress, 0, moving, action_dim=1).learning_rate for progress in (0.0, 0.5, 1.0)], [1e-3, 5.5e-4, 1e-4])
    constant = AgentConfig(learning_rate=1e-3, final_learning_rate=None)
    assert [agents.schedule(progress, 0, constant, action_dim=1).learning_rate for progress in (0.0, 1.0)] == [1e-3, 1e-3]


def test_span_of_the_average_by_hand():
    for rate, span, expected in ((0.2, 0.0, [0.2, 0.2, 0.2]), (1.0, 0.5, [1.0, 2 / 3, 0.1]), (0.3, 0.5, [0.3, 0.3, 0.1])):
        config = AgentConfig(actor_average_rate=rate, actor_average_span=span)
        rates = [agents.schedule(0.0, updates, config, action_dim=1).actor_average_rate for updates in (0, 1, 18)]
        np.testing.assert_allclose(rates, expected, rtol=1e-6)


def test_blocks_are_as_few_as_the_cache_allows_and_equal(monkeypatch):
    monkeypatch.setattr(agents, "_BLOCK_BYTES", 1000)
    config = AgentConfig(net_arch=(5, 10))  # 40 bytes per row: at most 25 rows per block
    assert [agents._num_blocks(batch_size, config) for batch_size in (1, 25, 26, 100, 120, 103)] == [1, 1, 2, 4, 5, 1]  # 103 is a prime
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert agents._num_blocks(100, config) == 1


def test_mean_over_blocks_is_the_mean_over_the_batch():
    rng = np.random.default_rng(0)
    columns = agents._Columns(
        inputs=jnp.asarray(rng.normal(size=(3, 12)), jnp.float32),
        next_inputs=jnp.zeros((3, 12)),
        action=jnp.asarray(rng.normal(size=(2, 12)), jnp.float32),
        reward=jnp.arange(12.0),
        discount=jnp.ones(12),
        is_demonstration=jnp.arange(12) < 5,
        obtained_return=jnp.asarray(rng.uniform(size=12), jnp.float32),
        noise=jnp.zeros((2, 12)),
        next_noise=jnp.zeros((2, 12)),
    )

    def function(block):
        # Columns stay together: a product of different fields would show a mixture.
        product = block.inputs[0] * block.action[1] * block.reward * block.is_demonstration * block.obtained_return
        return {"mean": jnp.mean(product), "matrix": block.inputs @ block.action.T / block.reward.shape[0]}

    expected = function(columns)
    for num_blocks in (1, 2, 3, 12):
        given = agents._mean_over_blocks(function, columns, num_blocks)
        chex.assert_trees_all_close(given, expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_an_update_in_blocks_is_the_same_update(precision, monkeypatch):
    config = dataclasses.replace(CONFIG, bc_weight=0.5, num_critics=3, top_quantiles_to_drop_per_net=1, network_precision=precision)
    rng = np.random.default_rng(0)
    batch = make_batch(
        action=rng.uniform(-1, 1, (B, 1)),
        reward=rng.normal(size=B),
        discount=0.9,
        observation=rng.normal(size=(B, 2)),
        next_observation=rng.normal(size=(B, 2)),
        is_demonstration=np.arange(B) < 5,
    ).replace(weight=jnp.asarray(rng.uniform(size=B), jnp.float32))
    start = jax.jit(lambda key: agents.init(key, config, observation_dim=2, goal_dim=1, action_dim=1))(jax.random.key(0))
    inputs, next_inputs = inputs_of(batch.observation, config), inputs_of(batch.next_observation, config)

    def update(num_blocks):
        monkeypatch.setattr(agents, "_num_blocks", lambda *_: num_blocks)
        once = jax.jit(lambda key: agents.update(key, start, batch, inputs=inputs, next_inputs=next_inputs, schedule=SCHEDULE, config=config))
        return once(jax.random.key(1))

    whole, cut = update(1), update(4)
    # Adam's first step is the gradient's sign times the step size, so the moments are what must agree closely.
    for given, expected in ((cut[0].critic_optimiser, whole[0].critic_optimiser), (cut[0].actor_optimiser, whole[0].actor_optimiser)):
        chex.assert_trees_all_close(given, expected, rtol=1e-3, atol=1e-6)
        assert min(np.abs(leaf).max() for leaf in jax.tree.leaves(expected.mu)) > 1e-5
    chex.assert_trees_all_close(cut[1], whole[1], rtol=1e-3, atol=1e-5)
