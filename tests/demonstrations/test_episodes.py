"""What a recording must be to be learned from in an environment: short enough, enough of it, and of that environment."""

import dataclasses
import json

import pytest
from line_world import LineWorld, assert_refused, edit, save

from hindrl_jax.demonstrations.hdf5 import load_demonstrations


def test_too_long_demonstrations_are_dropped_with_a_warning(path):
    env = LineWorld(horizon=3)
    with pytest.warns(UserWarning, match="dropped 1 of 3 demonstrations, longer than the horizon of 3 steps") as record:
        loaded = load_demonstrations(path, env)
    assert record[0].filename == __file__  # it points at the caller
    assert loaded.observations.shape == (2, 4, 3)
    assert loaded.observations[:, 0, 1].tolist() == [0, 2]
    # num_demos counts those that fit.
    with pytest.warns(UserWarning, match="dropped 1 of 3"):
        assert load_demonstrations(path, env, num_demos=2).lengths.tolist() == [3, 1]
    assert_refused(lambda: load_demonstrations(path, env, num_demos=3), "3 demonstrations asked for", "holds 2", "horizon of 3")


def test_longer_horizon_pads_further(path):
    loaded = load_demonstrations(path, LineWorld(horizon=9))
    assert loaded.observations.shape == (3, 10, 3)
    assert loaded.actions.shape == (3, 9, 2)
    assert loaded.lengths.tolist() == [3, 6, 1]


def test_no_demonstration_fits_the_horizon(tmp_path):
    file = save(tmp_path / "demos.hdf5", lengths=[4, 5])
    assert_refused(lambda: load_demonstrations(file, LineWorld(horizon=3)), "all 2", "horizon of 3")


@pytest.mark.parametrize("num_demos", [4, 0, -1])
def test_impossible_number_of_demonstrations(path, num_demos):
    assert_refused(lambda: load_demonstrations(path, LineWorld(), num_demos=num_demos), f"{num_demos} demonstrations asked for")


@pytest.mark.parametrize(
    ("env", "words"),
    [
        (LineWorld(name="PlaneWorld"), ["recorded in LineWorld", "not in PlaneWorld"]),
        (LineWorld(size=5.0), ["size = 10.0", "size = 5.0"]),
        (LineWorld(start=(0, 2)), ["start = [0, 1]", "start = [0, 2]"]),
    ],
)
def test_file_of_another_environment(path, env, words):
    assert_refused(lambda: load_demonstrations(path, env), *words)


@pytest.mark.parametrize(("field", "what"), [("observation_dim", "observations"), ("action_dim", "actions"), ("goal_dim", "achieved goals")])
def test_dimensions_other_than_the_environments(path, field, what):
    env = LineWorld(**{field: 4})
    edit(path, lambda data: data.attrs.modify("env_args", json.dumps({"env_name": env.name, "env_kwargs": dataclasses.asdict(env)})))
    assert_refused(lambda: load_demonstrations(path, env), "demo_0", what, "but 4 in LineWorld")


def test_achieved_goals_by_another_definition(path):
    def shift(data):
        data["demo_1/obs/achieved_goal"][...] += 1
        data["demo_1/next_obs/achieved_goal"][...] += 1

    edit(path, shift)
    assert_refused(lambda: load_demonstrations(path, LineWorld()), "demo_1", "achieved_goal is not what LineWorld derives")


def test_what_the_environment_calls_interchangeable_may_differ(path):
    class Flexible(LineWorld):
        interchangeable = ("size",)

    assert load_demonstrations(path, Flexible(size=5.0)).lengths.tolist() == [3, 6, 1]
    assert_refused(lambda: load_demonstrations(path, Flexible(size=5.0, start=(0, 2))), "start = [0, 1]", "start = [0, 2]")
