"""``rig design``: which runs tell most, before anything is energised."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Option

from daq import notation
from daq.cli import options, terminal

if TYPE_CHECKING:
    from daq.designs.discrimination import DiscriminationResult
    from daq.designs.result import DesignResult, PlannedRun


def design(
    question: Annotated[
        Path | None,
        Argument(metavar="QUESTION.yaml", help="What to know, from what, within what time."),
    ] = None,
    rig: options.RigOfDesign = None,
    time: options.LoggedTimeOfDesign = None,
    precision: options.Precision = None,
    model: options.ModelName = None,
    plant: options.PlantName = None,
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
    settings: options.DesignSettings = None,
    json: options.AsJson = False,
) -> None:
    """Find the runs that tell most about the parameters.

    Writes experiments for rig run, within the rig's limits, and says how narrow intervals will be,
    what stays unknown, and what would tell it. With structures in the question: the runs that tell
    these apart, and how surely. Nothing is energised.
    """
    from daq.designs import design as use_case
    from daq.designs.discrimination import DiscriminationResult

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
    elif isinstance(result, DiscriminationResult):
        _show_pairs(result)
    else:
        _show(result)


def _show(result: DesignResult) -> None:
    number, design = terminal.number, result.design
    _show_runs(result.runs, result.rig_name, design.duration)
    rows = [
        [
            quantity.name,
            *notation.measured(quantity.value, quantity.unit, quantity.after),
            *(number(100.0 * width, 2) for width in (quantity.before, quantity.after)),
            number(100.0 * quantity.widest, 2),
            "-" if quantity.target is None else notation.shortest(100.0 * quantity.target),
        ]
        for quantity in design.quantities
    ]
    head = ["quantity", "value", "unit", "before", "after", "at worst", "wanted"]
    title = (
        "95 % intervals to be expected: half widths in % of the value, which is the likeliest by "
        "all that is known, results and ranges together"
    )
    terminal.print_table(title, head, rows, text=["unit"])
    if result.short:
        more = 2.0 * result.question.rate
        narrowed = ", ".join(f"{q.name} to {number(100.0 * q.after, 2)} %" for q in result.short)
        terminal.print_text(
            f"Narrowed, but less than wanted: {narrowed}. What would help: more time, where the "
            f"device keeps up more samples of it (--set sample_rate={more:g}), or wider limits."
        )
    for unknown in result.unknown:
        names = ", ".join(unknown.names)
        terminal.print_text(
            f"Stays unknown: {names}: {unknown.why}. What would tell: {unknown.cure}."
        )
    if result.otherwise:
        terminal.print_text(result.otherwise)
    _show_next(result)


def _show_pairs(result: DiscriminationResult) -> None:
    number, contests = terminal.number, result.discrimination.contests
    _show_runs(result.runs, result.rig_name, result.discrimination.duration)
    rows = [
        [
            contest.truth,
            contest.rival,
            number(contest.distance, 3),
            number(100.0 * contest.probability, 3),
        ]
        for contest in contests
    ]
    head = ["if right is", "how wrong is", "chi-square", "refused [%]"]
    title = "What the best parameters of the other leave, and how often a test at 1 % refuses it"
    terminal.print_table(title, head, rows, text=["how wrong is"])
    for truth, rival in result.discrimination.inseparable:
        terminal.print_text(
            f"No run tells apart: {truth} and {rival}. What would: wider limits, longer runs, less "
            "noise, or another sensor."
        )
    for truth, rival in result.discrimination.nested:
        terminal.print_text(
            f"{rival} does all that {truth} does: where both fit alike, take {truth}."
        )
    _show_next(result)


def _show_runs(runs: Sequence[PlannedRun], rig: str, seconds: float) -> None:
    print()
    rows = [
        [
            run.file.name,
            run.protocol,
            *(_span(volts.min(), volts.max()) for volts in run.commands),
        ]
        for run in runs
    ]
    title = f"{len(rows)} runs on {rig}, {seconds:g} s in all"
    head = ["experiment", "protocol", "motor [V]", "brake [V]"]
    terminal.print_table(title, head, rows, text=["protocol"])


def _show_next(result: DesignResult | DiscriminationResult) -> None:
    from daq.designs.files import COMMANDS, DATA

    files = f"Experiments, {result.figure.name}, {DATA} and {COMMANDS}"
    print(f"{files}: {result.figure.parent}")
    terminal.print_next(*result.commands)


def _span(low: float, high: float) -> str:
    size = max(abs(low), abs(high))
    ends = (notation.rounded_off(volts, size) for volts in (low, high))
    return " to ".join(terminal.number(volts, 3) for volts in ends)
