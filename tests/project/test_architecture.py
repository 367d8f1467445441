"""The arrows between packages: what each may import. Read off the source, so that an import inside a function counts too."""

import ast
import graphlib
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent.parent

# From the ground up. A package uses only lower layers, never its neighbours.
LAYERS = (
    {"base"},
    {"config", "envs"},
    {"core", "experts"},
    {"tasks"},
    {"demonstrations", "training"},
    {"plotting"},
    {"runs"},
    {"reporting", "reproduction"},
    {"cli"},
)
LAYER = {package: layer for layer, packages in enumerate(LAYERS) for package in packages}
FACADE = {"hindrl_jax", "hindrl_jax.__main__"}  # what the package shows, and `python -m hindrl_jax`

# Packages that a package may import, where not every one is allowed.
STANDARD_LIBRARY = {"__future__", "abc", "collections", "copy", "dataclasses", "enum", "functools", "itertools", "math", "types", "typing"}
PURE = STANDARD_LIBRARY | {"jax", "flax", "optax", "chex"}
DRAWING = {"viewer", "drawing", "renderer", "meshes", "opengl"}  # modules of envs that dynamics never import
SCREEN = {"PIL", "os"}  # what all of them may import
# What single modules may import beyond the others of their package. robosuite is found and silenced in one module; a person plays in real time.
BEYOND = {
    "robot": {"mujoco", "pathlib"},  # to read the model's file
    "mjx_dynamics": {"mujoco", "contextlib", "io"},
    "mujoco_dynamics": {"mujoco", "os", "threading"},
    "model": {"xml"},
    "renderer": {"atexit"},
    "meshes": {"importlib", "pathlib"},
    "opengl": {"ctypes", "importlib", "sys"},
    "installation": {"contextlib", "importlib", "io", "logging", "os", "sys", "warnings"},
    "metaworld": {"warnings"},
    "scene": {"robosuite", "mujoco"},
    "cable_scene": {"robosuite"},
    "arm": {"mujoco", "os", "sys"},
    "devices": {"importlib"},
    "by_hand": {"contextlib", "time"},
}


def module_of(path):
    """The dotted name of a source file; the folders envs and experts are `hindrl_jax.envs` and `hindrl_jax.experts`."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    parts = parts if parts[0] == "hindrl_jax" else ("hindrl_jax", *parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


SOURCES = {module_of(path): path for top in ("hindrl_jax", "envs", "experts") for path in sorted((ROOT / top).rglob("*.py"))}


def imports(path, *, outermost=False):
    """Dotted names of everything that a file imports, or only of what it imports along with itself; `from a import b` counts as a.b, since b may
    be a module."""
    names = set()
    module = ast.parse(path.read_text())
    for node in outside_functions(module) if outermost else ast.walk(module):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import; write the full name"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def outside_functions(node):
    """What is executed when a module is imported: everything but the bodies of functions."""
    for child in ast.iter_child_nodes(node):
        yield child
        if not isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            yield from outside_functions(child)


def used_modules(path):
    """The modules of this project that a file imports."""
    found = set()
    for name in imports(path):
        if name.startswith("hindrl_jax."):
            found.add(name if name in SOURCES else name.rpartition(".")[0])
    return found


def used_packages(path):
    return {name.partition(".")[0] for name in imports(path)} - {"hindrl_jax"}


def package_of(module):
    return module.split(".")[1]


MODULES = {module: path for module, path in SOURCES.items() if module not in FACADE}
ARROWS = {module: used_modules(path) - {module} for module, path in SOURCES.items()}


def test_every_module_is_in_a_package():
    assert {package_of(module) for module in MODULES} == set(LAYER)


@pytest.mark.parametrize("module", MODULES)
def test_module_uses_only_lower_layers(module):
    own = package_of(module)
    others = {used for used in ARROWS[module] - FACADE if package_of(used) != own}
    assert [used for used in sorted(others) if LAYER[package_of(used)] >= LAYER[own]] == []


def test_no_circles():
    order = list(graphlib.TopologicalSorter(ARROWS).static_order())  # raises CycleError, which names the circle
    assert len(order) >= len(SOURCES)


def test_a_circle_is_found():
    with pytest.raises(graphlib.CycleError):
        graphlib.TopologicalSorter({"a": {"b"}, "b": {"a"}}).prepare()


@pytest.mark.parametrize("module", [module for module in MODULES if package_of(module) in ("core", "config")])
def test_core_and_config_are_pure(module):
    """No disk, no printing, no NumPy."""
    assert used_packages(SOURCES[module]) <= PURE
    assert called_names(SOURCES[module]) & {"print", "open", "input", "__import__", "exec", "eval"} == set()


@pytest.mark.parametrize("module", [module for module in MODULES if package_of(module) == "core"])
def test_core_knows_no_environment_and_no_file(module):
    assert {package_of(used) for used in ARROWS[module]} <= {"base", "config", "core"}
    assert {used for used in ARROWS[module] if package_of(used) == "base"} <= {
        f"hindrl_jax.base.{name}" for name in ("types", "environments", "errors")
    }


@pytest.mark.parametrize("module", [module for module in MODULES if package_of(module) in ("envs", "experts")])
def test_environments_and_experts_import_little(module):
    name = module.rpartition(".")[2]
    draws = package_of(module) == "envs" and name in DRAWING
    allowed = PURE | {"numpy"} | BEYOND.get(name, set()) | (SCREEN if draws else set())
    assert used_packages(SOURCES[module]) <= allowed
    if not draws and package_of(module) == "envs":
        assert not any(used.rpartition(".")[2] in DRAWING for used in ARROWS[module])


def called_names(path):
    return {node.func.id for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)}


def test_only_networks_knows_flax_linen():
    users = {module for module, path in SOURCES.items() if any(f"{name}.".startswith("flax.linen.") for name in imports(path))}
    assert users == {"hindrl_jax.core.networks"}


@pytest.mark.parametrize("module", SOURCES)
def test_robosuite_and_mujoco_are_never_imported_with_a_module(module):
    """The one takes seconds and half a gigabyte, the other loads OpenGL, and both may be unusable: only functions import them."""
    assert not {"robosuite", "mujoco"} & {name.partition(".")[0] for name in imports(SOURCES[module], outermost=True)}


@pytest.mark.parametrize("path", sorted((ROOT / "tests").rglob("*.py")) + sorted(ROOT.glob("examples/*.py")), ids=lambda path: path.name)
def test_nobody_imports_the_folders_by_their_own_names(path):
    """`envs` and `experts` are other people's names for their own folders."""
    assert not {name for name in imports(path) if name.partition(".")[0] in ("envs", "experts")}


def test_no_file_is_long():
    assert {module: length for module, path in SOURCES.items() if (length := len(path.read_text().splitlines())) > 350} == {}


@pytest.mark.parametrize("module", [module for module in MODULES if package_of(module) == "core"])
def test_functions_of_the_core_take_few_parameters(module):
    functions = [node for node in ast.walk(ast.parse(SOURCES[module].read_text())) if isinstance(node, ast.FunctionDef)]
    assert [function.name for function in functions if num_parameters(function) > 6] == []


def num_parameters(function):
    names = [parameter.arg for parameter in (*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs)]
    return len([name for name in names if name not in ("self", "cls")])


def test_every_package_says_what_it_is_for():
    for package in LAYER:
        assert len(ast.get_docstring(ast.parse(SOURCES[f"hindrl_jax.{package}"].read_text())).split()) > 8


def test_imports_outside_functions_are_found(tmp_path):
    path = tmp_path / "module.py"
    path.write_text("try:\n    import mujoco\nexcept ImportError:\n    pass\nclass A:\n    import robosuite\ndef f():\n    import numpy\n")
    assert imports(path, outermost=True) == {"mujoco", "robosuite"}


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ("import numpy as np", {"numpy"}),
        ("def f():\n    import h5py", {"h5py"}),
        ("import jax.numpy as jnp\nfrom hindrl_jax.base.types import Array", {"jax"}),
    ],
)
def test_packages_are_found(tmp_path, source, found):
    path = tmp_path / "module.py"
    path.write_text(source)
    assert used_packages(path) == found
