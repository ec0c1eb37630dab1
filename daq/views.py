"""How results show themselves: a line at the prompt, a table in a notebook."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

Lines = Sequence[Sequence[str]]


class Shown:
    """A result that says what it is in a line, and in a notebook with a table below.

    >>> class Weighed(Shown):
    ...     headline = "two samples"
    ...     def lines(self):
    ...         return [["sample", "mass"], ["A", "3 g"], ["B", "4 g"]]
    >>> Weighed()
    <Weighed: two samples>
    """

    @property
    def headline(self) -> str:
        """What it is, in a line."""
        raise NotImplementedError

    def lines(self) -> Lines:
        """The table: names of columns, then rows of texts; empty for none."""
        return ()

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {self.headline}>"

    def _repr_html_(self) -> str:
        headline, lines = f"<p>{escape(self.headline)}</p>", self.lines()
        if not lines:
            return headline
        head, *rows = (
            "".join(f"<{cell}>{escape(text)}</{cell}>" for text in line)
            for cell, line in zip(["th"] + ["td"] * len(lines), lines, strict=False)
        )
        body = "".join(f"<tr>{row}</tr>" for row in rows)
        return f"{headline}<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
