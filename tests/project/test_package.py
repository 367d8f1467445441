"""What is installed: one name, `hindrl_jax`, which works in a folder that has `envs` and `experts` of its own.

The sdist and, from it, the wheel are built with the packages of this environment, without the network; tests/try_package.sh installs both.
"""

import importlib.util
import os
import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent.parent
FOLDERS = {"envs": "hindrl_jax/envs", "experts": "hindrl_jax/experts"}  # at the top of the repository, and where they are imported from


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """A folder with an sdist, and a wheel that was built from it."""
    sources, built = tmp_path_factory.mktemp("sources"), tmp_path_factory.mktemp("built")
    for name in ("pyproject.toml", "setup.py", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, sources)
    for name in ("hindrl_jax", *FOLDERS):
        shutil.copytree(ROOT / name, sources / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(built), str(sources)]
    outcome = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert outcome.returncode == 0, outcome.stdout + outcome.stderr
    return built


@pytest.fixture(scope="module")
def wheel(built):
    return zipfile.ZipFile(next(built.glob("*.whl")))


def files(top, package):
    """The files of a folder of the repository, links not followed, by their names in a package."""
    paths = [path for path in (ROOT / top).rglob("*") if path.is_file() and "__pycache__" not in path.parts]
    return {f"{package}/{path.relative_to(ROOT / top)}" for path in paths}


@pytest.mark.parametrize(("top", "package"), FOLDERS.items())
def test_a_folder_at_the_top_is_a_package_by_a_link(top, package):
    assert (ROOT / package).is_symlink()
    assert os.readlink(ROOT / package) == f"../{top}"  # relative, so that it holds wherever the repository is
    assert not (ROOT / top).is_symlink()


def test_one_name_is_installed(wheel):
    tops = {name.partition("/")[0] for name in wheel.namelist()}
    assert {name for name in tops if not name.endswith(".dist-info")} == {"hindrl_jax"}


def test_wheel_and_sdist_hold_every_file_once(built, wheel):
    expected = set.union(*(files(top, package) for top, package in {"hindrl_jax": "hindrl_jax", **FOLDERS}.items()))
    assert "hindrl_jax/envs/panda/panda.xml" in expected
    names = [name for name in wheel.namelist() if ".dist-info/" not in name]
    assert sorted(names) == sorted(expected)
    with tarfile.open(next(built.glob("*.tar.gz"))) as sdist:
        assert not [member.name for member in sdist if member.issym() or member.islnk()]
        inside = {member.name.partition("/")[2] for member in sdist if member.isfile()}
    assert expected <= inside
    assert not [name for name in inside if name.startswith(tuple(f"{top}/" for top in FOLDERS))]


def test_what_pypi_shows_has_no_link_into_the_repository(wheel):
    name = next(name for name in wheel.namelist() if name.endswith(".dist-info/METADATA"))
    metadata = wheel.read(name).decode()
    assert "Description-Content-Type: text/markdown" in metadata
    assert "import hindrl_jax as hindrl" in metadata
    targets = re.findall(r"\]\(([^)]+)\)", metadata)
    assert "https://arxiv.org/abs/2112.00597" in targets
    assert [target for target in targets if not target.startswith("https://")] == []


def test_with_the_address_of_the_repository_links_and_pictures_lead_there():
    spec = importlib.util.spec_from_file_location("project_setup", ROOT / "setup.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    text = "| ![film](docs/film.gif) |\n|---|\n| words |\n\n[page](docs/page.md#there) [paper](https://arxiv.org/abs/1)\n"
    there = "https://example.org/hindrl"
    assert module.description(text, there) == (
        f"| ![film]({there}/raw/main/docs/film.gif) |\n|---|\n| words |\n\n[page]({there}/blob/main/docs/page.md#there) [paper](https://arxiv.org/abs/1)\n"
    )
    assert module.description(text, None) == "page [paper](https://arxiv.org/abs/1)\n"


def test_it_works_where_envs_and_experts_are_somebody_elses(wheel, tmp_path):
    installed, project = tmp_path / "installed", tmp_path / "project"
    wheel.extractall(installed)
    for name in FOLDERS:
        (project / name).mkdir(parents=True)
        (project / name / "__init__.py").write_text("MINE = True\n")
    code = """
import envs, experts, hindrl_jax
assert envs.MINE and experts.MINE
hindrl_jax.make("FixedGridPickAndPlace")
from hindrl_jax.envs import panda
assert panda.model().nq == 7
print(hindrl_jax.envs.__file__)
"""
    environment = os.environ | {"PYTHONPATH": str(installed), "JAX_PLATFORMS": "cpu"}
    outcome = subprocess.run([sys.executable, "-c", code], cwd=project, env=environment, capture_output=True, text=True, timeout=120)
    assert outcome.returncode == 0, outcome.stderr
    assert outcome.stdout.strip() == str(installed / "hindrl_jax" / "envs" / "__init__.py")
