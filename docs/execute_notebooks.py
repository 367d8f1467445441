"""Runs notebooks from top to bottom at their full size and keeps what they show, so that they can be read where nothing runs: `make notebooks`.

It takes minutes of two cores for those in EXECUTED. A notebook's metadata note which code its outputs are of: a test compares, and asks for another
run after a change of the code.
"""

from __future__ import annotations

import argparse
import hashlib
from pathlib import Path
from typing import Any

import nbformat

FOLDER = Path(__file__).parent.parent / "notebooks"
EXECUTED = ("01_quickstart", "02_your_own_task", "03_your_own_demonstrations", "04_goals_and_epsilon", "05_many_seeds_and_settings", "07_thesis")
"""Those that are stored with their outputs; the films of the two arms are too large for git."""
CODE = "outputs_of_code"
"""The entry of a notebook's metadata that says which code its outputs are of."""


def digest(notebook: Any) -> str:
    """A fingerprint of a notebook's code."""
    code = "\0".join(cell.source for cell in notebook.cells if cell.cell_type == "code")
    return hashlib.sha256(code.encode()).hexdigest()[:16]


def kinds(cell: Any) -> list[str]:
    """What a code cell has shown: kinds of pictures, and "text" where it has printed."""
    pictures = [kind for output in cell.outputs for kind in output.get("data", {}) if kind.startswith("image/")]
    return pictures + ["text"] * any(output.output_type == "stream" and output.name == "stdout" for output in cell.outputs)


def execute(notebook: Any, folder: Path = FOLDER) -> None:
    """Runs a notebook and puts its outputs into it; what changes from machine to machine is left out: moments, and bars that are gone in the end."""
    from nbclient import NotebookClient

    metadata = dict(notebook.metadata)
    where = {"metadata": {"path": str(folder)}}
    client = NotebookClient(notebook, timeout=3600, kernel_name="python3", record_timing=False, coalesce_streams=True, resources=where)
    client.execute()
    notebook.metadata.clear()
    notebook.metadata.update(metadata | {CODE: digest(notebook)})
    for cell in notebook.cells:
        if cell.cell_type == "code":
            cell.outputs = [output for output in cell.outputs if output.get("data", {}).get("text/html") != "" and output.get("name") != "stderr"]


def main() -> None:
    """Runs those that are named, or all of EXECUTED."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", choices=[*EXECUTED, []], help="notebooks (default: all that are stored with outputs)")
    for name in parser.parse_args().names or EXECUTED:
        path = FOLDER / f"{name}.ipynb"
        notebook = nbformat.read(path, as_version=4)
        execute(notebook)
        nbformat.write(notebook, path)
        print(f"{path}: {path.stat().st_size / 1000:,.0f} kB")


if __name__ == "__main__":
    main()
