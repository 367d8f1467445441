"""Hindsight steps and goals: exactly the promised support, drawn uniformly."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numbered_replay import DEMO_STATES, STRATEGIES, TABLE, allowed_goals, at, batch_of, kept, replay_history, triples

from hindrl_jax.core.hindsight import choose_sources, goal_source, hindsight_steps, intersection_steps

DRAWS = 400  # per transition; a state of an episode of 5 is missed by all of them with probability (5/6)^400 < 1e-31


def support_twin(step, length, source):
    """The states that may become the goal of transition `step`, as a plain loop."""
    states = []
    for state in range(length + 1):
        future = state > step
        if source == "episode" or (source == "future" and future) or (source == "final" and state == length):
            states.append(state)
    return states


@pytest.mark.parametrize("source", ["final", "future", "episode"])
def test_support_of_hindsight_steps(source):
    cases = [(t, length) for length in range(1, 6) for t in range(length)]
    steps, lengths = (jnp.repeat(jnp.array(column), DRAWS) for column in zip(*cases, strict=True))
    drawn = np.asarray(hindsight_steps(jax.random.key(1), steps, lengths, source=source)).reshape(len(cases), DRAWS)
    for (t, length), row in zip(cases, drawn, strict=True):
        assert sorted(set(row.tolist())) == support_twin(t, length, source), (t, length)


def test_future_steps_are_uniform():
    # States 2 .. 5 of an episode of 5: 4000 draws, 1000 each, standard deviation 27.
    drawn = np.asarray(hindsight_steps(jax.random.key(2), jnp.full(4000, 1), jnp.full(4000, 5), source="future"))
    counts = np.bincount(drawn, minlength=6)
    assert counts[:2].tolist() == [0, 0]
    assert np.abs(counts[2:] - 1000).max() < 140


def test_a_source_that_is_not_the_episode_has_no_steps():
    with pytest.raises(ValueError, match="random"):
        hindsight_steps(jax.random.key(0), jnp.zeros(1, jnp.int32), jnp.ones(1, jnp.int32), source="random")


def test_intersection_steps_are_the_later_states_near_a_demonstration():
    # Transitions 0 .. 4 lead to states 1 .. 5, of which 2, 3 and 5 are near. The episode has 4 transitions, so that state 5 is padding, and what
    # lies ahead of transition t is:
    is_near = np.array([False, True, True, False, True])
    ahead = {0: {2, 3}, 1: {2, 3}, 2: {3}, 3: set()}
    steps = jnp.repeat(jnp.arange(4), DRAWS)
    lengths, flags = jnp.full_like(steps, 4), jnp.broadcast_to(is_near[None], (4 * DRAWS, 5))
    drawn, found = (np.asarray(array).reshape(4, DRAWS) for array in intersection_steps(jax.random.key(3), steps, lengths, flags))
    for t, expected in ahead.items():
        assert set(found[t].tolist()) == {bool(expected)}
        assert set(drawn[t].tolist()) == (expected or {1})
    # Transition 0 draws 2 or 3 with equal chances: 400 draws, standard deviation 10.
    assert abs((drawn[0] == 2).sum() - 200) < 50


def test_sources_are_drawn_by_their_weights():
    # Weights 1 : 4 : 3 in 4000 draws: 500, 2000 and 1500; standard deviations of at most 32.
    counts = np.bincount(np.asarray(choose_sources(jax.random.key(4), 4000, (1.0, 4.0, 3.0))))
    assert np.abs(counts - [500, 2000, 1500]).max() < 160
    assert np.bincount(np.asarray(choose_sources(jax.random.key(5), 50, (0.2,)))).tolist() == [50]
    # A weight of zero, as joint_union may have, is never drawn.
    assert set(np.asarray(choose_sources(jax.random.key(6), 4000, (0.0, 1.0))).tolist()) == {1}
    assert set(np.asarray(choose_sources(jax.random.key(7), 4000, (1.0, 0.0))).tolist()) == {0}


@functools.partial(jax.jit, static_argnames=("config", "states_per_row"))
def draw_states(key, replay, rows, steps, config, states_per_row=None):
    if states_per_row:
        rows, steps = (jnp.broadcast_to(index[:, None], (index.shape[0], states_per_row)) for index in (rows, steps))
    return goal_source(TABLE, config)(key, replay, rows, steps)


def transitions_of(replay, complete):
    """(row, step, state, length) of each transition that may be drawn."""
    sources = kept(complete)
    for row, first in enumerate(triples(replay.episodes.observations[:, 0])):
        if first[:2] in sources and replay.episodes.lengths[row]:
            yield from ((row, t, (*first[:2], t), sources[first[:2]]) for t in range(sources[first[:2]]))


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_a_source_draws_every_state_that_it_may_and_no_other(strategy):
    history, complete = replay_history([[3, 2], [1, 3]])
    replay, sources = at(history, 17), kept(complete[17])
    places = list(transitions_of(replay, complete[17]))
    assert len(places) == sum(sources.values())
    # The least likely of at most 17 states has 1/6 * 1/2 / 8; 1500 draws miss it with probability (1 - 1/96)^1500 < 2e-7.
    rows, steps = (np.repeat([place[part] for place in places], 1500) for part in (0, 1))
    observations, found = (np.asarray(drawn) for drawn in draw_states(jax.random.key(0), replay, rows, steps, batch_of(strategy)))
    observations, found = observations.reshape(len(places), 1500, 3), found.reshape(len(places), 1500)
    for (_, _, state, length), drawn, was_found in zip(places, observations, found, strict=True):
        allowed = allowed_goals(strategy, state, length, sources)
        assert set(triples(drawn[was_found])) == allowed
        assert set(was_found.tolist()) == {bool(allowed)}  # an intersection may be empty


@pytest.mark.parametrize("strategy", ["final", "future", "episode", "random", "task_conditioned", "joint_union"])
def test_several_states_of_one_row_are_in_order_of_time_where_they_are_its_own(strategy):
    history, complete = replay_history([[3, 2], [1, 3]])
    replay, sources = at(history, 17), kept(complete[17])
    places = list(transitions_of(replay, complete[17]))
    rows, steps = (np.repeat([place[part] for place in places], 200) for part in (0, 1))
    observations, found = (np.asarray(drawn) for drawn in draw_states(jax.random.key(1), replay, rows, steps, batch_of(strategy), states_per_row=3))
    assert observations.shape == (len(rows), 3, 3)
    assert found.all()
    unordered = 0
    for index, drawn in enumerate(map(triples, observations)):
        _, _, state, length = places[index // 200]
        assert set(drawn) <= allowed_goals(strategy, state, length, sources)
        if strategy == "joint_union":  # all states of a row come from one source
            assert set(drawn) <= set(DEMO_STATES) or not set(drawn) & set(DEMO_STATES)
        unordered += drawn != sorted(drawn)
        assert drawn == sorted(drawn) or strategy in ("random", "task_conditioned") or set(drawn) <= set(DEMO_STATES)
    assert (unordered > 0) == (strategy in ("random", "task_conditioned", "joint_union"))
