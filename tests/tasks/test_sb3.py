"""Learners of others on our environments. Skipped where they are not installed, as PyTorch is too large for the tests' environment."""

import sys
from pathlib import Path

import gymnasium
import pytest

pytest.importorskip("sb3_contrib")
sys.path.insert(0, str(Path(__file__).parent.parent.parent / "examples"))

import sb3_her_tqc
import torch
from stable_baselines3.common.env_checker import check_env


@pytest.mark.parametrize("name", ["FixedGridPickAndPlace", "GridPickAndPlace"])
def test_stable_baselines_finds_no_fault(name):
    check_env(gymnasium.make(f"hindrl/{name}-v0").unwrapped)


def test_tqc_with_her_trains():
    torch.set_num_threads(1)  # more of them wait for one another where the cores have other work
    flags = "--num-envs 2 --steps 640 --eval-every 320 --eval-episodes 4"
    success = sb3_her_tqc.train(sb3_her_tqc.parse(flags.split()))
    assert len(success) == 2
    assert all(0.0 <= rate <= 1.0 for rate in success)
