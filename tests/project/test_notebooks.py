"""The notebooks run from top to bottom, at a small size."""

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

FOLDER = Path(__file__).parent.parent.parent / "notebooks"
# What each is made smaller by, and how many pictures and films it shows.
NOTEBOOKS = {
    "01_quickstart": ({"STEPS = None": "STEPS = 4_000", "SEEDS = [0, 1]": "SEEDS = [0]"}, 2, 1),
    "02_your_own_task": ({"STEPS = 40_000": "STEPS = 2_000", "SEEDS = [0, 1]": "SEEDS = [0]"}, 3, 0),
    "03_your_own_demonstrations": ({"STEPS = None": "STEPS = 2_000", "SEEDS = [0, 1]": "SEEDS = [0]"}, 2, 1),
    "04_goals_and_epsilon": ({"DEMOS = 5": "DEMOS = 2"}, 4, 0),
    "05_many_seeds_and_settings": ({"STEPS = 48_000": "STEPS = 2_000", "SEEDS = [0, 1, 2, 3]": "SEEDS = [0, 1]"}, 1, 0),
    "06_two_arms": ({"STEPS = 80_000": "STEPS = 6_000", "DEMOS = 20": "DEMOS = 2", "EPISODES = 100": "EPISODES = 10"}, 4, 1),
}


_ALL = [pytest.param(name, marks=pytest.mark.slow) if name == "06_two_arms" else name for name in NOTEBOOKS]  # minutes of compilation


@pytest.mark.parametrize("name", _ALL)
@pytest.mark.filterwarnings("default")  # Jupyter's own deprecations are not ours to mend
def test_notebook_runs(name):
    smaller, num_pictures, num_films = NOTEBOOKS[name]
    notebook = nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)
    for large, small in smaller.items():
        (cell,) = [cell for cell in notebook.cells if cell.cell_type == "code" and large in cell.source]
        cell.source = cell.source.replace(large, small)
    NotebookClient(notebook, timeout=300, kernel_name="python3").execute()
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    assert not any(output.output_type == "error" for output in outputs)
    assert sum("image/png" in output.get("data", {}) for output in outputs) == num_pictures
    assert sum("image/gif" in output.get("data", {}) for output in outputs) == num_films


def test_every_notebook_is_run():
    assert {path.stem for path in FOLDER.glob("*.ipynb")} == set(NOTEBOOKS)


def test_notebooks_carry_no_stale_output():
    for path in FOLDER.glob("*.ipynb"):
        assert all(not cell.get("outputs") for cell in nbformat.read(path, as_version=4).cells), path


def test_own_task_is_the_example():
    """The notebook has the code of examples/two_rooms.py, so that the two cannot part."""
    code = [cell.source.strip() for cell in nbformat.read(FOLDER / "02_your_own_task.ipynb", as_version=4).cells if cell.cell_type == "code"]
    example = (FOLDER.parent / "examples" / "two_rooms.py").read_text()
    blocks = [block for block in code if "class TwoRooms" in block or "class RoomsExpert" in block]
    assert len(blocks) == 2
    assert all(block in example for block in blocks)
