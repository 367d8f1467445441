"""A run's policies and critics as functions: in JAX they are what training played, in NumPy alone the same, and both refuse what they cannot use."""

import ast
import dataclasses
import subprocess
import sys
from pathlib import Path

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen as nn
from tiny import CONFIG, ENV

import hindrl_jax as hindrl
from hindrl_jax.base.environments import action_from_env
from hindrl_jax.config import GoalConfig, QuirksConfig
from hindrl_jax.core import agent, losses
from hindrl_jax.core.goals import GoalTable
from hindrl_jax.core.holding import hold
from hindrl_jax.core.inputs import InputScale, network_inputs
from hindrl_jax.core.networks import apply_critics
from hindrl_jax.runs import numpy_policy
from hindrl_jax.runs.reader import Run
from hindrl_jax.runs.spec import RunSpec

POINT, FLAT = "gymnasium:point_env:PointGoal-v0", "gymnasium:flat_env:PointFlat-v0"
OWN_GOALS = GoalConfig(behavioural_goals="environment")


def untrained(env=ENV, noise=0.0, **agent_fields):
    """A run of two seeds, 5 and 7, whose policies and critics are as they begin, in a task; other fields of the config beside those of its agent."""
    others = {
        name: agent_fields.pop(name)
        for name in ("action_hold", "action_chunks", "imitation_steps", "imitation_proposal", "quirks", "goal")
        if name in agent_fields
    }
    config = dataclasses.replace(CONFIG, **others, agent=dataclasses.replace(CONFIG.agent, net_arch=(6, 6), **agent_fields))
    decisions = hold(env, config.num_held, chunks=config.action_chunks)
    rng = np.random.default_rng(0)
    dims = dict(observation=env.observation_dim, goal=env.goal_dim)
    scale = {name: rng.uniform(0.5, 2.0, dim) for name, dim in dims.items()} | {f"{name}_centre": rng.normal(size=dim) for name, dim in dims.items()}
    scale = InputScale(**{name: jnp.asarray(values, jnp.float32) for name, values in scale.items()})
    begin = jax.jit(jax.vmap(lambda key: agent.init(key, scale, config, action_dim=decisions.action_dim)))
    states = begin(jax.random.split(jax.random.key(3), 2))
    policies = agent.policy(states, config, average=True).replace(noise=jnp.full(2, noise))
    goals = GoalTable(goals=jnp.asarray(rng.normal(size=(2, 3, env.goal_dim)), jnp.float32), count=jnp.array([3, 3]))
    return Run(Path("runs/mine"), RunSpec(env, config, "1", (5, 7)), policies, goals, states.critics)


def draws(env, *leading):
    rng = np.random.default_rng(1)
    return [rng.normal(size=(*leading, dim)).astype(np.float32) for dim in (env.observation_dim, env.goal_dim)]


CASES = {
    "multiscale": {},
    "raw": dict(input_encoding="raw"),
    "standardised": dict(input_encoding="standardised"),
    "residual": dict(residual=True),
    "held": dict(action_hold=3),
    "chunks": dict(action_hold=3, action_chunks=True),
    "with goals of its own": dict(env=POINT, goal=OWN_GOALS),
    "flat": dict(env=FLAT),
}


@pytest.mark.parametrize("name", CASES)
def test_a_policy_in_numpy_is_that_in_jax(name):
    case = dict(CASES[name])
    env = hindrl.make(case.pop("env")) if "env" in case else ENV
    run = untrained(env, **case)
    policy, plain = run.policy(7), run.numpy_policy(7)
    observation, goal = draws(env, 4)
    observation[3] *= 1e4  # far outside the demonstrations
    shape = (3, env.action_dim) if name == "chunks" else (env.action_dim,)
    action = np.asarray(policy(observation, goal))
    chex.assert_shape(action, (4, *shape))
    np.testing.assert_allclose(plain(observation, goal), action, atol=2e-6)
    assert np.abs(action - run.policy(5)(observation, goal)).max() > 1e-3
    np.testing.assert_allclose(policy(observation[1], goal[1]), action[1], atol=1e-6)
    np.testing.assert_allclose(plain(observation[:, None], goal[1]).reshape(4, *shape)[1], action[1], atol=2e-6)
    assert (plain.action_hold, plain.chunks, plain.task) == (policy.action_hold, policy.chunks, env.name)
    assert np.all((action >= plain.action_low) & (action <= plain.action_high))
    if name == "with goals of its own":
        for one, error in ((policy, hindrl.UserError), (plain, ValueError)):
            with pytest.raises(error, match="has a goal of its own in each episode: give it"):
                one(observation)
    else:
        np.testing.assert_array_equal(policy(observation), policy(observation, run.behavioural_goals.goals[1, 0]))
        np.testing.assert_allclose(plain(observation), policy(observation), atol=2e-6)


def test_whole_numbers_are_given_where_a_task_takes_such():
    env = hindrl.make("gymnasium:odd_env:Odd-v0", action="int8", low=[-3, 2], high=[3, 2], dims=2, threshold=5.0)
    run = untrained(env)
    observation, goal = (30.0 * values for values in draws(env, 50))
    action = np.asarray(run.policy()(observation, goal))
    np.testing.assert_array_equal(action, np.rint(action))
    assert -3 in action[:, 0]
    assert len(set(action[:, 0])) > 3
    assert np.abs(action[:, 0]).max() == 3
    assert set(action[:, 1]) == {2}
    np.testing.assert_array_equal(run.numpy_policy()(observation, goal), action)


def test_a_run_whose_networks_saw_goals_otherwise_is_refused():
    written = untrained(hindrl.make(POINT), goal=OWN_GOALS).spec.to_json()
    assert RunSpec.from_json(written, "config.json").env == hindrl.make(POINT)
    del written["env_args"]["success"]
    with pytest.raises(hindrl.UserError, match=r"networks saw goals otherwise .* so its policies would be misread: train again"):
        RunSpec.from_json(written, "config.json")


def test_a_run_from_before_proposals_were_a_switch_is_read_where_it_has_none():
    written = untrained().spec.to_json()
    expected = RunSpec.from_json(written, "config.json")
    before = written | {"config": {name: value for name, value in written["config"].items() if name != "imitation_steps"}}
    before["config"]["imitation_proposal"] = 0
    assert RunSpec.from_json(before, "config.json") == expected
    before["config"]["imitation_proposal"] = 2_000
    with pytest.raises(hindrl.UserError, match="imitation_proposal = 2000 is not usable"):
        RunSpec.from_json(before, "config.json")


def test_policies_may_be_called_within_compiled_programs():
    policy = untrained().policy()
    observation, goal = draws(ENV, 4)
    np.testing.assert_allclose(jax.jit(jax.vmap(policy))(observation, goal), policy(observation, goal), atol=1e-6)


def test_drawn_actions_have_the_policys_noise():
    run = untrained(noise=1.0)
    policy, plain = run.policy(), run.numpy_policy()
    observation, goal = (values[0] for values in draws(ENV, 1))
    many = np.broadcast_to(observation, (4_000, ENV.observation_dim))
    samples = [policy(many, goal, jax.random.key(0)), plain(many, goal, np.random.default_rng(0))]
    spread = [np.std(np.arctanh(np.clip(2.0 * np.asarray(drawn) - 1.0, -0.999999, 0.999999)), axis=0) for drawn in samples]
    assert np.all(spread[0] > 0.3)
    np.testing.assert_allclose(spread[1], spread[0], rtol=0.1)
    np.testing.assert_array_equal(untrained().policy()(observation, goal, jax.random.key(0)), untrained().policy()(observation, goal))


def test_the_policy_is_the_one_that_the_run_plays():
    """Each action of an episode is held for several steps, and is what the policy says of the observation at the first of them."""
    run = hindrl.load_run("policy:FixedGridPickAndPlace")
    episode = run.play(noise=0.0)
    env, length = run.spec.env, int(episode.lengths[0])
    said = action_from_env(run.policy()(episode.observations[0, :length]), env)
    np.testing.assert_allclose(said, episode.actions[0, :length], atol=1e-4)


def test_an_exported_policy_plays_where_there_is_no_jax(tmp_path):
    run = hindrl.load_run("policy:FixedParameterizedReach")
    path = run.export_policy(tmp_path / "robot")
    assert sorted(file.name for file in path.parent.iterdir()) == ["numpy_policy.py", "policy.npz"]
    with pytest.raises(hindrl.UserError, match="exists"):
        run.export_policy(tmp_path / "robot")
    run.export_policy(tmp_path / "robot", overwrite=True)
    (tmp_path / "half").mkdir()
    (tmp_path / "half" / "numpy_policy.py").touch()
    with pytest.raises(hindrl.UserError, match="exists"):
        run.export_policy(tmp_path / "half")
    assert not (tmp_path / "half" / "policy.npz").exists()
    observation, _ = draws(run.spec.env, 3)
    np.save(tmp_path / "robot" / "observation.npy", observation)
    code = """
import sys
sys.modules.update(jax=None, flax=None, hindrl_jax=None)  # whoever imports them fails
import numpy as np
from numpy_policy import load
policy = load("policy.npz")
np.save("action.npy", policy(np.load("observation.npy")))
print(policy.task, policy.action_hold)
"""
    said = subprocess.run([sys.executable, "-c", code], cwd=path.parent, capture_output=True, text=True, check=True).stdout
    assert said.split() == ["FixedParameterizedReach", "4"]
    np.testing.assert_allclose(np.load(path.parent / "action.npy"), run.policy()(observation), atol=2e-6)


def test_what_plays_an_exported_policy_imports_numpy_alone():
    imported = [node for node in ast.walk(ast.parse(Path(numpy_policy.__file__).read_text())) if isinstance(node, ast.Import | ast.ImportFrom)]
    names = {getattr(node, "module", None) or node.names[0].name for node in imported}
    assert names == {"__future__", "json", "typing", "numpy"}


@pytest.mark.parametrize(
    ("case", "name"),
    [
        (dict(imitation_steps=2, imitation_proposal=True), "imitation_proposal"),
        (dict(quirks=QuirksConfig(achieved_goal_input=True)), "achieved_goal_input"),
    ],
)
def test_what_has_no_form_in_numpy_is_refused(case, name):
    run = untrained(**case)
    with pytest.raises(hindrl.UserError, match=f"trained with {name}, which has no form in NumPy"):
        run.numpy_policy()
    assert run.policy()(draws(ENV)[0]).shape == (ENV.action_dim,)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda run: run.policy()(np.zeros(3)), r"an observation of shape \(3,\) is none of FixedGridPickAndPlace: give \(\.\.\., 10\)"),
        (lambda run: run.policy()(np.zeros(10), np.zeros((2, 4))), r"a goal of shape \(2, 4\) is none of .*: give \(\.\.\., 10\)"),
        (lambda run: run.value()(np.zeros(10), action=np.zeros(2)), r"an action of shape \(2,\) does not go with .*: give one of \(5,\)"),
        (lambda run: run.value()(np.zeros((3, 10)), action=np.zeros((2, 5))), r"an action of shape \(2, 5\) .*: give one of \(3, 5\)"),
        (lambda run: run.policy(6), "has no seed 6: choose one of 5, 7"),
        (lambda run: run.value(6), "has no seed 6: choose one of 5, 7"),
        (lambda run: dataclasses.replace(run, critics=None).value(), "holds no critics"),
    ],
)
def test_what_cannot_be_used_is_refused_in_a_line(call, message):
    with pytest.raises(hindrl.UserError, match=message) as error:
        call(untrained())
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("base", ["tqc", "sac"])
def test_values_are_those_of_the_critics(base):
    run = untrained(base=base)
    observation, goal = draws(ENV, 4)
    action = np.random.default_rng(2).uniform(0.0, 1.0, (4, ENV.action_dim)).astype(np.float32)
    critics, scale = jax.tree.map(lambda leaf: leaf[1], (run.critics, run.policies.scale))
    inputs = network_inputs(*map(jnp.asarray, (observation, observation, goal)), scale, run.spec.config)
    atoms = apply_critics(critics, inputs.T, action_from_env(jnp.asarray(action), ENV).T, run.spec.config.agent)
    expected = jnp.mean(atoms, axis=(0, 1)) if base == "tqc" else jnp.min(atoms[:, 0], axis=0)
    value = run.value(7)
    np.testing.assert_allclose(value(observation, goal, action), expected, atol=1e-6)
    np.testing.assert_allclose(value(observation, goal), value(observation, goal, run.policy(7)(observation, goal)), atol=1e-6)


def test_values_of_a_trained_run_rise_towards_the_goal():
    run = hindrl.load_run("policy:FixedGridPickAndPlace")
    episode = run.play(key=jax.random.key(300))
    assert episode.terminated[0]
    values = run.value()(episode.observations[0, : int(episode.lengths[0])])
    assert values[0] < 0.6
    assert values[-1] > 0.9
    assert np.corrcoef(values, np.arange(len(values)))[0, 1] > 0.9


class Tanh(nn.Module):
    """A network of one's own."""

    out_dim: int

    @nn.compact
    def __call__(self, inputs):
        return nn.Dense(self.out_dim)(nn.tanh(nn.Dense(5)(inputs)))


def calm(terms, config):
    return losses.actor_loss(terms, config) + jnp.mean(jnp.square(terms.mode))


def cautious(terms, config):
    return losses.critic_loss(terms, config) + 0.1 * jnp.mean(terms.critics(jnp.ones_like(terms.taken_action)))


def test_a_run_with_networks_and_losses_of_ones_own(tmp_path):
    own = dict(actor_network=Tanh, critic_network=Tanh, actor_loss=calm, critic_loss=cautious)
    config = dataclasses.replace(CONFIG, agent=dataclasses.replace(CONFIG.agent, **own))
    result = hindrl.fit(ENV, hindrl.record_demonstrations(ENV, 2), config, seeds=[300])
    assert result.returned.actor["params"]["Dense_1"]["kernel"].shape[-1] == 5
    hindrl.save_run(tmp_path / "run", result)
    run = hindrl.load_run(tmp_path / "run")
    assert run.spec.config == result.config
    observation, _ = draws(ENV, 4)
    assert run.policy()(observation).shape == (4, ENV.action_dim)
    assert np.isfinite(run.value()(observation)).all()
    with pytest.raises(hindrl.UserError, match="trained with actor_network"):
        run.export_policy(tmp_path / "robot")
