"""How long `hindrl train` takes from its start to its first gradient step, with nothing kept from earlier starts (cold) and after one (warm)."""

from __future__ import annotations

import json
import os
import re
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks import report, timing
from benchmarks.timing import Options, Row

TITLE = "Start-up"
REPEATS = 3
COMMAND = ("train", "--steps", "20000", "--demos", "1", "--seeds", "1")
_FIRST_UPDATE = re.compile(r"first updates after ([0-9.]+) s")
_MEASURED = ("first_update_s", "compile_s", "whole_s", "peak_memory_mib")


def run(options: Options) -> list[Row]:
    """A row for cold starts and one for warm ones, medians over a few pairs of both."""
    print(f"{TITLE}: hindrl {' '.join(COMMAND)}", flush=True)
    starts: dict[str, list[Row]] = {"cold": [], "warm": []}
    for _ in range(1 if options.quick else REPEATS):
        with tempfile.TemporaryDirectory() as folder:
            for measured in starts.values():
                measured.append(start(Path(folder)))
    rows = []
    for kind, measured in starts.items():
        row: Row = {"start": kind, "starts": len(measured)}
        for name in _MEASURED:
            values = [each[name] for each in measured]
            row |= {name: timing.rounded(statistics.median(values)), f"{name}_range": [min(values), max(values)]}
        print(
            f"  {kind}: first update after {row['first_update_s']} s, of which compilation {row['compile_s']} s; whole command {row['whole_s']} s; "
            f"peak memory {row['peak_memory_mib']:g} MiB",
            flush=True,
        )
        rows.append(row)
    return rows


def start(folder: Path) -> Row:
    """Runs the command once, with `folder` for its caches."""
    out = folder / "run"
    environment = {name: value for name, value in os.environ.items() if "COMPILATION_CACHE" not in name} | {"XDG_CACHE_HOME": str(folder / "cache")}
    began = time.perf_counter()
    command = [Path(sys.executable).with_name("hindrl"), *COMMAND, "--out", out, "--overwrite"]
    process = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    whole = time.perf_counter() - began
    found = _FIRST_UPDATE.search(process.stdout)
    if process.returncode or not found:
        raise RuntimeError(f"hindrl {' '.join(COMMAND)} did not say when its first update was:\n{process.stdout[-2000:]}{process.stderr[-2000:]}")
    summary = json.loads((out / "summary.json").read_text())
    return {
        "first_update_s": float(found[1]),
        "compile_s": round(summary["compile_seconds"], 2),
        "whole_s": round(whole, 2),
        "peak_memory_mib": round(summary["peak_memory_bytes"] / 2**20),
    }


def tables(rows: list[Row]) -> str:
    """Cold and warm beside each other."""

    def cell(row: Row, name: str) -> str:
        least, largest = row[f"{name}_range"]
        return f"{row[name]:g} ({least:g} .. {largest:g})"

    lines = [[row["start"], *(cell(row, name) for name in _MEASURED)] for row in rows]
    text = (
        f"`hindrl {' '.join(COMMAND)}` as a whole process, the median of {rows[0]['starts']} (least .. largest). Cold: an empty cache folder; "
        "warm: the start after.\n\n"
    )
    return text + report.table(["start", "s to the first update", "s of compilation in it", "s for the whole command", "peak memory, MiB"], lines)
