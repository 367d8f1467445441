"""The type checker has nothing to say, as in `make lint`."""

import subprocess
import sys
from pathlib import Path


def test_mypy_passes():
    outcome = subprocess.run([sys.executable, "-m", "mypy"], cwd=Path(__file__).parent.parent.parent, capture_output=True, text=True, timeout=300)
    assert outcome.returncode == 0, outcome.stdout + outcome.stderr
