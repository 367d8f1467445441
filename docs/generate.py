"""Writes docs/generated/: the pages that come from elsewhere in the project, so that they cannot go stale. `make docs` runs it first.

The command line's page is what each command answers to --help-all; notebooks become pages, with what they show where that is stored
(docs/execute_notebooks.py).

It is a hook of mkdocs, too. The pages of docs/ are also read as they stand, in a checkout or where it is hosted, so they link to the project's files:
to `../notebooks/01_quickstart.ipynb`, or `../hindrl_jax/core`. On the site, such a link leads to the page that is made of the file.
"""

from __future__ import annotations

import base64
import contextlib
import io
import json
import os
import re
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent
OUT = ROOT / "docs" / "generated"
WIDTH = 101  # characters, of the help texts

# Files shown as pages, with the links in them that lead elsewhere in the site. A link to a file that is no page is shown without its link.
PAGES = {
    "benchmark-results.md": ("benchmarks/RESULTS.md", {"README.md": "benchmark-method.md"}),
    "benchmark-method.md": ("benchmarks/README.md", {"RESULTS.md": "benchmark-results.md"}),
    "changelog.md": ("CHANGELOG.md", {}),
    "contributing.md": ("CONTRIBUTING.md", {}),
    "reproduction-measured.md": ("REPRODUCTION.md", {f"docs/{name}.md": f"../{name}.md" for name in ("reproduction", "differences", "results")}),
}
COMMANDS = "hindrl_jax/cli"
"""What stands for the command line's page in links."""
LINK = re.compile(r"(?<!!)\[([^\]]*)\]\(([^)\s]*)\)")
PICTURE = re.compile(r"(!\[[^\]]*\])\(([^)\s]*)\)")


def main() -> None:
    """Writes all of them, and removes what is no longer made."""
    OUT.mkdir(exist_ok=True)
    pages: dict[str, str | bytes] = {name: page(ROOT / source, links) for name, (source, links) in PAGES.items()}
    for source, _ in PAGES.values():
        file = ROOT / source
        pages |= {Path(picture).name: (file.parent / picture).read_bytes() for _, picture in PICTURE.findall(file.read_text())}
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        pages |= notebook(path)
    pages["command-line.md"] = command_line()
    for path in OUT.iterdir():
        if path.name not in pages:
            path.unlink()
    for name, content in pages.items():
        (OUT / name).write_bytes(content if isinstance(content, bytes) else content.encode())


def page(source: Path, links: dict[str, str]) -> str:
    """A Markdown file of the project, with its links made to fit; its pictures lie beside it."""

    def link(found: re.Match[str]) -> str:
        text, target = found.groups()
        if "://" in target or target.startswith("#"):
            return found[0]
        return f"[{text}]({links[target]})" if target in links else f"{text} (`{(source.parent / target).resolve().relative_to(ROOT)}`)"

    return PICTURE.sub(lambda found: f"{found[1]}({Path(found[2]).name})", LINK.sub(link, source.read_text()))


def on_page_markdown(markdown: str, *, page: Any, **_: Any) -> str:
    """Called by mkdocs: the text of a page, whose links to files of the project lead to the pages made of them; without one, no link is left."""
    folder, reference = (ROOT / "docs" / page.file.src_uri).parent, pages_of_modules()

    def link(found: re.Match[str]) -> str:
        text, target = found.groups()
        if not target.startswith("../"):
            return found[0]
        file = Path(os.path.normpath(folder / target))
        if file.is_relative_to(ROOT / "docs"):
            return found[0]
        made = page_of(file.relative_to(ROOT).as_posix(), reference)
        return f"[{text}]({os.path.relpath(ROOT / 'docs' / made, folder)})" if made else text

    return LINK.sub(link, markdown)


def page_of(file: str, reference: dict[str, str]) -> str | None:
    """The page, in docs/, that is made of a file or folder of the project; None where none is.

    Args:
      file: its path in the project.
      reference: of `pages_of_modules`.
    """
    if file == COMMANDS:
        return "generated/command-line.md"
    if file.endswith(".ipynb"):
        return f"generated/{Path(file).with_suffix('.md').name}"
    made = next((name for name, (source, _) in PAGES.items() if source == file), None)
    if made:
        return f"generated/{made}"
    module = file.removesuffix(".py").replace("/", ".")
    if module in reference:
        return f"{reference[module]}#{module}"
    return next((where for name, where in reference.items() if name.startswith(f"{module}.")), None)


def pages_of_modules() -> dict[str, str]:
    """The page of the reference, in docs/, on which each module stands."""
    pages = sorted((ROOT / "docs" / "api").glob("*.md"), key=lambda path: path.stem)
    return {module: f"api/{path.name}" for path in pages for module in re.findall(r"^::: (\S+)$", path.read_text(), re.MULTILINE)}


def notebook(path: Path) -> dict[str, str | bytes]:
    """A notebook as Markdown, and its pictures, by the names of their files: its text, its code in fences, and what that has shown."""
    parts: list[str] = []
    pictures: dict[str, str | bytes] = {}
    for cell in json.loads(path.read_text())["cells"]:
        text = "".join(cell["source"])
        parts.append(f"```python\n{text}\n```" if cell["cell_type"] == "code" else text)
        for output in cell.get("outputs", []):
            if output["output_type"] == "stream":
                parts.append(f"```text\n{''.join(output['text']).rstrip()}\n```")
            for kind, content in output.get("data", {}).items():
                if kind.startswith("image/"):
                    name = f"{path.stem}_{len(pictures)}.{kind.removeprefix('image/')}"
                    pictures[name] = base64.b64decode("".join(content))
                    parts.append(f"![What the code above shows]({name})")
    title, *rest = parts
    how = "with `.venv/bin/pip install notebook` and `.venv/bin/jupyter notebook notebooks` after `make train`."
    seen = "" if pictures else ", without its pictures"
    where = f'!!! note ""\n    This is `notebooks/{path.name}`{seen}: run it {"yourself" if pictures else "to see them"}, {how}'
    # Links between notebooks are links between their pages here.
    return {f"{path.stem}.md": re.sub(r"\((\d\d_\w+)\.ipynb\)", r"(\1.md)", "\n\n".join([title, where, *rest]) + "\n"), **pictures}


def command_line() -> str:
    """Every command's answer to --help-all."""
    os.environ["COLUMNS"] = str(WIDTH)
    from hindrl_jax.cli import COMMANDS

    intro = (
        "What each command answers to `--help-all`; `hindrl train --help` is shorter. Flags of the environment and of the config follow from `--env`."
    )
    sections = ["# Command line", intro]
    for name, command in COMMANDS.items():
        for words in [(name,)] if callable(command) else [(name, sub) for sub in command]:
            sections += [f"## hindrl {' '.join(words)}", *as_lists(help_text(words))]
            if words in (("train",), ("demos", "record")):
                for env, what in (("FixedParameterizedReach", "the arm"), ("BringNear", "two arms and cables")):
                    answer = help_text((*words, "--env", env))
                    sections += [f"## hindrl {' '.join(words)}, for {what}", f"With `--env {env}`:", *as_lists(answer)]
    return "\n\n".join(sections) + "\n"


def as_lists(text: str) -> list[str]:
    """A help page as Markdown: a heading for each group, and a list of its options."""
    usage, _, *lines = text.splitlines()
    parts = [f"```text\n{usage}\n```"]
    head = body = ""
    items: list[str] = []
    prose = False  # whether the last line was of a paragraph

    def end_item() -> None:
        nonlocal head, body
        if head:
            items.append(f"- `{head}`{': ' if body else ''}{body}")
        head = body = ""

    def end_list() -> None:
        end_item()
        parts.extend(["\n".join(items)] if items else [])
        items.clear()

    for line in lines:
        if line.startswith(" " * 6):
            body = f"{body} {line.strip()}".strip()
        elif line.startswith(" " * 4):
            head += line.strip()
        elif line.startswith("  ") and (line.startswith("  --") or line.strip().isupper()):
            end_item()
            head = line.strip()
        elif line.endswith(":") and not line.startswith(" "):
            end_list()
            parts.append(f"**{line[:-1].capitalize()}**")
        elif line and prose:
            parts[-1] += f" {line.strip()}"
        elif line:
            parts.append(line.strip())
        prose = bool(line) and not items and not head and not line.endswith(":")
    end_list()
    return parts


def help_text(words: tuple[str, ...]) -> str:
    """What `hindrl WORDS --help-all` prints."""
    from hindrl_jax import cli

    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
        cli.main([*words, "--help-all"])
    text = printed.getvalue().rstrip()
    if not text.startswith("usage: hindrl"):
        raise RuntimeError(f"hindrl {' '.join(words)} --help-all printed no help: {text[:200]!r}")
    return "\n".join(line.rstrip() for line in text.splitlines())


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))
    main()
