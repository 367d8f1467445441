"""Held actions in the toy corridor, worked by hand: what a decision does, when it ends early, and what becomes of demonstrations."""

import dataclasses
from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toy_env import Corridor, corridor_demonstrations

from hindrl_jax.base.environments import RelabelsObservations, Restorable, action_to_env, can_step, compiler_options, state_dim
from hindrl_jax.base.errors import UserError
from hindrl_jax.base.types import Episodes
from hindrl_jax.config import TrainConfig
from hindrl_jax.core.holding import hold, hold_demonstrations, longest_hold, with_action_hold

FORWARD = jnp.array([1.0, 0.5])


def follow(env, actions, *, key=0):
    """The states and time steps of one episode, and the state at its start."""
    start, _ = env.reset(jax.random.key(key))
    state, steps = start, []
    for action in actions:
        state, time_step = env.step(state, action)
        steps.append((state, time_step))
    return start, steps


def assert_equal_trees(found, expected):
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        a, b = (jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x for x in (a, b))
        np.testing.assert_array_equal(a, b)


def test_a_decision_is_as_many_steps_with_the_same_action():
    """The state of the corridor has a random key, which is carried along as well."""
    env = Corridor(horizon=20, width=10.0)
    start, decisions = follow(hold(env, 3), [FORWARD, 2.0 * FORWARD])
    same, steps = follow(env, [FORWARD] * 3 + [2.0 * FORWARD] * 3)
    assert_equal_trees(start, same)
    for decision, last in zip(decisions, steps[2::3], strict=True):
        assert_equal_trees(decision, last)
    assert [float(time_step.observation[2]) for _, time_step in decisions] == [3.0, 9.0]


def test_a_decision_ends_where_the_task_is_solved_and_its_reward_is_kept():
    env = Corridor(horizon=20, width=3.0)
    state, time_step = follow(hold(env, 8), [FORWARD])[1][0]
    assert (float(state.position), int(state.step)) == (4.0, 4)  # the fifth step would lead to 5
    assert (float(time_step.reward), bool(time_step.terminated), bool(time_step.truncated)) == (1.0, True, False)
    assert time_step.observation.tolist() == [state.start, 4.0, 4.0]


def test_a_decision_ends_at_the_horizon():
    env = Corridor(horizon=5, width=30.0)
    held = hold(env, 2)
    assert held.horizon == 3
    *_, (_, before), (state, time_step) = follow(held, [FORWARD] * 3)[1]
    assert not before.truncated
    assert (float(state.position), int(state.step)) == (5.0, 5)  # and not 6
    assert (float(time_step.reward), bool(time_step.terminated), bool(time_step.truncated)) == (0.0, False, True)


@pytest.mark.parametrize(("horizon", "num_held", "decisions"), [(5, 2, 3), (6, 2, 3), (5, 5, 1), (5, 8, 1), (7, 3, 3)])
def test_the_horizon_counts_decisions(horizon, num_held, decisions):
    assert hold(Corridor(horizon=horizon), num_held).horizon == decisions


def test_an_action_held_once_is_not_held():
    env = Corridor()
    assert hold(env, 1) is env


@dataclass(frozen=True)
class AbleCorridor(Corridor):
    """A corridor that can do more, and has fields named as those of what holds it."""

    gives_goals: ClassVar[bool] = False
    env: str = "own"
    num_held: int = 7

    @property
    def compiler_options(self):
        return {"option": 1}

    @property
    def num_subgoals(self):
        return 1

    def relabel_observations(self, key, observations, subgoals):
        return observations, observations[1:, 2] > subgoals[0, 2]


@dataclass(frozen=True)
class Steppers:
    """Steppable on the host only: says which stepper it was asked for."""

    name: ClassVar[str] = "Steppers"
    horizon: int = 5

    def stepper(self, num_envs, *, num_held=1):
        return num_envs, num_held

    def watched(self, *, with_pictures):
        return None


def test_a_held_environment_is_able_to_do_what_its_own_is():
    plain, able = hold(Corridor(), 2), hold(AbleCorridor(), 2)
    for held, relabels, options in ((plain, False, {}), (able, True, {"option": 1})):
        assert can_step(held)
        assert isinstance(held, Restorable)
        assert isinstance(held, RelabelsObservations) == relabels
        assert compiler_options(held, learns=True) == options
        assert state_dim(held) == 3
        assert (held.name, held.observation_dim, held.action_dim, held.action_high) == ("Corridor", 3, 2, 2.0)
    assert (able.env, able.num_held) == (AbleCorridor(), 2)
    vector = jnp.array([0.5, 2.0, 3.0])
    np.testing.assert_array_equal(plain.state_to_vector(plain.vector_to_state(jax.random.key(0), vector)), vector)


def test_a_held_environment_is_a_static_value():
    assert hold(Corridor(), 2) == hold(Corridor(), 2)
    assert hash(hold(Corridor(), 2)) == hash(hold(Corridor(), 2))
    assert hold(Corridor(), 2) != hold(Corridor(), 3)
    assert hold(Corridor(), 2) != hold(Corridor(width=4.0), 2)
    assert dataclasses.replace(hold(Corridor(), 2), num_held=3) == hold(Corridor(), 3)


def test_the_host_holds_actions_by_itself():
    held = hold(Steppers(), 3)
    assert held.stepper(4) == (4, 3)
    assert not can_step(held)
    assert not hasattr(held, "watched")  # it would show control steps


def test_a_chunk_is_as_many_steps_with_an_action_each():
    env = Corridor(horizon=20, width=10.0)
    chunks, decision = hold(env, 3, chunks=True), jnp.array([1.0, 0.0, 2.0, 0.1, 0.5, 0.2])
    assert (chunks.action_dim, hold(env, 3).action_dim, chunks.horizon) == (6, 2, 7)
    (*_, (state, time_step)), (*_, (expected, last)) = follow(chunks, [decision, decision[::-1]])[1], follow(env, CHUNK + BACKWARDS)[1]
    assert_equal_trees((state, time_step), (expected, last))


CHUNK = [jnp.array(action) for action in ([1.0, 0.0], [2.0, 0.1], [0.5, 0.2])]
BACKWARDS = [jnp.array(action) for action in ([0.2, 0.5], [0.1, 2.0], [0.0, 1.0])]


def test_a_chunk_ends_where_the_task_is_solved():
    env = Corridor(horizon=20, width=3.0)
    state, time_step = follow(hold(env, 4, chunks=True), [jnp.array([2.0, 0.5, 1.5, 0.5, 2.0, 0.5, 2.0, 0.5])])[1][0]
    assert (float(state.position), int(state.step)) == (3.5, 2)  # neither of the last two actions is taken
    assert (float(time_step.reward), bool(time_step.terminated), bool(time_step.truncated)) == (1.0, True, False)


def test_each_action_of_a_chunk_has_the_bounds_of_its_own_dimension():
    bounded = hold(BoundedCorridor(), 3, chunks=True)
    assert bounded.action_low.tolist() == [0.0, -1.0] * 3
    assert bounded.action_high == 2.0
    # [-1, 1] to [0, 2] and [-1, 2]
    np.testing.assert_allclose(action_to_env(jnp.array([-1.0, -1.0, 0.0, 0.0, 1.0, 1.0]), bounded), [0.0, -1.0, 1.0, 0.5, 2.0, 2.0])


@dataclass(frozen=True)
class BoundedCorridor(Corridor):
    """A corridor whose actions have bounds of their own."""

    @property
    def action_low(self):
        return jnp.array([0.0, -1.0])


def table(**changes):
    """One demonstration of 5 steps, in a table of 6: observations 0, 10, ..., actions 0.0, 0.1, ..., and padding that must not be read."""
    fields = dict(
        observations=np.array([[[0], [10], [20], [30], [40], [50], [99]]], np.float32),
        actions=np.array([[[0.0], [0.1], [0.2], [0.3], [0.4], [np.nan]]], np.float32),
        rewards=np.array([[0, 0, 0, 0, 1, 99]], np.float32),
        lengths=np.array([5], np.int32),
        terminated=np.array([True]),
        desired_goals=np.array([[50.0]], np.float32),
        states=np.array([[[0], [-1], [-2], [-3], [-4], [-5], [np.nan]]], np.float32),
    )
    return Episodes(**(fields | changes))


def test_demonstrations_are_held_as_worked_by_hand():
    held = hold_demonstrations(table(), 2)
    assert held.lengths.tolist() == [3]
    assert held.observations[0, :, 0].tolist() == [0.0, 20.0, 40.0, 50.0]  # the last decision is a step alone
    assert held.states[0, :, 0].tolist() == [0.0, -2.0, -4.0, -5.0]
    np.testing.assert_allclose(held.actions[0, :, 0], [0.05, 0.25, 0.4], atol=1e-7)
    assert held.rewards.tolist() == [[0.0, 0.0, 1.0]]
    assert (held.terminated.tolist(), held.desired_goals.tolist()) == ([True], [[50.0]])
    for leaf, before in zip(jax.tree.leaves(held), jax.tree.leaves(table()), strict=True):
        assert isinstance(leaf, np.ndarray)
        assert leaf.dtype == before.dtype


def test_where_the_goal_is_to_be_held_a_decision_has_the_reward_of_its_last_step():
    rewards = np.array([[0, 1, 1, 1, 1, 99]], np.float32)  # decisions of steps 0 and 1, 2 and 3, and 4 alone
    assert hold_demonstrations(table(rewards=rewards), 2, holds_goal=True).rewards.tolist() == [[1.0, 1.0, 1.0]]
    rewards = np.array([[1, 0, 0, 1, 99, 99]], np.float32)
    held = hold_demonstrations(table(rewards=rewards, lengths=np.array([4], np.int32)), 2, holds_goal=True)
    assert held.rewards.tolist() == [[0.0, 1.0, 0.0]]


def test_demonstrations_are_cut_into_chunks_as_worked_by_hand():
    chunks, held = hold_demonstrations(table(), 2, chunks=True), hold_demonstrations(table(), 2)
    # The third decision is a step alone, whose action 0.4 is repeated; nothing is blurred, and the padding is not read.
    np.testing.assert_array_equal(chunks.actions[0], np.array([[0.0, 0.1], [0.2, 0.3], [0.4, 0.4]], np.float32))
    jax.tree.map(np.testing.assert_array_equal, chunks.replace(actions=held.actions), held)  # all else is the same
    # Of two dimensions the first action's come first; of a shorter demonstration its own last action is repeated.
    actions = np.arange(24, dtype=np.float32).reshape(2, 6, 2)
    both = jax.tree.map(lambda leaf: np.concatenate([leaf, leaf]), table()).replace(actions=actions, lengths=np.array([5, 4], np.int32))
    found = hold_demonstrations(both, 3, chunks=True).actions
    assert found.tolist() == [[[0, 1, 2, 3, 4, 5], [6, 7, 8, 9, 8, 9]], [[12, 13, 14, 15, 16, 17], [18, 19, 18, 19, 18, 19]]]
    per_seed = jax.tree.map(lambda leaf: leaf[None], both)
    assert hold_demonstrations(per_seed, 3, chunks=True).actions.tolist() == [found.tolist()]


def test_a_demonstration_in_chunks_is_the_demonstration():
    env = Corridor(horizon=7, width=3.0)
    demonstrations = corridor_demonstrations((1.0, 0.5, 0.8), env=env)
    chunks_env, chunks = hold(env, 2, chunks=True), hold_demonstrations(demonstrations, 2, chunks=True)
    for index, length in enumerate(chunks.lengths):
        state = env.vector_to_state(jax.random.key(0), chunks.states[index, 0])
        for t in range(int(length)):
            state, time_step = chunks_env.step(state, action_to_env(chunks.actions[index, t], chunks_env))
            np.testing.assert_allclose(time_step.observation, chunks.observations[index, t + 1], atol=1e-5)
        assert time_step.terminated


def test_chunks_are_refused_where_there_would_be_none():
    with pytest.raises(ValueError, match="action_hold = 1: raise that, too"):
        TrainConfig(action_chunks=True, action_hold=1)
    config = TrainConfig(action_chunks=True)
    with pytest.raises(UserError, match="too short for chunks"):
        with_action_hold(config, table())
    long = with_action_hold(config, table(lengths=np.array([250], np.int32)))
    assert (long.action_hold, long.action_chunks) == (4, True)


def test_padding_of_held_demonstrations_is_finite():
    held = hold_demonstrations(table(lengths=np.array([2], np.int32), rewards=np.array([[0, 1, 99, 99, 99, 99]], np.float32)), 2)
    assert held.lengths.tolist() == [1]
    assert held.observations[0, :, 0].tolist() == [0.0, 20.0, 20.0, 20.0]
    assert held.rewards.tolist() == [[1.0, 0.0, 0.0]]
    np.testing.assert_allclose(held.actions[0, :, 0], [0.05, 0.0, 0.0], atol=1e-7)


def test_demonstrations_are_held_for_each_seed_and_without_states():
    other = table(lengths=np.array([4], np.int32), actions=-table().actions)
    both = hold_demonstrations(jax.tree.map(lambda *leaves: np.stack(leaves), table(), other), 3)
    for index, one in enumerate((table(), other)):
        jax.tree.map(np.testing.assert_array_equal, jax.tree.map(lambda leaf, i=index: leaf[i], both), hold_demonstrations(one, 3))
    assert hold_demonstrations(table(states=None), 3).states is None
    assert hold_demonstrations(other, 1) is other


def test_a_held_demonstration_leads_to_the_same_place_where_commands_add_up():
    """Whose last decision is cut short by the end of the task: it is held on, but the episode is over."""
    env = Corridor(horizon=7, width=3.0)
    demonstrations = corridor_demonstrations((1.0, 0.5, 0.8), env=env)
    held_env, held = hold(env, 2), hold_demonstrations(demonstrations, 2)
    for index, length in enumerate(held.lengths):
        state = env.vector_to_state(jax.random.key(0), held.states[index, 0])
        time_step = None
        for t in range(int(length)):
            assert time_step is None or not time_step.terminated
            state, time_step = held_env.step(state, held.actions[index, t] + 1.0)  # from [-1, 1] to [0, 2]
            np.testing.assert_allclose(time_step.observation, held.observations[index, t + 1], atol=1e-5)
        assert time_step.terminated
        np.testing.assert_allclose(env.state_to_vector(state), demonstrations.states[index, demonstrations.lengths[index]], atol=1e-5)


def test_a_held_demonstration_of_changing_commands_leads_to_the_same_place():
    env = Corridor(horizon=6, width=30.0)
    actions = jnp.array([0.5, 1.5, 0.0, 1.0, 2.0, 0.25])
    demonstration = table(actions=np.asarray(actions)[None, :, None] - 1.0, lengths=np.array([6], np.int32))
    held = hold_demonstrations(demonstration, 3).actions[0, :, 0] + 1.0
    (*_, (state, _)), (*_, (expected, _)) = (
        follow(e, [jnp.array([a, 0.0]) for a in commands])[1] for e, commands in ((hold(env, 3), held), (env, actions))
    )
    np.testing.assert_allclose(state.position, expected.position, rtol=1e-6)


@pytest.mark.parametrize(("length", "num_held"), [(55, 1), (119, 1), (120, 2), (290, 4), (410, 6)])
def test_actions_are_held_as_long_as_sixty_decisions_remain(length, num_held):
    assert longest_hold(np.array([length])) == num_held
    assert longest_hold(np.array([[length, 1, 10_000]])) == num_held  # the median
