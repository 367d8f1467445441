"""The batch: how many rows come from where, in which order, and that each is what a plain loop makes of the place that it comes from."""

import dataclasses
import functools
import math

import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import strategies as st
from numbered_replay import (
    BATCH,
    DEMO,
    DEMO_LENGTHS,
    DEMO_STATES,
    HORIZON,
    LENGTHS,
    NUM_ADDS,
    NUM_DEMO,
    NUM_RELABELLED,
    STRATEGIES,
    Numbered,
    NumberedTask,
    at,
    batch_of,
    check_rows,
    demonstrations,
    guidance,
    kept,
    replay_history,
    triples,
)

from hindrl_jax.config import BatchConfig, QuirksConfig, TrainConfig
from hindrl_jax.core.batch import num_demo_rows, rows_of_demonstrations, sample_batch, sample_demonstrations

NUMBERED = Numbered()


@functools.partial(jax.jit, static_argnames=("config", "env"))
def draw_batch(key, replay, config, env_steps=0, env=NUMBERED):
    return sample_batch(key, replay, guidance(), env_steps, env, config)


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_every_row_of_a_batch_comes_from_where_it_should(strategy):
    config = TrainConfig(batch=batch_of(strategy))

    @hypothesis.settings(deadline=None, max_examples=12)
    @hypothesis.given(lengths=LENGTHS, step=st.integers(HORIZON - 1, NUM_ADDS - 1))
    @hypothesis.example(lengths=[[3], [3]], step=11)
    def check(lengths, step):
        history, complete = replay_history(lengths)
        batch = jax.device_get(draw_batch(jax.random.key(step), at(history, step), config))
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(batch))
        # First the demonstrations, then the relabelled rows, then the original ones.
        assert np.asarray(batch.is_demonstration).tolist() == [True] * NUM_DEMO + [False] * (64 - NUM_DEMO)
        in_hindsight = (np.arange(64) >= NUM_DEMO) & (np.arange(64) < NUM_DEMO + NUM_RELABELLED)
        check_rows(batch, in_hindsight, kept(complete[step]), strategy, config)

    check()


REWRITTEN = [(strategy, {}) for strategy in ("final", "future", "episode", "random", "task_conditioned", "joint_union")]
REWRITTEN += [("future", {"bootstrap_past_relabelled_goals": True}), ("random", {"timeouts_are_terminal": True})]


@pytest.mark.parametrize(("strategy", "quirks"), REWRITTEN)
def test_relabelled_observations_are_about_states_of_their_source_in_their_order(strategy, quirks):
    history, complete = replay_history([[3, 2], [1, 3]])
    replay, sources = at(history, 17), kept(complete[17])  # early: episodes have numbers of one digit
    config = TrainConfig(batch=batch_of(strategy), quirks=QuirksConfig(**quirks))
    batch = jax.device_get(draw_batch(jax.random.key(0), replay, config, env=NumberedTask()))
    relabelled = np.flatnonzero(batch.is_relabelled)
    assert relabelled.tolist() == list(range(NUM_DEMO, NUM_DEMO + NUM_RELABELLED))
    assert (np.delete(batch.observation, relabelled, axis=0)[:, 0] <= 9).all()
    for row in relabelled:
        (*first, env), (*second, episode) = ([int(digit) for digit in str(int(value))[1:]] for value in batch.observation[row, :2])
        first, second, t = tuple(first), tuple(second), int(batch.observation[row, 2])
        length = sources[env, episode]
        own = [(env, episode, step) for step in range(length + 1)]
        if strategy in ("final", "future", "episode"):
            assert first in own
            assert second in own
            assert first <= second
            assert strategy != "future" or first[2] > t
        if strategy == "random":
            assert all(sources[other[:2]] >= other[2] for other in (first, second))
        if strategy == "task_conditioned":
            assert {first, second} <= set(DEMO_STATES)
        if strategy == "joint_union":
            assert {first, second} <= set(DEMO_STATES) or (set(own) >= {first, second} and t < first[2] <= second[2])
        # A plain loop over at most two steps, each of which may solve the task.
        expected_reward, expected_discount, following = 0.0, 1.0, t
        for step in range(t, min(t + 2, length)):
            solved = step + 1 >= second[2]
            expected_reward, expected_discount, following = expected_reward + expected_discount * solved, expected_discount * 0.5, step + 1
            if solved or (config.quirks.timeouts_are_terminal and step + 1 == length):
                expected_discount = 0.0
                break
        assert (batch.reward[row], batch.discount[row], batch.next_observation[row, 2]) == (expected_reward, expected_discount, following)
        assert batch.next_observation[row, 0] == batch.observation[row, 0]
        assert batch.desired_goal[row, 0] == -1 - env  # the goal that the episode was acted under
    foreign = (batch.observation[relabelled, 0] // 1000 % 10 == DEMO).mean()
    assert {"task_conditioned": foreign == 1.0, "joint_union": 0.0 < foreign < 1.0}.get(strategy, foreign == 0.0)


def test_union_draws_from_both_sources_and_relabelling_can_be_off():
    history, _ = replay_history([[3], [3]])
    batch = draw_batch(jax.random.key(0), at(history, 20), TrainConfig(batch=batch_of("joint_union")))
    goals = np.asarray(batch.desired_goal)[NUM_DEMO : NUM_DEMO + NUM_RELABELLED, 0]
    assert set(goals.tolist()) == {0.0, 1.0, DEMO}
    # Of 1024 * 3 / 4 = 768 relabelled rows, a quarter has goals of demonstrations: 192, standard deviation 12.
    config = dataclasses.replace(batch_of("joint_union"), batch_size=1024, max_demo_ratio=0.0, union_sampling_ratio=0.25)
    batch = draw_batch(jax.random.key(1), at(history, 20), TrainConfig(batch=config))
    assert int(batch.is_relabelled.sum()) == 768
    assert abs(int((np.asarray(batch.desired_goal)[:, 0] == DEMO).sum()) - 192) < 60
    batch = draw_batch(jax.random.key(0), at(history, 20), TrainConfig(batch=dataclasses.replace(BATCH, relabelled_per_original=0)))
    assert np.all(np.asarray(batch.desired_goal)[:, 0] < 0)


def test_empty_intersections_keep_their_rows():
    # Episodes of 1: state 1 of even episodes is near a demonstrated goal, odd episodes have no intersection.
    history, _ = replay_history([[1], [1]])
    config = dataclasses.replace(BATCH, hindrl_sampling_strategy="joint_intersection", batch_size=512, max_demo_ratio=NUM_DEMO / 512)
    batch = jax.device_get(draw_batch(jax.random.key(0), at(history, 20), TrainConfig(batch=config)))
    odd = batch.observation[:, 1] % 2 == 1
    assert not batch.is_relabelled[odd].any()
    assert batch.is_relabelled.sum() > 100


@pytest.mark.parametrize(
    ("size", "relabelled_per_original", "demo", "relabelled", "original"),
    [
        (4096, 4, 409, 2949, 738),  # the thesis's two batches, with r = 0.1 and n = 4
        (12_000, 4, 1200, 8640, 2160),
        (4096, 0.5, 409, 1229, 2458),  # one relabelled row for two others: 3687 / 3
    ],
)
def test_composition_of_the_batch(size, relabelled_per_original, demo, relabelled, original):
    config = BatchConfig(
        batch_size=size, max_demo_ratio=0.1, relabelled_per_original=relabelled_per_original, hindrl_sampling_strategy="future", n_step=1
    )
    history, _ = replay_history([[3], [2]])
    batch = draw_batch(jax.random.key(0), at(history, 20), TrainConfig(batch=config))
    assert config.max_demo_rows == demo
    assert int(batch.is_demonstration.sum()) == demo
    behavioural = np.asarray(batch.desired_goal)[:, 0] < 0  # demonstrations keep theirs, too
    assert (~behavioural).sum() == relabelled
    assert (behavioural & ~np.asarray(batch.is_demonstration)).sum() == original
    sources, counts = np.unique(np.asarray(batch.observation)[:demo, 1], return_counts=True)
    assert sources.tolist() == [0.0, 1.0, 2.0]
    # Uniform by demonstration, not by step: a third each; five deviations of a binomial.
    assert np.abs(counts - demo / 3).max() < 5 * (demo * 2 / 9) ** 0.5


# Of 0.2 * 64 = 12.8 rows: 12 at the start, floor(12.8 * (1 - 57/100)) = floor(5.504) after 57 of 100 steps, and none from step 100 on.
@pytest.mark.parametrize(("env_steps", "demo_rows"), [(0, 12), (57, 5), (100, 0), (1000, 0)])
def test_demonstration_rows_fade_and_replay_rows_take_their_place(env_steps, demo_rows):
    history, _ = replay_history([[3], [2]])
    config = TrainConfig(batch=dataclasses.replace(BATCH, reach_zero=100))
    batch = draw_batch(jax.random.key(0), at(history, 20), config, jnp.asarray(env_steps))
    assert np.asarray(batch.is_demonstration).tolist() == [True] * demo_rows + [False] * (64 - demo_rows)
    assert ((np.asarray(batch.observation)[:, 0] == DEMO) == np.asarray(batch.is_demonstration)).all()
    goals = np.asarray(batch.desired_goal)[:, 0]
    assert (goals == DEMO).sum() == (64 - demo_rows) * 3 // 4  # task-conditioned


@pytest.mark.parametrize(
    ("env_steps", "rows"),
    [(0, 409), (1, 409), (250, 307), (500, 204), (999, 0), (1000, 0), (5000, 0)],  # floor(409.6 (1 - steps / 1000)); eq. 4.9
)
def test_share_of_demonstrations_by_hand(env_steps, rows):
    config = BatchConfig(batch_size=4096, max_demo_ratio=0.1, reach_zero=1000)
    assert int(num_demo_rows(jnp.asarray(env_steps), config)) == rows
    assert int(num_demo_rows(jnp.asarray(env_steps), dataclasses.replace(config, reach_zero=None))) == 409


@hypothesis.settings(deadline=None, max_examples=50)
@hypothesis.given(size=st.integers(2, 5000), percent=st.integers(0, 50))
def test_decay_starts_with_the_full_number_of_rows(size, percent):
    config = BatchConfig(batch_size=size, max_demo_ratio=percent / 100, reach_zero=10)
    assert int(num_demo_rows(np.int32(0), config)) == config.max_demo_rows == math.floor(percent / 100 * size)


def test_last_row_of_a_solved_demonstration_is_worth_one_and_ends():
    rewards = np.zeros((3, HORIZON), np.float32)
    for i, length in enumerate(DEMO_LENGTHS):
        rewards[i, length - 1] = 1.0
    table = demonstrations().replace(rewards=jnp.asarray(rewards), terminated=jnp.ones(3, bool))
    rows, steps = zip(*[(i, t) for i, length in enumerate(DEMO_LENGTHS) for t in range(length)], strict=True)
    config = TrainConfig(batch=BatchConfig(gamma=0.5, n_step=1))
    batch = rows_of_demonstrations(table, jnp.array(rows), jnp.array(steps), NUMBERED, config)
    assert batch.reward.tolist() == [0, 0, 1, 1, 0, 1]
    assert batch.discount.tolist() == [0.5, 0.5, 0, 0, 0.5, 0]
    assert batch.is_demonstration.all()
    assert not batch.is_relabelled.any()


def test_a_batch_of_demonstrations_alone():
    config = TrainConfig(batch=dataclasses.replace(BATCH, batch_size=600, max_demo_ratio=0.0))
    batch = jax.device_get(jax.jit(lambda key: sample_demonstrations(key, demonstrations(), NUMBERED, config))(jax.random.key(0)))
    assert batch.is_demonstration.tolist() == [True] * 600
    check_rows(batch, np.zeros(600, bool), {}, "task_conditioned", config)
    assert set(triples(batch.observation)) == {state for state in DEMO_STATES if state[2] < DEMO_LENGTHS[state[1]]}
    # Uniform by demonstration, then by step: 200 each, deviation 12.
    assert np.abs(np.bincount(batch.observation[:, 1].astype(int)) - 200).max() < 60
