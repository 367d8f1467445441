"""Training end to end at toy size: what is counted, what is stored, what is compiled."""

import dataclasses
import functools
import inspect

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toy_env import Corridor, corridor_demonstrations

from hindrl_jax.base.errors import UserError
from hindrl_jax.base.types import Episodes
from hindrl_jax.config import AgentConfig, BatchConfig, GoalConfig, TrainConfig
from hindrl_jax.core import replay as replays
from hindrl_jax.core import rollout, train
from hindrl_jax.core.agent import network_inputs
from hindrl_jax.core.networks import apply_critics
from hindrl_jax.core.replay import sample_batch
from hindrl_jax.envs.grid import FixedGridPickAndPlace

NUM_ENVS, HORIZON, COLLECT_STEPS, LEARN_STEPS = 3, 7, 14, 3
# Every program is traced once in this file, whoever calls it: each test builds its own, equal config and environment.
STATIC = ("env", "config", "num_iterations", "num_episodes", "stochastic")


def program(function, **options):
    names = [name for name in inspect.signature(function).parameters if name in STATIC]
    return jax.jit(chex.assert_max_traces(function, n=1), static_argnames=names, **options)


init, collect, clone, evaluate = program(train.init), program(train.collect), program(train.clone), program(train.evaluate)
learn = program(train.learn, donate_argnums=0)


def make_env():
    return Corridor(horizon=HORIZON, width=4.0)


def make_config(**changes):
    """Relabels from both sources. The last of the 4 demonstration rows goes at step 50, within the first call of `learn`: 4 (1 - 50 / 66) < 1."""
    config = TrainConfig(
        num_envs=NUM_ENVS,
        updates_per_iteration=2,
        learning_starts=NUM_ENVS * HORIZON,
        buffer_size=30_000,
        steps=102,
        batch=BatchConfig(batch_size=16, hindrl_sampling_strategy="joint_union", reach_zero=66),
        goal=GoalConfig(m=1, k=1.0, epsilon_filtering=True),
        agent=AgentConfig(net_arch=(8,), num_quantiles=5, top_quantiles_to_drop_per_net=1, target_entropy=-1000.0, final_target_entropy=1000.0),
    )
    return dataclasses.replace(config, **changes)


@pytest.fixture(scope="module")
def data():
    return train.guidance(corridor_demonstrations((1.0, 1.25, 0.9), env=make_env()), make_env(), make_config())


def collected(seed, data):
    state = init(jax.random.key(seed), data, make_env(), make_config())
    return collect(state, data, env=make_env(), config=make_config(), num_iterations=COLLECT_STEPS)


def with_output_bias(state, bias):
    """The state with an actor that has the same (mean, log_std) everywhere, whatever it sees."""
    last = state.agent.actor["params"]["Dense_1"]
    last = {"kernel": jnp.zeros_like(last["kernel"]), "bias": jnp.array(bias)}
    actor = {"params": {**state.agent.actor["params"], "Dense_1": last}}
    return state.replace(agent=state.agent.replace(actor=actor))


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


def lived_episodes(state):
    """(environment, length, observations, actions, rewards, terminated, goal) of the complete episodes, oldest first in each environment."""
    episodes = jax.device_get(state.replay.episodes)
    slots = len(episodes.lengths) // NUM_ENVS
    for row in np.flatnonzero(episodes.lengths):
        length = episodes.lengths[row]
        yield (
            row // slots,
            length,
            episodes.observations[row, : length + 1],
            episodes.actions[row, :length],
            episodes.rewards[row, :length],
            episodes.terminated[row],
            episodes.desired_goals[row],
        )


def test_replay_holds_what_was_lived(learnt, data):
    goals = np.asarray(data.behavioural_goals.goals)
    starts = []
    for _, length, observations, actions, rewards, terminated, goal in lived_episodes(learnt[2]):
        starts.append(observations[0, 0])
        assert np.all(observations[:, 0] == observations[0, 0])  # one episode, not two
        assert observations[:, 1].tolist() == list(range(length + 1))
        np.testing.assert_allclose(np.diff(observations[:, 2]), actions[:, 0] + 1.0, atol=1e-5)  # policy units to velocities
        assert rewards.tolist() == (observations[1:, 2] > 4.0).tolist()
        assert bool(terminated) == bool(rewards[-1])
        assert rewards[:-1].sum() == 0.0
        assert terminated or length == HORIZON
        assert np.any(goal == goals)
        assert np.abs(actions).max() <= 1.0
    assert len(starts) >= NUM_ENVS * 2
    assert len(set(starts)) == len(starts)


def test_actions_are_uniform_at_first_and_the_policys_when_learning(learnt):
    replay = learnt[0].replay
    slots, first_of_policy = len(replay.episodes.lengths) // NUM_ENVS, set()
    for env in range(NUM_ENVS):
        rows = [(env * slots + slot, length) for slot, length in enumerate(replay.episodes.lengths[env * slots : (env + 1) * slots]) if length]
        rows.append((env * slots + replay.slot[env], replay.step[env]))  # the episode under way
        actions = np.concatenate([replay.episodes.actions[row, :length] for row, length in rows])
        assert len(actions) == COLLECT_STEPS + LEARN_STEPS
        # The policy has moved by a few Adam steps of 1e-3; a uniform action is as near as that to it with probability 1e-3 at most.
        from_policy = np.all(np.abs(actions - np.array([0.5, -0.5])) < 0.05, axis=1)
        assert from_policy.tolist() == [False] * COLLECT_STEPS + [True] * LEARN_STEPS
        assert actions[:COLLECT_STEPS].std() > 0.4  # U(-1, 1) has 0.58
        first_of_policy.add(float(actions[COLLECT_STEPS, 0]))
    assert len(first_of_policy) == NUM_ENVS  # sampled: the mean action is the same in all environments


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


PRIORITISED = BatchConfig(
    batch_size=16,
    n_step=2,
    hindrl_sampling_strategy="mixture",
    strategy_mixture=(("future", 1.0), ("task_conditioned", 1.0), ("joint_intersection", 1.0)),
    demo_returns="monte_carlo",
    bound_by_obtained_return=True,
    priority_exponent=0.5,
    demo_priority_bonus=3.0,
)


def test_prioritised_training_over_two_seeds():
    """With everything else that a batch can have. The priorities are finite, where they should be, no longer those of the start, and in place."""
    env = make_env()
    goal = GoalConfig(m=1, k=1.0)
    agent = dataclasses.replace(make_config().agent, num_critics=3, num_target_critics=2, clip_targets=True)
    config = make_config(batch=PRIORITISED, goal=goal, agent=agent)
    data = train.guidance(corridor_demonstrations((1.0, 1.25, 0.9), env=env), env, config)

    @jax.jit
    @jax.vmap
    def start(seed):
        return train.collect(train.init(jax.random.key(seed), data, env, config), data, env=env, config=config, num_iterations=COLLECT_STEPS)

    before = start(jnp.arange(2))
    former = jax.device_get(before.replay.priorities)
    learn = jax.vmap(functools.partial(train.learn, data=data, env=env, config=config, num_iterations=LEARN_STEPS))
    learn = jax.jit(learn, donate_argnums=0).lower(before).compile()
    state, metrics = learn(before)
    chex.assert_tree_all_finite((state.agent, metrics, state.replay.priorities))

    for seed in range(2):
        replay = jax.tree.map(lambda leaf, seed=seed: np.asarray(leaf[seed]), state.replay)
        lengths, slots = replay.episodes.lengths, len(replay.episodes.lengths) // NUM_ENVS
        complete = np.where(np.isin(np.arange(len(lengths)), np.arange(NUM_ENVS) * slots + replay.slot), 0, lengths)
        priorities = replay.priorities
        np.testing.assert_array_equal(priorities.replay > 0.0, np.arange(HORIZON)[None] < complete[:, None])
        np.testing.assert_array_equal(priorities.demonstrations > 0.0, former.demonstrations[seed] > 0.0)
        renewed = (priorities.replay > 0.0) & (priorities.replay != 1.0)
        demonstrated = priorities.demonstrations != former.demonstrations[seed]
        assert renewed.sum() > 10
        assert demonstrated.sum() > 5
        # Targets lie in [0, 1], as do hardly any errors by then. Demonstrations: at most 3 more; (1 + 3)^0.5 was their first priority.
        assert priorities.demonstrations[demonstrated].min() > (3.0 + 1e-3) ** 0.5 - 1e-6
        assert np.median(priorities.replay[renewed]) < 1.0
        assert priorities.largest == max(1.0, priorities.replay.max())
    # 14 demonstrated transitions of priority 2 and some 30 of priority 1 or less.
    assert (metrics["batch/demonstrations"] > 0.2).all()

    shape = f"f32[2,{','.join(map(str, former.replay.shape[1:]))}]"
    text = learn.as_text()
    assert f"= {shape}" in text
    assert [line for line in text.splitlines() if f"= {shape}" in line and " copy" in line.split(shape, 1)[1].split("(", 1)[0]] == []
    assert learn.memory_analysis().temp_size_in_bytes < former.replay.nbytes


def test_drawn_transitions_get_the_errors_of_their_own_rows():
    # Critics say 2 everywhere, their targets 1: the error is |2 - (reward + discount)|.
    env, batch = make_env(), dataclasses.replace(PRIORITISED, bound_by_obtained_return=False, hindrl_sampling_strategy="final", strategy_mixture=())
    config = make_config(batch=batch, goal=GoalConfig())
    data = train.guidance(corridor_demonstrations((1.0, 1.25, 0.9), env=env), env, config)

    def constant(critics, value):
        last = critics["params"]["Dense_1"]
        last = {"kernel": jnp.zeros_like(last["kernel"]), "bias": jnp.full_like(last["bias"], value)}
        return {"params": {**critics["params"], "Dense_1": last}}

    @jax.jit
    def run(key):
        key_init, key_draw, key_errors = jax.random.split(key, 3)
        state = train.collect(train.init(key_init, data, env, config), data, env=env, config=config, num_iterations=20)
        critics = dict(critics=constant(state.agent.critics, 2.0), target_critics=constant(state.agent.target_critics, 1.0))
        state = state.replace(agent=state.agent.replace(**critics, log_alpha=jnp.asarray(-30.0)))
        given = dict(replay=state.replay, demonstrations=data.demonstrations, table=data.goals, achieved_goal=env.achieved_goal)
        draw = functools.partial(replays.sample_prioritised_batch, **given, epsilon=data.epsilon, config=batch)
        batches, drawn = jax.vmap(draw)(jax.random.split(key_draw, 2))
        return state, batches, drawn, train._with_new_priorities(key_errors, state, batches, drawn, data, env, config)

    before, batches, drawn, after = jax.device_get(run(jax.random.key(0)))
    errors = np.abs(2.0 - batches.reward - batches.discount) + 1e-3
    for is_demonstration, name, bonus in ((True, "demonstrations", 3.0), (False, "replay", 0.0)):
        expected = np.array(getattr(before.replay.priorities, name))
        rows = np.argwhere(drawn.is_demonstration == is_demonstration)
        places = {}
        for row in map(tuple, rows):
            places.setdefault((drawn.rows[row], drawn.steps[row]), []).append((errors[row] + bonus) ** 0.5)
        for place, found in places.items():
            expected[place] = max(found)
        assert len(places) > 5
        np.testing.assert_allclose(getattr(after.replay.priorities, name), expected, rtol=1e-5)
    assert len(set(errors.ravel().round(3).tolist())) > 3


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
    action = train.make_policy(state.agent.actor, data.scale, make_env(), config, stochastic=False)(
        jax.random.key(0), data.demonstrations.observations[:, 0], data.demonstrations.desired_goals
    )
    np.testing.assert_allclose(action[:, 1], -0.5, atol=0.3)


def test_evaluation_plays_the_mean_action_unless_asked_to_sample(data):
    state = with_output_bias(init(jax.random.key(0), data, make_env(), make_config()), [0.0, 0.0, 0.0, 0.0])
    for seed in (1, 2):
        result = evaluate(jax.random.key(seed), state.agent.actor, data, env=make_env(), config=make_config(), num_episodes=20)
        # Velocity 1 passes 4 in the fifth step.
        assert result.length.tolist() == [5] * 20
        assert result.success.tolist() == [True] * 20
    sampling = functools.partial(train.evaluate, env=make_env(), config=make_config(), num_episodes=20, stochastic=True)
    result = jax.jit(sampling)(jax.random.key(3), state.agent.actor, data)
    assert len(set(result.length.tolist())) > 1


def test_reset_and_step_are_traced_once(data):
    reset = jax.jit(chex.assert_max_traces(rollout.reset, n=1), static_argnums=(1, 3))
    step = jax.jit(chex.assert_max_traces(rollout.step, n=1), static_argnums=3)
    state = reset(jax.random.key(0), make_env(), data.behavioural_goals, 4)
    for seed in range(1, 4):
        restarted = reset(jax.random.key(seed), make_env(), data.behavioural_goals, 4)
        state, time_step = step(state, restarted, jnp.zeros((4, 2)), make_env())
    assert time_step.reward.shape == (4,)


# One demonstration in steps of 1, whose achieved goals are 0, 1, 2, 3, 4, and one in steps of 2: 0, 2, 4. Lengths 4 and 2.
TWO_SPEEDS = (1.0, 2.0)


def guidance(goal=None, batch=None):
    env = Corridor(horizon=5, width=3.0)
    config = make_config(goal=goal or GoalConfig(), batch=batch or BatchConfig())
    return train.guidance(corridor_demonstrations(TWO_SPEEDS, env=env), env, config)


def goals_of(table):
    return table.goals[: int(table.count), 0].tolist()


def test_guidance_by_default():
    data = guidance()
    assert goals_of(data.goals) == [0.0, 1.0, 2.0, 3.0, 4.0, 0.0, 2.0, 4.0]
    assert goals_of(data.behavioural_goals) == [4.0, 4.0]
    assert data.epsilon.tolist() == [0.0]
    # Root mean square of the 5 + 3 goals: (0 + 1 + 4 + 9 + 16 + 0 + 4 + 16) / 8 = 2.5^2.
    np.testing.assert_allclose(data.scale.goal, [2.5], rtol=1e-6)
    np.testing.assert_allclose(data.scale.observation[2], 2.5, rtol=1e-6)
    demonstrations = data.demonstrations
    assert demonstrations.desired_goals.tolist() == [[4.0], [4.0]]
    given = corridor_demonstrations(TWO_SPEEDS)
    for field in dataclasses.fields(Episodes):
        if field.name not in ("desired_goals", "states"):
            np.testing.assert_array_equal(getattr(demonstrations, field.name), getattr(given, field.name))
    assert demonstrations.states is None  # they would only travel along
    assert data.starts is None


def test_guidance_reads_no_padding():
    env = Corridor(horizon=5, width=3.0)
    clean = corridor_demonstrations(TWO_SPEEDS, env=env)
    inside = (np.arange(6) <= np.asarray(clean.lengths)[:, None])[..., None]
    dirty = clean.replace(observations=jnp.asarray(np.where(inside, clean.observations, np.nan)))
    config = make_config(goal=GoalConfig(m=1, k=1.0, epsilon_filtering=True))
    expected, found = (train.guidance(demonstrations, env, config) for demonstrations in (clean, dirty))
    for name in ("epsilon", "behavioural_goals", "scale"):
        chex.assert_trees_all_close(getattr(found, name), getattr(expected, name))
    assert goals_of(found.goals) == goals_of(expected.goals)


def test_training_episodes_may_begin_in_demonstrated_states_and_evaluations_never_do():
    env, config = make_env(), make_config(demo_reset_ratio=1.0, batch=BatchConfig(n_step=1))
    demonstrations = corridor_demonstrations((1.0, 1.25, 0.9), env=env)
    data = train.guidance(demonstrations, env, config)
    assert data.starts.lengths.sum() == 14
    assert data.demonstrations.states is None

    @jax.jit
    def run(key):
        key_init, key_evaluate = jax.random.split(key)
        state = train.init(key_init, data, env, config)
        state = with_output_bias(train.collect(state, data, env=env, config=config, num_iterations=60), [0.0, 0.0, 0.0, 0.0])
        return state.replay, train.evaluate(key_evaluate, state.agent.actor, data, env=env, config=config, num_episodes=20)

    replay, evaluation = jax.device_get(run(jax.random.key(0)))
    begun = set()
    for row in np.flatnonzero(replay.episodes.lengths):
        observations, length = replay.episodes.observations[row], replay.episodes.lengths[row]
        demo, start = int(observations[0, 0]) - 10, int(observations[0, 1])
        np.testing.assert_array_equal(observations[0], demonstrations.observations[demo, start])
        assert start < demonstrations.lengths[demo]
        assert observations[: length + 1, 1].tolist() == list(range(start, start + length + 1))  # the steps are counted on
        assert start + length == HORIZON or replay.episodes.terminated[row]
        begun.add((demo, start))
    assert len(begun) > 7  # of 14
    assert evaluation.length.tolist() == [5] * 20  # from 0, velocity 1 passes 4 in the fifth step


def test_training_episodes_are_cut_at_random_and_evaluations_never_are(data):
    env, config = make_env(), make_config(random_truncation=0.5)

    @jax.jit
    def run(key):
        key_init, key_evaluate = jax.random.split(key)
        state = train.init(key_init, data, env, config)
        state = with_output_bias(train.collect(state, data, env=env, config=config, num_iterations=60), [0.0, 0.0, 0.0, 0.0])
        return state.replay, train.evaluate(key_evaluate, state.agent.actor, data, env=env, config=config, num_episodes=20)

    replay, evaluation = jax.device_get(run(jax.random.key(0)))
    complete = replay.episodes.lengths > 0
    lengths = replay.episodes.lengths[complete & ~replay.episodes.terminated]
    assert lengths.size > 20
    assert 1.0 < lengths.mean() < 3.0  # 2 steps, if none were cut by the horizon
    assert evaluation.length.tolist() == [5] * 20


def test_a_reverse_curriculum_widens_from_the_end_of_the_demonstrations():
    # Demonstrations of 5, 4 and 5 steps. The curriculum lasts for half of the 1,200 steps; each of the 3 environments takes 400 of them.
    env = make_env()
    config = make_config(demo_reset_ratio=1.0, demo_reset_curriculum=0.5, steps=1200, batch=BatchConfig(n_step=1))
    demonstrations = corridor_demonstrations((1.0, 1.25, 0.9), env=env)
    data = train.guidance(demonstrations, env, config)

    @jax.jit
    def begin(key, progress):
        return jax.vmap(lambda key: train._new_episodes(key, data, env, config, progress).observation)(jax.random.split(key, 300))

    for progress, share in ((0.0, 0.0), (0.25, 0.5), (0.5, 1.0), (1.0, 1.0)):
        observations = np.asarray(begin(jax.random.key(1), progress)).reshape(-1, 3)
        for demo, length in enumerate(demonstrations.lengths.tolist()):
            eligible = min(max(int(np.ceil(share * length)), 1), length)
            begun = observations[observations[:, 0] == 10 + demo, 1]
            assert sorted(set(begun.tolist())) == list(range(length - eligible, length)), (progress, demo)

    # It is told how far the run is: no episode of the first 30 steps of all begins before the last state but one.
    replay = jax.jit(lambda key: train.collect(train.init(key, data, env, config), data, env=env, config=config, num_iterations=10))(
        jax.random.key(0)
    )
    starts = [observations[0] for _, _, observations, *_ in lived_episodes(replay)]
    assert len(starts) >= 3
    assert all(start[1] >= demonstrations.lengths[int(start[0]) - 10] - 1 for start in starts)


ACHIEVED = GoalConfig(achieved_goal_ratio=1.0)


def test_achieved_goals_are_given_to_new_episodes_and_judge_them():
    env, config = make_env(), make_config(goal=ACHIEVED, batch=BatchConfig(batch_size=64, relabelled_per_original=0, n_step=1))
    data = train.guidance(corridor_demonstrations((1.0,), env=env), env, config)

    @jax.jit
    def run(key):
        key_init, key_batch = jax.random.split(key)
        state = train.collect(train.init(key_init, data, env, config), data, env=env, config=config, num_iterations=60)
        draw = functools.partial(sample_batch, demonstrations=data.demonstrations, table=data.goals, achieved_goal=env.achieved_goal)
        rows = jnp.asarray(0)
        return state, draw(key_batch, state.replay, epsilon=jnp.zeros(1), demo_rows=rows, config=config.batch)

    state, batch = jax.device_get(run(jax.random.key(0)))
    replay, task_goal, seen, achieved_goals = state.replay, float(data.behavioural_goals.goals[0, 0]), set(), 0
    for row in np.flatnonzero(replay.episodes.lengths):
        goal = float(replay.episodes.desired_goals[row, 0])
        if replay.judged_by_goal[row]:
            achieved_goals += 1
        else:
            assert goal == task_goal
        seen |= set(replay.episodes.observations[row, : replay.episodes.lengths[row] + 1, 2].tolist())
    goals = replay.episodes.desired_goals[np.flatnonzero(replay.judged_by_goal & (replay.episodes.lengths > 0)), 0]
    assert set(goals.tolist()) <= seen  # each was reached in some episode
    assert len(set(goals.tolist())) > 10
    assert achieved_goals >= len(np.flatnonzero(replay.episodes.lengths)) - 2 * NUM_ENVS  # all but the first episodes, when there was no past
    # Rows of those episodes are rewarded for their goal alone, and only where it is reached exactly; the others by the environment.
    judged = batch.desired_goal[:, 0] != task_goal
    assert judged.sum() > 0
    assert not batch.is_relabelled.any()
    reached = batch.next_observation[:, 2] == batch.desired_goal[:, 0]
    np.testing.assert_array_equal(batch.reward[judged], reached[judged])
    solved = batch.next_observation[:, 2] > env.width
    np.testing.assert_array_equal(batch.discount == 0.0, (judged & reached) | solved)


def test_achieved_goals_cost_no_copy_of_the_replay(data):
    config = make_config(goal=GoalConfig(achieved_goal_ratio=0.5))
    state = jax.eval_shape(lambda key: train.init(key, data, make_env(), config), jax.random.key(0))
    run = functools.partial(train.learn, env=make_env(), config=config, num_iterations=LEARN_STEPS)
    memory = jax.jit(run, donate_argnums=0).lower(state, data).compile().memory_analysis()
    assert memory.temp_size_in_bytes < state.replay.episodes.actions.size * 4


def test_the_share_of_achieved_goals_moves_linearly():
    env, goal = make_env(), GoalConfig(achieved_goal_ratio=0.8, final_achieved_goal_ratio=0.0)
    config = make_config(goal=goal, num_envs=500, buffer_size=500 * 2 * HORIZON, steps=10**6)
    data = train.guidance(corridor_demonstrations((1.0,), env=env), env, config)

    @jax.jit
    def judged(key):
        key_init, key_new, key_goals = jax.random.split(key, 3)
        state = train.collect(train.init(key_init, data, env, config), data, env=env, config=config, num_iterations=HORIZON)
        episodes = train._new_episodes(key_new, data, env, config, 0.0)

        def at(progress):
            return jnp.sum(train._with_achieved_goals(key_goals, episodes, state.replay, env, config, progress).judged_by_goal)

        return jax.vmap(at)(jnp.array([0.0, 0.5, 1.0]))

    # Of 500: 400, 200 and none; standard deviations up to 11.
    np.testing.assert_allclose(judged(jax.random.key(0)), [400, 200, 0], atol=55)


def test_warm_start_clones_and_pretraining_teaches_the_critics_before_any_mixed_batch():
    env = make_env()
    agent = dataclasses.replace(make_config().agent, learning_rate=1e-2, target_update_rate=0.1, initial_alpha=1e-4)
    batch = BatchConfig(batch_size=32, n_step=1, gamma=0.5)
    data = train.guidance(corridor_demonstrations((1.0, 1.25, 0.9), env=env), env, make_config())

    def after(**changes):
        config = make_config(agent=agent, batch=batch, **changes)
        start = train.init(jax.random.key(0), data, env, config)
        return start, jax.jit(lambda state: train.pretrain(state, data, env=env, config=config))(start)

    start, warm = after(bc_warm_start=300)
    assert int(warm.updates) == 300
    chex.assert_trees_all_equal(warm.agent.critics, start.agent.critics)
    act = train.make_policy(warm.agent.actor, data.scale, env, make_config(), stochastic=False)
    action = act(jax.random.key(0), data.demonstrations.observations[:, 0], data.demonstrations.desired_goals)
    np.testing.assert_allclose(action[:, 1], -0.5, atol=0.2)

    td3 = dataclasses.replace(agent, base="td3", max_gradient_norm=1e-3)
    config = make_config(agent=td3, batch=batch, bc_warm_start=300)
    start = train.init(jax.random.key(0), data, env, config)
    warm = jax.jit(lambda state: train.pretrain(state, data, env=env, config=config))(start)
    chex.assert_trees_all_close(warm.agent.target_actor, warm.agent.actor, atol=0.1)  # it has followed
    moved = jax.tree.map(lambda old, new: float(np.abs(old - new).max()), start.agent.target_actor, warm.agent.target_actor)
    assert max(jax.tree.leaves(moved)) > 0.1

    start, trained = after(bc_warm_start=100, pretrain_updates=300)
    assert (int(trained.updates), int(trained.env_steps)) == (400, 0)
    chex.assert_tree_all_finite(trained.agent)
    # The last transition of a demonstration is worth 1, the one before it 0.5, and so on.
    table = data.demonstrations
    for steps_left in (1, 2):
        rows, step = jnp.arange(3), table.lengths - steps_left
        inputs = network_inputs(table.observations[rows, step], table.observations[rows, step, 2:], table.desired_goals, data.scale, agent)
        values = jnp.mean(apply_critics(trained.agent.critics, inputs.T, table.actions[rows, step].T, agent), axis=(0, 1))
        np.testing.assert_allclose(values, 0.5 ** (steps_left - 1), atol=0.2)


@pytest.mark.parametrize("returns", ["n_step", "monte_carlo"])
def test_pretraining_sees_the_returns_that_are_asked_for(data, returns):
    config = make_config(batch=BatchConfig(batch_size=64, n_step=1, demo_returns=returns))
    batch = train._demonstration_batch(jax.random.key(0), data, config)
    assert batch.is_demonstration.all()
    assert set((np.asarray(batch.discount) > 0).tolist()) == ({False} if returns == "monte_carlo" else {False, True})


def test_demonstrations_without_states_cannot_be_begun_in():
    demonstrations = corridor_demonstrations(TWO_SPEEDS).replace(states=None)
    config = make_config(demo_reset_ratio=0.1)
    with pytest.raises(UserError, match=r"demo_reset_ratio = 0\.1 needs the states of the demonstrations"):
        train.guidance(demonstrations, Corridor(), config)
    assert train.guidance(demonstrations, Corridor(), make_config()).starts is None


def test_behavioural_goal_may_be_the_one_of_the_task():
    data = guidance(GoalConfig(behavioural_goals="task"))
    assert goals_of(data.behavioural_goals) == [3.0]
    assert data.demonstrations.desired_goals.tolist() == [[3.0], [3.0]]


def test_last_goals_may_be_excluded():
    assert goals_of(guidance(GoalConfig(exclude_last_goal=True)).goals) == [0.0, 1.0, 2.0, 3.0, 0.0, 2.0]


def test_epsilon_and_filtering_follow_the_config():
    # Distances one step apart: 1, 1, 1, 1, 2, 2. Mean 8 / 6, variance (4 * 1 + 2 * 4) / 6 - (8 / 6)^2 = 2 / 9.
    assert guidance(GoalConfig(m=1)).epsilon[0] == pytest.approx(8 / 6)
    data = guidance(GoalConfig(m=1, k=2.0, epsilon_filtering=True))
    assert data.epsilon[0] == pytest.approx(8 / 6 + 2 * (2 / 9) ** 0.5)  # 2.28
    assert goals_of(data.goals) == [0.0, 3.0, 0.0, 4.0]
    # With m = 0 only equal neighbours are dropped, and not even those under the strict test.
    assert goals_of(guidance(GoalConfig(epsilon_filtering=True)).goals) == [0.0, 1.0, 2.0, 3.0, 4.0, 0.0, 2.0, 4.0]


def test_the_filter_uses_the_goal_test_of_the_batch():
    env = Corridor(horizon=5, width=3.0)
    kept = {}
    for inclusive in (True, False):
        config = make_config(goal=GoalConfig(m=1, epsilon_filtering=True), batch=BatchConfig(inclusive_goal_test=inclusive))
        kept[inclusive] = goals_of(train.guidance(corridor_demonstrations((1.0,), env=env), env, config).goals)
    # Epsilon is 1, the length of each step.
    assert kept == {True: [0.0, 2.0, 4.0], False: [0.0, 1.0, 2.0, 3.0, 4.0]}


def test_demonstrated_actions_may_be_left_in_units_of_the_environment():
    actions = guidance(GoalConfig(rescale_demo_actions=False)).demonstrations.actions
    assert actions[0, :4].tolist() == [[1.0, 0.5]] * 4
    assert actions[1, :2].tolist() == [[2.0, 0.5]] * 2


def test_demonstrated_actions_may_be_paired_with_the_observation_after_them():
    env, given = make_env(), corridor_demonstrations((1.0, 1.25), env=make_env())
    # Actions that tell their step.
    given = given.replace(actions=given.actions.at[..., 1].set(np.arange(HORIZON) / 10.0 * np.ones((2, 1))))
    lived = train.guidance(given, env, make_config(goal=GoalConfig(misalign_demo_actions=True))).demonstrations
    assert lived.lengths.tolist() == [4, 3]
    for row, length in enumerate((4, 3)):
        assert lived.observations[row, : length + 1, 1].tolist() == list(range(1, length + 2))
        np.testing.assert_allclose(lived.actions[row, :length, 1], np.arange(length) / 10.0)
        assert lived.rewards[row, :length].tolist() == [0.0] * (length - 1) + [1.0]


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
        batch=BatchConfig(batch_size=8, n_step=2, bound_by_obtained_return=True),
        agent=AgentConfig(
            net_arch=(8,), num_critics=1, num_quantiles=3, top_quantiles_to_drop_per_net=1, clip_targets=True, input_encoding="standardised"
        ),
    )

    @jax.jit
    def run(key):
        key_init, key_evaluate = jax.random.split(key)
        data = train.guidance(grid_demonstrations(env, 2), env, config)
        state = train.collect(train.init(key_init, data, env, config), data, env=env, config=config, num_iterations=8)
        state, metrics = train.learn(state, data, env=env, config=config, num_iterations=4)
        return state, metrics, train.evaluate(key_evaluate, state.agent.actor, data, env=env, config=config, num_episodes=3)

    state, metrics, evaluation = run(jax.random.key(0))
    chex.assert_tree_all_finite((state.agent, metrics))
    assert (int(state.env_steps), int(state.updates)) == (24, 4)
    assert 0.0 < metrics["critic/target"] <= 1.0
    assert np.all(np.asarray(evaluation.length) <= 8)
    assert state.replay.episodes.observations.shape == (8, 9, env.observation_dim)


def test_with_span_1_the_averaged_actor_is_the_mean_of_all_actors(data):
    agent = dataclasses.replace(make_config().agent, actor_average_rate=1.0, actor_average_span=1.0)
    config, step = make_config(algo="bc", agent=agent), program(train.clone)
    state, actors = train.init(jax.random.key(0), data, make_env(), config), []
    for _ in range(4):
        state, _ = step(state, data, env=make_env(), config=config, num_iterations=1)
        actors.append(state.agent.actor)
    mean = jax.tree.map(lambda *leaves: sum(leaves) / 4, *actors)
    chex.assert_trees_all_close(state.agent.average_actor, mean, atol=1e-6)
    chex.assert_trees_all_close(actors[0], actors[3], atol=0.1)
    assert np.abs(mean["params"]["Dense_0"]["kernel"] - actors[3]["params"]["Dense_0"]["kernel"]).max() > 1e-4


def test_the_agent_begins_anew_once_and_the_replay_stays(data):
    """A reset halfway, at step 51: collecting takes 42 steps, each call of `learn` 9 more and 6 updates."""
    config = make_config(agent_resets=(0.5,))
    run = jax.jit(functools.partial(train.learn, env=make_env(), config=config, num_iterations=LEARN_STEPS))
    steps, states = [], [collected(0, data)]
    for _ in range(3):
        state, _ = run(states[-1], data)
        states.append(state)
        steps.append((int(state.env_steps), int(state.resets), int(state.updates_at_reset), int(state.agent.actor_optimiser.count)))
    # The second call begins at step 51, so its 6 updates are the first ones of the new agent; the third goes on with it.
    assert steps == [(51, 0, 0, 6), (60, 1, 6, 6), (69, 1, 6, 12)]
    assert [int(state.updates) for state in states[1:]] == [6, 12, 18]
    assert (np.asarray(states[3].replay.num_complete) >= np.asarray(states[1].replay.num_complete)).all()
    assert np.asarray(states[3].replay.num_complete).sum() > 0
    # Schedules span the time between resets: at step 60 a sixth of 51 steps or less is over, and the target entropy rises from -1000 to 1000.
    never = make_config()
    before = train._agent_schedule(states[2], never, states[2].updates, make_env())
    after = train._agent_schedule(states[2], config, states[2].updates, make_env())
    np.testing.assert_allclose(before.target_entropy, -1000.0 + 2000.0 * 60 / 102, rtol=1e-6)
    np.testing.assert_allclose(after.target_entropy, -1000.0 + 2000.0 * (60 - 51) / 51, rtol=1e-6)
    np.testing.assert_allclose(after.actor_average_rate, min(config.agent.actor_average_rate, 1.0 / (1.0 + 0.25 * 6)), rtol=1e-6)
    first = train._agent_schedule(states[0], config, states[0].updates, make_env())
    np.testing.assert_allclose(first.target_entropy, -1000.0 + 2000.0 * 42 / 51, rtol=1e-6)
