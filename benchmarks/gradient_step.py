"""What a gradient step costs: hindrl_jax, parts of it, and its peers, each in a process of its own, taking turns."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

from benchmarks import report, timing
from benchmarks.settings import SETTINGS, Setting
from benchmarks.timing import Contestant, Cost, Options, Row

TITLE = "Gradient step"
FOLDER = Path(__file__).parent

OURS = {
    "ours": "`train.learn`: the whole loop, environment steps, replay and sampling included",
    "ours-update": "`agent.update` alone, on one fixed batch",
    "passes-own": "nothing but the network passes, by the project's networks",
    "passes": "nothing but the network passes, written the usual way and left to XLA",
}
QUICK = ("ours", "ours-update", "passes-own")
_SBX = {"JAX_PLATFORMS": "cpu", "JAX_NUM_CPU_DEVICES": "1"}  # as JAX comes
# Name -> worker, its steps per call, variables of its environment, description.
PEERS = {
    "sb3-contrib": ("worker_sb3.py", 1, {}, "`TQC.train`, as it comes"),
    "sb3-contrib-malloc": (
        "worker_sb3.py",
        1,
        {"MALLOC_MMAP_THRESHOLD_": "2000000000", "MALLOC_TRIM_THRESHOLD_": "4000000000"},
        "the same, and glibc told to keep large blocks of memory",
    ),
    "sbx": ("worker_sbx.py", 1, _SBX, "`TQC.train` with 1 gradient step per call, the default of `learn`"),
    "sbx-20": ("worker_sbx.py", 20, _SBX, "the same with 20 gradient steps per call"),
}


class Worker:
    """A process that takes gradient steps on request, see `peers/protocol.py`."""

    def __init__(self, command: Sequence[str | Path], environment: dict[str, str]):
        self._log = tempfile.TemporaryFile("w+")  # noqa: SIM115 (closed by `close`)
        self._process = subprocess.Popen(
            [str(word) for word in command],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._log,
            text=True,
            env=os.environ | environment,
            cwd=FOLDER.parent,
        )

    def wait(self) -> None:
        """Returns when the worker is ready."""
        answer = self._answer()
        if answer != "ready":
            raise RuntimeError(f"a worker says {answer!r} in place of 'ready'")

    def contestant(self, steps_per_call: int) -> Contestant:
        def turn(num_calls: int) -> Cost:
            steps = num_calls * steps_per_call
            self._process.stdin.write(f"{steps}\n")
            self._process.stdin.flush()
            answer = json.loads(self._answer())
            return Cost(cpu=steps * answer["cpu_ms"] / 1000.0, wall=steps * answer["wall_ms"] / 1000.0)

        return Contestant(turn, steps_per_call)

    def close(self) -> None:
        self._process.kill()
        self._process.wait()
        self._process.stdin.close()
        self._process.stdout.close()
        self._log.close()

    def _answer(self) -> str:
        answer = self._process.stdout.readline().strip()
        if not answer:
            self._log.seek(0)
            raise RuntimeError(f"{' '.join(map(str, self._process.args))} ended:\n{self._log.read()[-4000:]}")
        return answer


def run(options: Options) -> list[Row]:
    """One row per setting and contestant, milliseconds per gradient step."""
    rows = []
    for name in ["default"] if options.quick else SETTINGS:
        print(f"{TITLE}, {name}: {SETTINGS[name].description}", flush=True)
        with _workers(name, options) as contestants:
            results = timing.take_turns(contestants, options.effort)
        for who, result in results.items():
            print(timing.line(who, result), flush=True)
            rows.append({"setting": name, "who": who} | result)
    return rows


@contextlib.contextmanager
def _workers(name: str, options: Options) -> Iterator[dict[str, Contestant]]:
    """Starts all contestants of a setting, waits until all are ready, and ends them in the end."""
    setting = SETTINGS[name]
    with contextlib.ExitStack() as stack:
        started: dict[str, tuple[Worker, int]] = {}

        def start(who: str, command: Sequence[str | Path], environment: dict[str, str], steps_per_call: int) -> None:
            worker = Worker(command, environment)
            stack.callback(worker.close)
            started[who] = worker, steps_per_call

        for who in OURS if not options.quick else QUICK:
            command = [sys.executable, "-m", "benchmarks.worker_ours", "--who", who, "--setting", name]
            start(who, command, {}, setting.steps_per_call)
        if options.peers:
            for who, (script, steps_per_call, environment, _) in PEERS.items():
                command = [
                    options.peers,
                    FOLDER / "peers" / script,
                    *_peer_arguments(setting, options.cores),
                    "--steps-per-call",
                    str(steps_per_call),
                ]
                start(who, command, environment, steps_per_call)
        for worker, _ in started.values():
            worker.wait()
        yield {who: worker.contestant(steps_per_call) for who, (worker, steps_per_call) in started.items()}


def _peer_arguments(setting: Setting, cores: int) -> list[str]:
    agent, dims = setting.config.agent, setting.dims()
    arguments = {
        "batch-size": setting.config.batch.batch_size,
        "layers": ",".join(map(str, agent.net_arch)),
        "drop": agent.top_quantiles_to_drop_per_net,
        "observation-dim": dims["input_dim"],
        "action-dim": dims["action_dim"],
        "num-quantiles": agent.num_quantiles,
        "num-critics": agent.num_critics,
        "threads": cores,
    }
    return [f"--{name}={value}" for name, value in arguments.items()]


def versions(options: Options) -> dict[str, str]:
    """Versions of the peers' packages."""
    if not options.peers:
        return {}
    found: dict[str, str] = {}
    for script in ("worker_sb3.py", "worker_sbx.py"):
        answer = subprocess.run([options.peers, FOLDER / "peers" / script, "--versions"], capture_output=True, text=True, check=True)
        found |= json.loads(answer.stdout)
    return {name: found[name] for name in ("torch", "stable-baselines3", "sb3-contrib", "sbx-rl")}


def tables(rows: list[Row]) -> str:
    """One table per setting; ratios are to `ours`."""
    text = "Milliseconds per gradient step: median (least .. largest turn). CPU time counts all threads.\n"
    descriptions = OURS | {who: peer[-1] for who, peer in PEERS.items()}
    for name in dict.fromkeys(row["setting"] for row in rows):
        of_setting = [row for row in rows if row["setting"] == name]
        ours = next(row for row in of_setting if row["who"] == "ours")
        text += f"\n`{name}`: {SETTINGS[name].description}\n\n"
        text += report.table(
            ["who", "what", "CPU ms", "wall ms", "CPU, x ours", "wall, x ours"],
            [
                [
                    f"`{row['who']}`",
                    descriptions[row["who"]],
                    timing.milliseconds(row, "cpu"),
                    timing.milliseconds(row, "wall"),
                    f"{row['cpu_ms'] / ours['cpu_ms']:.2f}",
                    f"{row['wall_ms'] / ours['wall_ms']:.2f}",
                ]
                for row in of_setting
            ],
        )
    return text
