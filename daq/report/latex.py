"""Identified parameters as a LaTeX table."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from daq import notation

_HEAD = r"""% Parameters of an identification: \input{parameters.tex} where the table is to stand.
% With \usepackage{booktabs} its rules are those of booktabs, without it plain ones.
\providecommand{\toprule}{\hline}
\providecommand{\midrule}{\hline}
\providecommand{\bottomrule}{\hline}
"""


def latex(document: Mapping[str, Any], notes: Mapping[str, str]) -> str:
    """The table of a report's document, without meanings where no parameter has one.

    notes: what stands in place of an interval, by why there is none.
    """
    meanings = {name: one.get("description", "") for name, one in document["parameters"].items()}
    heads = ["Parameter", "Meaning", "Value", r"95\,\% interval", "Unit"]
    rows = [_row(name, meanings[name], one, notes) for name, one in document["parameters"].items()]
    combined = [one for a in document.get("ambiguities", ()) for one in a["determined"]]
    rows += [_row(one["name"], "", one, notes) for one in combined]
    columns = "llrrl"
    if not any(meanings.values()):
        columns = "lrrl"
        heads, *rows = ([cells[0], *cells[2:]] for cells in (heads, *rows))
    head, *body = (" & ".join(cells) + " \\\\\n" for cells in (heads, *rows))
    return (
        f"{_HEAD}\\begin{{tabular}}{{{columns}}}\n\\toprule\n{head}\\midrule\n{''.join(body)}"
        "\\bottomrule\n\\end{tabular}\n"
    )


def _row(name: str, meaning: str, one: Mapping[str, Any], notes: Mapping[str, str]) -> list[str]:
    digits = 4 if one.get("fixed") or "tied" in one else notation.digits(
        one["value"], one.get("std")
    )  # fmt: skip
    return [
        notation.tex(name),
        notation.escape_tex(meaning),
        notation.number_tex(notation.number(one["value"], digits)),
        _interval(one, digits, notes),
        notation.unit_tex(one["unit"]),
    ]


def _interval(one: Mapping[str, Any], digits: int, notes: Mapping[str, str]) -> str:
    if "interval" in one:
        ends = (notation.number_tex(notation.number(end, digits)) for end in one["interval"])
        return " to ".join(ends)
    if "tied" in one:
        return f"$=$ {notation.tex(one['tied'])}"
    if one.get("fixed"):
        return "fixed"
    why = one.get("undetermined", "bound" if one.get("on_bound") else "")
    return notation.escape_tex(notes[why]) or "--"
