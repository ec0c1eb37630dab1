"""Docstrings are plain prose: what means something to reStructuredText alone is taken literally."""

from __future__ import annotations

import re
from typing import Any

from sphinx.application import Sphinx

_SPECIAL = re.compile(r"[*|\\]|(?<=\w)_(?=\W|$)|(?<!`)`(?!`)")
# Code, and the names of a list of parameters, which napoleon sees to.
_KEPT = re.compile(r"(``.*?``|^[ ]*\w+(?:, \w+)* : )", re.MULTILINE | re.DOTALL)
_BEFORE_NAPOLEON = 100


def _escape(app: Sphinx, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    parts = _KEPT.split("\n".join(lines))
    parts[::2] = [_SPECIAL.sub(lambda found: "\\" + found[0], part) for part in parts[::2]]
    lines[:] = "".join(parts).split("\n")


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the change of docstrings."""
    app.connect("autodoc-process-docstring", _escape, priority=_BEFORE_NAPOLEON)
    return {"parallel_read_safe": True}
