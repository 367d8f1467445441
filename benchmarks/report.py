"""Where measurements go: results.json, the rows as they were measured, and RESULTS.md, which is made from them."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from types import ModuleType
from typing import Any

import jax

Results = dict[str, Any]
"""Part -> {"measured": where, when and with what, "rows": [...]}."""


def table(header: Sequence[Any], lines: Sequence[Sequence[Any]]) -> str:
    """A Markdown table."""
    return "".join(f"| {' | '.join(map(str, line))} |\n" for line in (header, ["---"] * len(header), *lines))


def machine() -> str:
    """The processor, the cores that the benchmark keeps to, and the accelerator if there is one."""
    cores, all_cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(), os.cpu_count()
    text = f"{_processor()}, {cores} cores" + (f" of {all_cores}" if cores != all_cores else "")
    return text if jax.default_backend() == "cpu" else f"{jax.devices()[0].device_kind}, {text}"


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.machine())


def versions() -> dict[str, str]:
    """Versions of Python, of hindrl_jax and of what it computes with."""
    return {"python": platform.python_version()} | installed("hindrl-jax", "jax", "jaxlib", "flax", "optax", "numpy")


def installed(*packages: str) -> dict[str, str]:
    """Versions of those of the packages that are installed."""
    found = {name: next(iter(metadata.distributions(name=name)), None) for name in packages}
    return {name: package.version for name, package in found.items() if package}


def read(path: Path) -> Results:
    """The results so far; nothing if there are none."""
    return json.loads(path.read_text()) if path.exists() else {}


def write(results: Results, parts: dict[str, ModuleType], json_path: Path, markdown_path: Path) -> None:
    """Writes both files, with the parts in their order."""
    results = {name: results[name] for name in parts if name in results}
    json_path.write_text(_one_row_per_line(results))
    provenance = {name: _provenance(result["measured"]) for name, result in results.items()}
    same = len(set(provenance.values())) == 1
    text = f"# Results\n\nMade by `python -m benchmarks.run` from the rows in `{json_path.name}`; [README.md](README.md) says how to read it.\n"
    if same:
        text += f"\n{next(iter(provenance.values()))}\n"
    for name, result in results.items():
        text += f"\n## {parts[name].TITLE}\n\n"
        text += "" if same else f"{provenance[name]}\n\n"
        text += f"{_circumstances(result['measured'])}\n\n{parts[name].tables(result['rows'])}"
    markdown_path.write_text(text)


def _one_row_per_line(results: Results) -> str:
    """JSON that a person can compare line by line."""
    parts = []
    for name, result in results.items():
        rows = ",\n".join(f"      {json.dumps(row)}" for row in result["rows"])
        parts.append(f'  {json.dumps(name)}: {{\n    "measured": {json.dumps(result["measured"])},\n    "rows": [\n{rows}\n    ]\n  }}')
    return "{\n" + ",\n".join(parts) + "\n}\n"


def _provenance(measured: dict[str, Any]) -> str:
    quick = " **A quick run: the figures mean nothing.**" if measured["quick"] else ""
    return f"{measured['date']}, {measured['machine']}; {_versions(measured['versions'])}; `{measured['command']}`.{quick}"


def _circumstances(measured: dict[str, Any]) -> str:
    busy = "" if measured["busy"] is None else f"Just before, other programs used {measured['busy']:.0%} of the machine."
    return f"{busy} Peers: {_versions(measured['peers'])}." if measured["peers"] else busy


def _versions(versions: dict[str, str]) -> str:
    return ", ".join(f"{name} {version}" for name, version in versions.items())
