"""Training end to end at toy size: what is counted, what is learnt, what is compiled."""

import dataclasses
import functools
import inspect
import itertools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from corridor_training import COLLECT_STEPS, HORIZON, LEARN_STEPS, NUM_ENVS, make_config, make_data, make_env, with_output_bias

from hindrl_jax.base.types import Episodes
from hindrl_jax.config import AgentConfig, BatchConfig, TrainConfig
from hindrl_jax.core import agent as agents
from hindrl_jax.core import rollout, train
from hindrl_jax.core.guidance import guidance
from hindrl_jax.envs.grid import FixedGridPickAndPlace

# Every program is traced once in this file, whoever calls it: each test builds its own, equal config and environment.
STATIC = ("env", "config", "num_iterations", "num_episodes")


def program(function, **options):
    names = [name for name in inspect.signature(function).parameters if name in STATIC]
    return jax.jit(chex.assert_max_traces(function, n=1), static_argnames=names, **options)


init, collect, clone, evaluate = program(train.init), program(train.collect), program(train.clone), program(train.evaluate)
learn = program(train.learn, donate_argnums=0)


@pytest.fixture(scope="module")
def data():
    return make_data(make_config())


def collected(seed, data):
    state = init(jax.random.key(seed), data, make_env(), make_config())
    return collect(state, data, env=make_env(), config=make_config(), num_iterations=COLLECT_STEPS)


def actor_of(state, noise=0.0):
    """The policy that explores, with its mean actions or, at noise 1, as it does."""
    return agents.policy(state.agent, make_config(), average=False).replace(noise=noise)


@pytest.fixture(scope="module")
def learnt(data):
    """What `learn` made of the state after `collect`, by calling it twice; the first policy plays (0.5, -0.5) and a little noise."""
    config = make_config()
    start = with_output_bias(collected(0, data), [np.arctanh(0.5), np.arctanh(-0.5), -5.0, -5.0])
    first, metrics_first = learn(start, data, env=make_env(), config=config, num_iterations=LEARN_STEPS)
    snapshot = jax.device_get(first.replace(key=jax.random.key_data(first.key), rollout=None))
    second, metrics_second = learn(first, data, env=make_env(), config=make_config(), num_iterations=LEARN_STEPS)
    return snapshot, metrics_first, second, metrics_second


def test_steps_are_counted(learnt):
    first, _, second, _ = learnt
    assert int(first.env_steps) == NUM_ENVS * (COLLECT_STEPS + LEARN_STEPS)
    assert int(second.env_steps) == NUM_ENVS * (COLLECT_STEPS + 2 * LEARN_STEPS)
    assert (int(first.updates), int(second.updates)) == (2 * LEARN_STEPS, 4 * LEARN_STEPS)
    assert int(first.agent.critic_optimiser.count) == 2 * LEARN_STEPS
    # What is in the replay is what was stepped: complete episodes, and the beginning of those under way.
    episodes, slots = second.replay.episodes, second.replay.episodes.lengths.shape[0] // NUM_ENVS
    assert slots == 30_000 // (NUM_ENVS * HORIZON)
    assert int(episodes.lengths.sum() + second.replay.step.sum()) == int(second.env_steps)


def test_everything_stays_finite_and_learns(learnt):
    first, metrics_first, second, metrics_second = learnt
    chex.assert_tree_all_finite((second.agent, metrics_first, metrics_second))
    assert all(value.shape == () for value in metrics_first.values())
    moved = jax.tree.map(lambda a, b: float(np.abs(a - b).max()), first.agent.critics, second.agent.critics)
    assert min(jax.tree.leaves(moved)) > 0.0


def test_demonstrations_fade_out_with_the_environment_steps(learnt):
    _, metrics_first, _, metrics_second = learnt
    assert metrics_first["actor/bc_loss"] > 0.0
    assert metrics_second["actor/bc_loss"] == 0.0


def test_target_entropy_moves_with_the_environment_steps(learnt):
    # The target passes 0 after half of the 102 steps, which is where the first call ends. Log alpha has just begun to fall from 0, and stays
    # negative; so the loss log alpha * (entropy - target) has the sign of the target, which is far from any entropy.
    _, metrics_first, second, metrics_second = learnt
    assert second.agent.log_alpha < 0.0
    assert metrics_first["alpha/loss"] < 0.0 < metrics_second["alpha/loss"]


def stack(*trees):
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)


def two_seeds(data):
    return stack(collected(1, data), collected(2, data)), stack(data, data)


@pytest.fixture(scope="module")
def mapped(data):
    """`learn` over two seeds, compiled as the experiments do."""
    run = jax.vmap(functools.partial(train.learn, env=make_env(), config=make_config(), num_iterations=LEARN_STEPS))
    return jax.jit(run, donate_argnums=0).lower(*two_seeds(data)).compile()


def test_a_seed_alone_equals_its_row_under_vmap(mapped, data):
    together, metrics_together = mapped(*two_seeds(data))
    for index, seed in enumerate((1, 2)):
        alone, metrics = learn(collected(seed, data), data, env=make_env(), config=make_config(), num_iterations=LEARN_STEPS)
        row = jax.tree.map(lambda leaf, index=index: leaf[index], (together.agent, together.replay, metrics_together))
        chex.assert_trees_all_close((alone.agent, alone.replay, metrics), row, rtol=1e-3, atol=1e-4)
    kernel = together.agent.critics["params"]["Dense_0"]["kernel"]
    assert np.abs(kernel[0] - kernel[1]).max() > 0.01


def test_the_replay_is_written_in_place(mapped, data):
    """No copy of the replay: neither in the program's text nor among its buffers, and the donated state becomes the new one."""
    episodes = collected(1, data).replay.episodes
    leaves = [getattr(episodes, name) for name in ("observations", "actions", "rewards")]
    text = mapped.as_text()
    for leaf in leaves:
        shape = f"f32[2,{','.join(map(str, leaf.shape))}]"
        assert f"= {shape}" in text  # the shape is spelt as the program spells it
        assert [line for line in text.splitlines() if f"= {shape}" in line and " copy" in line.split(shape, 1)[1].split("(", 1)[0]] == []
    memory = mapped.memory_analysis()
    smallest, replay = min(2 * leaf.nbytes for leaf in leaves), sum(2 * leaf.nbytes for leaf in leaves)
    assert memory.temp_size_in_bytes < smallest
    assert memory.alias_size_in_bytes > replay
    assert memory.argument_size_in_bytes - memory.alias_size_in_bytes < smallest


def test_donated_state_is_consumed(data):
    state = collected(3, data)
    observations = state.replay.episodes.observations
    learn(state, data, env=make_env(), config=make_config(), num_iterations=LEARN_STEPS)
    assert observations.is_deleted()


def test_clone_trains_the_actor_on_demonstrations_alone(data):
    config = make_config(algo="bc", learning_starts=0)
    start = init(jax.random.key(0), data, make_env(), make_config())
    state, losses = start, []
    for _ in range(2):
        state, metrics = clone(state, data, env=make_env(), config=make_config(algo="bc", learning_starts=0), num_iterations=500)
        losses.append(float(metrics["actor/bc_loss"]))
    chex.assert_tree_all_finite((state.agent, metrics))
    assert losses[1] < losses[0]
    assert (int(state.env_steps), int(state.updates)) == (0, 1000)
    chex.assert_trees_all_equal(state.replay, start.replay)
    chex.assert_trees_all_equal(state.agent.critics, start.agent.critics)
    # Demonstrated second actions are -0.5 throughout; the policy has left 0 for them.
    act = train.make_policy(actor_of(state), make_env(), config)
    action = act(jax.random.key(0), data.demonstrations.observations[:, 0], data.demonstrations.desired_goals)
    np.testing.assert_allclose(action[:, 1], -0.5, atol=0.3)


def test_evaluation_plays_mean_actions_or_sampled_ones_as_the_policy_says(data):
    state = with_output_bias(init(jax.random.key(0), data, make_env(), make_config()), [0.0, 0.0, 0.0, 0.0])
    for seed in (1, 2):
        result = evaluate(jax.random.key(seed), actor_of(state), data, env=make_env(), config=make_config(), num_episodes=20)
        # Velocity 1 passes 4 in the fifth step.
        assert result.length.tolist() == [5] * 20
        assert result.success.tolist() == [True] * 20
    act = train.make_policy(actor_of(state, noise=1.0), make_env(), make_config())
    result = jax.jit(lambda key: rollout.evaluate(key, make_env(), data.behavioural_goals, act, 20))(jax.random.key(3))
    assert len(set(result.length.tolist())) > 1


def test_reset_and_step_are_traced_once(data):
    reset = jax.jit(chex.assert_max_traces(rollout.reset, n=1), static_argnums=(1, 3))
    step = jax.jit(chex.assert_max_traces(rollout.step, n=1), static_argnums=3)
    state = reset(jax.random.key(0), make_env(), data.behavioural_goals, 4)
    for seed in range(1, 4):
        restarted = reset(jax.random.key(seed), make_env(), data.behavioural_goals, 4)
        state, time_step = step(state, restarted, jnp.zeros((4, 2)), make_env())
    assert time_step.reward.shape == (4,)


def test_cloning_moves_the_actor_alone_and_its_average_follows(data):
    agent = dataclasses.replace(make_config().agent, learning_rate=1e-2, actor_average_span=0.02)
    config = make_config(algo="bc", agent=agent, batch=BatchConfig(batch_size=32))
    start = train.init(jax.random.key(0), data, make_env(), config)
    run = functools.partial(train.clone, env=make_env(), config=config, num_iterations=300)
    cloned, metrics = jax.jit(run)(start, data)
    chex.assert_tree_all_finite((cloned.agent, metrics))
    assert (int(cloned.updates), int(cloned.env_steps)) == (300, 0)
    chex.assert_trees_all_equal(cloned.agent.critics, start.agent.critics)
    chex.assert_trees_all_equal(cloned.replay, start.replay)
    act = train.make_policy(actor_of(cloned), make_env(), config)
    action = act(jax.random.key(0), data.demonstrations.observations[:, 0], data.demonstrations.desired_goals)
    np.testing.assert_allclose(action[:, 1], -0.5, atol=0.2)
    chex.assert_trees_all_close(cloned.agent.average_actor, cloned.agent.actor, atol=0.1)  # it has followed
    moved = jax.tree.map(lambda old, new: float(np.abs(old - new).max()), start.agent.average_actor, cloned.agent.average_actor)
    assert max(jax.tree.leaves(moved)) > 0.1


def test_a_stuck_agent_is_replaced_by_a_fresh_one_and_all_else_stays(learnt, data):
    env, config, without_keys = make_env(), make_config(imitation_steps=3), dict(key=None, rollout=None)
    started = agents.init(jax.random.key(8), data.scale, config, action_dim=env.action_dim)
    state = learnt[2].replace(agent=learnt[2].agent.replace(imitation=started.imitation))
    reset = functools.partial(program(train.reset_networks), env=env, config=config)
    chex.assert_trees_all_equal(reset(state, jnp.array(False)).replace(**without_keys), state.replace(**without_keys))
    fresh = reset(state, jnp.array(True))
    chex.assert_trees_all_equal(fresh.replace(agent=state.agent, updates=state.updates, **without_keys), state.replace(**without_keys))
    assert (int(fresh.updates), int(state.updates) > 0) == (0, True)
    chex.assert_trees_all_equal_shapes_and_dtypes(fresh.agent, started)
    chex.assert_trees_all_equal((fresh.agent.imitation, fresh.agent.scale), (started.imitation, started.scale))
    chex.assert_trees_all_equal((fresh.agent.critics, fresh.agent.actor), (fresh.agent.target_critics, fresh.agent.average_actor))
    assert int(fresh.agent.actor_optimiser.count) == 0
    later = reset(fresh.replace(key=jax.random.key(9)), jnp.array(True))
    kernels = [np.asarray(one.agent.actor["params"]["Dense_0"]["kernel"]) for one in (state, fresh, later)]
    assert min(np.abs(a - b).max() for a, b in itertools.combinations(kernels, 2)) > 0.1


def test_warm_up_lasts_until_an_episode_can_be_complete():
    horizon = make_env().horizon
    assert train.warm_up_iterations(make_env(), make_config(learning_starts=0)) == horizon
    assert train.warm_up_iterations(make_env(), make_config(learning_starts=NUM_ENVS * horizon + 1, steps=10**6)) == horizon + 1


def test_too_small_replay_is_refused(data):
    def start(**changes):
        return jax.eval_shape(lambda key: train.init(key, data, make_env(), make_config(**changes)), jax.random.key(0))

    with pytest.raises(ValueError, match="buffer_size = 41"):
        start(buffer_size=2 * NUM_ENVS * HORIZON - 1)
    start(buffer_size=2 * NUM_ENVS * HORIZON)
    start(algo="bc", buffer_size=1)  # cloning stores nothing


def grid_demonstrations(env, num):
    """Numbers of the right shapes; what the grid's expert does is its own test's concern."""
    rng = np.random.default_rng(0)
    return Episodes(
        observations=jnp.asarray(rng.integers(-3, 4, size=(num, env.horizon + 1, env.observation_dim)), jnp.float32),
        actions=jnp.asarray(rng.uniform(-1, 1, size=(num, env.horizon, env.action_dim)), jnp.float32),
        rewards=jnp.zeros((num, env.horizon)).at[:, 5].set(1.0),
        lengths=jnp.full(num, 6),
        terminated=jnp.ones(num, bool),
        desired_goals=jnp.zeros((num, env.goal_dim)),
        states=jnp.zeros((num, env.horizon + 1, env.state_dim)),
    )


def test_grid_runs_end_to_end():
    """With everything switched on that is off by default."""
    env = FixedGridPickAndPlace(size=4, random_box_size=1, horizon=8)
    config = TrainConfig(
        num_envs=2,
        updates_per_iteration=1,
        learning_starts=16,
        buffer_size=64,
        steps=100,
        demo_reset_ratio=0.5,
        batch=BatchConfig(batch_size=8, n_step=2),
        agent=AgentConfig(
            net_arch=(8,), num_critics=1, num_quantiles=3, top_quantiles_to_drop_per_net=1, clip_targets=True, input_encoding="standardised"
        ),
    )

    @jax.jit
    def run(key):
        key_init, key_evaluate = jax.random.split(key)
        data = guidance(grid_demonstrations(env, 2), env, config)
        state = train.collect(train.init(key_init, data, env, config), data, env=env, config=config, num_iterations=8)
        state, metrics = train.learn(state, data, env=env, config=config, num_iterations=4)
        return state, metrics, train.evaluate(key_evaluate, actor_of(state), data, env=env, config=config, num_episodes=3)

    state, metrics, evaluation = run(jax.random.key(0))
    chex.assert_tree_all_finite((state.agent, metrics))
    assert (int(state.env_steps), int(state.updates)) == (24, 4)
    assert 0.0 < metrics["critic/target"] <= 1.0
    assert np.all(np.asarray(evaluation.length) <= 8)
    assert state.replay.episodes.observations.shape == (8, 9, env.observation_dim)


def test_with_span_1_the_averaged_actor_is_the_mean_of_all_actors(data):
    agent = dataclasses.replace(make_config().agent, actor_average_span=1.0)
    config, step = make_config(algo="bc", agent=agent), program(train.clone)
    state, actors = train.init(jax.random.key(0), data, make_env(), config), []
    for _ in range(4):
        state, _ = step(state, data, env=make_env(), config=config, num_iterations=1)
        actors.append(state.agent.actor)
    mean = jax.tree.map(lambda *leaves: sum(leaves) / 4, *actors)
    chex.assert_trees_all_close(state.agent.average_actor, mean, atol=1e-6)
    chex.assert_trees_all_close(actors[0], actors[3], atol=0.1)
    assert np.abs(mean["params"]["Dense_0"]["kernel"] - actors[3]["params"]["Dense_0"]["kernel"]).max() > 1e-4
