"""Priorities by hand: what is drawn how often, what new, drawn and overwritten transitions get, and what corrects for it."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hindrl_jax.base.types import Episodes
from hindrl_jax.config import BatchConfig
from hindrl_jax.core import priorities as prioritised
from hindrl_jax.core.priorities import Drawn, Priorities, importance_weights

CONFIG = BatchConfig(priority_exponent=0.5, importance_exponent=0.5, demo_priority_bonus=3.0)
LEAST = 1e-3  # is added to every error
draw = functools.partial(jax.jit, static_argnums=2)(prioritised.draw)


def table_of(demonstrations, replay, largest=1.0):
    return Priorities(demonstrations=jnp.array(demonstrations), replay=jnp.array(replay), largest=jnp.asarray(largest))


def drawn_from(*places):
    """Rows of a batch from (whether demonstrated, row, step, priority)."""
    flags, rows, steps, priority = zip(*places, strict=True)
    return Drawn(is_demonstration=jnp.array(flags), rows=jnp.array(rows), steps=jnp.array(steps), priority=jnp.array(priority))


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
    found = prioritised.add(table_of([[1.0]], old, largest=7.0), jnp.array([0, 3, 5]), jnp.array([2, 3, 2]), jnp.array([1, 2, 5]))
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
