"""Measures all parts of the benchmark, or those named, and writes results.json and RESULTS.md.

python -m benchmarks.run                              # everything; `make bench` installs the peers first
python -m benchmarks.run --only environments seeds    # the results of the other parts stay as they are
python -m benchmarks.run --quick --without-peers      # does it all still work?
"""

from __future__ import annotations

import argparse
import os
import shlex
import sys
import time
from pathlib import Path

FOLDER = Path(__file__).parent
QUICK_FLAGS = "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"  # compile fast, run slowly
BUSY = 0.1  # share of the machine in the hands of others from which on timings are not to be trusted


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.run", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", metavar="PART", help="measure only these parts")
    parser.add_argument("--quick", action="store_true", help="a sample of each part, to see that it works; writes files of its own")
    parser.add_argument("--without-peers", action="store_true", help="leave the peers out")
    parser.add_argument("--peers", type=Path, default=FOLDER / ".venv/bin/python", metavar="PYTHON", help="interpreter that has the peers")
    parser.add_argument("--cores", type=int, default=2, help="cores that everybody may use (default: 2)")
    parser.add_argument("--out", type=Path, default=FOLDER, metavar="FOLDER", help="where the results are (default: benchmarks)")
    return parser.parse_args()


def prepare_process(*, cores: int, quick: bool) -> None:
    """Settings that must stand before JAX starts, and that the processes started from here inherit."""
    if hasattr(os, "sched_setaffinity"):  # Linux; XLA and PyTorch take as many threads as they see cores
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:cores])
    os.environ["JAX_NUM_CPU_DEVICES"] = str(cores)  # as the `hindrl` command does
    os.environ["XLA_PYTHON_CLIENT_PREALLOCATE"] = "false"  # several processes share a GPU
    if quick:
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {QUICK_FLAGS}".strip()


def main() -> None:
    given = arguments()
    prepare_process(cores=given.cores, quick=given.quick)

    import jax

    from benchmarks import (
        cable_holding,
        cable_parity,
        cable_safety,
        cable_speed,
        compilation,
        environments,
        gradient_step,
        host_loop,
        reach_parity,
        reach_speed,
        relabelling,
        replay_size,
        report,
        seeds,
        startup,
        timing,
    )
    from benchmarks.timing import Effort, Options

    parts = {
        "gradient_step": gradient_step,
        "environments": environments,
        "reach_speed": reach_speed,
        "reach_parity": reach_parity,
        "cable_speed": cable_speed,
        "cable_parity": cable_parity,
        "cable_safety": cable_safety,
        "cable_holding": cable_holding,
        "host_loop": host_loop,
        "relabelling": relabelling,
        "replay_size": replay_size,
        "seeds": seeds,
        "compilation": compilation,
        "startup": startup,
    }
    chosen = given.only or list(parts)
    if unknown := set(chosen) - set(parts):
        sys.exit(f"unknown part {min(unknown)!r}: choose from {', '.join(parts)}")
    on_cpu = jax.default_backend() == "cpu"
    with_peers = on_cpu and not given.without_peers and "gradient_step" in chosen  # the peers are set up for the CPU alone
    if with_peers and not given.peers.exists():
        sys.exit(f"{given.peers} is not there: `make bench` installs the peers; or name their interpreter with --peers, or use --without-peers")
    effort = Effort(rounds=2, turn_seconds=0.05) if given.quick else Effort(rounds=9, turn_seconds=1.0)
    options = Options(effort=effort, quick=given.quick, cores=given.cores, peers=given.peers.absolute() if with_peers else None)

    suffix = ("" if on_cpu else "-gpu") + ("-quick" if given.quick else "")
    json_path, markdown_path = given.out / f"results{suffix}.json", given.out / f"RESULTS{suffix}.md"
    results = report.read(json_path)
    print(report.machine(), flush=True)
    for name in chosen:
        busy = timing.busy_share()
        if busy is not None and busy > BUSY:
            print(f"WARNING: other programs use {busy:.0%} of the machine; timings will be off, those of PyTorch several times over", flush=True)
        began = time.perf_counter()
        rows = parts[name].run(options)
        if not rows:  # something optional is not installed, as the part has said; what was measured earlier stays
            continue
        measured = {
            "date": time.strftime("%Y-%m-%d"),
            "machine": report.machine(),
            "versions": report.versions(),
            "peers": parts[name].versions(options) if hasattr(parts[name], "versions") else {},
            "command": shlex.join(["python", "-m", "benchmarks.run", *sys.argv[1:]]),
            "quick": given.quick,
            "busy": busy,
        }
        results[name] = {"measured": measured, "rows": rows}
        report.write(results, parts, json_path, markdown_path)  # after each part, so that a later failure loses nothing
        print(f"{parts[name].TITLE} took {time.perf_counter() - began:.0f} s", flush=True)
    if json_path.exists():
        print(f"results are in {json_path} and {markdown_path}")


if __name__ == "__main__":
    main()
