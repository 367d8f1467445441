"""A replay in which every stored number says which environment, episode and step it belongs to, so that a sample says where it came from.

States are (environment, episode, step). Demonstrations take the place of environment 9. The achieved goal is the state itself, and the
behavioural goal of an episode is (-1 - environment, episode, 0), which no state equals.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import strategies as st
from toy_env import Corridor

from hindrl_jax.base.types import Episodes
from hindrl_jax.config import BatchConfig, TrainConfig
from hindrl_jax.core import replay as replays
from hindrl_jax.core.goals import GoalTable, constant_goal
from hindrl_jax.core.guidance import Guidance
from hindrl_jax.core.hindsight import NEARBY_GOAL
from hindrl_jax.core.inputs import InputScale
from hindrl_jax.core.replay import RecordedStep

NUM_ENVS, HORIZON, SLOTS = 2, 3, 4
NUM_ADDS = 40
DEMO_LENGTHS = (3, 1, 2)
DEMO = 9
DEMO_STATES = [(DEMO, i, t) for i, length in enumerate(DEMO_LENGTHS) for t in range(length + 1)]
_GOALS = jnp.array([*DEMO_STATES, (np.nan,) * 3], jnp.float32)  # the last row is padding
TABLE = GoalTable(goals=_GOALS, observations=_GOALS, count=jnp.asarray(len(DEMO_STATES)))

LENGTHS = st.lists(st.lists(st.integers(1, HORIZON), min_size=1, max_size=5), min_size=NUM_ENVS, max_size=NUM_ENVS)
BATCH = BatchConfig(batch_size=64, max_demo_ratio=0.2, relabelled_per_original=3, gamma=0.5, n_step=2)
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
}


@dataclasses.dataclass(frozen=True)
class Numbered(Corridor):
    """What replay and batch need to know of an environment: its dimensions, and that the achieved goal is the observation. It is never stepped."""

    horizon: int = HORIZON
    goal_dim: int = 3
    action_dim: int = 1

    def achieved_goal(self, observation):
        return observation


@dataclasses.dataclass(frozen=True)
class NumberedTask(Numbered):
    """The task is about two states, which are observed: hindsight writes them, as decimal digits, into the first two numbers of an observation. It is
    solved at the step of the second."""

    num_subgoals: int = 2

    def relabel_observations(self, key, observations, subgoals):
        codes = 1000.0 + subgoals @ jnp.array([100.0, 10.0, 1.0])
        return observations.at[:, :2].add(10.0 * codes[None]), observations[1:, 2] >= subgoals[1, 2]


def batch_of(strategy, **changes):
    """BATCH with one of STRATEGIES."""
    return dataclasses.replace(BATCH, hindrl_sampling_strategy=strategy.split()[-1], **STRATEGIES[strategy], **changes)


def reward_of(env, episode, step):
    return 1000.0 * env + 10.0 * episode + step


def is_terminated(episode):
    return episode % 2 == 0


def near(env, episode, step):
    """The row of TABLE that these tests take for near a state; -1 for every other state."""
    return (env + 2 * episode + step) % len(DEMO_STATES) if (episode + step) % 2 else -1


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


def guidance():
    """The demonstrations, their goals, and a box of half-width 0."""
    ones = jnp.ones(3)
    return Guidance(
        demonstrations=demonstrations(),
        goals=TABLE,
        behavioural_goals=constant_goal(jnp.zeros(3)),
        epsilon=jnp.zeros(3),
        scale=InputScale(observation=ones, goal=ones, observation_centre=0.0 * ones, goal_centre=0.0 * ones),
        starts=None,
    )


def empty_replay():
    """Room for SLOTS episodes per environment, and some more transitions that do not make a slot."""
    return replays.init(Numbered(), num_envs=NUM_ENVS, capacity=NUM_ENVS * HORIZON * SLOTS + 5, notes={NEARBY_GOAL: -1})


@jax.jit
def _add_all(stream):
    """The replay after each of the steps in `stream`: leaves (NUM_ADDS, ...)."""

    def add(replay, recorded):
        replay = replays.add(replay, recorded)
        return replay, replay

    return jax.lax.scan(add, empty_replay(), stream)[1]


def replay_history(lengths):
    """Plays episodes of the given lengths over and over.

    Args:
      lengths: one list of episode lengths per environment.

    Returns:
      The replay after each step, and for each step and environment the list of complete episodes: [step][env] -> [length, ...].
    """
    names = ("observation", "desired_goal", "action", "reward", "next_observation", "terminated", "truncated", NEARBY_GOAL)
    stream = {name: [] for name in names}
    episode, step, complete, history = [0] * NUM_ENVS, [0] * NUM_ENVS, [[] for _ in range(NUM_ENVS)], []
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
            row[NEARBY_GOAL].append(near(env, now, t + 1))
            if last:
                complete[env].append(length)
            episode[env], step[env] = (now + 1, 0) if last else (now, t + 1)
        for name in names:
            stream[name].append(row[name])
        history.append([list(lengths) for lengths in complete])
    kinds = {"terminated": bool, "truncated": bool, NEARBY_GOAL: np.int32}
    arrays = {name: np.asarray(rows, kinds.get(name, np.float32)) for name, rows in stream.items()}
    notes = {NEARBY_GOAL: arrays.pop(NEARBY_GOAL)}
    return _add_all(RecordedStep(**arrays, notes=notes)), history


def at(history, step):
    return jax.tree.map(lambda leaf: leaf[step], jax.device_get(history))


def kept(complete):
    """What a ring must still hold: {(env, episode): length} of the newest complete episodes, one slot being kept free for writing."""
    return {(env, episode): length for env, lengths in enumerate(complete) for episode, length in list(enumerate(lengths))[-(SLOTS - 1) :]}


def triples(array):
    return [tuple(map(int, row)) for row in np.asarray(array)]


def expected_return(state, length, goal, *, by_goal, config: TrainConfig):
    """(reward, discount, next state) of the transition that starts in `state`, as a plain loop; rewarded for its goal, or as recorded."""
    env, episode, step = state
    total, discount, following = 0.0, 1.0, state
    for t in range(step, min(step + config.batch.n_step, length)):
        following = (env, episode, t + 1)
        reached = by_goal and following == goal
        total += discount * ((1.0 if reached else 0.0) if by_goal else reward_of(env, episode, t))
        discount *= config.batch.gamma
        solved = t == length - 1 and (is_terminated(episode) or config.quirks.timeouts_are_terminal)
        if solved or (reached and not config.quirks.bootstrap_past_relabelled_goals):
            return total, 0.0, following
    return total, discount, following


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
    return set(goals[strategy])


def check_rows(batch, in_hindsight, sources, strategy, config: TrainConfig):
    """Each row is what a plain loop makes of the state that it begins in; `in_hindsight` says which rows are to be relabelled."""
    states, nexts, goals = triples(batch.observation), triples(batch.next_observation), triples(batch.desired_goal)
    assert (triples(batch.achieved_goal), triples(batch.next_achieved_goal)) == (states, nexts)
    for row, (state, goal) in enumerate(zip(states, goals, strict=True)):
        env, episode, t = state
        is_demonstration = batch.is_demonstration[row]
        length = DEMO_LENGTHS[episode] if is_demonstration else sources[env, episode]  # a KeyError here: not a complete episode
        assert (env == DEMO) == is_demonstration
        assert t < length
        allowed = allowed_goals(strategy, state, length, sources) if in_hindsight[row] else set()
        relabelled = bool(allowed)
        assert batch.is_relabelled[row] == relabelled
        assert goal in (allowed if relabelled else {(-1 - env, episode, 0)})
        reward, discount, following = expected_return(state, length, goal, by_goal=relabelled, config=config)
        assert (batch.reward[row], batch.discount[row]) == (reward, discount)  # exact, since gamma = 1/2
        assert nexts[row] == following
        assert batch.action[row, 0] == reward_of(env, episode, t)
