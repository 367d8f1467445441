"""A second policy that is cloned at the start: that it stays what it is, and, where it proposes actions beside the actor, what is chosen."""

import dataclasses
import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from corridor_training import make_config, make_data, make_env
from probe import ACTIONS, CONFIG, B, fresh_agent, make_batch, one_update, with_agent, with_constant_critics

from hindrl_jax.config import BatchConfig
from hindrl_jax.core import agent as agents
from hindrl_jax.core import imitation, train

CLONING = dataclasses.replace(CONFIG, imitation_steps=10)
PROPOSING = dataclasses.replace(CLONING, imitation_proposal=True)


def playing(actor, action, *, log_std=-5.0):
    """An actor whose mode is `action` in each dimension everywhere."""
    last = max(actor["params"])
    kernel = jnp.zeros_like(actor["params"][last]["kernel"])
    last_layer = {"kernel": kernel, "bias": jnp.repeat(jnp.array([np.arctanh(action), log_std], jnp.float32), kernel.shape[1] // 2)}
    return {"params": {**actor["params"], last: last_layer}}


def preferring(critics, sign):
    """Critics whose value rises with sign * action: the first hidden unit is relu(1 + sign * action / 2), and nothing else is read."""
    first, last = critics["params"]["Dense_0"], critics["params"]["Dense_1"]
    kernel = jnp.zeros_like(first["kernel"]).at[:, -1, 0].set(sign / 2.0)
    bias = jnp.zeros_like(first["bias"]).at[:, 0].set(1.0)
    output = {"kernel": jnp.zeros_like(last["kernel"]).at[:, 0].set(1.0), "bias": jnp.zeros_like(last["bias"])}
    return {"params": {"Dense_0": {"kernel": kernel, "bias": bias}, "Dense_1": output}}


def agent_of(config, *, sign):
    """The actor plays 0.6, the imitation -0.4; the target critics say 1 + sign * action / 2: 1.3 and 0.8, or 0.7 and 1.2."""
    start = fresh_agent(jax.random.key(0), config).replace(log_alpha=jnp.asarray(-30.0))
    target_critics = preferring(start.target_critics, sign)
    return start.replace(actor=playing(start.actor, 0.6), imitation=playing(start.imitation, -0.4), target_critics=target_critics)


@pytest.mark.parametrize(("sign", "chosen"), [(1.0, 0.6), (-1.0, -0.4)])
@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_what_is_done_is_what_the_target_critics_value_more(sign, chosen, noise):
    state = agent_of(PROPOSING, sign=sign)
    policy = agents.policy(state, PROPOSING, average=False).replace(noise=noise)
    action = agents.select_action(jax.random.key(1), policy, jnp.zeros((4, 3)), PROPOSING, action_dim=1)
    np.testing.assert_allclose(action, chosen, atol=0.03 if noise else 1e-5)  # deviations of e^-5 = 0.007


@pytest.mark.parametrize("base", ["tqc", "sac"])
@pytest.mark.parametrize(("sign", "value"), [(1.0, 1.3), (-1.0, 1.2)])
def test_targets_take_the_better_of_both_next_actions(base, sign, value):
    config = with_agent(PROPOSING, base=base)
    batch = make_batch(action=ACTIONS, reward=0.25, discount=0.5)
    metrics = one_update(jax.random.key(0), agent_of(config, sign=sign), batch, config)[1]
    np.testing.assert_allclose(metrics["critic/target"], 0.25 + 0.5 * value, atol=0.01)  # the actor's is sampled


def test_the_bonus_for_entropy_is_only_the_actors():
    # log alpha = 0, and the actor's log-probability at its mode, 0.6, is 5 - log(2 pi) / 2 - log(1 - 0.36) = 4.527: the bonus is -4.527.
    for sign, expected in ((1.0, 1.3 - 4.527), (-1.0, 1.2)):
        state = agent_of(PROPOSING, sign=sign).replace(log_alpha=jnp.asarray(0.0))
        zero, row = jnp.zeros(B), jnp.zeros((1, B))
        block = agents._Columns(
            inputs=jnp.zeros((3, B)),
            next_inputs=jnp.zeros((3, B)),
            action=row,
            noise=row,
            next_noise=row,
            reward=zero,
            discount=zero + 1.0,
            is_demonstration=zero > 0,
        )
        np.testing.assert_allclose(agents._targets(state, state.target_critics, PROPOSING, block), expected, atol=1e-3)


def test_the_imitation_is_frozen_and_the_rest_of_the_agent_learns():
    start = agent_of(PROPOSING, sign=1.0)
    after = one_update(jax.random.key(0), start, make_batch(action=ACTIONS, reward=ACTIONS[:, 0], discount=0.0), PROPOSING)[0]
    chex.assert_trees_all_equal(after.imitation, start.imitation)
    assert np.abs(after.actor["params"]["Dense_1"]["bias"] - start.actor["params"]["Dense_1"]["bias"]).max() > 0.0


def test_there_is_no_imitation_where_none_is_cloned():
    state = with_constant_critics(fresh_agent(jax.random.key(0)), [0.0, 0.0])
    assert state.imitation is None
    assert agents.policy(state, CONFIG, average=False).actor is state.actor


@pytest.mark.parametrize(("config", "sign"), [(CLONING, 1.0), (PROPOSING, 1.0), (PROPOSING, -1.0)])
def test_the_imitation_acts_alone_where_it_is_asked_and_without_noise(config, sign):
    state = agent_of(config, sign=sign)
    clone = agents.policy(state, config, average=True, imitates=True)
    chex.assert_trees_all_equal_structs(clone, agents.policy(state, config, average=True))  # so that they are kept and saved alike
    for noise in (0.0, 1.0):
        action = agents.select_action(jax.random.key(1), clone.replace(noise=noise), jnp.zeros((4, 3)), config, action_dim=1)
        np.testing.assert_allclose(action, -0.4, atol=1e-6)


def test_a_clone_that_does_not_propose_has_no_part_in_what_is_done_and_learnt():
    with_clone = agent_of(CLONING, sign=-1.0)
    without = with_clone.replace(imitation=None)
    assert agents.policy(with_clone, CLONING, average=False).actor is with_clone.actor
    action = agents.select_action(jax.random.key(1), agents.policy(with_clone, CLONING, average=True), jnp.zeros((4, 3)), CLONING, action_dim=1)
    expected = agents.select_action(jax.random.key(1), agents.policy(without, CONFIG, average=True), jnp.zeros((4, 3)), CONFIG, action_dim=1)
    np.testing.assert_array_equal(action, expected)
    batch = make_batch(action=ACTIONS, reward=ACTIONS[:, 0], discount=0.5)
    after, plain = (one_update(jax.random.key(0), state, batch, config)[0] for state, config in ((with_clone, CLONING), (without, CONFIG)))
    chex.assert_trees_all_equal(after.replace(imitation=None), plain)


def test_the_imitation_is_cloned_and_all_else_stays_as_it_is():
    agent = dataclasses.replace(make_config().agent, learning_rate=1e-2)
    config = make_config(agent=agent, imitation_steps=300, batch=BatchConfig(batch_size=32))
    data, env = make_data(config), make_env()
    start = train.init(jax.random.key(0), data, env, config)
    state, clones = jax.jit(functools.partial(imitation.imitate, env=env, config=config))(start, data, imitation.no_practice(env))
    chex.assert_trees_all_equal(*(each.replace(agent=each.agent.replace(imitation=None)) for each in (state, start)))
    act = train.make_policy(agents.policy(state.agent, config, average=True, imitates=True), env, config)
    action = act(jax.random.key(0), data.demonstrations.observations[:, 0], data.demonstrations.desired_goals)
    np.testing.assert_allclose(action[:, 1], -0.5, atol=0.2)  # all demonstrated second actions
    chex.assert_trees_all_equal(clones[-1], state.agent.imitation)
    of_each = [state.agent.replace(imitation=clone) for clone in clones]
    acts = [train.make_policy(agents.policy(agent, config, average=True, imitates=True), env, config) for agent in of_each]
    seen = data.demonstrations.observations[:, 0], data.demonstrations.desired_goals
    errors = [float(jnp.mean((act(jax.random.key(0), *seen)[:, 1] + 0.5) ** 2)) for act in acts]
    assert errors[0] > errors[-1]


def played(env, *, delays, lengths=None, marks=0.0):
    """Episodes of 3 steps whose rewards begin after so many; -1 for none at all. Their first actions are the mark."""
    steps, delays = jnp.arange(env.horizon)[None], jnp.array(delays)[:, None]
    lengths = jnp.full(len(delays), 3) if lengths is None else jnp.array(lengths)
    table = imitation.no_practice(env).episodes
    table = jax.tree.map(lambda leaf: leaf[: len(delays)], table)
    rewards = jnp.where((delays >= 0) & (steps >= delays) & (steps < lengths[:, None]), 1.0, 0.0)
    return table.replace(rewards=rewards, lengths=lengths.astype(jnp.int32), actions=table.actions.at[:, 0, 0].set(marks))


def test_the_fastest_solved_attempt_at_each_start_is_remembered():
    env = make_env()
    best = jax.tree.map(lambda leaf: leaf[:4] if leaf.ndim else leaf, imitation.no_practice(env))
    assert not best.solved.any()
    outcomes = []
    for mark, delays in enumerate([(2, -1, 1, -1), (1, 2, 1, -1), (2, 1, 0, -1)], start=1):
        best, attempts = imitation.with_attempt(best, played(env, delays=delays, marks=mark))
        outcomes.append(attempts)
    assert best.solved.tolist() == [True, True, True, False]
    assert best.episodes.actions[:3, 0, 0].tolist() == [2.0, 3.0, 3.0]
    assert outcomes[0].solved.tolist() == [True, False, True, False]
    assert outcomes[0].delay.tolist() == [2, 3, 1, 3]
    best, _ = imitation.with_attempt(best, played(env, delays=(1, 1, 0, -1), marks=9.0))  # no faster
    assert best.episodes.actions[:3, 0, 0].tolist() == [2.0, 3.0, 3.0]


def test_an_attempt_that_leaves_its_goal_is_not_solved():
    env = make_env()
    episodes = played(env, delays=(1, 1))
    episodes = episodes.replace(rewards=episodes.rewards.at[0, 2].set(0.0))
    best = jax.tree.map(lambda leaf: leaf[:2] if leaf.ndim else leaf, imitation.no_practice(env))
    best, attempts = imitation.with_attempt(best, episodes)
    assert best.solved.tolist() == attempts.solved.tolist() == [False, True]
    assert attempts.delay.tolist() == [2, 1]


def test_what_was_solved_is_cloned_beside_the_demonstrations_and_nothing_else():
    """Demonstrations and episodes of practice are drawn alike; in the place of one that did not solve the task a demonstration is."""
    config = make_config(imitation_steps=3, batch=BatchConfig(batch_size=64))
    data, env = make_data(config), make_env()
    practice = imitation.no_practice(env)
    size = practice.solved.shape[0]
    practice = practice.replace(
        episodes=practice.episodes.replace(actions=jnp.where(jnp.arange(size) % 2 == 0, 0.25, -0.75)[:, None, None] + practice.episodes.actions),
        solved=jnp.arange(size) % 2 == 0,
    )
    examples = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), data.demonstrations, practice.episodes)
    draw = jax.jit(jax.vmap(lambda key: imitation._sample_examples(key, examples, practice.solved, env, config)))
    actions = draw(jax.random.split(jax.random.key(0), 200)).action[..., 1]
    num_demos = data.demonstrations.lengths.shape[0]
    assert not (actions == -0.75).any()
    np.testing.assert_allclose((actions == 0.25).mean(), size / 2 / (num_demos + size), atol=0.01)
    np.testing.assert_allclose((actions == -0.5).mean(), 1.0 - size / 2 / (num_demos + size), atol=0.01)  # all demonstrated second actions


def test_practice_plays_each_start_several_times_and_its_episodes_are_what_the_environment_makes_of_their_actions():
    config = make_config(imitation_steps=3)
    data, env = make_data(config), make_env()
    state = train.init(jax.random.key(0), data, env, config)
    state = state.replace(agent=state.agent.replace(imitation=playing(state.agent.imitation, 0.0)))  # 5 steps of 1, for more than 4
    practise = jax.jit(functools.partial(imitation.practise, env=env, config=config))
    practice, attempts = practise(state, data, imitation.no_practice(env))
    assert int(practice.num_rounds) == 1
    assert attempts.solved.shape == attempts.length.shape == attempts.delay.shape == (len(imitation.NOISES), imitation.NUM_STARTS)
    np.testing.assert_array_equal(practice.solved, attempts.solved.any(axis=0))
    assert attempts.solved[0].all()
    fastest = jnp.where(attempts.solved, attempts.delay, env.horizon).min(axis=0)
    np.testing.assert_array_equal(practice.episodes.lengths - 1, fastest)
    assert (fastest < attempts.delay[0]).any()  # noise helps here and there
    episodes = jax.device_get(practice.episodes)
    assert len(np.unique(episodes.observations[:, 0])) > imitation.NUM_STARTS // 2
    for row in range(3):
        start = jnp.array([episodes.observations[row, 0, 0], 0.0, 0.0])
        state_of_env = env.vector_to_state(jax.random.key(0), start)
        for step in range(int(episodes.lengths[row])):
            state_of_env, time_step = env.step(state_of_env, 1.0 + episodes.actions[row, step])
            np.testing.assert_allclose(time_step.observation, episodes.observations[row, step + 1], atol=1e-5)
            assert float(time_step.reward) == episodes.rewards[row, step]
    again, _ = practise(state, data, practice)
    assert int(again.num_rounds) == 2
    assert not np.array_equal(again.episodes.observations[:, 0], episodes.observations[:, 0])  # other starts
