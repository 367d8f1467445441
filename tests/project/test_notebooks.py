"""The notebooks run from top to bottom, at a small size; what is stored of a run at full size is of the code that stands there."""

import copy
import importlib.util
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

FOLDER = Path(__file__).parent.parent.parent / "notebooks"
_SPEC = importlib.util.spec_from_file_location("execute_notebooks", FOLDER.parent / "docs" / "execute_notebooks.py")
execute_notebooks = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(execute_notebooks)
MOST_BYTES = 1_500_000  # of all notebooks together: each version of one is kept by git for ever
# Presets are small, too, from the cell of sizes on.
SIZES = "# The size"
SMALL_PRESETS = f"\nimport sys; sys.path.append({str(FOLDER.parent / 'tests')!r})\nimport small_presets; small_presets.install()"
# What each is made smaller by, and how many pictures and films it shows.
NOTEBOOKS = {
    "01_quickstart": ({"STEPS = None": "STEPS = 260"}, 2, 1),
    "02_your_own_task": ({"STEPS = 40_000": "STEPS = 260", "SEEDS = [0, 1]": "SEEDS = [0]"}, 3, 0),
    "03_your_own_demonstrations": ({"STEPS = None": "STEPS = 260", "SEEDS = [0, 1]": "SEEDS = [0]"}, 2, 1),
    "04_goals_and_epsilon": ({"DEMOS = 5": "DEMOS = 2"}, 4, 0),
    "05_many_seeds_and_settings": ({"STEPS = 32_000": "STEPS = 260", "SEEDS = [0, 1, 2, 3]": "SEEDS = [0, 1]"}, 1, 0),
    "06_two_arms": ({"STEPS = 80_000": "STEPS = 6_000", "DEMOS = 20": "DEMOS = 2", "EPISODES = 100": "EPISODES = 10"}, 4, 1),
    "07_thesis": ({"../benchmarks": "benchmarks"}, 2, 0),  # from where the tests run; the report there is small
}


SLOW = "06_two_arms"  # minutes of compilation
_ALL = [pytest.param(name, marks=pytest.mark.slow) if name == SLOW else name for name in NOTEBOOKS]


@pytest.mark.parametrize("name", _ALL)
@pytest.mark.filterwarnings("default")  # Jupyter's own deprecations are not ours to mend
def test_notebook_runs(name):
    smaller, num_pictures, num_films = NOTEBOOKS[name]
    notebook = nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)
    stored = [execute_notebooks.kinds(cell) for cell in notebook.cells if cell.cell_type == "code"]
    for large, small in smaller.items():
        (cell,) = [cell for cell in notebook.cells if cell.cell_type == "code" and large in cell.source]
        cell.source = cell.source.replace(large, small)
    for cell in notebook.cells:
        if cell.cell_type == "code" and cell.source.startswith(SIZES) and name != SLOW:
            cell.source += SMALL_PRESETS
    NotebookClient(notebook, timeout=300, kernel_name="python3", coalesce_streams=True).execute()
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    assert not any(output.output_type == "error" for output in outputs)
    assert sum("image/png" in output.get("data", {}) for output in outputs) == num_pictures
    assert sum("image/gif" in output.get("data", {}) for output in outputs) == num_films
    if name in execute_notebooks.EXECUTED:  # the same cells have shown the same
        assert stored == [execute_notebooks.kinds(cell) for cell in notebook.cells if cell.cell_type == "code"]


def test_every_notebook_is_run():
    assert {path.stem for path in FOLDER.glob("*.ipynb")} == set(NOTEBOOKS)


def is_fresh(notebook):
    """Whether the outputs are those of the code that stands there, and none of them an error."""
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    return notebook.metadata.get(execute_notebooks.CODE) == execute_notebooks.digest(notebook) and all(o.output_type != "error" for o in outputs)


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_outputs_are_of_the_code_that_stands_there(name):
    notebook = nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)
    if name not in execute_notebooks.EXECUTED:
        assert all(not cell.get("outputs") for cell in notebook.cells)
        return
    assert is_fresh(notebook), f"the code of {name} has changed since it was run: `make notebooks`"
    changed = copy.deepcopy(notebook)
    next(cell for cell in changed.cells if cell.cell_type == "code").source += "\n1"
    assert not is_fresh(changed)


def test_notebooks_with_outputs_are_small():
    assert sum(path.stat().st_size for path in FOLDER.glob("*.ipynb")) < MOST_BYTES


def test_own_task_is_the_example():
    """The notebook has the code of examples/two_rooms.py, so that the two cannot part."""
    code = [cell.source.strip() for cell in nbformat.read(FOLDER / "02_your_own_task.ipynb", as_version=4).cells if cell.cell_type == "code"]
    example = (FOLDER.parent / "examples" / "two_rooms.py").read_text()
    blocks = [block for block in code if "class TwoRooms" in block or "class RoomsExpert" in block]
    assert len(blocks) == 2
    assert all(block in example for block in blocks)
