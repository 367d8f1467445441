"""Seeds spread over devices: 8 virtual ones in one process, and two processes that talk over loopback, against everything on one device."""

import csv
import json
import os
import socket
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from commands import TINY

from hindrl_jax import cli
from hindrl_jax.training import devices

TRAIN = """
import dataclasses, json, sys
import jax, numpy as np
import hindrl_jax as hindrl
from hindrl_jax.config import AgentConfig, BatchConfig, TrainConfig

env = hindrl.make("FixedGridPickAndPlace", size=4, random_box_size=1, horizon=20)
config = TrainConfig(
    steps=60, num_envs=2, updates_per_iteration=1, learning_starts=40, buffer_size=200, eval_every=20, eval_episodes=4, imitation_steps=3,
    batch=BatchConfig(batch_size=8), agent=AgentConfig(net_arch=(4,), num_quantiles=3, top_quantiles_to_drop_per_net=1),
)
demonstrations = [hindrl.record_demonstrations(env, 1, seed=seed) for seed in range(8)]
configs = [dataclasses.replace(config, agent=dataclasses.replace(config.agent, learning_rate=rate)) for rate in (1e-3, 2e-3) for _ in range(4)]
result = hindrl.fit(env, demonstrations, configs, seeds=range(8))
leaves = jax.tree.leaves((result.state.agent, result.state.replay))
print(json.dumps({
    "metrics": [row.metrics for row in result.rows],
    "devices": sorted({len(leaf.sharding.device_set) for leaf in leaves}),
    "checksum": [[float(np.abs(part).sum()) for part in np.asarray(leaf)] for leaf in jax.tree.leaves(result.state.agent.actor)],
}))
"""


def with_devices(count):
    return os.environ | {"JAX_ENABLE_COMPILATION_CACHE": "false", "JAX_NUM_CPU_DEVICES": str(count), "JAX_PLATFORMS": "cpu"}


def test_eight_devices_give_what_one_gives():
    outputs = []
    for count in (1, 8):
        done = subprocess.run([sys.executable, "-c", TRAIN], env=with_devices(count), capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        outputs.append(json.loads(done.stdout))
    one, eight = outputs
    assert (one["devices"], eight["devices"]) == ([1], [8])  # every leaf of the state lies on all of them
    for expected, given in zip(one["metrics"], eight["metrics"], strict=True):
        for name, value in expected.items():
            assert given[name] == pytest.approx(value, rel=1e-3, abs=1e-5), name
    np.testing.assert_allclose(eight["checksum"], one["checksum"], rtol=1e-3)


def hindrl(*arguments):
    command = [sys.executable, "-m", "hindrl_jax", *map(str, arguments)]
    return subprocess.Popen(command, env=with_devices(1), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.mark.slow
def test_two_processes_give_what_one_gives(tmp_path):
    """The one is this process: its programs are those of other tests, while the two begin without any."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    small = [*TINY, "--imitation-steps", 3]
    together = ["--distributed", "--coordinator", f"127.0.0.1:{port}", "--num-hosts", 2]
    runs = [
        hindrl("train", "--out", tmp_path / "two", "--seeds", 2, *small, *together, "--host", 0),
        hindrl("train", "--out", tmp_path / "two", "--seeds", 2, *small, *together, "--host", 1),
    ]
    try:
        cli.main(["train", "--out", str(tmp_path / "one"), "--seeds", "2", *map(str, small)])
        outputs = [run.communicate(timeout=300) for run in runs]
    finally:
        for run in runs:
            run.kill()
    assert [run.returncode for run in runs] == [0, 0], outputs
    assert "on 2 of 2 devices" in outputs[0][0]
    assert "FixedGrid" in outputs[0][0]
    assert "FixedGrid" not in outputs[1][0]  # only the first host prints and writes
    one, two = (list(csv.DictReader((tmp_path / name / "metrics.csv").read_text().splitlines())) for name in ("one", "two"))
    assert [(row["seed"], row["env_steps"]) for row in two] == [("0", "240"), ("1", "240"), ("0", "260"), ("1", "260")]
    for expected, given in zip(one, two, strict=True):
        for name in expected.keys() - {"seconds"}:
            assert float(given[name]) == pytest.approx(float(expected[name]), rel=1e-3, abs=1e-5), name
    with np.load(tmp_path / "one" / "parameters.npz") as first, np.load(tmp_path / "two" / "parameters.npz") as second:
        for name in first.files:
            np.testing.assert_allclose(second[name], first[name], rtol=1e-3, atol=1e-4, err_msg=name)


@pytest.mark.parametrize(
    ("num_seeds", "hosts", "devices_each", "used"), [(1, 1, 8, 1), (8, 1, 8, 8), (6, 1, 4, 3), (7, 1, 4, 1), (5, 1, 8, 5), (64, 2, 48, 64)]
)
def test_as_many_devices_as_divide_the_seeds(num_seeds, hosts, devices_each, used, monkeypatch):
    made = [SimpleNamespace(process_index=host) for host in range(hosts) for _ in range(devices_each)]
    monkeypatch.setattr(devices.jax, "devices", lambda: made)
    monkeypatch.setattr(devices.jax, "process_count", lambda: hosts)
    monkeypatch.setattr(devices, "Mesh", lambda chosen, axes: chosen)
    chosen = devices.seed_mesh(num_seeds)
    assert [sum(device.process_index == host for device in chosen) for host in range(hosts)] == [used // hosts] * hosts


def test_hosts_share_evenly(monkeypatch):
    monkeypatch.setattr(devices.jax, "process_count", lambda: 2)
    with pytest.raises(devices.UserError, match="make --seeds a multiple of 2"):
        devices.seed_mesh(7)
