"""The first 20 updates of each model, as numbers that were recorded once.

They say that the algorithm is the same as before, not that it is right: a change that is meant to change it records them again, which the
function `record` does (`python tests/core/test_golden.py`), and says so. The file was first made by the code as it was before it was taken
apart into packages.

Numbers are compared to a thousandth, or to 1e-5 where they are near 0. Another processor, or other work of the compiler, adds in another order,
and what that changes grows along a run. Here it stays below a third of what is allowed, from the instructions of 2008 to those of today and
with all optimisations or none, while whatever draws another random number or takes another branch changes far more.
"""

import dataclasses
import functools
import json
from pathlib import Path

import jax
import numpy as np
import pytest

import hindrl_jax
from hindrl_jax.core import train
from hindrl_jax.core.guidance import guidance

FILE = Path(__file__).parent.parent / "data" / "golden.json"
NUM_UPDATES = 20
GRID, REACH, RANDOM_REACH = "FixedGridPickAndPlace", "FixedParameterizedReach", "ParameterizedReach"
CASES = {  # environment, model and kind of preset
    "grid-bc": (GRID, "bc", "default"),
    "grid-tqcfd": (GRID, "tqcfd", "default"),
    "grid-hindrl": (GRID, "hindrl", "default"),
    "grid-smooth-hindrl": (GRID, "smooth-hindrl", "default"),
    "reach-hindrl": (REACH, "hindrl", "default"),
    "random-reach": (RANDOM_REACH, "hindrl", "default"),
    "thesis-grid-hindrl": (GRID, "hindrl", "thesis"),
    "original-grid-hindrl": (GRID, "hindrl", "original"),
}


@functools.cache
def environment_and_demonstrations(name):
    env = hindrl_jax.make(name)
    return env, hindrl_jax.record_demonstrations(env, 3, seed=3)


def small_config(algo, kind, env):
    """The preset with little of everything that costs time."""
    config = hindrl_jax.preset(algo, kind, env=env)
    batch, agent = dataclasses.replace(config.batch, batch_size=64), dataclasses.replace(config.agent, net_arch=(16, 16))
    return dataclasses.replace(config, num_envs=4, updates_per_iteration=1, learning_starts=0, buffer_size=4000, batch=batch, agent=agent)


PROGRAMS = {}


def compiled(function, *arguments):
    """The function's result. Compiling takes nearly all of the time here, so cases whose programs come out the same share them."""
    lowered = jax.jit(function).lower(*arguments)
    text = lowered.as_text()
    if text not in PROGRAMS:
        PROGRAMS[text] = lowered.compile()
    return PROGRAMS[text](*arguments)


def run(case):
    """Each metric of the first updates, and after them the sums of the sizes of all parameters, by names that begin with the case's."""
    env_name, algo, kind = CASES[case]
    env, demonstrations = environment_and_demonstrations(env_name)
    config = small_config(algo, kind, env)

    def first_updates(key, data):
        state, step = train.init(key, data, env, config), train.clone
        if config.learns_from_rollouts:
            state = train.collect(state, data, env=env, config=config, num_iterations=train.warm_up_iterations(env, config))
            step = train.learn
        state, metrics = jax.lax.scan(lambda state, _: step(state, data, env=env, config=config, num_iterations=1), state, length=NUM_UPDATES)
        return state.agent, metrics

    data = compiled(lambda demonstrations: guidance(demonstrations, env, config), demonstrations)
    agent, metrics = jax.device_get(compiled(first_updates, jax.random.key(7), data))
    for name, parameters in (("actor", agent.actor), ("critics", agent.critics)):
        metrics[f"{name}/size"] = sum(np.abs(leaf).sum() for leaf in jax.tree.leaves(parameters))
    return {f"{case} {name}": np.atleast_1d(values).tolist() for name, values in metrics.items()}


# What these run is run by the others, too, nearly all of it.
SELDOM = ("reach-hindrl", "thesis-grid-hindrl")


@pytest.mark.parametrize("case", [pytest.param(case, marks=pytest.mark.slow) if case in SELDOM else case for case in CASES])
def test_the_first_updates_are_what_they_were(case):
    recorded = {name: values for name, values in json.loads(FILE.read_text()).items() if name.split()[0] == case}
    found = run(case)
    assert recorded.keys() == found.keys()
    for name, values in recorded.items():
        np.testing.assert_allclose(found[name], values, rtol=1e-3, atol=1e-5, err_msg=name)


def write(numbers):
    """Numbers by name, to six digits and a line each, to the file."""
    lines = [f'"{name}": [{", ".join(f"{value:.6g}" for value in values)}]' for name, values in sorted(numbers.items())]
    FILE.write_text("{\n" + ",\n".join(lines) + "\n}\n")


def record():
    """Records the numbers of the code as it is."""
    write({name: values for case in CASES for name, values in run(case).items()})


if __name__ == "__main__":
    record()
