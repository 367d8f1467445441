"""The benchmarks still run; their figures are not looked at here, except where they are no timings."""

import json
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import reach_parity, reach_speed
from benchmarks.timing import Effort, Options
from hindrl_jax.base.errors import UserError
from hindrl_jax.envs import panda
from hindrl_jax.envs.panda import closed_form
from hindrl_jax.envs.reach import FixedParameterizedReach

ROOT = Path(__file__).parent.parent.parent
INITIAL = np.asarray(panda.INITIAL_JOINTS, np.float32)


def quick_benchmark(folder, *parts):
    """Runs parts of the benchmark in a process of their own and returns its results and its document."""
    command = [sys.executable, "-m", "benchmarks.run", "--quick", "--without-peers", "--only", *parts, "--out", folder]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return json.loads((folder / "results-quick.json").read_text()), (folder / "RESULTS-quick.md").read_text()


def test_a_quick_benchmark_writes_its_results(tmp_path):
    results, document = quick_benchmark(tmp_path, "environments")
    assert all(row["steps_per_second"] > 0 for row in results["environments"]["rows"])
    assert "A quick run: the figures mean nothing" in document


@pytest.mark.slow
def test_parts_of_a_benchmark_stand_in_the_order_of_the_document(tmp_path):
    results, _ = quick_benchmark(tmp_path, "relabelling", "environments")
    assert list(results) == ["environments", "relabelling"]  # in the order of the document, whatever the order of measuring
    assert all(row["cpu_ms"] > 0 for row in results["relabelling"]["rows"])


@pytest.mark.slow
def test_a_quick_benchmark_of_the_arm(tmp_path):
    results, _ = quick_benchmark(tmp_path, "reach_speed", "reach_parity")
    assert {row["who"] for row in results["reach_speed"]["rows"]} >= {"closed_form", "environment", "mjx", "mujoco"}
    if "reach_parity" in results:  # else robosuite is not installed
        assert all(row["position_mm_max"] < 0.1 for row in results["reach_parity"]["rows"])  # after 10 steps


# --- the arm, without MJX and robosuite, which take long


@pytest.mark.parametrize(
    "contestant",
    [lambda: reach_speed.arms(closed_form.control_step, 3, 2, {}), lambda: reach_speed.physics(3, 2, 2)],
    ids=["closed form", "C MuJoCo"],
)
def test_arms_take_turns(contestant):
    contestant = contestant()
    assert contestant.units == 3 * 2
    assert all(contestant.turn(number).wall > 0 for number in (1, 2))


def test_commands_are_within_bounds_and_taken_back():
    commands, bounds = np.array(reach_speed.commands(4)), FixedParameterizedReach().action_high
    assert (np.abs(commands) <= bounds).all()
    np.testing.assert_allclose(commands.sum(axis=0), 0.0, atol=1e-6)


def test_errors_between_hands():
    """Turning joint 1 or 7 by 1 mrad turns the hand by as much. The grip site lies on the axis of joint 7, and away from that of joint 1."""
    position = np.array(panda.posture(jnp.asarray(INITIAL)).hand_position)
    turned = np.stack([INITIAL, INITIAL + 1e-3 * np.eye(7, dtype=np.float32)[0], INITIAL + 1e-3 * np.eye(7, dtype=np.float32)[6]])
    distances, angles = reach_parity.errors(jnp.asarray(INITIAL[None]), jnp.asarray(turned))
    np.testing.assert_allclose(distances, [0.0, 1e-3 * np.hypot(*position[:2]), 0.0], atol=1e-6)
    np.testing.assert_allclose(angles, [0.0, 1e-3, 1e-3], atol=1e-6)


def test_limits_are_met_by_any_joint_at_any_step():
    ways = np.tile(INITIAL, (3, 4, 1))
    ways[1, 2, 5] = panda.chain().upper[5]
    ways[2, 3, 3] = panda.chain().lower[3] + 0.001
    assert reach_parity.meets_limit(jnp.asarray(ways)).tolist() == [False, True, True]


def test_sequences_start_apart_and_stay_within_bounds():
    env, num_starts, num_steps = FixedParameterizedReach(), 2, 5
    starts, commands = map(np.array, reach_parity.sequences(jax.random.key(0), env, num_starts, num_steps))
    commands = dict(zip(reach_parity.SEQUENCES, commands, strict=True))
    assert starts.shape == (len(commands), num_starts, 7)
    assert len(np.unique(starts.reshape(-1, 7), axis=0)) == len(commands) * num_starts
    for name, sequence in commands.items():
        assert sequence.shape == (num_starts, num_steps, 6)
        assert (np.abs(sequence) <= env.action_high * 1.00001).all(), name
    np.testing.assert_allclose(commands["constant_down"], np.tile([0, 0, -0.02, 0, 0, 0], (num_starts, num_steps, 1)), rtol=1e-6)
    np.testing.assert_allclose(commands["constant_yaw"], np.tile([0, 0, 0, 0, 0, 0.05], (num_starts, num_steps, 1)), rtol=1e-6)
    np.testing.assert_allclose(np.abs(commands["smooth"]).max(axis=1), np.tile(env.action_high, (num_starts, 1)), rtol=1e-5)


def test_parity_is_left_out_without_robosuite(monkeypatch, capsys):
    def missing():
        raise UserError("robosuite is not installed")

    monkeypatch.setattr(reach_parity, "RobosuiteArm", missing)
    options = Options(effort=Effort(rounds=1, turn_seconds=0.0), quick=True, cores=1, peers=None)
    assert reach_parity.run(options) == []
    assert "left out: robosuite is not installed" in capsys.readouterr().out


def test_the_table_of_speeds_has_a_line_for_each_back_end_that_was_measured():
    cost = {"cpu_ms": 0.5, "cpu_ms_range": [0.25, 1.0]}
    rows = [{"who": "closed_form", "num_envs": size, "steps_per_second": 1000 * size} | cost for size in (1, 16)]
    text = reach_speed.tables([*rows, {"who": "robosuite", "num_envs": 1, "steps_per_second": 100} | cost])
    assert "| `closed_form` | 1,000 | 16,000 |" in text
    assert "| `robosuite` | 100 |  |" in text
    assert "| `robosuite` | 500 (250 .. 1,000) |  |" in text
    assert "mjx" not in text


def test_the_table_of_errors_names_the_largest_with_and_without_limits():
    def row(commands, first, second, *, largest, free):
        values = {"position_mm": 0.5, "position_mm_max": largest, "position_mm_max_free": free}
        values |= {"rotation_mrad": 1.0, "rotation_mrad_max": 2.0, "rotation_mrad_max_free": 2.0}
        known = {"commands": commands, "first": first, "second": second, "steps": 100, "starts": 5, "starts_at_limit": 1, "away_mm": 218.3}
        return known | values

    rows = [row(name, *pair, largest=9.0, free=0.75) for name in ("random", "smooth") for pair in reach_parity.PAIRS]
    text = reach_parity.tables(rows)
    assert "| uniformly random | 218 | 1 | 0.500 / 9.000 | 1.000 / 2.000 |" in text
    assert "closed form - robosuite, largest of all: 9.000 mm and 2.000 mrad; without the starts at a limit: 0.750 mm and 2.000 mrad." in text
