"""Several runs beside each other: their parameters in a table, and all in one figure."""

from __future__ import annotations

import datetime
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from daq.catalogue.entries import RunEntry
from daq.errors import ConfigError, RigError, RunError
from daq.files import write_whole
from daq.identification.rows import QuantityRow
from daq.progress import Note, Watch, ignore

if TYPE_CHECKING:
    from daq.figures.history import Overlay, Trend

_SIGNALS = ("current_motor", "current_brake", "torque", "omega")
_MOST_LINES = 12  # runs whose signals are drawn over each other
_MOST_TRENDS = 12  # parameters that are drawn where none are named


def quantities_of(entries: Sequence[RunEntry]) -> list[str]:
    """Parameters and combinations with an interval of both ends in any of the runs."""
    rows = (row for entry in entries for row in entry.quantities if row.two_sided)
    return list(dict.fromkeys(row.name for row in rows))


def draw_comparison(
    root: Path, entries: Sequence[RunEntry], names: Sequence[str], path: Path, watch: Watch = ignore
) -> None:
    """Signals of runs over each other, and parameters over their dates, in a figure at a path.

    names: of the parameters; default those with intervals in two runs at least. Raises ConfigError
    where there is nothing to draw, or no file can be.
    """
    from daq.figures import style
    from daq.figures.history import history

    kind = style.format_of(path)
    figure = history(_overlays(root, entries, watch), _trends(entries, names))
    try:
        write_whole(
            path, style.render(figure, kind), "or choose another place with --plot FILE.png"
        )
    except RunError as error:
        raise ConfigError(str(error)) from None


def _overlays(root: Path, entries: Sequence[RunEntry], watch: Watch) -> list[Overlay]:
    from daq.figures.history import Overlay
    from daq.logs.columns import UNITS
    from daq.logs.recording import load

    entries = [entry for entry in entries if entry.is_run]
    if len(entries) > _MOST_LINES:
        watch(
            Note("note", f"signals of the last {_MOST_LINES} of {len(entries)} runs are drawn only")
        )
    drawn = entries[-_MOST_LINES:]
    columns_of = {}
    for entry in drawn:
        try:
            columns_of[entry.folder] = load(root / entry.folder).columns
        except RigError as error:  # a run that failed before its first sample is no reason for none
            watch(Note("warning", f"its signals are not drawn: {error}"))
    if not columns_of:
        raise ConfigError("none of these runs has samples to draw", cure="name others")
    return [
        Overlay(
            signal,
            UNITS[signal],
            {folder: (columns["t"], columns[signal]) for folder, columns in columns_of.items()},
        )
        for signal in _SIGNALS
    ]


def _trends(entries: Sequence[RunEntry], names: Sequence[str]) -> list[Trend]:
    from daq.figures.history import Trend

    trends = []
    for name in names or quantities_of(entries):
        rows = [
            (entry, row)
            for entry in entries
            if entry.started and entry.is_run and (row := entry.quantity(name)) is not None
        ]
        dates = [datetime.datetime.fromisoformat(entry.started) for entry, _ in rows]
        values = np.array([(row.value, *_ends(row)) for _, row in rows], dtype=np.float64)
        if len(rows) > 1 or (names and rows):
            trends.append(Trend(name, rows[0][1].unit, dates, values))
    return trends if names else trends[:_MOST_TRENDS]


def _ends(row: QuantityRow) -> tuple[float, float]:
    low, high = row.interval or (None, None)
    return math.nan if low is None else low, math.nan if high is None else high
