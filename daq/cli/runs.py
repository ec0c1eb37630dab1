"""``rig runs``: the runs of a folder, those that are asked for, beside each other, noted upon."""

from __future__ import annotations

import re
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, BadParameter, Option

from daq.cli import options, terminal

if TYPE_CHECKING:
    from daq.catalogue.entries import RunEntry
    from daq.identification.rows import QuantityRow

_FACTS = ("protocol", "rig", "status", "trust")
_MOST_ROWS = 200  # on a terminal, unless more are asked for
_MOST_COLUMNS = 6  # runs beside each other in a table
_RUN_COLUMN = 19  # characters


def runs(
    terms: Annotated[
        list[str] | None,
        Argument(
            metavar="TERM",
            help="Runs that all of these hold of: a word, KEY=VALUE with *, 'KEY>0.1' and the "
            "like, or capture folders; keys are facts, metadata, parameters.",
        ),
    ] = None,
    folder: Annotated[
        Path, Option("--in", metavar="DIR", help="Folder that the runs are in.")
    ] = Path("runs"),
    sort: Annotated[str, Option(metavar="KEY", help="Sort by this, largest last.")] = "started",
    last: Annotated[int | None, Option(metavar="N", min=1, help="Only the last so many.")] = None,
    parameters: Annotated[
        str | None,
        Option(metavar="NAME,NAME", help="Show these parameters, or combinations of some."),
    ] = None,
    details: Annotated[bool, Option("--details", help="All that is known of each run.")] = False,
    compare: Annotated[
        bool, Option("--compare", help="Parameters of the runs beside each other.")
    ] = False,
    plot: Annotated[
        Path | None,
        Option(metavar="FILE.png", help="Draw signals over each other, parameters over the dates."),
    ] = None,
    note: options.Notes = None,
    tag: Annotated[
        list[str] | None, Option(metavar="TAG", help="Give the runs this tag; may be repeated.")
    ] = None,
    untag: Annotated[
        list[str] | None, Option(metavar="TAG", help="Take this tag away; may be repeated.")
    ] = None,
    json: options.AsJson = False,
) -> None:
    """List recorded runs; search, compare and annotate them.

    Results of several runs are listed as well, as joint, where they lie in the folder of the runs.
    """
    from daq.catalogue.annotation import annotate
    from daq.catalogue.index import catalogue
    from daq.catalogue.query import ordered, require_quantities, select
    from daq.errors import ConfigError

    names = [name.strip() for name in (parameters or "").split(",") if name.strip()]
    with terminal.watching(json) as watch:
        entries = catalogue(folder, watch)
        require_quantities(entries, names)
        chosen = select(folder, ordered(entries, sort), terms or [])[-(last or 0) :]
        if note or tag or untag:
            if not terms:
                raise BadParameter("say of which runs; name them, or a word that they have")
            if not chosen:
                cure = "rig runs lists them all"
                raise ConfigError("no run is meant, and nothing was noted", cure=cure)
            chosen = annotate(folder, chosen, note or [], tag or [], untag or [])
        if plot is not None and chosen:
            from daq.catalogue.comparison import draw_comparison

            draw_comparison(folder, chosen, names, plot, watch)
    if json:
        terminal.print_json({"folder": str(folder), "runs": [run.document for run in chosen]})
        return
    if not chosen:
        hint = "Record one:  rig run prbs.yaml" if not entries else "rig runs lists them all."
        print(f"0 of {len(entries)} runs in {folder}. {hint}")
    elif details:
        for entry in chosen:
            _show(entry, folder)
    elif compare:
        _compare(chosen, names)
    else:
        room = len(chosen) if last or not sys.stdout.isatty() else _MOST_ROWS
        what = "runs" if all(entry.is_run for entry in entries) else "runs and results"
        _list(chosen, names, f"{len(chosen)} of {len(entries)} {what} in {folder}", room)
    for problem in (problem for entry in chosen for problem in entry.problems):
        terminal.report("warning", problem)
    if plot is not None and chosen:
        print(f"Figure: {plot}")


def _list(entries: Sequence[RunEntry], names: Sequence[str], title: str, room: int) -> None:
    """A row for each run, of the last for which there is room; what none of them has is left out.

    A terminal has little room: what is the same in all runs is said once there, above them, and a
    date only where the run's name does not begin with it. Names of runs stay whole: they are copied
    from here.
    """
    if len(entries) > room:
        terminal.report("note", f"the last {room} are shown; --last N shows so many")
        entries = entries[-room:]
    noted = list(dict.fromkeys(key for entry in entries for key in entry.metadata))
    quantities = [[entry.quantity(name) for name in names] for entry in entries]
    units = {row.name: row.unit for shown in quantities for row in shown if row is not None}
    titles = [f"{name} [{units[name]}]" if name in units else name for name in names]
    head = ["run", "date (UTC)", *_FACTS, *titles, *noted]
    rows = [
        [
            entry.folder,
            entry.started[:16].replace("T", " "),
            *(str(getattr(entry, fact)) for fact in _FACTS),
            *map(_quantity, shown),
            *(_text(entry.metadata.get(key, "")) for key in noted),
        ]
        for entry, shown in zip(entries, quantities, strict=True)
    ]
    kept = [k for k in range(len(head)) if any(row[k] for row in rows)]
    if sys.stdout.isatty() and all(map(_is_dated, entries)):
        kept.remove(1)
    texts = [name for name in head if name not in titles]
    terminal.print_table_of_differences(
        title, [head[k] for k in kept], [[row[k] for k in kept] for row in rows],
        once=texts[1:], text=texts, spare=noted, elsewhere="--details shows all of a run",
    )  # fmt: skip


def _is_dated(entry: RunEntry) -> bool:
    """Whether a run's name begins with when it started, as 20260101T1200."""
    name = entry.folder.rsplit("/", 1)[-1]
    return bool(entry.started) and name.startswith(re.sub("[-:]", "", entry.started[:16]))


def _compare(entries: Sequence[RunEntry], names: Sequence[str]) -> None:
    """A row for each parameter, a column for each run; on a terminal as many as it has room for."""
    from daq.catalogue.comparison import quantities_of

    identified = [entry for entry in entries if entry.values]
    if not identified:
        terminal.report("note", "nothing has been identified from them; try rig identify RUN")
        return
    shown = identified[-_MOST_COLUMNS:]
    names = names or quantities_of(shown)
    on_terminal = sys.stdout.isatty()
    if on_terminal:
        units = (len(row.unit) for entry in shown for row in entry.quantities)
        beside = max(map(len, ("parameter", *names))) + max(units) + 5
        room = (shutil.get_terminal_size().columns - beside) // _RUN_COLUMN
        shown = shown[-max(room, 2) :]
    if len(entries) > len(shown):
        which = "identified" if len(identified) == len(shown) else f"last {len(shown)} identified"
        terminal.report("note", f"of {len(entries)} runs the {which} are compared; --plot has all")
    between = "\n" if on_terminal else " "
    head = ["parameter", "unit", *(entry.folder for entry in shown)]
    rows = [["trust", "", *(entry.trust for entry in shown)]]
    for name in names:
        quantities = [entry.quantity(name) for entry in shown]
        unit = next(row.unit for row in quantities if row is not None) if any(quantities) else ""
        rows.append([name, unit, *(_quantity(row, between) for row in quantities)])
    terminal.print_table("Parameters, with their 95 % intervals", head, rows, text=["unit"])


def _show(entry: RunEntry, folder: Path) -> None:
    """Everything that is known of a run."""
    path = folder / entry.folder
    facts = {
        "run": str(path),
        "started": entry.started,
        "status": ": ".join(filter(None, (entry.status, entry.reason))),
        "protocol": entry.protocol,
        "rig": entry.rig,
        "device": entry.device,
        "identified from": ", ".join(entry.logs),
        **{key: _text(value) for key, value in entry.metadata.items()},
        "model": entry.model,
        "predictions": entry.predictions or entry.trust,
        "parameters": entry.parameters or entry.trust,
    }
    for key, value in facts.items():
        if value:
            terminal.print_text(f"{key}: {value}")
    if entry.quantities:
        rows = []
        for row in entry.quantities:
            scale, unit = row.engineering
            ends = row.span(scale) if row.interval else ""
            rows.append([row.name, row.text(row.value, scale), ends, unit, row.undetermined_label])
        head = ["name", "value", "95 % interval", "unit", "note"]
        terminal.print_table("Parameters", head, rows, text=["unit", "note"])
    else:
        print()


def _quantity(row: QuantityRow | None, between: str = "") -> str:
    """A value, and its interval in brackets behind ``between``; empty where there is none."""
    if row is None:
        return ""
    value = row.text(row.value)
    if row.interval in (None, (None, None)):
        return f"({value})"  # no data stand behind it
    return f"{value}{between}({_ends(row)})" if between else value


def _ends(row: QuantityRow) -> str:
    return row.interval_text(row.text, " .. ", "")


def _text(value: object) -> str:
    return ", ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)
