"""The texts of a page, as HTML: the run's state above, the values beside the figures."""

import math
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any

from daq.hal import Flag, FloatArray
from daq.logs.columns import UNITS
from daq.scope.looks import BLUE, GREEN, GREY, ORANGE, RED, color_of, flag_name
from daq.scope.watch import FollowedLog

_STATES = {
    "running": (GREEN, "recording"),
    "completed": (BLUE, "completed"),
    "incomplete": (ORANGE, "incomplete"),
    "stopped": (ORANGE, "stopped"),
    "log": (GREY, "log without a run record"),
}
VALUE_FIELDS = ("row", "color", "channel", "value", "unit", "difference", "style")
FAILED = "The page stopped by a mistake in this program; reload it, and report this:"
HELP = (
    "Orange: asked for. Blue: what came of it. Dotted red: a limit of the rig, where it is near."
    "<br>Drag: zoom in time. Wheel: zoom. Click: set a mark; double click: remove it. "
    "Live, or the toolbar's reset: follow again."
)

_FIRST_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<title>rig scope</title>
<link rel="icon" href="data:,">
<style>
body {{ font: 14px/1.5 system-ui, sans-serif; margin: 8px; }}
</style>
</head>
<body>
<div id="first">{head}<p>The figures are being made …</p></div>
<script src="{address}/static/js/bokeh.min.js"></script>
<script src="{address}/static/js/bokeh-widgets.min.js"></script>
"""


def first_page(head: str, address: str) -> str:
    """The page's beginning: a heading that stands until the figures do, and Bokeh's scripts."""
    return _FIRST_PAGE.format(head=head, address=escape(address))


def heading(log: FollowedLog | None, root: Path, newer: bool, notes: Sequence[str] = ()) -> str:
    """Which run, in which state, and what is wrong with it; newer: another one has begun.

    notes: more lines, as HTML.
    """
    if log is None:
        missing = "" if root.is_dir() else ", nor that folder"
        return (
            f"<b>No run under {escape(str(root))} yet{missing}.</b> "
            "It is shown as soon as one begins: <code>rig run prbs.yaml</code>"
        )
    lines = [_title(log)]
    if log.state.reason:
        lines.append(f"<b>{escape(log.state.reason)}</b>")
    if newer:
        lines.append("<b>A new run has begun: press Live to see it.</b>")
    if log.loading is not None:
        lines.append(f"reading the log: {log.loading:.0%}")
    elif log.state.running and not log.n_rows:
        lines.append("waiting for the first sample: offset calibration, winding of the load")
    elif not log.n_rows and not log.complaints():
        lines.append("no sample in this log yet; what is written to it will be shown")
    lines += notes
    lines += [
        f'<span style="color:#a33c00">&#9888; {escape(text)}</span>' for text in log.complaints()
    ]
    return "<br>".join(lines)


def readout(
    columns: Sequence[str], values: FloatArray, marked: FloatArray | None, at_cursor: bool
) -> dict[str, list[Any]]:
    """A table of every column's value, its unit, and its difference from the mark."""
    where = "at the cursor" if at_cursor else "newest sample"
    from_mark = "" if marked is None else "from the mark"
    rows: list[tuple[Any, ...]] = [(0, "transparent", "", where, "", from_mark, "bold")]
    for place, name in enumerate(columns):
        value, unit, difference = _figures(name, values[place], 6), UNITS.get(name, ""), ""
        if name == "flags":
            value = _flags(values[place])
        elif marked is not None:
            difference = _figures(name, values[place] - marked[place], 5, "+")
        rows.append((place + 1, color_of(name), name, value, unit, difference, "normal"))
    cells = map(list, zip(*rows, strict=True))
    return dict(zip(VALUE_FIELDS, cells, strict=True))


def _title(log: FollowedLog) -> str:
    state, rows = log.state, log.n_rows
    color, word = _STATES.get(state.status, (RED, state.status))
    facts = [f"{name} {value}" for name, value in state.details.items()]
    if state.running and state.expected_rows:
        facts.append(f"{100 * rows // state.expected_rows} % of {state.expected_rows} samples")
    elif log.history is not None and rows:
        facts.append(f"{rows} samples, {log.history.span[1]:.5g} s")
    return (
        f'<b style="font-size:1.25em">{escape(log.name)}</b> '
        f'<span style="background:{color};color:white;border-radius:3px;padding:1px 8px">'
        f"{escape(word)}</span> {escape(' · '.join(facts))}"
    )


def _figures(name: str, value: float, digits: int, sign: str = "") -> str:
    # After half an hour six digits would tell neighbouring samples no longer apart.
    digits = 10 if name in ("t", "tick") else digits
    return f"{value:{sign}.{digits}g}"


def _flags(value: float) -> str:
    if not math.isfinite(value):
        return "?"
    return ", ".join(flag_name(flag) for flag in Flag if int(value) & int(flag)) or "none"
