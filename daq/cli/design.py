"""``rig design``: which runs tell most, before anything is energised."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Option

from daq.cli import options, terminal

if TYPE_CHECKING:
    from daq.designs.result import DesignResult


def design(
    question: Annotated[
        Path | None,
        Argument(metavar="[QUESTION.yaml]", help="What to know, from what, within what time."),
    ] = None,
    rig: options.RigOfRun = None,
    time: Annotated[
        str | None, Option(metavar="SECONDS", help="Logged time of all runs, at most.")
    ] = None,
    precision: Annotated[
        str | None,
        Option(metavar="PERCENT", help="Half width wanted of all intervals, such as 5%."),
    ] = None,
    model: options.ModelName = None,
    plant: Annotated[
        str | None,
        Option(metavar="NAME|FILE.py:OBJECT", help="The whole rig as a model, load included."),
    ] = None,
    config: options.ConfigFile = None,
    parameters: Annotated[
        Path | None,
        Option(metavar="RESULT", help="An earlier identification, from which to start."),
    ] = None,
    log: Annotated[
        Path | None, Option(metavar="RUN", help="A run whose calibration tells the noise.")
    ] = None,
    out: Annotated[
        Path | None, Option(metavar="DIR", help="Where the files go; default under designs/.")
    ] = None,
    settings: Annotated[
        list[str] | None,
        Option(
            "--set",
            metavar="KEY=VALUE",
            help="Any key of the question, such as targets.K_m=1%; may be repeated.",
        ),
    ] = None,
    json: options.AsJson = False,
) -> None:
    """Find the runs that tell most about the parameters, within the rig's limits.

    Writes them as experiments for rig run, and says beforehand how narrow the intervals will be,
    what stays unknown, and what would tell it. Nothing is energised.
    """
    from daq.designs import design as use_case

    typed = {
        "rig": rig,
        "time": time,
        "precision": precision,
        "model": model,
        "plant": plant,
        "config": None if config is None else str(config),
        "parameters": None if parameters is None else str(parameters),
        "log": None if log is None else str(log),
    }
    with terminal.watching(json) as watch:
        result = use_case.design_files(question, typed, settings or [], out, watch)
    if json:
        terminal.print_json(result.document)
        return
    _show(result)


def _show(result: DesignResult) -> None:
    number, design = terminal.number, result.design
    print()
    rows = [
        [
            run.file.name,
            run.protocol,
            *(_span(run.commands[:, j].min(), run.commands[:, j].max()) for j in range(2)),
        ]
        for run in result.runs
    ]
    title = f"{len(rows)} runs on {result.rig_name}, {design.duration:g} s in all"
    head = ["experiment", "protocol", "motor [V]", "brake [V]"]
    terminal.print_table(title, head, rows, text=["protocol"])
    rows = [
        [
            quantity.name,
            number(quantity.value),
            quantity.unit,
            *(number(100.0 * width, 2) for width in (quantity.before, quantity.after)),
            number(100.0 * quantity.widest, 2),
            "-" if quantity.target is None else number(100.0 * quantity.target, 2),
        ]
        for quantity in design.quantities
    ]
    head = ["quantity", "value", "unit", "before", "after", "at worst", "wanted"]
    title = "95 % intervals to be expected: half widths in % of the value"
    terminal.print_table(title, head, rows, text=["unit"])
    for unknown in result.unknown:
        names = ", ".join(unknown.names)
        terminal.print_text(
            f"Stays unknown: {names}: {unknown.why}. What would tell: {unknown.cure}."
        )
    print(f"Experiments, {result.figure.name} and design.json: {result.folder}")
    rig = shlex.quote(str(result.runs[0].file))
    terminal.print_next(f"rig check {rig}", f"rig run {rig}, and so each of them")


def _span(low: float, high: float) -> str:
    return f"{terminal.number(low, 3)} to {terminal.number(high, 3)}"
