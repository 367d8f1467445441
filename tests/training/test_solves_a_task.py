"""Learning works: the command solves a task, by its own recipe, with a hundred demonstrations and a shorter training.

With them all of eight seeds that were tried reached 100% within 26,000 environment steps and stayed there. The compiler does its full work here,
unlike in the other fast tests: half a minute on two idle cores, two thirds of it compilation.
"""

import json
import os
import subprocess
import sys


def test_the_command_solves_the_fixed_grid(tmp_path):
    task = ["--env", "FixedGridPickAndPlace", "--demos", "100", "--seed", "700"]
    length = ["--steps", "32000", "--agent-resets"]  # without a reset of the agent, which the recipe has in its longer training
    command = [sys.executable, "-m", "hindrl_jax", "train", *task, *length, "--out", str(tmp_path / "run")]
    environment = os.environ | {"XLA_FLAGS": "", "JAX_PLATFORMS": "cpu"}
    outcome = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=600)
    assert outcome.returncode == 0, outcome.stderr
    (seed,) = json.loads((tmp_path / "run" / "summary.json").read_text())["seeds"]
    assert seed["final_success"] >= 0.9, outcome.stdout
    assert seed["episode_length"] <= 46, outcome.stdout  # the best possible is 41.5, the expert's 54.5
