"""The notebooks run from top to bottom, at a small size."""

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOKS = sorted((Path(__file__).parent.parent / "notebooks").glob("*.ipynb"))
SMALL = {"STEPS = None": "STEPS = 8_000", "SEEDS = [0, 1]": "SEEDS = [0]"}


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
@pytest.mark.filterwarnings("default")  # Jupyter's own deprecations are not ours to mend
def test_notebook_runs(path):
    notebook = nbformat.read(path, as_version=4)
    for large, small in SMALL.items():
        (cell,) = [cell for cell in notebook.cells if cell.cell_type == "code" and large in cell.source]
        cell.source = cell.source.replace(large, small)
    NotebookClient(notebook, timeout=300, kernel_name="python3").execute()
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    assert not any(output.output_type == "error" for output in outputs)
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 2
    assert sum("image/gif" in output.get("data", {}) for output in outputs) == 1


def test_notebooks_carry_no_stale_output():
    for path in NOTEBOOKS:
        assert all(not cell.get("outputs") for cell in nbformat.read(path, as_version=4).cells), path
