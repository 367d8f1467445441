"""Replay: every stored number says which environment, episode and step it belongs to, so that a sample says where it came from.

States are (environment, episode, step). Demonstrations take the place of environment 9. The achieved goal is the state itself, and the
behavioural goal of an episode is (-1 - environment, episode, 0), which no state equals.
"""

import dataclasses
import functools
import math

import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import strategies as st

from hindrl_jax.base.types import Episodes
from hindrl_jax.config import BatchConfig
from hindrl_jax.core import priorities as prioritised
from hindrl_jax.core import replay as replays
from hindrl_jax.core.goals import GoalTable
from hindrl_jax.core.replay import (
    demonstration_rows,
    judge_by_goals,
    num_demo_rows,
    read_steps,
    sample_batch,
    sample_episodes,
    sample_prioritised_batch,
    sample_steps,
    transitions,
)

NUM_ENVS, HORIZON, SLOTS = 2, 3, 4
NUM_ADDS = 40
DEMO_LENGTHS = (3, 1, 2)
DEMO = 9


def reward_of(env, episode, step):
    return 1000.0 * env + 10.0 * episode + step


def is_terminated(episode):
    return episode % 2 == 0


def identity(observation):
    return observation


def demonstrations():
    """Demonstrations 0 and 2 are solved, 1 is cut by the horizon; padding is NaN, so that reading it shows."""
    num = len(DEMO_LENGTHS)
    observations = np.full((num, HORIZON + 1, 3), np.nan, np.float32)
    actions = np.full((num, HORIZON, 1), np.nan, np.float32)
    rewards = np.full((num, HORIZON), np.nan, np.float32)
    for i, length in enumerate(DEMO_LENGTHS):
        for t in range(length + 1):
            observations[i, t] = (DEMO, i, t)
        for t in range(length):
            actions[i, t] = rewards[i, t] = reward_of(DEMO, i, t)
    return Episodes(
        observations=jnp.asarray(observations),
        actions=jnp.asarray(actions),
        rewards=jnp.asarray(rewards),
        lengths=jnp.array(DEMO_LENGTHS),
        terminated=jnp.array([is_terminated(i) for i in range(num)]),
        desired_goals=jnp.array([[-1.0 - DEMO, i, 0.0] for i in range(num)]),
    )


PRIORITISED = BatchConfig(priority_exponent=0.5, demo_priority_bonus=3.0)
DEMO_STATES = [(DEMO, i, t) for i, length in enumerate(DEMO_LENGTHS) for t in range(length + 1)]
TABLE = GoalTable(goals=jnp.array([*DEMO_STATES, (np.nan,) * 3], jnp.float32), count=jnp.asarray(len(DEMO_STATES)))


@jax.jit
def add_all(stream):
    """The replay after each of the steps in `stream`: leaves (NUM_ADDS, ...)."""
    dims = dict(horizon=HORIZON, observation_dim=3, action_dim=1, goal_dim=3)
    start = replays.init(num_envs=NUM_ENVS, capacity=NUM_ENVS * HORIZON * SLOTS + 5, keep_nearby_goals=True, **dims)
    start = start.replace(priorities=prioritised.init(demonstrations(), start.episodes, PRIORITISED))

    def add(state, step):
        state = replays.add(state, **step)
        return state, state

    return jax.lax.scan(add, start, stream)[1]


def replay_history(lengths):
    """Plays episodes of the given lengths over and over.

    Args:
      lengths: one list of episode lengths per environment.

    Returns:
      The replay after each step, and for each step and environment the list of complete episodes: [step][env] -> [length, ...].
    """
    names = ("observation", "desired_goal", "action", "reward", "next_observation", "terminated", "truncated", "judged_by_goal", "nearby_goal")
    stream = {name: [] for name in names}
    episode, step, complete, story = [0] * NUM_ENVS, [0] * NUM_ENVS, [[] for _ in range(NUM_ENVS)], []
    for _ in range(NUM_ADDS):
        row = {name: [] for name in names}
        for env in range(NUM_ENVS):
            now, t, length = episode[env], step[env], lengths[env][episode[env] % len(lengths[env])]
            last = t + 1 == length
            row["observation"].append((env, now, t))
            row["desired_goal"].append((-1 - env, now, 0))
            row["action"].append((reward_of(env, now, t),))
            row["reward"].append(reward_of(env, now, t))
            row["next_observation"].append((env, now, t + 1))
            row["terminated"].append(last and is_terminated(now))
            row["truncated"].append(last and not is_terminated(now))
            row["nearby_goal"].append(near(env, now, t + 1))
            row["judged_by_goal"].append(False)
            if last:
                complete[env].append(length)
            episode[env], step[env] = (now + 1, 0) if last else (now, t + 1)
        for name in names:
            stream[name].append(row[name])
        story.append([list(lengths) for lengths in complete])
    kinds = {"terminated": bool, "truncated": bool, "judged_by_goal": bool, "nearby_goal": np.int32}
    return add_all({name: np.asarray(rows, kinds.get(name, np.float32)) for name, rows in stream.items()}), story


def at(history, step):
    return jax.tree.map(lambda leaf: leaf[step], jax.device_get(history))


def kept(complete):
    """What a ring must still hold: {(env, episode): length} of the newest complete episodes, one slot being kept free for writing."""
    return {(env, episode): length for env, lengths in enumerate(complete) for episode, length in list(enumerate(lengths))[-(SLOTS - 1) :]}


LENGTHS = st.lists(st.lists(st.integers(1, HORIZON), min_size=1, max_size=5), min_size=NUM_ENVS, max_size=NUM_ENVS)
draw_episodes = jax.jit(sample_episodes, static_argnums=2)
draw_steps = jax.jit(sample_steps)


@hypothesis.settings(deadline=None, max_examples=30)
@hypothesis.given(lengths=LENGTHS, step=st.integers(HORIZON - 1, NUM_ADDS - 1))
@hypothesis.example(lengths=[[3], [3]], step=2)  # the first episode is just complete
@hypothesis.example(lengths=[[3], [3]], step=8)  # all slots but one are complete
@hypothesis.example(lengths=[[3], [3]], step=10)  # the last slot is being written
@hypothesis.example(lengths=[[3], [3]], step=11)  # every slot has been written to its end
@hypothesis.example(lengths=[[3], [3]], step=12)  # the first slot is being written again
@hypothesis.example(lengths=[[1], [3, 2]], step=NUM_ADDS - 1)  # many times around, at different paces
def test_samples_are_exactly_the_complete_episodes_still_held(lengths, step):
    history, story = replay_history(lengths)
    replay, expected = at(history, step), kept(story[step])
    episodes = replay.episodes
    # At most 6 episodes: the chance that 400 draws miss one is below 6 * (5/6)^400 < 1e-30.
    rows = np.asarray(draw_episodes(jax.random.key(step), replay, 400))
    assert {tuple(map(int, episodes.observations[row, 0, :2])) for row in rows} == set(expected)
    for row in set(rows.tolist()):
        env, episode = (int(number) for number in episodes.observations[row, 0, :2])
        length = expected[env, episode]
        assert episodes.lengths[row] == length
        assert episodes.terminated[row] == is_terminated(episode)
        assert episodes.desired_goals[row].tolist() == [-1 - env, episode, 0]
        assert episodes.observations[row, : length + 1].tolist() == [[env, episode, t] for t in range(length + 1)]
        rewards = [reward_of(env, episode, t) for t in range(length)]
        assert episodes.rewards[row, :length].tolist() == rewards
        assert episodes.actions[row, :length, 0].tolist() == rewards
    steps = np.asarray(draw_steps(jax.random.key(1000 + step), episodes, rows))
    assert set(zip(rows.tolist(), steps.tolist(), strict=True)) == {(row, t) for row in set(rows.tolist()) for t in range(episodes.lengths[row])}


def test_complete_episodes_are_drawn_uniformly_whatever_their_environment():
    # After 5 steps environment 0 has three complete episodes left of five, environment 1 has one. 4000 draws, 1000 each, deviation 27.
    history, _ = replay_history([[1], [3]])
    rows = np.asarray(draw_episodes(jax.random.key(0), at(history, 4), 4000))
    counts = np.unique(rows, return_counts=True)[1]
    assert len(counts) == 4
    assert np.abs(counts - 1000).max() < 140


def test_steps_are_drawn_uniformly():
    steps = np.asarray(sample_steps(jax.random.key(0), demonstrations(), jnp.zeros(3000, jnp.int32)))
    counts = np.bincount(steps)
    assert len(counts) == 3
    assert np.abs(counts - 1000).max() < 130  # deviation 26


@functools.partial(jax.jit, static_argnames="config")
def draw_batch(key, replay, demo_rows, config):
    return sample_batch(key, replay, demonstrations(), TABLE, achieved_goal=identity, epsilon=jnp.zeros(3), demo_rows=demo_rows, config=config)


def expected_return(state, length, goal, *, relabelled, config):
    """(reward, discount, next state) of the transition that starts in `state`, as a plain loop."""
    env, episode, step = state
    total, discount, following = 0.0, 1.0, state
    for t in range(step, min(step + config.n_step, length)):
        following = (env, episode, t + 1)
        reached = relabelled and following == goal
        total += discount * ((1.0 if reached else 0.0) if relabelled else reward_of(env, episode, t))
        discount *= config.gamma
        solved = t == length - 1 and (is_terminated(episode) or config.timeouts_are_terminal)
        if solved or (reached and config.terminate_on_relabel):
            return total, 0.0, following
    return total, discount, following


BATCH = BatchConfig(batch_size=64, max_demo_ratio=0.2, relabelled_per_original=3, gamma=0.5, n_step=2, bound_by_obtained_return=True)
NUM_DEMO, NUM_RELABELLED = 12, 39  # int(0.2 * 64), (64 - 12) * 3 // 4
STRATEGIES = {
    "final": {},
    "future": {},
    "episode": {},
    "random": {},
    "task_conditioned": {},
    "joint_union": {},
    "joint_intersection": {},
    "the other joint_intersection": {"intersection_goals": "demonstrations"},
    "mixture": {"strategy_mixture": (("final", 1.0), ("random", 2.0), ("joint_intersection", 3.0))},
}


def near(env, episode, step):
    """The row of TABLE that this test takes for near a state; -1 for every other state."""
    return (env + 2 * episode + step) % len(DEMO_STATES) if (episode + step) % 2 else -1


def allowed_goals(strategy, state, length, sources):
    """The goals that a relabelled row may get, as plain loops over the states of its own episode, of all episodes held, and of the demonstrations."""
    env, episode, step = state
    own, later = [(env, episode, t) for t in range(length + 1)], [(env, episode, t) for t in range(step + 1, length + 1)]
    close = [other for other in later if near(*other) >= 0]
    goals = {
        "final": own[-1:],
        "future": later,
        "episode": own,
        "random": [(*other, t) for other, other_length in sources.items() for t in range(other_length + 1)],
        "task_conditioned": DEMO_STATES,
        "joint_union": DEMO_STATES + later,
        "joint_intersection": close,
        "the other joint_intersection": [DEMO_STATES[near(*other)] for other in close],
    }
    return set(goals["final"] + goals["random"] + goals["joint_intersection"] if strategy == "mixture" else goals[strategy])


def triples(array):
    return [tuple(map(int, row)) for row in np.asarray(array)]


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_every_row_of_a_batch_comes_from_where_it_should(strategy):
    config = dataclasses.replace(BATCH, hindrl_sampling_strategy=strategy.split()[-1], **STRATEGIES[strategy])

    @hypothesis.settings(deadline=None, max_examples=12)
    @hypothesis.given(lengths=LENGTHS, step=st.integers(HORIZON - 1, NUM_ADDS - 1))
    @hypothesis.example(lengths=[[3], [3]], step=11)
    def check(lengths, step):
        history, story = replay_history(lengths)
        batch = jax.device_get(draw_batch(jax.random.key(step), at(history, step), NUM_DEMO, config))
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(batch))
        assert np.asarray(batch.is_demonstration).tolist() == [True] * NUM_DEMO + [False] * (64 - NUM_DEMO)
        hindsight = (np.arange(64) >= NUM_DEMO) & (np.arange(64) < NUM_DEMO + NUM_RELABELLED)
        check_rows(batch, hindsight, kept(story[step]), strategy, config)

    check()


def check_rows(batch, hindsight, sources, strategy, config):
    """Each row is what a plain loop makes of the state that it begins in; `hindsight` says which rows are to be relabelled."""
    states, nexts, goals = triples(batch.observation), triples(batch.next_observation), triples(batch.desired_goal)
    for row, (state, goal) in enumerate(zip(states, goals, strict=True)):
        env, episode, t = state
        is_demonstration = batch.is_demonstration[row]
        length = DEMO_LENGTHS[episode] if is_demonstration else sources[env, episode]  # a KeyError here: not a complete episode
        assert (env == DEMO) == is_demonstration
        assert t < length
        allowed = allowed_goals(strategy, state, length, sources) if hindsight[row] else set()
        relabelled = bool(allowed) if strategy != "mixture" else goal in allowed
        assert batch.is_relabelled[row] == relabelled
        assert goal in (allowed if relabelled else {(-1 - env, episode, 0)})
        n_step = HORIZON if is_demonstration and config.demo_returns == "monte_carlo" else config.n_step
        of_row = dataclasses.replace(config, n_step=n_step)
        reward, discount, following = expected_return(state, length, goal, relabelled=relabelled, config=of_row)
        assert (batch.reward[row], batch.discount[row]) == (reward, discount)  # exact, since gamma = 1/2
        assert batch.obtained_return[row] == (0.0 if relabelled else reward_of(env, episode, length - 1) * 0.5 ** (length - 1 - t))
        assert nexts[row] == following
        assert batch.action[row, 0] == reward_of(env, episode, t)


def tell(key, observations, subgoals):
    """Writes the two states that the story is about, as decimal digits, into its observations; it is over at the step of the second."""
    codes = 1000.0 + subgoals @ jnp.array([100.0, 10.0, 1.0])
    told = observations.at[:, :2].add(10.0 * codes[None])
    return told, observations[1:, 2] >= subgoals[1, 2]


@functools.partial(jax.jit, static_argnames="config")
def draw_retold_batch(key, replay, config):
    table = TABLE.replace(observations=TABLE.goals)
    given = dict(achieved_goal=identity, epsilon=jnp.zeros(3), demo_rows=jnp.asarray(NUM_DEMO), config=config)
    return sample_batch(key, replay, demonstrations(), table, retelling=replays.Retelling(tell, 2), **given)


RETOLD = [(strategy, {}) for strategy in ("final", "future", "episode", "random", "task_conditioned", "joint_union")]
RETOLD += [("future", {"terminate_on_relabel": False}), ("random", {"timeouts_are_terminal": True})]


@pytest.mark.parametrize(("strategy", "rules"), RETOLD)
def test_a_retold_row_is_about_states_of_its_source_in_their_order(strategy, rules):
    history, story = replay_history([[3, 2], [1, 3]])
    replay, sources = at(history, 17), kept(story[17])  # early: episodes have numbers of one digit
    config = dataclasses.replace(BATCH, hindrl_sampling_strategy=strategy, **rules)
    batch = jax.device_get(draw_retold_batch(jax.random.key(0), replay, config))
    retold = np.flatnonzero(batch.is_relabelled)
    assert retold.tolist() == list(range(NUM_DEMO, NUM_DEMO + NUM_RELABELLED))
    assert (np.delete(batch.observation, retold, axis=0)[:, 0] <= 9).all()
    for row in retold:
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
        # A plain loop over at most two steps, each of which may end the story.
        expected_reward, expected_discount, following = 0.0, 1.0, t
        for step in range(t, min(t + 2, length)):
            solved = step + 1 >= second[2]
            expected_reward, expected_discount, following = expected_reward + expected_discount * solved, expected_discount * 0.5, step + 1
            if solved or (config.timeouts_are_terminal and step + 1 == length):
                expected_discount = 0.0
                break
        assert (batch.reward[row], batch.discount[row], batch.next_observation[row, 2]) == (expected_reward, expected_discount, following)
        assert batch.next_observation[row, 0] == batch.observation[row, 0]
        assert batch.desired_goal[row, 0] == -1 - env  # the goal that the episode was acted under
        assert batch.obtained_return[row] == 0.0
    foreign = (batch.observation[retold, 0] // 1000 % 10 == DEMO).mean()
    assert {"task_conditioned": foreign == 1.0, "joint_union": 0.0 < foreign < 1.0}.get(strategy, foreign == 0.0)


@functools.partial(jax.jit, static_argnames=("config", "retelling"))
def draw_prioritised_batch(key, replay, config, retelling=None):
    given = dict(achieved_goal=identity, epsilon=jnp.zeros(3), config=config, retelling=retelling)
    return sample_prioritised_batch(key, replay, demonstrations(), TABLE, **given)


def with_random_priorities(replay, seed):
    """The replay with other priorities wherever there are any, on the host."""
    rng, priorities = np.random.default_rng(seed), replay.priorities
    changed = [
        np.where(table > 0.0, rng.uniform(0.5, 2.0, table.shape), 0.0).astype(np.float32) for table in (priorities.demonstrations, priorities.replay)
    ]
    return replay.replace(priorities=priorities.replace(demonstrations=changed[0], replay=changed[1]))


@hypothesis.settings(deadline=None, max_examples=20)
@hypothesis.given(lengths=LENGTHS, step=st.integers(0, NUM_ADDS - 1))
@hypothesis.example(lengths=[[3], [3]], step=1)  # nothing is complete
@hypothesis.example(lengths=[[3], [3]], step=2)
@hypothesis.example(lengths=[[3], [3]], step=10)
@hypothesis.example(lengths=[[3], [3]], step=11)
@hypothesis.example(lengths=[[3], [3]], step=12)
def test_exactly_the_transitions_of_complete_episodes_have_priorities(lengths, step):
    history, story = replay_history(lengths)
    replay = at(history, step)
    priorities, observations = replay.priorities, replay.episodes.observations
    expected = {(*source, t): 1.0 for source, length in kept(story[step]).items() for t in range(length)}
    places = np.argwhere(priorities.replay > 0.0)
    assert {tuple(map(int, observations[row, t])): priorities.replay[row, t] for row, t in places} == expected
    assert len(places) == len(expected)
    assert priorities.demonstrations.tolist() == [[2.0 * (t < length) for t in range(HORIZON)] for length in DEMO_LENGTHS]  # (1 + 3)^0.5


@pytest.mark.parametrize("step", [2, 8, 10, 11, 12, 23, NUM_ADDS - 1])  # as above: nearly empty, full, and being written again
def test_transitions_are_drawn_by_their_priorities_wherever_the_rings_stand(step):
    history, story = replay_history([[3], [3, 1, 2]])
    replay = with_random_priorities(at(history, step), step)
    priorities, sources = replay.priorities, kept(story[step])
    config = dataclasses.replace(BATCH, priority_exponent=0.5, importance_exponent=0.5, relabelled_per_original=0, batch_size=8192)
    batch = jax.device_get(draw_prioritised_batch(jax.random.key(step), replay, config)[0])
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
    changes = dict(priority_exponent=0.5, demo_priority_bonus=3.0, demo_returns="monte_carlo", hindrl_sampling_strategy=strategy.split()[-1])
    config = dataclasses.replace(BATCH, **changes, **STRATEGIES[strategy])
    history, story = replay_history([[3, 2], [1, 3]])
    for step in (2, 11, 12, NUM_ADDS - 1):
        replay = with_random_priorities(at(history, step), step)
        batch, drawn = jax.device_get(draw_prioritised_batch(jax.random.key(step), replay, config))
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(batch))
        assert batch.is_demonstration.tolist() == drawn.is_demonstration.tolist()
        assert 0 < batch.is_demonstration.sum() < 64
        replayed = np.flatnonzero(~batch.is_demonstration)
        hindsight = np.isin(np.arange(64), replayed[: len(replayed) * 3 // 4])
        check_rows(batch, hindsight, kept(story[step]), strategy, config)
        tables = (replay.episodes, replay.priorities.replay), (jax.device_get(demonstrations()), replay.priorities.demonstrations)
        for row, (state, is_demonstration) in enumerate(zip(triples(batch.observation), batch.is_demonstration, strict=True)):
            episodes, priorities = tables[int(is_demonstration)]
            place = drawn.rows[row], drawn.steps[row]
            assert tuple(map(int, episodes.observations[*place])) == state
            assert priorities[*place] == drawn.priority[row]


def test_a_prioritised_batch_retells_the_first_of_its_replayed_rows():
    history, _ = replay_history([[3, 2], [1, 3]])
    config = dataclasses.replace(BATCH, priority_exponent=0.5, hindrl_sampling_strategy="future")
    replay = with_random_priorities(at(history, 17), 0)
    batch, _ = jax.device_get(draw_prioritised_batch(jax.random.key(0), replay, config, replays.Retelling(tell, 2)))
    replayed = np.flatnonzero(~batch.is_demonstration)
    retold = replayed[: len(replayed) * 3 // 4]
    assert 0 < len(retold) < len(replayed) < 64
    assert np.flatnonzero(batch.is_relabelled).tolist() == retold.tolist()
    assert np.flatnonzero(batch.observation[:, 0] > 9).tolist() == retold.tolist()  # where a story was written


def test_union_draws_from_both_sources_and_relabelling_can_be_off():
    history, _ = replay_history([[3], [3]])
    config = dataclasses.replace(BATCH, hindrl_sampling_strategy="joint_union")
    batch = draw_batch(jax.random.key(0), at(history, 20), NUM_DEMO, config)
    goals = np.asarray(batch.desired_goal)[NUM_DEMO : NUM_DEMO + NUM_RELABELLED, 0]
    assert set(goals.tolist()) == {0.0, 1.0, DEMO}
    batch = draw_batch(jax.random.key(0), at(history, 20), NUM_DEMO, dataclasses.replace(BATCH, relabelled_per_original=0))
    assert np.all(np.asarray(batch.desired_goal)[:, 0] < 0)


def test_every_part_of_a_mixture_is_drawn_and_empty_intersections_keep_their_rows():
    # Episodes of 1: state 1 of even episodes is near a demonstrated goal, odd episodes have no intersection.
    history, _ = replay_history([[1], [1]])
    config = dataclasses.replace(BATCH, hindrl_sampling_strategy="joint_intersection", batch_size=512)
    batch = jax.device_get(draw_batch(jax.random.key(0), at(history, 20), NUM_DEMO, config))
    odd = batch.observation[:, 1] % 2 == 1
    assert not batch.is_relabelled[odd].any()
    assert batch.is_relabelled.sum() > 100
    mixture = (("task_conditioned", 1.0), ("joint_intersection", 1.0))
    config = dataclasses.replace(config, hindrl_sampling_strategy="mixture", strategy_mixture=mixture)
    batch = jax.device_get(draw_batch(jax.random.key(0), at(history, 20), NUM_DEMO, config))
    demonstrated = batch.desired_goal[:, 0] == DEMO
    assert batch.is_relabelled[demonstrated].all()
    assert set((batch.observation[demonstrated, 1] % 2).tolist()) == {0, 1}
    assert (batch.is_relabelled & ~demonstrated).any()


def test_monte_carlo_returns_of_demonstrations_go_all_the_way():
    # n_step is 2, demonstration 0 has 3 steps: from step 0 its return is r0 + r1 / 2 + r2 / 4, and it has ended. Demonstration 1 was cut.
    history, _ = replay_history([[3], [2]])
    config = dataclasses.replace(BATCH, demo_returns="monte_carlo")
    batch = jax.device_get(draw_batch(jax.random.key(0), at(history, 20), NUM_DEMO, config))
    seen = set()
    for row, (env, episode, t) in enumerate(triples(batch.observation)):
        length = DEMO_LENGTHS[episode] if row < NUM_DEMO else 3 - env
        n_step = HORIZON if row < NUM_DEMO else 2
        if row < NUM_DEMO or row >= NUM_DEMO + NUM_RELABELLED:
            plain = dataclasses.replace(config, n_step=n_step)
            reward, discount, following = expected_return((env, episode, t), length, None, relabelled=False, config=plain)
            assert (batch.reward[row], batch.discount[row], *batch.next_observation[row]) == (reward, discount, *following)
            seen.add((row < NUM_DEMO, episode, t))
    assert (True, 0, 0) in seen


@pytest.mark.parametrize("n_step", [1, 2])
def test_episodes_judged_by_their_goal_are_rewarded_for_reaching_it(n_step):
    # Environment 0 plays episodes of 3 and means to reach state 2 of them; its rows, relabelled or not, are rewarded for their goal alone.
    history, _ = replay_history([[3], [3]])
    replay = at(history, 11)
    episodes, slots = replay.episodes, SLOTS
    goals = np.array(episodes.desired_goals)
    goals[:slots] = episodes.observations[:slots, 2]
    judged = np.arange(2 * slots) < slots
    replay = replay.replace(episodes=episodes.replace(desired_goals=goals), judged_by_goal=judged)
    config = dataclasses.replace(BATCH, relabelled_per_original=0.5, hindrl_sampling_strategy="final", n_step=n_step)
    batch = jax.device_get(draw_batch(jax.random.key(2), replay, 0, config))
    kinds = set()
    for row, (state, goal) in enumerate(zip(triples(batch.observation), triples(batch.desired_goal), strict=True)):
        env, episode, _ = state
        in_hindsight = row < 64 // 3
        assert goal == ((env, episode, 3) if in_hindsight else (0, episode, 2) if env == 0 else (-2, episode, 0))
        by_goal = in_hindsight or env == 0
        assert batch.is_relabelled[row] == in_hindsight
        reward, discount, following = expected_return(state, 3, goal, relabelled=by_goal, config=config)
        assert (batch.reward[row], batch.discount[row], *batch.next_observation[row]) == (reward, discount, *following)
        kinds.add((env, in_hindsight))
    assert len(kinds) == 4


def test_jitted_equals_not_jitted():
    def read(episodes, rows, steps, goals):
        chosen = goals[:, 2] < 2
        told = read_steps(episodes, rows, steps, BATCH.n_step)
        told = judge_by_goals(told, chosen, goals, achieved_goal=identity, epsilon=jnp.zeros(3), config=BATCH)
        return transitions(told, goals, is_relabelled=chosen, is_demonstration=False, config=BATCH)

    arguments = (demonstrations(), jnp.array([0, 2, 2, 1]), jnp.array([1, 0, 1, 0]), jnp.array([[DEMO, 2.0, t] for t in range(4)]))
    jax.tree.map(np.testing.assert_array_equal, jax.jit(read)(*arguments), read(*arguments))


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
    batch = draw_batch(jax.random.key(0), at(history, 20), num_demo_rows(jnp.asarray(0), config), config)
    assert config.max_demo_rows == demo
    assert int(batch.is_demonstration.sum()) == demo
    behavioural = np.asarray(batch.desired_goal)[:, 0] < 0  # demonstrations keep theirs, too
    assert (~behavioural).sum() == relabelled
    assert (behavioural & ~np.asarray(batch.is_demonstration)).sum() == original
    sources, counts = np.unique(np.asarray(batch.observation)[:demo, 1], return_counts=True)
    assert sources.tolist() == [0.0, 1.0, 2.0]
    # Uniform by demonstration, not by step: a third each; five deviations of a binomial.
    assert np.abs(counts - demo / 3).max() < 5 * (demo * 2 / 9) ** 0.5


def test_demonstration_rows_fade_and_replay_rows_take_their_place():
    history, _ = replay_history([[3], [2]])
    for demo_rows in (0, 5):
        batch = draw_batch(jax.random.key(0), at(history, 20), demo_rows, BATCH)
        assert np.asarray(batch.is_demonstration).tolist() == [True] * demo_rows + [False] * (64 - demo_rows)
        assert ((np.asarray(batch.observation)[:, 0] == DEMO) == np.asarray(batch.is_demonstration)).all()
        goals = np.asarray(batch.desired_goal)[:, 0]
        assert (goals == DEMO).sum() == (64 - demo_rows) * 3 // 4  # task-conditioned


@pytest.mark.parametrize(
    ("env_steps", "rows"),
    [(0, 409), (1, 409), (250, 307), (500, 204), (999, 0), (1000, 0), (5000, 0)],  # floor(409.6 (1 - steps / 1000)); eq. 4.9
)
def test_linear_decay_of_the_demonstrations(env_steps, rows):
    config = BatchConfig(batch_size=4096, max_demo_ratio=0.1, reach_zero=1000)
    assert int(num_demo_rows(jnp.asarray(env_steps), config)) == rows
    assert int(num_demo_rows(jnp.asarray(env_steps), dataclasses.replace(config, reach_zero=None))) == 409


@hypothesis.settings(deadline=None, max_examples=50)
@hypothesis.given(size=st.integers(2, 5000), percent=st.integers(0, 50))
def test_decay_starts_with_the_full_number_of_rows(size, percent):
    config = BatchConfig(batch_size=size, max_demo_ratio=percent / 100, reach_zero=10)
    assert int(num_demo_rows(np.int32(0), config)) == config.max_demo_rows == math.floor(percent / 100 * size)


def transition_twin(episodes, row, step, goal, *, relabelled, epsilon, config):
    """(reward, discount, next observation, goal) as a plain loop; the achieved goal is entry 2 of an observation."""
    length, total, discount = int(episodes.lengths[row]), 0.0, 1.0
    for t in range(step, min(step + config.n_step, length)):
        following = episodes.observations[row, t + 1]
        distance = abs(following[2] - goal)
        reached = relabelled and bool(distance <= epsilon if config.inclusive_goal_test else distance < epsilon)
        total += discount * (float(reached) if relabelled else episodes.rewards[row, t])
        discount *= config.gamma
        over = t == length - 1 and (bool(episodes.terminated[row]) or config.timeouts_are_terminal)
        if over or (reached and config.terminate_on_relabel):
            discount = 0.0
            break
    return total, discount, following, goal if relabelled else episodes.desired_goals[row, 0]


ROWS = 6


@hypothesis.settings(deadline=None, max_examples=60)
@hypothesis.given(
    lengths=st.lists(st.integers(1, 4), min_size=3, max_size=3),
    places=st.lists(st.integers(0, 2), min_size=15, max_size=15),
    terminated=st.lists(st.booleans(), min_size=3, max_size=3),
    chosen=st.lists(st.tuples(st.integers(0, 2), st.integers(0, 3), st.integers(0, 2), st.booleans()), min_size=ROWS, max_size=ROWS),
    epsilon=st.sampled_from([0.0, 1.0]),
    config=st.builds(
        BatchConfig,
        n_step=st.sampled_from([1, 3]),
        gamma=st.sampled_from([0.5, 0.9, 1.0]),
        inclusive_goal_test=st.booleans(),
        terminate_on_relabel=st.booleans(),
        timeouts_are_terminal=st.booleans(),
        bound_by_obtained_return=st.booleans(),
    ),
    is_demonstration=st.booleans(),
)
def test_transitions_are_those_of_a_plain_loop(lengths, places, terminated, chosen, epsilon, config, is_demonstration):
    observations = np.zeros((3, 5, 3), np.float32)
    observations[..., 0], observations[..., 1], observations[..., 2] = np.arange(3)[:, None], np.arange(5)[None], np.reshape(places, (3, 5))
    rewards = np.arange(12, dtype=np.float32).reshape(3, 4) + 1.0
    for i, length in enumerate(lengths):
        observations[i, length + 1 :] = np.nan
        rewards[i, length:] = np.nan
    episodes = Episodes(
        observations=observations,
        actions=-rewards[..., None],
        rewards=rewards,
        lengths=np.array(lengths, np.int32),
        terminated=np.array(terminated),
        desired_goals=np.array([[-1.0], [-2.0], [-3.0]], np.float32),
    )
    rows = np.array([row for row, _, _, _ in chosen], np.int32)
    steps = np.array([step % lengths[row] for row, step, _, _ in chosen], np.int32)
    goals = np.array([[goal] for _, _, goal, _ in chosen], np.float32)
    relabelled = np.array([flag for _, _, _, flag in chosen])
    table, chosen = jax.tree.map(jnp.asarray, episodes), jnp.asarray(relabelled)
    told = read_steps(table, jnp.asarray(rows), jnp.asarray(steps), config.n_step)
    told = judge_by_goals(
        told, chosen, jnp.asarray(goals), achieved_goal=lambda observation: observation[..., 2:], epsilon=jnp.array([epsilon]), config=config
    )
    desired = jnp.where(chosen[:, None], goals, table.desired_goals[rows])
    batch = jax.device_get(transitions(told, desired, is_relabelled=chosen, is_demonstration=is_demonstration, config=config))
    for i in range(ROWS):
        reward, discount, following, goal = transition_twin(
            episodes, rows[i], steps[i], goals[i, 0], relabelled=relabelled[i], epsilon=epsilon, config=config
        )
        np.testing.assert_allclose([batch.reward[i], batch.discount[i], batch.desired_goal[i, 0]], [reward, discount, goal], rtol=1e-5)
        np.testing.assert_array_equal(batch.next_observation[i], following)
        np.testing.assert_array_equal(batch.observation[i], observations[rows[i], steps[i]])
        assert batch.action[i, 0] == -rewards[rows[i], steps[i]]
        if config.bound_by_obtained_return:
            last = lengths[rows[i]] - 1
            obtained = 0.0 if relabelled[i] else rewards[rows[i], last] * config.gamma ** (last - steps[i])
            np.testing.assert_allclose(batch.obtained_return[i], obtained, rtol=1e-5)
    assert (batch.obtained_return is None) == (not config.bound_by_obtained_return)
    assert np.asarray(batch.is_demonstration).tolist() == [is_demonstration] * ROWS


def test_last_row_of_a_solved_demonstration_is_worth_one_and_ends():
    rewards = np.zeros((3, HORIZON), np.float32)
    for i, length in enumerate(DEMO_LENGTHS):
        rewards[i, length - 1] = 1.0
    table = demonstrations().replace(rewards=jnp.asarray(rewards), terminated=jnp.ones(3, bool))
    rows, steps = zip(*[(i, t) for i, length in enumerate(DEMO_LENGTHS) for t in range(length)], strict=True)
    config = BatchConfig(gamma=0.5, n_step=1, bound_by_obtained_return=True)
    batch = demonstration_rows(table, jnp.array(rows), jnp.array(steps), config)
    assert batch.reward.tolist() == [0, 0, 1, 1, 0, 1]
    assert batch.discount.tolist() == [0.5, 0.5, 0, 0, 0.5, 0]
    assert batch.obtained_return.tolist() == [0.25, 0.5, 1, 1, 0.5, 1]  # lengths 3, 1 and 2


def test_capacity_is_at_least_two_episodes_per_environment():
    dims = dict(horizon=10, observation_dim=1, action_dim=1, goal_dim=1)
    with pytest.raises(ValueError, match=r"buffer_size = 59 is too small.*at least 60"):
        replays.init(num_envs=3, capacity=59, **dims)
    assert replays.init(num_envs=3, capacity=60, **dims).episodes.rewards.shape == (6, 10)
    assert replays.init(num_envs=3, capacity=119, **dims).episodes.rewards.shape == (9, 10)
