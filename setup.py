"""README.md as PyPI shows it, where links within the repository lead nowhere. All other metadata are in pyproject.toml."""

import re
import tomllib
from pathlib import Path

from setuptools import setup

HERE = Path(__file__).parent
REPOSITORY = tomllib.loads((HERE / "pyproject.toml").read_text())["project"]["urls"].get("Repository")
LINK = re.compile(r"(!?)\[([^\]]*)\]\((?!\w+://|#)([^)]+)\)")


def description(text: str, repository: str | None) -> str:
    """README with absolute links into the repository; without its address, pictures are left out and links are plain text."""

    def link(found: re.Match[str]) -> str:
        picture, label, target = found.groups()
        if repository is None:
            return "" if picture else label
        return f"{picture}[{label}]({repository}/{'raw' if picture else 'blob'}/main/{target})"

    text = LINK.sub(link, text)
    if repository is None:  # a table of nothing but pictures, and captions that would stand without them
        text = re.sub(r"^\|( *\|)+\n\|(-+\|)+\n\|.*\n\n?", "", text, flags=re.MULTILINE)
    return text


if __name__ == "__main__":
    setup(long_description=description((HERE / "README.md").read_text(), REPOSITORY), long_description_content_type="text/markdown")
