"""The script for a GPU still runs, here on a CPU; its figures are not looked at."""

import json
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest

from benchmarks import gpu
from benchmarks.gpu import Task

ROOT = Path(__file__).parent.parent.parent


@pytest.fixture
def task():
    return Task(quick=True, ends=time.perf_counter() + 600.0)


@pytest.mark.slow
def test_a_quick_run_writes_all_parts(tmp_path):
    command = [sys.executable, "-m", "benchmarks.gpu", "--quick", "--out", tmp_path]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    results = json.loads((tmp_path / "gpu-quick.json").read_text())
    assert {row["setting"] for row in results["gradient_steps"]} == {"default", "grid"}
    assert all(row["steps_per_second"] > 0 for row in results["environment_steps"])
    assert results["solving"][0]["env_steps"] == 400
    assert "table 5.1: GridPickAndPlace" in done.stdout
    assert "left out" not in done.stdout


def test_kernels_are_measured_in_both_forms(task):
    rows = gpu.forms(task)
    assert {(row["kernel"], row["form"]) for row in rows} == set(gpu.KERNELS)
    assert all(row["wall_ms"] > 0 for row in rows)


@pytest.mark.parametrize("kernel", ["quantile loss", "truncation"])
def test_both_forms_compute_the_same(kernel):
    first, second = jax.random.normal(jax.random.key(0), (2, 25, 8)), jax.random.normal(jax.random.key(1), (46, 8))
    inputs = (first, second) if kernel == "quantile loss" else (first.reshape(50, 8),)
    whole, loop = (np.asarray(gpu.KERNELS[kernel, form](*inputs)) for form in ("whole arrays", "loop over atoms"))
    order = (lambda array: np.sort(array, axis=0)) if kernel == "truncation" else np.asarray  # which promises no order
    np.testing.assert_allclose(order(whole), order(loop), atol=1e-6)


def test_what_does_not_fit_in_is_named_and_left_out(capsys):
    assert gpu.gradient_steps(Task(quick=True, ends=time.perf_counter())) == []
    assert "left out for want of time: default, 1 seeds" in capsys.readouterr().out
    assert Task(quick=True, ends=time.perf_counter() + 60.0).fits("it", 30.0)
    assert not Task(quick=True, ends=time.perf_counter() + 60.0).fits("it", 90.0)


def test_hours_of_the_thesis():
    """36 ms per step and seed with 8 seeds: 300,000 steps take 3 hours, 8 seeds 24, 8 and 6 cells 192 and 144. Nothing was measured for reaching."""
    rows = gpu.hours_of_the_thesis([dict(setting="grid", num_seeds=1, ms_per_seed=100.0), dict(setting="grid", num_seeds=8, ms_per_seed=36.0)])
    assert [(row["cells"], row["hours"]) for row in rows] == [(8, 192.0), (6, 144.0)]


def test_tables_of_what_was_measured():
    cost = {"wall_ms": 3.0, "wall_ms_range": [2.0, 4.0]}
    solved = dict(
        num_seeds=128, compile_seconds=20.0, train_seconds=60.0, env_steps=40_000, seeds_solved=127, seconds_to_half=30.0, seconds_to_all=None
    )
    results = {
        "forms": [dict(kernel="truncation", form="whole arrays", batch=4096) | cost],
        "environment_steps": [dict(env="GridPickAndPlace", num_envs=4096, steps_per_second=1_000_000)],
        "solving": [solved],
        "gradient_steps": [dict(setting="grid", num_seeds=8, ms_per_seed=0.5) | cost],
        "hours_of_the_thesis": [
            dict(experiment="one", cells=1, steps=300_000, hours=0.33),
            dict(experiment="another", cells=2, steps=300_000, hours=1.0),
        ],
    }
    text = gpu.tables(results)
    assert "| `grid` | 8 | 3 (2 .. 4) | 0.5 | 2,000 |" in text
    assert "| 20 s | 30 s | - | 127 | 40000 |" in text
    assert "| all | 112 |  | 4.7 |" in text  # 14 cells of 8 seeds, 300,000 steps of 0.5 ms
    assert gpu.tables({"forms": results["forms"]}).count("\n\n") == 1  # what there is, if the script was stopped
