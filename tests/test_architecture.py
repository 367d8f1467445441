"""The arrows between modules: what each may import. Read off the source, so that an import inside a function counts too."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
STANDARD_LIBRARY = {"__future__", "abc", "collections", "copy", "dataclasses", "enum", "functools", "itertools", "math", "types", "typing"}
PURE = STANDARD_LIBRARY | {"jax", "flax", "optax", "chex"}

# Module of the core -> the modules of the core that it may import.
CORE = {
    "errors": set(),
    "checks": set(),
    "types": set(),
    "config": {"checks"},
    "randomness": {"types"},
    "goals": {"types", "config", "randomness"},
    "relabel": {"types", "config", "randomness", "goals"},
    "priorities": {"types", "config"},
    "replay": {"errors", "types", "config", "randomness", "goals", "relabel", "priorities"},
    "networks": {"types", "config"},
    "losses": {"types"},
    "agent": {"types", "config", "networks", "losses"},
    "rollout": {"types", "config", "randomness", "goals"},
    "train": {"errors", "types", "config", "randomness", "goals", "relabel", "priorities", "replay", "networks", "losses", "agent", "rollout"},
}
DRAWING = {"viewer", "drawing"}  # modules of envs that dynamics never import
ENVS = sorted(path for path in (ROOT / "envs").rglob("*.py") if path.stem not in DRAWING)
VIEWERS = sorted(path for path in (ROOT / "envs").rglob("*.py") if path.stem in DRAWING)
SCREEN = {"PIL", "mujoco", "numpy", "os", "pathlib", "hindrl_jax.errors"} | {"atexit", "ctypes", "importlib", "sys"}  # the latter to open OpenGL
EXPERTS = sorted((ROOT / "experts").rglob("*.py"))
# What single modules may import beyond the others of their kind. robosuite is found and silenced in one module; a person plays in real time.
BEYOND = {
    "panda": {"mujoco", "pathlib", "hindrl_jax.errors"},  # to read the model's file
    "mjx_dynamics": {"mujoco", "contextlib", "io"},
    "robosuite_arm": {"robosuite", "mujoco", "contextlib", "importlib", "io", "logging", "os", "sys", "warnings"},
    "by_hand": {"contextlib", "time"},
}


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


def not_allowed(path, allowed):
    """The imports of a file that are neither one of the dotted names in `allowed` nor inside one."""
    return sorted(name for name in imports(path) if not any(f"{name}.".startswith(f"{prefix}.") for prefix in allowed))


def called_names(path):
    return {node.func.id for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)}


def name_of(path):
    return str(path.relative_to(ROOT))


@pytest.mark.parametrize("module", CORE)
def test_core_module_imports_only_what_comes_before_it(module):
    path = ROOT / "hindrl_jax" / f"{module}.py"
    assert not_allowed(path, PURE | {f"hindrl_jax.{used}" for used in CORE[module]}) == []
    assert called_names(path) & {"print", "open", "input", "__import__", "exec", "eval"} == set()


def test_arrows_of_the_core_form_no_circle():
    """Each module uses only modules that stand before it in the table."""
    order = list(CORE)
    assert all(order.index(used) < order.index(module) for module in CORE for used in CORE[module])


def test_only_networks_knows_flax_linen():
    users = {name_of(path) for top in ("hindrl_jax", "envs", "experts") for path in (ROOT / top).rglob("*.py") if uses_linen(path)}
    assert users == {"hindrl_jax/networks.py"}


def uses_linen(path):
    return any(f"{name}.".startswith("flax.linen.") for name in imports(path))


@pytest.mark.parametrize("path", ENVS, ids=name_of)
def test_env_imports_only_core_types_and_goals(path):
    # An environment may use its neighbours in envs, but never a viewer.
    allowed = PURE | {"numpy", "hindrl_jax.checks", "hindrl_jax.types", "hindrl_jax.goals", "envs"}
    assert not_allowed(path, allowed | BEYOND.get(path.stem, set())) == []
    assert not any(DRAWING & set(name.split(".")) for name in imports(path))


@pytest.mark.parametrize("path", VIEWERS, ids=name_of)
def test_viewer_may_draw_as_well(path):
    assert not_allowed(path, PURE | SCREEN | {"hindrl_jax.types", "hindrl_jax.goals", "envs"}) == []


@pytest.mark.parametrize("path", EXPERTS, ids=name_of)
def test_expert_imports_only_envs_and_core_types(path):
    allowed = PURE | {"numpy", "hindrl_jax.checks", "hindrl_jax.errors", "hindrl_jax.types", "envs", "experts"}
    assert not_allowed(path, allowed | BEYOND.get(path.stem, set())) == []


@pytest.mark.parametrize("path", sorted(path for top in ("envs", "experts", "hindrl_jax") for path in (ROOT / top).rglob("*.py")), ids=name_of)
def test_robosuite_and_mujoco_are_never_imported_with_a_module(path):
    """The one takes seconds and half a gigabyte, the other loads OpenGL, and both may be unusable: only functions import them."""
    assert not {"robosuite", "mujoco"} & {name.split(".")[0] for name in imports(path, outermost=True)}


def test_imports_outside_functions_are_found(tmp_path):
    path = tmp_path / "module.py"
    path.write_text("try:\n    import mujoco\nexcept ImportError:\n    pass\nclass A:\n    import robosuite\ndef f():\n    import numpy\n")
    assert imports(path, outermost=True) == {"mujoco", "robosuite"}


def test_experts_form_no_circle():
    order = ["grid", "reach", "fetch", "robosuite_arm", "recording", "by_hand"]
    assert {path.stem for path in EXPERTS} - {"__init__"} == set(order)
    for path in EXPERTS:
        used = {name.split(".")[1] for name in imports(path) if name.startswith("experts.")}
        assert path.stem == "__init__" or all(order.index(name) < order.index(path.stem) for name in used)


def test_there_is_something_to_check():
    assert ENVS
    assert {path.stem for path in VIEWERS} == DRAWING
    assert EXPERTS


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ("import numpy as np", ["numpy"]),
        ("from hindrl_jax import train", ["hindrl_jax.train"]),
        ("from hindrl_jax.train import step", ["hindrl_jax.train.step"]),
        ("def f():\n    import h5py", ["h5py"]),
        ("import jaxtyping", ["jaxtyping"]),
        ("import jax.numpy as jnp\nfrom hindrl_jax.types import Array", []),
    ],
)
def test_forbidden_imports_are_found(tmp_path, source, found):
    path = tmp_path / "module.py"
    path.write_text(source)
    assert not_allowed(path, PURE | {"hindrl_jax.types"}) == found
