"""For the reference pages: a comment behind a field, as in `lengths: Array  # (N,) int32`, is that field's documentation, and a list in a docstring
is one on the page, too, where no empty line stands before it."""

from __future__ import annotations

import ast
import re
from typing import Any

import griffe


class Shapes(griffe.Extension):
    """Gives attributes without a docstring the comment that ends their line."""

    def on_attribute_instance(self, *, node: ast.AST | griffe.ObjectNode, attr: griffe.Attribute, **_: Any) -> None:
        """Called by griffe for every attribute that it finds."""
        if attr.docstring is not None or not isinstance(node, ast.AnnAssign) or attr.parent is None or not attr.parent.is_class:
            return
        line = attr.lines_collection[attr.filepath][(node.end_lineno or node.lineno) - 1]
        comment = line[node.end_col_offset or 0 :].strip()
        if comment.startswith("#"):
            attr.docstring = griffe.Docstring(comment.lstrip("# "), lineno=node.lineno, parent=attr)

    def on_instance(self, *, obj: griffe.Object, **_: Any) -> None:
        """Called by griffe for everything that it finds."""
        if obj.docstring is not None:
            obj.docstring.value = re.sub(r"^(?! *\* )(.*\S.*)\n( *\* )", r"\1\n\n\2", obj.docstring.value, flags=re.MULTILINE)
