"""The reverse curriculum, worked by hand."""

import jax
import jax.numpy as jnp
import numpy as np

from hindrl_jax.core import curriculum
from hindrl_jax.core.curriculum import Curriculum, Origin

LENGTHS = jnp.array([10, 5, 20])


def now(*first_steps_and_successes):
    first_step, successes = zip(*first_steps_and_successes, strict=True)
    return Curriculum(first_step=jnp.array(first_step), successes=jnp.array(successes))


def after(before, *episodes):
    """Episodes are (demo, step, ended, success), over in the same moment."""
    demo, step, ended, success = zip(*episodes, strict=True)
    found = curriculum.record(before, Origin(demo=jnp.array(demo), step=jnp.array(step)), jnp.array(ended), jnp.array(success))
    return list(zip(found.first_step.tolist(), found.successes.tolist(), strict=True))


def test_it_begins_at_the_last_step():
    begun = curriculum.init(LENGTHS)
    assert (begun.first_step.tolist(), begun.successes.tolist()) == ([9, 4, 19], [0, 0, 0])


def test_three_successes_in_a_row_move_it_four_steps_back():
    before = now((9, 2), (4, 0), (19, 1))
    assert after(before, (0, 9, True, True)) == [(5, 0), (4, 0), (19, 1)]
    assert after(before, (2, 19, True, True)) == [(9, 2), (4, 0), (19, 2)]
    assert after(before, (0, 9, True, False)) == [(9, 0), (4, 0), (19, 1)]
    assert after(now((2, 2)), (0, 2, True, True)) == [(0, 0)]  # not before the beginning
    assert after(now((0, 2)), (0, 0, True, True)) == [(0, 0)]


def test_only_episodes_that_began_at_the_first_step_and_are_over_count():
    before = now((9, 2), (4, 2), (19, 2))
    nothing = [(9, 2), (4, 2), (19, 2)]
    assert after(before, (0, 9, False, True), (1, 3, True, True), (2, 18, True, False), (-1, 9, True, True), (-1, 9, True, False)) == nothing


def test_episodes_that_end_together_count_in_their_order():
    before = now((9, 1), (4, 0), (19, 2))
    # Of the first: success, failure, success leave one in a row. Of the second: three successes. Of the third: one, which moves it.
    episodes = [(0, 9, True), (1, 4, True), (0, 9, False), (1, 4, True), (2, 19, True), (0, 9, True), (1, 4, True)]
    assert after(before, *[(demo, step, True, success) for demo, step, success in episodes]) == [(9, 1), (0, 0), (15, 0)]


def test_where_episodes_begin():
    drawn = jax.jit(curriculum.sample, static_argnums=3)(jax.random.key(0), now((6, 0), (4, 0), (0, 0)), LENGTHS, 8000)
    rows, counts = np.unique(np.stack([drawn.demo, drawn.step], axis=1), axis=0, return_counts=True)
    # Ahead are 6 / 10, 4 / 5 and nothing: 3 / 7, 4 / 7 and a millionth. Of the first 0.5, 0.25, 0.125 and, cut off at step 9, twice 0.0625 begin at
    # 6, 7, 8 and 9; of the second, of which 4 is the last step, all at 4.
    assert rows.tolist() == [[0, 6], [0, 7], [0, 8], [0, 9], [1, 4]]
    share = np.array([3 / 14, 3 / 28, 3 / 56, 3 / 56, 4 / 7])
    assert np.all(np.abs(counts - 8000 * share) < 5 * np.sqrt(8000 * share * (1 - share)))


def test_all_demonstrations_are_drawn_alike_where_all_are_done():
    drawn = curriculum.sample(jax.random.key(0), now((0, 0), (0, 0), (0, 0)), LENGTHS, 3000)
    assert np.abs(np.bincount(drawn.demo) - 1000).max() < 5 * np.sqrt(1000)
