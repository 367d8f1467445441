"""Learning works: the command solves a task, by its own recipe, with a hundred demonstrations, and stops when it has.

The compiler does its full work here, unlike in the other fast tests: half a minute on two idle cores, a third of it compilation.
"""

import json
import os
import subprocess
import sys


def test_the_command_solves_the_fixed_grid(tmp_path):
    task = ["--env", "FixedGridPickAndPlace", "--demos", "100", "--seed", "700"]
    length = ["--steps", "32000", "--stop-at", "0.95", "--imitation-steps", "0"]
    command = [sys.executable, "-m", "hindrl_jax", "train", *task, *length, "--out", str(tmp_path / "run")]
    environment = os.environ | {"XLA_FLAGS": "", "JAX_PLATFORMS": "cpu"}
    outcome = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=600)
    assert outcome.returncode == 0, outcome.stderr
    (seed,) = json.loads((tmp_path / "run" / "summary.json").read_text())["seeds"]
    assert seed["returned_success"] >= 0.9, outcome.stdout  # in other episodes than those that confirmed it
    assert seed["returned_length"] <= 50, outcome.stdout  # the best possible is 41.5, the expert's 54.5
    assert seed["returned_env_steps"] < 32_000, outcome.stdout
