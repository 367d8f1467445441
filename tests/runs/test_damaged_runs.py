"""Runs that were edited or damaged: one line and exit code 2, never a figure."""

import dataclasses
import json
import os
import re
import shutil
import subprocess
import sys

import numpy as np
import pytest
from commands import refusal
from tiny import CONFIG, ENV

import hindrl_jax as hindrl


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """The directory of a run of two seeds."""
    path = tmp_path_factory.mktemp("runs") / "run"
    config = dataclasses.replace(CONFIG, algo="bc", steps=2)
    hindrl.save_run(path, hindrl.fit(ENV, hindrl.record_demonstrations(ENV, 2), config, seeds=[0, 1]))
    return path


@pytest.fixture
def path(saved, tmp_path):
    """A copy of it, to be changed."""
    return shutil.copytree(saved, tmp_path / "run")


def edit(path, where, value):
    """Puts a value into config.json, under names that are parted by dots."""
    *before, last = where.split(".")
    data = holder = json.loads((path / "config.json").read_text())
    for name in before:
        holder = holder[name]
    holder[last] = value
    (path / "config.json").write_text(json.dumps(data))


@pytest.mark.parametrize(
    ("where", "value"),
    [
        ("config.agent.net_arch", [5]),
        ("config.agent.net_arch", [4, 4]),
        ("config.agent.input_encoding", "raw"),
        ("config.agent.residual", True),
        ("config.quirks.achieved_goal_input", True),
        ("env_args.num_objects", 3),
        ("seeds", [0]),
        ("seeds", [0, 1, 2]),
    ],
)
def test_a_configuration_that_no_longer_fits_the_parameters(path, capsys, where, value):
    edit(path, where, value)
    assert "does not fit config.json beside it" in refusal(capsys, "eval", path, "--episodes", "1")


@pytest.mark.parametrize(
    ("where", "value", "message"),
    [
        ("env", ["FixedGridPickAndPlace"], "env = ['FixedGridPickAndPlace'] is not usable: it must be a text"),
        ("demos", 3, "demos = 3 is not usable: it must be a text"),
        ("env_args", [], "must be an object"),
        ("env_args.size", "4", "must be a whole number"),
        ("env_args.size", 10**400, "must be a whole number"),
        ("config.agent.learning_rate", 10**400, "must be a finite number"),
        ("config.agent.net_arch", 4, "must be a list"),
        ("config.batch", 0.5, "must be an object of fields"),
        ("config.steps", True, "must be a whole number"),
        ("seeds", 0, "must be a list of whole numbers"),
    ],
)
def test_values_of_another_type(path, capsys, where, value, message):
    edit(path, where, value)
    assert message in refusal(capsys, "eval", path)
    assert message in refusal(capsys, "train", "--config", path)
    assert message in refusal(capsys, "train", "--resume", path)


def test_files_that_nest_without_end(path, capsys):
    deep = "[" * 100_000
    for name, commands in (("config.json", (["eval", path], ["compare", path])), ("summary.json", (["compare", path],))):
        before = (path / name).read_text()
        (path / name).write_text(deep)
        for command in commands:
            assert "recursion" in refusal(capsys, *command)
        (path / name).write_text(before)


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("policy/params/Dense_0/kernel", lambda array: array * np.nan, "holds what is no finite number"),
        ("policy/params/Dense_0/bias", lambda array: array + np.inf, "holds what is no finite number"),
        ("policy/params/Dense_0/kernel", lambda array: array[0, 0, 0], "does not fit config.json"),
        ("policy/params/Dense_0/kernel", lambda array: array.astype(str), "damaged"),
        ("policy", lambda array: np.float32(1.0), "does not fit config.json"),
        ("input_scale/observation", lambda array: array * np.nan, "holds what is no finite number"),
        ("input_scale", lambda array: np.float32(1.0), "damaged"),
        ("behavioural_goals/goals", lambda array: array * np.nan, "holds what is no finite number"),
        ("behavioural_goals/goals", lambda array: array[..., :-1], "does not fit config.json"),
        ("behavioural_goals/count", lambda array: array * 0, "behavioural goals"),
        ("behavioural_goals", lambda array: np.zeros(2), "damaged"),
        ("policy_noise", lambda array: np.float32(0.0), "does not fit config.json"),
    ],
)
def test_parameters_that_cannot_be_played(path, capsys, name, change, message):
    with np.load(path / "parameters.npz") as archive:
        arrays = dict(archive)
    changed = {name: change(arrays.get(name, np.zeros(1)))}
    kept = {key: array for key, array in arrays.items() if not key.startswith(f"{name}/")}
    np.savez(path / "parameters.npz", **(kept | changed))
    assert message in refusal(capsys, "eval", path, "--episodes", "1")
    assert message in refusal(capsys, "render", path)


@pytest.mark.parametrize("value", ["NaN", "1.5", "-0.1", "Infinity", '"all"', "[1]"])
def test_success_that_is_no_share_is_not_compared(path, capsys, value):
    text = (path / "summary.json").read_text()
    (path / "summary.json").write_text(re.sub(r'("returned_success": )[\d.]+', rf"\g<1>{value}", text, count=1))
    assert "is damaged" in refusal(capsys, "compare", path, path)
    (path / "summary.json").write_text(text)
    (path / "metrics.csv").write_text((path / "metrics.csv").read_text().replace(",0,", ",nan,"))
    assert "is damaged" in refusal(capsys, "compare", path)


@pytest.mark.parametrize("noise", ["nan", "-1", "inf", "-inf"])
def test_noise_that_is_none(path, capsys, noise):
    for command in ("eval", "render"):
        assert f"noise = {float(noise)} is not usable" in refusal(capsys, command, path, f"--noise={noise}")


def test_jax_with_64_bits_trains_and_plays_as_with_32():
    """In a process of its own, in which JAX was set so before it was imported."""
    script = """if True:
        import jax, numpy as np, gymnasium, tempfile, warnings
        import hindrl_jax as hindrl, tiny, dataclasses
        assert jax.numpy.arange(1.0).dtype == "float64"
        demonstrations = hindrl.record_demonstrations(tiny.ENV, 1)
        result = hindrl.fit(tiny.ENV, demonstrations, dataclasses.replace(tiny.CONFIG, steps=44, eval_every=4, eval_episodes=2))
        assert all(leaf.dtype == "float32" for leaf in jax.tree.leaves(result.state.agent.actor))
        env = gymnasium.make("hindrl/FixedGridPickAndPlace-v0")
        observation, _ = env.reset(seed=0)
        assert env.step(env.action_space.sample())[0]["observation"].dtype == "float32"
        print("trained")
    """
    environment = os.environ | {"JAX_ENABLE_X64": "1", "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, env=environment)
    assert done.stdout.strip() == "trained", done.stderr


def test_a_platform_that_is_not_there_is_one_line(tmp_path):
    environment = os.environ | {"JAX_PLATFORMS": "nonsense", "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-m", "hindrl_jax", "demos", "record", "--demos", "1", "--out", str(tmp_path / "x.hdf5")]
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert done.returncode == 2
    assert done.stderr.startswith("hindrl: JAX cannot compute on JAX_PLATFORMS = nonsense (")
    assert done.stderr.count("\n") == 1
