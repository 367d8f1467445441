"""The benchmarks still run; their figures are not looked at here."""

import json
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent


def test_a_quick_benchmark_writes_its_results(tmp_path):
    command = [sys.executable, "-m", "benchmarks.run", "--quick", "--without-peers", "--only", "relabelling", "environments", "--out", tmp_path]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    results = json.loads((tmp_path / "results-quick.json").read_text())
    assert list(results) == ["environments", "relabelling"]  # in the order of the document, whatever the order of measuring
    assert all(row["cpu_ms"] > 0 for row in results["relabelling"]["rows"])
    assert "A quick run: the figures mean nothing" in (tmp_path / "RESULTS-quick.md").read_text()
