"""Programs: which there are, and that each is compiled once."""

import dataclasses

import chex
import jax
import numpy as np
import pytest
from host_env import HostCorridor
from tiny import CONFIG, ENV
from toy_env import corridor_demonstrations

import hindrl_jax as hindrl
from hindrl_jax.config import with_values
from hindrl_jax.core import train
from hindrl_jax.core.agent import policy
from hindrl_jax.core.guidance import guidance
from hindrl_jax.training.experiment import programs_of
from hindrl_jax.training.host import HostPrograms
from hindrl_jax.training.programs import FRESH_EPISODES, JaxPrograms, extent

CLONING = dataclasses.replace(CONFIG, algo="bc")


@pytest.fixture(scope="module")
def demonstrations():
    return hindrl.record_demonstrations(ENV, 2)


def check(programs, tables, num_runs):
    """They start, learn and evaluate all runs at once."""
    guidance, state, key = programs.start(np.arange(num_runs, dtype=np.uint32), tables)
    assert jax.tree.map(np.shape, (guidance, state)) == jax.tree.map(np.shape, (programs.shapes["guidance"], programs.shapes["state"]))
    state, metrics = programs.learn(state, guidance)
    assert np.asarray(state.updates).tolist() == [programs.chunk] * num_runs
    assert all(values.shape == (num_runs,) for values in metrics.values())
    for num_episodes in (3, FRESH_EPISODES):
        key, evaluation = programs.evaluate(key, policy(state.agent, programs.config, average=True), guidance, num_episodes)
        assert evaluation.success.shape == evaluation.length.shape == (num_runs, num_episodes)


def test_programs_are_chosen_by_where_an_environment_is_stepped(demonstrations):
    config = dataclasses.replace(CLONING, eval_episodes=3)
    configs = [with_values(config, {"learning_rate": rate}) for rate in (1e-3, 2e-3)]
    tables = jax.tree.map(lambda leaf: np.stack([leaf] * 2), jax.device_get(demonstrations.replace(states=None)))
    in_jax = programs_of(ENV, configs, tables)
    assert isinstance(in_jax, JaxPrograms)
    np.testing.assert_allclose(in_jax.values["learning_rate"], [1e-3, 2e-3])
    check(in_jax, tables, 2)

    tables = jax.tree.map(lambda leaf: np.asarray(leaf)[None], corridor_demonstrations().replace(states=None))
    on_host = programs_of(HostCorridor(), [config], tables)
    assert isinstance(on_host, HostPrograms)
    check(on_host, tables, 1)
    on_host.close()


def test_length_of_chunks_by_hand():
    # 20 steps of horizon x 2 environments at random; 44 steps are left of 84; a tenth of 20 is one iteration of 2 environments.
    assert extent(ENV, dataclasses.replace(CONFIG, steps=84)) == (20, 1)
    assert extent(ENV, dataclasses.replace(CONFIG, steps=84, eval_every=400)) == (20, 20)
    assert extent(ENV, dataclasses.replace(CONFIG, steps=84, eval_every=4000)) == (20, 22)  # no more than are left
    assert extent(ENV, dataclasses.replace(CLONING, steps=84, eval_every=400)) == (0, 40)
    with pytest.raises(hindrl.UserError, match="raise steps"):
        extent(ENV, dataclasses.replace(CONFIG, steps=40))


@pytest.mark.parametrize(("config", "program"), [(CONFIG, train.learn), (CLONING, train.clone)], ids=["learn", "clone"])
def test_a_program_that_is_called_again_is_not_compiled_again(config, program, demonstrations):
    """A state goes in as it came out of `init`, and again as it came out of the program."""
    chex.clear_trace_counter()
    data = guidance(demonstrations, ENV, config)
    state = train.init(jax.random.key(0), data, ENV, config)
    if config.learns_from_rollouts:
        state = jax.jit(lambda state: train.collect(state, data, env=ENV, config=config, num_iterations=20))(state)
    run = jax.jit(chex.assert_max_traces(lambda state: program(state, data, env=ENV, config=config, num_iterations=1)[0], n=1))
    later = run(run(state))
    assert jax.tree.map(jax.typeof, state) == jax.tree.map(jax.typeof, later)
    assert later.updates == 2
