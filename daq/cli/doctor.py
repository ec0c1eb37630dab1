"""``rig doctor``: does this computer suit a rig in real time, and what to do where it does not."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from daq.cli import terminal
from daq.cli.options import AsJson, RunsFolder

if TYPE_CHECKING:
    from daq.diagnose.computer import Check


def doctor(
    names: Annotated[
        list[str] | None,
        typer.Argument(metavar="[PORT...]", help="Device names; default all that exist."),
    ] = None,
    out: RunsFolder = Path("runs"),
    json: AsJson = False,
) -> None:
    """Check whether this computer suits a rig in real time.

    What does not is told with its cure.
    """
    from daq.diagnose.computer import diagnose
    from daq.errors import RunError
    from daq.serial.ports import ports_of

    checks = diagnose(ports_of(names or []), out)
    bad = [check.subject for check in checks if check.verdict == "bad"]
    if json:
        terminal.print_json({"checks": [_document(check) for check in checks], "good": not bad})
    else:
        _show(checks)
    if bad:
        problem = f"not fit for a rig in real time: {', '.join(bad)}"
        raise RunError(problem, cure="the cures stand above")


def _document(check: Check) -> dict[str, str]:
    return {
        "what": check.subject,
        "verdict": check.verdict,
        "found": check.observation,
        "cure": check.cure,
    }


def _show(checks: list[Check]) -> None:
    terminal.print_table(
        "This computer",
        ["what", "verdict", "found"],
        [[check.subject, check.verdict, check.observation] for check in checks],
        text=["verdict", "found"],
    )
    for check in checks:
        if check.cure:
            terminal.print_line(f"{check.subject}: {check.cure}")
