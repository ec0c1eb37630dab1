"""``rig characterise``: a rig's parameters by runs that design themselves."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Option

from daq import notation
from daq.cli import completion, options, terminal
from daq.cli.identification import print_verdict
from daq.config.units import converted
from daq.errors import ConfigError

if TYPE_CHECKING:
    from daq.characterise.characterise import Characterisation

_SECONDS = 60.0  # logged time, without another


def characterise(
    rig: Annotated[
        str | None,
        Argument(
            metavar="RIG.yaml",
            help="Rig file; default the simulated rig.",
            autocompletion=completion.rigs,
        ),
    ] = None,
    time: options.LoggedTime = None,
    precision: options.Precision = None,
    model: options.ModelName = None,
    plant: options.PlantName = None,
    config: options.ConfigFile = None,
    out: Annotated[
        Path | None, Option(metavar="DIR", help="New folder for all of it; default under runs/.")
    ] = None,
    settings: options.DesignSettings = None,
    resume: Annotated[
        Path | None,
        Option(
            metavar="DIR",
            help="Go on there, however it ended; --time and --precision replace what was wanted.",
        ),
    ] = None,
    ask: Annotated[
        bool,
        Option("--ask", help="Have another mounting of the rig's file put on where it tells more."),
    ] = False,
    json: options.AsJson = False,
) -> None:
    """Find a rig's parameters: design, run, identify, and again.

    Until the intervals are narrow enough, the time is used up, or no run would tell more. One
    folder holds designs, logs, results and a page; however it ended it goes on from there. By the
    clock 10 s of the shipped rig take some 6 minutes on two cores, nearly all of it computing.
    """
    from daq.characterise import characterise as use_case
    from daq.lookup.rigs import DEFAULT_RIG

    with terminal.watching(json) as watch:
        seconds = None if time is None else _number("--time", time, "s")
        percent = None if precision is None else _number("--precision", precision, "%")
        if resume is not None:
            fixed = {
                "RIG.yaml": rig,
                "--model": model,
                "--plant": plant,
                "--config": config,
                "--out": out,
                "--set": settings,
            }
            _refuse_changes(resume, [name for name, value in fixed.items() if value])
            result = use_case.resume(
                resume, seconds, percent, ask=_asked if ask else None, watch=watch
            )
        else:
            result = use_case.characterise(
                rig or DEFAULT_RIG,
                seconds or _SECONDS,
                percent,
                out,
                model=model,
                plant=plant,
                config=config,
                settings=settings or [],
                ask=_asked if ask else None,
                watch=watch,
            )
    if json:
        terminal.print_json(result.document)
    else:
        _show(result)


def _refuse_changes(folder: Path, names: Sequence[str]) -> None:
    """Refuse what holds for all rounds from the first on."""
    if names:
        problem = f"{', '.join(names)} cannot be changed on resuming: all rounds have them alike"
        cure = (
            "leave out all but --time, --precision and --ask, or begin another characterisation "
            "without --resume"
        )
        raise ConfigError(problem, cure=cure, file=folder)


def _asked(change: str) -> None:
    """Wait until a person has done what a round needs."""
    if not terminal.wait_for(f"{change}; then press Enter"):
        raise ConfigError(
            f"nobody has answered to: {change}", cure="go on at a terminal, or answer with Enter"
        )


def _number(option: str, text: str, unit: str) -> float:
    """A number above 0, with its unit or without."""
    try:
        number = float(converted(text, unit))
    except ValueError:
        number = -1.0
    if not 0.0 < number <= 1e5:
        raise ConfigError(
            f"{text!r} is no number above 0 in {unit}", cure=f"write {option} 10 or "
            f"{option} '10 {unit}'", key=option,
        )  # fmt: skip
    return number


def _show(result: Characterisation) -> None:
    number = terminal.number
    rows = [
        [
            interval.name,
            *notation.measured(interval.value, interval.unit, interval.width),
            "-" if interval.width is None else number(100.0 * interval.width, 2),
            "-" if interval.expected is None else number(100.0 * interval.expected, 2),
        ]
        for interval in result.intervals
    ]
    print()
    n = len(result.rounds)
    spent = f"{result.seconds:g} s in {n} round{'s' * (n != 1)}"
    title = f"{result.rounds[-1].model} after {spent}: 95 % intervals in % of the value"
    head = ["quantity", "value", "unit", "half width", "expected"]
    if result.precision is not None:
        head.append(f"{result.precision:g} % wanted")
        for row in rows:
            row.append("missed" if row[0] in result.missed else "met")
    terminal.print_table(title, head, rows, text=["unit"])
    for assumption in result.assumptions:
        terminal.print_text(assumption)
    terminal.print_text(f"It ended because {result.reason}.")
    print_verdict(result.verdict)
    print(f"Page: {result.page}")
    print(f"Report: {result.report}")
    if result.missed:
        missed = f"Wider than the {result.precision:g} % wanted: {', '.join(result.missed)}."
        if result.helped_by_time:
            terminal.print_text(
                f"{missed} Where the device keeps up, more samples in the same time tell more "
                "(another --set sample_rate, anew). More time goes on from here:"
            )
            again = f"rig characterise --resume {shlex.quote(str(result.folder))}"
            print(f"{again} --time {2.0 * result.seconds:g}")
        else:
            terminal.print_text(missed)
    last = result.rounds[-1]
    # Judged by a run that took no part.
    run = f"rig run prbs.yaml --rig {shlex.quote(last.rig)}"
    terminal.print_next(run, f"rig replay RUN --parameters {shlex.quote(str(last.identification))}")
