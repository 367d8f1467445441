"""Priorities by hand: what is drawn how often, what new, drawn and overwritten transitions get, and what corrects for it. Then batches that are drawn
by them, against plain loops, and whole training."""

import dataclasses
import functools

import chex
import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from corridor_training import COLLECT_STEPS, HORIZON, LEARN_STEPS, NUM_ENVS, make_config, make_data, make_env
from hypothesis import strategies as st
from numbered_replay import (
    BATCH,
    DEMO,
    DEMO_LENGTHS,
    LENGTHS,
    NUM_ADDS,
    STRATEGIES,
    Numbered,
    NumberedTask,
    at,
    batch_of,
    check_rows,
    demonstrations,
    empty_replay,
    guidance,
    kept,
    replay_history,
    triples,
)
from numbered_replay import HORIZON as NUMBERED_HORIZON

from hindrl_jax.base.types import Episodes
from hindrl_jax.config import BatchConfig, GoalConfig, PriorityConfig, TrainConfig
from hindrl_jax.core import replay as replays
from hindrl_jax.core import train
from hindrl_jax.training import prioritised
from hindrl_jax.training.prioritised import Drawn, Priorities, importance_weights, prioritised_sampler, sample_batch, sampler_for

CONFIG = PriorityConfig(priority_exponent=0.5, importance_exponent=0.5, demo_priority_bonus=3.0)
LEAST = 1e-3  # is added to every error
draw = functools.partial(jax.jit, static_argnums=2)(prioritised.draw)


def table_of(demonstrations, replay, largest=1.0):
    return Priorities(demonstrations=jnp.array(demonstrations), replay=jnp.array(replay), largest=jnp.asarray(largest))


def drawn_from(*places):
    """Rows of a batch from (whether demonstrated, row, step, priority)."""
    flags, rows, steps, priority = zip(*places, strict=True)
    return Drawn(is_demonstration=jnp.array(flags), rows=jnp.array(rows), steps=jnp.array(steps), priority=jnp.array(priority))


def replay_at(*, slots, steps):
    """A replay of environments with two slots of three steps each, of which each is writing one, and has written that many steps."""
    replay = replays.init(Numbered(), num_envs=len(slots), capacity=len(slots) * 2 * 3)
    return replay.replace(slot=jnp.array(slots), step=jnp.array(steps))


def test_transitions_are_drawn_in_proportion_to_their_priorities():
    demonstrations = [[1.0, 2.0], [3.0, 0.0], [0.0, 0.0]]
    replay = [[0.0, 0.0, 0.0, 0.0], [0.5, 0.5, 8.0, 0.0], [0.0, 0.0, 0.0, 0.0], [1.0, 0.0, 4.0, 0.0]]
    num, total = 40_000, 20.0
    drawn = jax.device_get(draw(jax.random.key(0), table_of(demonstrations, replay), num))
    for is_demonstration, table in ((True, demonstrations), (False, replay)):
        table, chosen = np.array(table), drawn.is_demonstration == is_demonstration
        counts = np.zeros(table.shape)
        np.add.at(counts, (drawn.rows[chosen], drawn.steps[chosen]), 1)
        assert not counts[table == 0.0].any()
        share = table / total
        assert (np.abs(counts - num * share) <= 5.0 * np.sqrt(num * share * (1.0 - share))).all()
        np.testing.assert_array_equal(drawn.priority[chosen], table[drawn.rows[chosen], drawn.steps[chosen]])


def test_a_large_table_is_drawn_evenly_and_without_padding():
    # A million transitions of equal priority; every second episode is empty, the others are padded after three quarters.
    replay = np.zeros((20_000, 100), np.float32)
    replay[::2, :75] = 0.3
    drawn = jax.device_get(draw(jax.random.key(1), table_of([[0.0]], replay), 100_000))
    assert not drawn.is_demonstration.any()
    assert (drawn.rows % 2 == 0).all()
    assert drawn.steps.max() == 74
    for values, bins in ((drawn.rows // 2000, 10), (drawn.steps, 75)):
        counts, mean = np.bincount(values, minlength=bins), 100_000 / bins
        assert np.abs(counts - mean).max() < 5.0 * np.sqrt(mean)


@pytest.mark.parametrize("seed", range(3))
def test_what_has_weight_0_is_not_drawn_however_sums_are_rounded(seed):
    # 30,001 weights over many orders of magnitude, half of them 0.
    rng = np.random.default_rng(seed)
    weights = np.where(rng.uniform(size=30_001) < 0.5, 0.0, rng.lognormal(sigma=2.0, size=30_001)).astype(np.float32)
    drawn = np.asarray(jax.jit(prioritised._draw_row, static_argnums=2)(jax.random.key(seed), weights, 500_000))
    assert weights[drawn].all()
    share = weights.astype(np.float64) / weights.sum(dtype=np.float64)
    # The distribution function at every hundredth place, in deviations.
    counted, expected = (np.cumsum(values)[::100] for values in (np.bincount(drawn, minlength=30_001) / 500_000, share))
    assert (np.abs(counted - expected) <= 5.0 * np.sqrt(np.maximum(expected * (1.0 - expected), 0.0) / 500_000) + 1e-6).all()


def test_demonstrations_begin_with_priority_1_and_the_bonus():
    demonstrations = Episodes(
        observations=jnp.zeros((3, 4, 1)),
        actions=jnp.zeros((3, 3, 1)),
        rewards=jnp.zeros((3, 3)),
        lengths=jnp.array([3, 1, 2]),
        terminated=jnp.ones(3, bool),
        desired_goals=jnp.zeros((3, 1)),
    )
    found = prioritised.init(demonstrations, demonstrations.replace(rewards=jnp.ones((7, 5))), CONFIG)
    assert found.demonstrations.tolist() == [[2.0, 2.0, 2.0], [2.0, 0.0, 0.0], [2.0, 2.0, 0.0]]  # (1 + 3)^0.5
    assert found.replay.tolist() == [[0.0] * 5] * 7
    assert found.largest == 1.0


def test_ended_episodes_get_the_largest_priority_and_what_is_written_to_has_none():
    # Three environments with two slots each, and traces of earlier episodes. The first has just ended an episode of 2 steps in slot 0 and goes on
    # in slot 1, the second an episode of 3 in slot 1 and begins again, the third is underway in slot 1.
    old = [[5.0, 5.0, 5.0]] * 6
    before = replay_at(slots=[0, 1, 1], steps=[1, 2, 1])
    after = replay_at(slots=[1, 0, 1], steps=[0, 0, 2])
    found = prioritised.add(table_of([[1.0]], old, largest=7.0), before, after)
    assert found.replay.tolist() == [[7.0, 7.0, 0.0], [0.0] * 3, [0.0] * 3, [7.0, 7.0, 7.0], [5.0] * 3, [0.0] * 3]
    assert (found.demonstrations.tolist(), found.largest) == ([[1.0]], 7.0)


def test_errors_become_the_priorities_of_what_was_drawn():
    # Row 1 of the replay is drawn twice at step 2, with errors 1 and 4. Exponent 1/2; demonstrations have a bonus of 3.
    before = table_of([[9.0, 9.0], [9.0, 0.0]], [[9.0, 9.0, 9.0], [9.0, 9.0, 9.0]])
    drawn = drawn_from((False, 1, 2, 9.0), (False, 1, 2, 9.0), (True, 1, 0, 9.0), (False, 0, 0, 9.0), (True, 0, 1, 9.0))
    errors = jnp.array([4.0, 1.0, 13.0, 0.0, 0.25])
    found = prioritised.assign(before, drawn, errors, CONFIG)
    np.testing.assert_allclose(found.replay, [[LEAST**0.5, 9.0, 9.0], [9.0, 9.0, (4.0 + LEAST) ** 0.5]], rtol=1e-6)
    np.testing.assert_allclose(found.demonstrations, [[9.0, (3.25 + LEAST) ** 0.5], [(16.0 + LEAST) ** 0.5, 0.0]], rtol=1e-6)
    np.testing.assert_allclose(found.largest, (13.0 + LEAST) ** 0.5, rtol=1e-6)  # of all errors, without the bonus
    # In two batches, the same; and what was the largest remains it.
    two = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), (drawn, errors))
    jax.tree.map(np.testing.assert_array_equal, prioritised.assign(before, *two, CONFIG), found)
    assert prioritised.assign(before.replace(largest=jnp.asarray(8.0)), drawn, errors, CONFIG).largest == 8.0


def test_importance_weights_by_hand():
    drawn = drawn_from((False, 0, 0, 1.0), (True, 0, 0, 16.0), (False, 1, 1, 4.0))
    assert importance_weights(drawn, CONFIG).tolist() == [1.0, 0.25, 0.5]
    # The definition, for a table of 10 transitions whose priorities add up to 50: (1 / (10 P))^0.5, over the largest.
    weights = (10.0 * np.array([1.0, 16.0, 4.0]) / 50.0) ** -0.5
    np.testing.assert_allclose(importance_weights(drawn, CONFIG), weights / weights.max(), rtol=1e-6)


PRIORITISED = TrainConfig(batch=BATCH, priority=CONFIG)
NUMBERED = Numbered()


@jax.jit
def priorities_along(history):
    """The priorities after each step of a replay's history: leaves (NUM_ADDS, ...)."""
    empty = empty_replay()

    def add(carry, replay):
        before, priorities = carry
        priorities = prioritised.add(priorities, before, replay)
        return (replay, priorities), priorities

    return jax.lax.scan(add, (empty, prioritised.init(demonstrations(), empty.episodes, CONFIG)), history)[1]


def history_with_priorities(lengths):
    """As `replay_history`, and the priorities after each step."""
    history, complete = replay_history(lengths)
    return history, priorities_along(history), complete


def at_random(priorities, seed):
    """Other priorities wherever there are any, on the host."""
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda table: np.where(table > 0.0, rng.uniform(0.5, 2.0, table.shape), 0.0).astype(np.float32), priorities)


@functools.partial(jax.jit, static_argnames=("config", "env"))
def draw_batch(key, replay, priorities, config, env=NUMBERED):
    zero = jnp.asarray(0)
    counts = dict(env_steps=zero, updates=zero, resets=zero, updates_at_reset=zero)
    state = train.TrainState(agent=None, replay=replay, rollout=None, sampler=priorities, key=key, **counts)
    return sample_batch(key, state, guidance(), env, config)


@hypothesis.settings(deadline=None, max_examples=20)
@hypothesis.given(lengths=LENGTHS, step=st.integers(0, NUM_ADDS - 1))
@hypothesis.example(lengths=[[3], [3]], step=1)  # nothing is complete
@hypothesis.example(lengths=[[3], [3]], step=2)
@hypothesis.example(lengths=[[3], [3]], step=10)
@hypothesis.example(lengths=[[3], [3]], step=11)
@hypothesis.example(lengths=[[3], [3]], step=12)
def test_exactly_the_transitions_of_complete_episodes_have_priorities(lengths, step):
    history, priorities, complete = history_with_priorities(lengths)
    observations, priorities = at(history, step).episodes.observations, at(priorities, step)
    expected = {(*source, t): 1.0 for source, length in kept(complete[step]).items() for t in range(length)}
    places = np.argwhere(priorities.replay > 0.0)
    assert {tuple(map(int, observations[row, t])): priorities.replay[row, t] for row, t in places} == expected
    assert len(places) == len(expected)
    # (1 + 3)^0.5
    assert priorities.demonstrations.tolist() == [[2.0 * (t < length) for t in range(NUMBERED_HORIZON)] for length in DEMO_LENGTHS]


@pytest.mark.parametrize("step", [2, 8, 10, 11, 12, 23, NUM_ADDS - 1])  # as above: nearly empty, full, and being written again
def test_transitions_are_drawn_by_their_priorities_wherever_the_rings_stand(step):
    history, priorities, complete = history_with_priorities([[3], [3, 1, 2]])
    replay, priorities, sources = at(history, step), at_random(at(priorities, step), step), kept(complete[step])
    batch_config = dataclasses.replace(BATCH, relabelled_per_original=0, batch_size=8192)
    batch = jax.device_get(draw_batch(jax.random.key(step), replay, priorities, dataclasses.replace(PRIORITISED, batch=batch_config))[0])
    total = priorities.demonstrations.sum() + priorities.replay.sum()
    expected = {(DEMO, *map(int, place)): priorities.demonstrations[*place] / total for place in np.argwhere(priorities.demonstrations)}
    for row, t in np.argwhere(priorities.replay):
        expected[tuple(map(int, replay.episodes.observations[row, t]))] = priorities.replay[row, t] / total
    assert len(expected) == sum(DEMO_LENGTHS) + sum(sources.values())
    states, counts = np.unique(triples(batch.observation), axis=0, return_counts=True)
    counted = {tuple(map(int, state)): count for state, count in zip(states, counts, strict=True)}
    assert set(counted) <= set(expected)
    for state, share in expected.items():
        assert abs(counted.get(state, 0) - 8192 * share) < 5.0 * (8192 * share * (1.0 - share)) ** 0.5
    # The weights are those of the probabilities: (1 / P)^0.5 over the largest of the batch.
    weights = np.array([expected[state] for state in triples(batch.observation)]) ** -0.5
    np.testing.assert_allclose(batch.weight, weights / weights.max(), rtol=1e-5)


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_every_row_of_a_prioritised_batch_comes_from_where_it_says(strategy):
    config = dataclasses.replace(PRIORITISED, batch=batch_of(strategy))
    history, all_priorities, complete = history_with_priorities([[3, 2], [1, 3]])
    for step in (2, 11, 12, NUM_ADDS - 1):
        replay, priorities = at(history, step), at_random(at(all_priorities, step), step)
        batch, drawn = jax.device_get(draw_batch(jax.random.key(step), replay, priorities, config))
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(batch))
        assert batch.is_demonstration.tolist() == drawn.is_demonstration.tolist()
        assert 0 < batch.is_demonstration.sum() < 64
        replayed = np.flatnonzero(~batch.is_demonstration)
        in_hindsight = np.isin(np.arange(64), replayed[: len(replayed) * 3 // 4])
        check_rows(batch, in_hindsight, kept(complete[step]), strategy, config)
        tables = (replay.episodes, priorities.replay), (jax.device_get(demonstrations()), priorities.demonstrations)
        for row, (state, is_demonstration) in enumerate(zip(triples(batch.observation), batch.is_demonstration, strict=True)):
            episodes, table = tables[int(is_demonstration)]
            place = drawn.rows[row], drawn.steps[row]
            assert tuple(map(int, episodes.observations[*place])) == state
            assert table[*place] == drawn.priority[row]


def test_a_prioritised_batch_relabels_the_observations_of_the_first_of_its_replayed_rows():
    history, priorities, _ = history_with_priorities([[3, 2], [1, 3]])
    config = dataclasses.replace(PRIORITISED, batch=batch_of("future"))
    batch, _ = jax.device_get(draw_batch(jax.random.key(0), at(history, 17), at_random(at(priorities, 17), 0), config, env=NumberedTask()))
    replayed = np.flatnonzero(~batch.is_demonstration)
    relabelled = replayed[: len(replayed) * 3 // 4]
    assert 0 < len(relabelled) < len(replayed) < 64
    assert np.flatnonzero(batch.is_relabelled).tolist() == relabelled.tolist()
    assert np.flatnonzero(batch.observation[:, 0] > 9).tolist() == relabelled.tolist()  # where two states were written


def test_the_config_says_how_batches_are_drawn():
    env, data, replay = NUMBERED, guidance(), empty_replay()
    assert sampler_for(env, TrainConfig()).init(data, replay) == ()
    chex.assert_trees_all_equal(sampler_for(env, PRIORITISED).init(data, replay), prioritised.init(demonstrations(), replay.episodes, CONFIG))


def test_prioritised_training_over_two_seeds():
    """With everything else that a batch can have. The priorities are finite, where they should be, no longer those of the start, and in place."""
    env, goal = make_env(), GoalConfig(epsilon_steps=1, epsilon_deviations=1.0)
    agent = dataclasses.replace(make_config().agent, num_critics=3, num_target_critics=2, clip_targets=True)
    batch = BatchConfig(batch_size=16, n_step=2, hindrl_sampling_strategy="joint_intersection")
    config = make_config(batch=batch, goal=goal, agent=agent, priority=PriorityConfig(priority_exponent=0.5, demo_priority_bonus=3.0))
    data, sampler = make_data(config), prioritised_sampler(env, config)

    @jax.jit
    @jax.vmap
    def start(seed):
        state = train.init(jax.random.key(seed), data, env, config, sampler=sampler)
        return train.collect(state, data, env=env, config=config, num_iterations=COLLECT_STEPS, sampler=sampler)

    before = start(jnp.arange(2))
    former = jax.device_get(before.sampler)
    learn = jax.vmap(functools.partial(train.learn, guidance=data, env=env, config=config, num_iterations=LEARN_STEPS, sampler=sampler))
    learn = jax.jit(learn, donate_argnums=0).lower(before).compile()
    state, metrics = learn(before)
    chex.assert_tree_all_finite((state.agent, metrics, state.sampler))

    for seed in range(2):
        replay, priorities = jax.tree.map(lambda leaf, seed=seed: np.asarray(leaf[seed]), (state.replay, state.sampler))
        lengths, slots = replay.episodes.lengths, len(replay.episodes.lengths) // NUM_ENVS
        complete = np.where(np.isin(np.arange(len(lengths)), np.arange(NUM_ENVS) * slots + replay.slot), 0, lengths)
        np.testing.assert_array_equal(priorities.replay > 0.0, np.arange(HORIZON)[None] < complete[:, None])
        np.testing.assert_array_equal(priorities.demonstrations > 0.0, former.demonstrations[seed] > 0.0)
        renewed = (priorities.replay > 0.0) & (priorities.replay != 1.0)
        demonstrated = priorities.demonstrations != former.demonstrations[seed]
        assert renewed.sum() > 10
        assert demonstrated.sum() > 5
        # Targets lie in [0, 1], as do hardly any errors by then. Demonstrations: at most 3 more; (1 + 3)^0.5 was their first priority.
        assert priorities.demonstrations[demonstrated].min() > (3.0 + 1e-3) ** 0.5 - 1e-6
        assert np.median(priorities.replay[renewed]) < 1.0
        assert priorities.largest >= max(1.0, priorities.replay.max())  # which may have fallen since
    # 14 demonstrated transitions of priority 2 and some 30 of priority 1 or less.
    assert (metrics["batch/demonstrations"] > 0.2).all()

    shape = f"f32[2,{','.join(map(str, former.replay.shape[1:]))}]"
    text = learn.as_text()
    assert f"= {shape}" in text
    assert [line for line in text.splitlines() if f"= {shape}" in line and " copy" in line.split(shape, 1)[1].split("(", 1)[0]] == []
    assert learn.memory_analysis().temp_size_in_bytes < former.replay.nbytes


def test_drawn_transitions_get_the_errors_of_their_own_rows():
    # Critics say 2 everywhere, their targets 1: the error is |2 - (reward + discount)|. The bonus of demonstrations is 3, the exponent 1/2.
    env = make_env()
    batch = BatchConfig(batch_size=16, n_step=4, gamma=0.5, hindrl_sampling_strategy="final")
    config = make_config(batch=batch, goal=GoalConfig(), priority=CONFIG)
    data, sampler = make_data(config), prioritised_sampler(env, config)

    def constant(critics, value):
        last = critics["params"]["Dense_1"]
        last = {"kernel": jnp.zeros_like(last["kernel"]), "bias": jnp.full_like(last["bias"], value)}
        return {"params": {**critics["params"], "Dense_1": last}}

    @jax.jit
    def run(key):
        key_init, key_draw = jax.random.split(key)
        state = train.init(key_init, data, env, config, sampler=sampler)
        state = train.collect(state, data, env=env, config=config, num_iterations=20, sampler=sampler)
        critics = dict(critics=constant(state.agent.critics, 2.0), target_critics=constant(state.agent.target_critics, 1.0))
        state = state.replace(agent=state.agent.replace(**critics, log_alpha=jnp.asarray(-30.0)))
        batches, (drawn, key_errors) = sampler.draw(key_draw, state, data)
        return state.sampler, batches, drawn, sampler.learned(state, batches, (drawn, key_errors))

    before, batches, drawn, after = jax.device_get(run(jax.random.key(0)))
    assert batches.reward.shape == (2, 16)
    errors = np.abs(2.0 - batches.reward - batches.discount) + 1e-3
    for is_demonstration, name, bonus in ((True, "demonstrations", 3.0), (False, "replay", 0.0)):
        expected = np.array(getattr(before, name))
        rows = np.argwhere(drawn.is_demonstration == is_demonstration)
        places = {}
        for row in map(tuple, rows):
            places.setdefault((drawn.rows[row], drawn.steps[row]), []).append((errors[row] + bonus) ** 0.5)
        for place, found in places.items():
            expected[place] = max(found)
        assert len(places) > 5
        np.testing.assert_allclose(getattr(after, name), expected, rtol=1e-5)
    assert len(set(errors.ravel().round(3).tolist())) > 3
