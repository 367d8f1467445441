"""Relabelling by hand: which rows, which source, which goal, which reward, and where the return ends."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toy_env import Corridor

from hindrl_jax.base.types import Episodes
from hindrl_jax.config import BatchConfig, QuirksConfig, TrainConfig
from hindrl_jax.core import replay as replays
from hindrl_jax.core.goals import GoalTable, GoalTest
from hindrl_jax.core.hindsight import goal_source
from hindrl_jax.core.relabel import num_relabelled, relabel, relabel_observations, reward_by_goal
from hindrl_jax.core.steps import read_steps, transitions

# Two episodes along a line. The state is a position, and so is the goal; both were acted under the goal 9.
#   episode 0: positions 0, 1, 2, 4; three transitions without reward, cut by the horizon
#   episode 1: positions 5, 7, 8; two transitions, of which the second solved the task
EPISODES = Episodes(
    observations=jnp.array([[0.0, 1.0, 2.0, 4.0], [5.0, 7.0, 8.0, jnp.nan]])[..., None],
    actions=jnp.zeros((2, 3, 1)),
    rewards=jnp.array([[0.0, 0.0, 0.0], [0.0, 1.0, jnp.nan]]),
    lengths=jnp.array([3, 2]),
    terminated=jnp.array([False, True]),
    desired_goals=jnp.array([[9.0], [9.0]]),
)
TABLE = GoalTable(goals=jnp.array([[6.0]]), observations=jnp.array([[6.0]]), count=jnp.asarray(1))  # one demonstrated goal


@dataclasses.dataclass(frozen=True)
class Line(Corridor):
    """The positions of EPISODES."""

    horizon: int = 3
    observation_dim: int = 1
    action_dim: int = 1

    def achieved_goal(self, observation):
        return observation


def replay_of_both():
    """One environment, whose ring of three slots holds both episodes and is about to write the third."""
    empty = replays.init(Line(), num_envs=1, capacity=9)
    episodes = jax.tree.map(lambda stored, given: stored.at[:2].set(given), empty.episodes, EPISODES)
    return empty.replace(episodes=episodes, slot=jnp.array([2]), num_complete=jnp.array([2]))


NO_QUIRKS = QuirksConfig()


def goal_test(quirks=NO_QUIRKS, epsilon=1.0, own_goals=False):
    return GoalTest(
        own_goals=own_goals,
        achieved_goal=Line().achieved_goal,
        epsilon=jnp.array([epsilon]),
        inclusive=not quirks.strict_goal_test,
        ends_return=not quirks.bootstrap_past_relabelled_goals,
    )


@pytest.mark.parametrize(
    ("replay_rows", "relabelled_per_original", "relabelled"),
    [
        (6, 2.0, 4),  # 6 * 2/3
        (52, 3.0, 39),  # 52 * 3/4
        (3687, 4.0, 2949),  # 3687 * 4/5 = 2949.6, rounded down; the thesis's batch of 4096 has 3687 replay rows, and n = 4
        (10_800, 4.0, 8640),  # its batch of 12,000
        (3687, 0.5, 1229),  # one relabelled row for two others: 3687 / 3 exactly
        (108, 1.4, 63),  # 108 * 7/12 = 63 exactly, which float32 takes for a little less
        (5, 1.0, 2),  # 2.5
        (7, 0.0, 0),
        (0, 4.0, 0),
    ],
)
def test_number_of_relabelled_rows_by_hand(replay_rows, relabelled_per_original, relabelled):
    """Thesis section 4.1.2: n / (n + 1) of the rows that come from the replay."""
    assert int(num_relabelled(jnp.asarray(replay_rows), relabelled_per_original)) == relabelled


# Which rows: of six, 6 * 2/3 = 4, the first ones. Which source: "final", so that the goal is the last position of the row's own episode, 4 or 8.
# Which reward, with n = 2, gamma = 1/2 and epsilon = 1:
#   row 0, episode 0 from step 0 on: positions 1 and 2 are 3 and 2 away from 4. 0 + 0/2 = 0, up to position 2, whose value counts with 1/4
#   row 1, episode 0 from step 1 on: position 2 is 2 away, position 4 is there. 0 + 1/2 = 1/2, up to position 4
#   row 2, episode 0 from step 2 on: position 4 is there: 1, up to position 4
#   row 3, episode 1 from step 0 on: position 7 is 1 away from 8, which is within epsilon: 1, up to position 7, where the return ends
#   row 4, episode 1 from step 0 on, original: the recorded rewards 0 + 1/2 = 1/2, up to position 8, where the task was solved
#   row 5, episode 0 from step 0 on, original: 0, up to position 2, whose value counts with 1/4
# Rows 1, 2 and 3 reach their goals, so nothing is added to their returns. Where reaching a goal does not end the return:
#   row 1: the episode was cut by the horizon, so the value of position 4 counts with 1/4
#   row 2: likewise with 1/2, after one step
#   row 3: position 8 is there, too: 1 + 1/2 = 3/2, more than any return can be; the end of the recorded episode still ends it
# With the strict test, row 3 is not there at position 7, since 1 < 1 is false: 0 + 1/2 = 1/2, up to position 8.
ROWS = [(0, 0), (0, 1), (0, 2), (1, 0), (1, 0), (0, 0)]
GOALS = [4.0, 4.0, 4.0, 8.0, 9.0, 9.0]


@pytest.mark.parametrize(
    ("quirks", "rewards", "discounts", "nexts"),
    [
        (QuirksConfig(), [0.0, 0.5, 1.0, 1.0, 0.5, 0.0], [0.25, 0.0, 0.0, 0.0, 0.0, 0.25], [2.0, 4.0, 4.0, 7.0, 8.0, 2.0]),
        (
            QuirksConfig(bootstrap_past_relabelled_goals=True),
            [0.0, 0.5, 1.0, 1.5, 0.5, 0.0],
            [0.25, 0.25, 0.5, 0.0, 0.0, 0.25],
            [2.0, 4.0, 4.0, 8.0, 8.0, 2.0],
        ),
        (QuirksConfig(strict_goal_test=True), [0.0, 0.5, 1.0, 0.5, 0.5, 0.0], [0.25, 0.0, 0.0, 0.0, 0.0, 0.25], [2.0, 4.0, 4.0, 8.0, 8.0, 2.0]),
    ],
)
def test_relabelling_by_hand(quirks, rewards, discounts, nexts):
    batch_config = BatchConfig(relabelled_per_original=2, hindrl_sampling_strategy="final", n_step=2, gamma=0.5)
    config, replay = TrainConfig(batch=batch_config, quirks=quirks), replay_of_both()
    row, step = (jnp.array(column) for column in zip(*ROWS, strict=True))
    chosen = jnp.arange(6) < num_relabelled(jnp.asarray(6), batch_config.relabelled_per_original)
    steps = read_steps(replay.episodes, row, step, 2)
    steps = relabel(jax.random.key(0), replay, steps, chosen, goal_source(TABLE, batch_config), goal_test(quirks))
    batch = transitions(steps, Line().achieved_goal, config, is_demonstration=False)
    assert batch.is_relabelled.tolist() == [True] * 4 + [False] * 2
    assert batch.desired_goal[:, 0].tolist() == GOALS
    assert batch.reward.tolist() == rewards
    assert batch.discount.tolist() == discounts
    assert batch.next_observation[:, 0].tolist() == nexts
    assert batch.observation[:, 0].tolist() == [0.0, 1.0, 2.0, 5.0, 5.0, 0.0]  # what was observed stays


def test_a_source_is_asked_for_the_rows_steps_and_where_it_finds_nothing_the_row_stays():
    replay, key = replay_of_both(), jax.random.key(3)
    asked = []

    def source(key, replay, rows, steps):
        """The state that the transition leads to; none for the last transition of an episode."""
        asked.append((key, rows, steps))
        return replay.episodes.observations[rows, steps + 1], steps + 1 < replay.episodes.lengths[rows]

    row, step = jnp.array([0, 0, 1, 1, 0]), jnp.array([1, 2, 0, 1, 0])
    chosen = jnp.array([True, True, True, True, False])
    recorded = read_steps(replay.episodes, row, step, 2)
    steps = relabel(key, replay, recorded, chosen, source, goal_test(epsilon=0.0))
    ((key_given, rows, first_steps),) = asked
    assert key_given is key
    assert (rows.tolist(), first_steps.tolist()) == (row.tolist(), step.tolist())
    # Rows 0 and 2 are relabelled: positions 2 and 7 are reached by the first step, and not by the second, at 4 and 8. In rows 1 and 3 there is no
    # later state, and row 4 was not chosen; they keep their goal and their rewards, of which that of row 3 is 1.
    assert steps.is_relabelled.tolist() == [True, False, True, False, False]
    assert steps.desired_goal[:, 0].tolist() == [2.0, 9.0, 7.0, 9.0, 9.0]
    assert steps.ends.tolist() == [[True, False], [False, False], [True, False], [False, False], [False, False]]
    counted = np.where(steps.inside, steps.rewards, 0.0)
    assert counted.tolist() == [[1.0, 0.0], [0.0, 0.0], [1.0, 0.0], [1.0, 0.0], [0.0, 0.0]]
    for name in ("row", "step", "observation", "action", "next_observations", "inside", "is_last", "terminated"):
        np.testing.assert_array_equal(getattr(steps, name), getattr(recorded, name))


def test_an_episode_that_ended_at_its_own_goal_goes_on_for_another():
    # All rows get the goal 6, which is never near. Episode 1 ended at position 8, its own goal, within these two steps or this one; for the goal 6
    # the value of position 8 counts, after two steps with 1/4 and after one with 1/2. Where all episodes aim at the same, a solved one is over for
    # every goal. An end without reward is the environment's own, and an end for every goal, too.
    batch_config = BatchConfig(hindrl_sampling_strategy="task_conditioned", n_step=2, gamma=0.5)
    config, replay = TrainConfig(batch=batch_config), replay_of_both()
    failed = replay.replace(episodes=replay.episodes.replace(rewards=jnp.zeros_like(replay.episodes.rewards)))
    cases = (True, replay, [0.25, 0.5, 0.25, 0.0]), (False, replay, [0.0, 0.0, 0.25, 0.0]), (True, failed, [0.0, 0.0, 0.25, 0.0])
    for own_goals, stored, discounts in cases:
        steps = read_steps(stored.episodes, jnp.array([1, 1, 0, 1]), jnp.array([0, 1, 0, 1]), 2)
        chosen, source = jnp.array([True, True, True, False]), goal_source(TABLE, batch_config)
        steps = relabel(jax.random.key(0), stored, steps, chosen, source, goal_test(epsilon=0.5, own_goals=own_goals))
        batch = transitions(steps, Line().achieved_goal, config, is_demonstration=False)
        assert batch.discount.tolist() == discounts
        assert batch.reward[:3].tolist() == [0.0, 0.0, 0.0]
        assert batch.next_observation[:2, 0].tolist() == [8.0, 8.0]


def test_a_demonstrated_goal_is_one_of_the_table():
    # The only goal of the table is 6. From 5, position 7 is 1 away from it and position 8 is 2 away; 0 is never near.
    batch_config = BatchConfig(relabelled_per_original=1, hindrl_sampling_strategy="task_conditioned", n_step=2)
    replay = replay_of_both()
    steps = read_steps(replay.episodes, jnp.array([1, 0]), jnp.array([0, 0]), 2)
    steps = relabel(jax.random.key(0), replay, steps, jnp.array([True, True]), goal_source(TABLE, batch_config), goal_test())
    assert steps.desired_goal[:, 0].tolist() == [6.0, 6.0]
    assert steps.rewards.tolist() == [[1.0, 0.0], [0.0, 0.0]]


@pytest.mark.parametrize(("quirks", "ends"), [(QuirksConfig(), True), (QuirksConfig(bootstrap_past_relabelled_goals=True), False)])
def test_relabelled_rows_are_rewarded_for_their_goal_by_hand(quirks, ends):
    # The goal of all rows is 9, and epsilon is 1. Rows 0 and 1 are episode 1 from step 0 on: position 7 is 2 away, 8 is 1 away, so row 0
    # is rewarded for reaching its goal by the second step. Row 1 is not relabelled, and keeps the reward that was recorded there. Row 2 is episode 0
    # from step 1 on: positions 2 and 4 are 7 and 5 away.
    replay = replay_of_both()
    steps = read_steps(replay.episodes, jnp.array([1, 1, 0]), jnp.array([0, 0, 1]), 2)
    steps = reward_by_goal(steps.replace(is_relabelled=jnp.array([True, False, True])), goal_test(quirks))
    assert steps.rewards.tolist() == [[0.0, 1.0], [0.0, 1.0], [0.0, 0.0]]
    assert steps.ends.tolist() == [[False, ends], [False, False], [False, False]]
    assert steps.desired_goal[:, 0].tolist() == [9.0] * 3


@dataclasses.dataclass(frozen=True)
class LineWithTarget(Line):
    """Observations are (position, target): how far to go is a parameter of the task, which hindsight replaces."""

    observation_dim: int = 2
    num_subgoals: int = 1

    def achieved_goal(self, observation):
        return observation[..., :1]

    def relabel_observations(self, key, observations, subgoals):
        target = subgoals[0, 0]
        return observations.at[:, 1].set(target), observations[1:, 0] >= target


def replay_with_targets():
    """The episodes from above, with the target 9 observed in both."""
    observations = jnp.concatenate([EPISODES.observations, jnp.full((2, 4, 1), 9.0)], axis=-1)
    empty = replays.init(LineWithTarget(), num_envs=1, capacity=9)
    episodes = jax.tree.map(lambda stored, given: stored.at[:2].set(given), empty.episodes, EPISODES.replace(observations=observations))
    return empty.replace(episodes=episodes, slot=jnp.array([2]), num_complete=jnp.array([2]))


@pytest.mark.parametrize("quirks", [QuirksConfig(), QuirksConfig(bootstrap_past_relabelled_goals=True)])
def test_relabelled_observations_by_hand(quirks):
    # The source is "final", so that the new target is the last position, 4 or 8. n = 2, gamma = 1/2.
    #   row 0, episode 0 from step 0 on: (1, 4) and (2, 4) do not reach 4: 0, and the value of the second counts with 1/4
    #   row 1, episode 0 from step 1 on: (2, 4) does not, (4, 4) does: 0 + 1/2, and the return ends, whatever the goal test says
    #   row 2, episode 1 from step 1 on: (8, 8) reaches it: 1, and the return ends
    #   row 3, the same, original: its recorded reward of 1 at (8, 9), where it was solved
    replay = replay_with_targets()
    batch_config = BatchConfig(relabelled_per_original=1, hindrl_sampling_strategy="final", n_step=2, gamma=0.5)
    config, env = TrainConfig(batch=batch_config, quirks=quirks), LineWithTarget()
    steps = read_steps(replay.episodes, jnp.array([0, 0, 1, 1]), jnp.array([0, 1, 1, 1]), 2)
    chosen = jnp.array([True, True, True, False])
    steps = relabel_observations(jax.random.key(0), replay, steps, chosen, goal_source(TABLE, batch_config), env)
    batch = transitions(steps, env.achieved_goal, config, is_demonstration=False)
    assert batch.observation.tolist() == [[0.0, 4.0], [1.0, 4.0], [7.0, 8.0], [7.0, 9.0]]
    assert batch.next_observation.tolist() == [[2.0, 4.0], [4.0, 4.0], [8.0, 8.0], [8.0, 9.0]]
    assert batch.reward.tolist() == [0.0, 0.5, 1.0, 1.0]
    assert batch.discount.tolist() == [0.25, 0.0, 0.0, 0.0]
    assert batch.is_relabelled.tolist() == [True, True, True, False]
    assert batch.desired_goal[:, 0].tolist() == [9.0] * 4  # goals stay


def test_where_a_recorded_task_was_solved_the_relabelled_one_may_go_on():
    # Episode 1 from step 1 on, twice. With the target 20 position 8 solves nothing: reward 0, and its value counts with gamma = 1/2. As recorded, it
    # was solved there.
    table = GoalTable(goals=jnp.array([[20.0]]), observations=jnp.array([[20.0, 0.0]]), count=jnp.asarray(1))
    batch_config = BatchConfig(relabelled_per_original=1, hindrl_sampling_strategy="task_conditioned", n_step=2, gamma=0.5)
    replay, env = replay_with_targets(), LineWithTarget()
    steps = read_steps(replay.episodes, jnp.array([1, 1]), jnp.array([1, 1]), 2)
    steps = relabel_observations(jax.random.key(0), replay, steps, jnp.array([True, False]), goal_source(table, batch_config), env)
    batch = transitions(steps, env.achieved_goal, TrainConfig(batch=batch_config), is_demonstration=False)
    assert batch.next_observation.tolist() == [[8.0, 20.0], [8.0, 9.0]]
    assert batch.reward.tolist() == [0.0, 1.0]
    assert batch.discount.tolist() == [0.5, 0.0]
