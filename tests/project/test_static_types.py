"""The type checker knows what the package shows; what it has to say about the package itself, `make lint` tells."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import hindrl_jax as hindrl

ROOT = Path(__file__).parent.parent.parent
FACADE = ROOT / "hindrl_jax" / "__init__.py"


def mypy(*arguments):
    command = [sys.executable, "-m", "mypy", *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)


def test_mypy_knows_what_the_package_shows(tmp_path):
    """The functions with their parameters; and a name that does not exist."""
    lines = [f"reveal_type(hindrl.{name})" for name in hindrl.__all__]
    code = tmp_path / "own_project.py"
    wrong = ['hindrl.fit("FixedGridPickAndPlace", [])', "hindrl.fitt", "run = hindrl.load_run('runs/mine')", "run.policy(1).action_holds"]
    code.write_text("\n".join(["import hindrl_jax as hindrl", *lines, *wrong, "run.value().critic", "run.numpy_policy()([0.0]).shapes"]))
    said = mypy(str(code)).stdout
    revealed = dict(zip(hindrl.__all__, [line for line in said.splitlines() if "Revealed type is" in line], strict=True))
    assert [name for name, line in revealed.items() if 'is "Any"' in line] == []
    assert "def (env: " in revealed["fit"]
    assert "seeds: typing.Sequence[int]" in revealed["fit"].replace("collections.abc.", "typing.")
    assert "-> hindrl_jax.training.result.Result" in revealed["fit"]
    assert 'Missing positional argument "config" in call to "fit"' in said
    assert 'Module has no attribute "fitt"' in said
    for kind, name in (("TrainedPolicy", "action_holds"), ("TrainedValue", "critic"), ("ndarray[tuple[Any, ...], dtype[Any]]", "shapes")):
        assert f'"{kind}" has no attribute "{name}"' in said


def test_names_are_loaded_from_where_type_checkers_see_them():
    """Every name of the table is imported for type checkers from the same module, as itself: without "as", it would be private to them."""
    imports = [node for node in ast.walk(ast.parse(FACADE.read_text())) if isinstance(node, ast.ImportFrom) and node.module.startswith("hindrl_jax.")]
    aliases = [(alias.name, alias.asname, node.module) for node in imports for alias in node.names]
    assert [name for name, as_name, _ in aliases if as_name != name] == []
    assert {name: module for name, _, module in aliases} == hindrl._EXPORTS


@pytest.mark.parametrize("name", hindrl.__all__)
def test_names_are_there_and_documented(name):
    assert getattr(hindrl, name) is not None
    assert name in dir(hindrl)
    assert name == "__version__" or f"[`{name}`]" in (ROOT / "docs" / "api" / "outside.md").read_text()


def loaded_by(module):
    code = f"import sys; before = set(sys.modules); import {module}; print(*sorted(set(sys.modules) - before))"
    return subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()


def test_a_command_starts_without_what_only_some_commands_need():
    assert {"scipy.stats", "matplotlib", "mujoco", "orbax", "PIL"} & set(loaded_by("hindrl_jax.cli")) == set()


def test_importing_the_package_loads_nothing_large():
    """Gymnasium, whose registry learns our ids, is the largest."""
    loaded = loaded_by("hindrl_jax")
    large = {"jax", "jaxlib", "flax", "optax", "chex", "h5py", "matplotlib", "mujoco", "orbax", "PIL"}
    assert {name.partition(".")[0] for name in loaded} & large == set()
    own = [name for name in loaded if name.startswith("hindrl_jax.")]
    assert own == ["hindrl_jax.base", "hindrl_jax.base.errors", "hindrl_jax.tasks", "hindrl_jax.tasks.ids"]
