"""The documentation: its site builds without a warning, its examples run, and it speaks of no flag, file or module that is not there."""

import dataclasses
import glob
import importlib.util
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import small_presets

from hindrl_jax.tasks import presets
from hindrl_jax.tasks.from_gymnasium import GymnasiumEnv

ROOT = Path(__file__).parent.parent.parent
README, *PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), *sorted((ROOT / "docs" / "api").glob("*.md"))]
FENCE = re.compile(r"```python\n(.*?)```", re.DOTALL)
BLOCKS = {f"{path.name}:{i}": code for path in (README, *PAGES) for i, code in enumerate(FENCE.findall(path.read_text()))}
# One that is the beginning of another is run with it.
EXAMPLES = [name for name, code in BLOCKS.items() if not any(other.startswith(code) for other in BLOCKS.values() if other != code)]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The project's text, its generated pages and the site, in a folder of their own."""
    folder = tmp_path_factory.mktemp("site")
    ignored = shutil.ignore_patterns("generated", "__pycache__")
    for name in ("docs", "notebooks", "benchmarks", "examples"):
        shutil.copytree(ROOT / name, folder / name, ignore=ignored)
    for name in ("README.md", "CHANGELOG.md", "CONTRIBUTING.md", "REPRODUCTION.md", "mkdocs.yml"):
        shutil.copy(ROOT / name, folder)
    (folder / "hindrl_jax").symlink_to(ROOT / "hindrl_jax")
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1", "JAX_PLATFORMS": "cpu"}
    for command in (["docs/generate.py"], ["-m", "mkdocs", "build", "--strict"]):  # with --quiet, warnings would not count
        outcome = subprocess.run([sys.executable, *command], cwd=folder, env=environment, capture_output=True, text=True, timeout=300)
        assert outcome.returncode == 0, outcome.stdout + outcome.stderr
    return folder


def test_site_builds_without_a_warning(site):
    core = (site / "site" / "api" / "core.html").read_text()
    assert "Half-width of the goal box per dimension (thesis eq. 4.7)" in core
    base = (site / "site" / "api" / "base.html").read_text()
    assert "(B,), factor of the bootstrapped value" in base  # a shape comment behind a field of Transition
    commands = (site / "site" / "generated" / "command-line.html").read_text()
    assert "--hindrl-sampling-strategy" in commands
    assert "\x1b" not in commands


@pytest.fixture(scope="module")
def checker():
    """docs/check_site.py as a module."""
    spec = importlib.util.spec_from_file_location("check_site", ROOT / "docs" / "check_site.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules["check_site"] = module
    spec.loader.exec_module(module)
    if module.find_browser() is None:
        pytest.skip("no browser is installed")
    return module


def test_site_in_a_browser(site, checker):
    report = checker.check(site / "site", checker.find_browser())
    assert report.pages > 30
    assert report.is_good(), "\n".join(report.lines())


def test_the_browser_check_finds_what_is_wrong(checker, tmp_path):
    (tmp_path / "index.html").write_text(
        """<body><div class="md-content"><p style="width: 2000px">wide</p>
        <pre style="overflow: auto; width: 90px"><code>a long line of code</code></pre>
        <img src="nowhere.png"><a href="nowhere.html">nowhere</a><a href="#nowhere">nowhere</a><a href="#here" id="here">here</a></div>
        <input class="md-search__input"><input type="checkbox" id="__search"><script>console.error("trouble")</script></body>"""
    )
    report = checker.check(tmp_path, checker.find_browser(), patience=0.5)
    assert [one.rpartition("page: ")[2] for one in report.overflowing] == [
        "p: wide",
        "index.html, laptop: has to be scrolled: pre: a long line of code",
        "p: wide",
    ]
    assert [one.rpartition("/")[2] for one in report.dead_links] == ["index.html#nowhere", "nowhere.html"]
    assert report.missing_pictures == ["index.html: nowhere.png"]
    assert any("trouble" in one for one in report.console_errors)
    assert not report.is_good()


def test_flags_exist(site):
    """Every flag that the pages mention, of whatever command."""
    commands = (site / "docs" / "generated" / "command-line.md").read_text()
    known = set(re.findall(r"--[a-z][a-z0-9-]*", commands))
    others = {"--ntasks-per-node", "--gpus-per-node"}  # SLURM's
    others |= {"--gate-width", "--noise"}  # the example's own
    others |= {f"--{field.name.replace('_', '-')}" for field in dataclasses.fields(GymnasiumEnv)}  # which has a page only where it is installed
    others |= {"--only", "--minutes", "--help", "--help-all", "--version", "--logdir"}
    for path in (README, *PAGES):
        unknown = set(re.findall(r"(?<![\w-])--[a-z][a-z0-9-]*", path.read_text())) - known - others
        assert not unknown, f"{path.name}: {unknown}"


def test_every_module_has_a_page():
    listed = {name for path in PAGES for name in re.findall(r"^::: (\S+)$", path.read_text(), re.M)}
    files = [ROOT.joinpath(path) for path in glob.glob("hindrl_jax/**/*.py", root_dir=ROOT, recursive=True)]  # unlike rglob, follows links
    modules = {".".join(path.relative_to(ROOT).with_suffix("").parts) for path in files}
    modules = {name for name in modules if not name.rpartition(".")[2].startswith("_") and not name.startswith("hindrl_jax.cli.")}
    assert listed == modules


def test_links_lead_to_files_of_the_project():
    """As the pages stand, in a checkout: to what is made for the site alone, no page links."""
    pages = (README, ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", ROOT / "REPRODUCTION.md", *PAGES)
    links = {(path, target) for path in pages for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", path.read_text()) if "://" not in target}
    assert len(links) > 100
    missing = [f"{path.name}: {target}" for path, target in links if not (path.parent / target).exists()]
    assert missing == []
    made = [f"{path.name}: {target}" for path, target in links if (path.parent / target).resolve().is_relative_to(ROOT / "docs" / "generated")]
    assert made == []
    # Those of the reference exist, and hold hardly more than names of modules.
    reference = {f"{path.name}: {target}" for path, target in links if "api/" in target and path.parent.name != "api"}
    assert not reference


def test_links_to_sources_lead_to_pages_on_the_site(site):
    pages = {
        "quick-start.html": "generated/01_quickstart.html",
        "index.html": "generated/command-line.html",
        "faq.html": "api/core.html",
        "performance.html": "generated/benchmark-method.html",
        "training.html": "api/core-learning.html#hindrl_jax.core.holding",
    }
    for name, target in pages.items():
        assert f'href="{target}"' in (site / "site" / name).read_text().partition("<article")[2], name
    assert "planar_arm.py</code>. Six parts" in (site / "site" / "tutorial.html").read_text()  # which has no page


@pytest.fixture
def small(monkeypatch, tmp_path):
    """Presets of hardly any steps."""
    monkeypatch.setattr(presets, "preset", small_presets.preset)
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("name", EXAMPLES)
def test_example_runs(name, small):
    exec(compile(BLOCKS[name], name, "exec"), {"__name__": "example"})


def test_there_are_examples():
    assert {"README.md:0", "quick-start.md:0", "demonstrations.md:0"} <= set(BLOCKS)
    assert "README.md:0" not in EXAMPLES
