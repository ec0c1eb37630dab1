"""``rig doctor``: does this computer suit a rig in real time, and what to do where it does not."""

from __future__ import annotations

from pathlib import Path

from daq.cli import terminal as console
from daq.diagnose.computer import Check, Diagnosis, diagnose
from daq.errors import RunError
from daq.serial.ports import ports_of


def doctor_command(names: list[str], out: Path, as_json: bool) -> None:
    """Look at ports, scheduling, memory and disk; exit status 1 when something is bad."""
    diagnosis = diagnose(ports_of(names), out)
    if as_json:
        checks = [_document(check) for check in diagnosis.checks]
        console.print_json({"checks": checks, "good": not diagnosis.bad})
    else:
        _show(diagnosis)
    if diagnosis.bad:
        raise RunError(
            f"not fit for a rig in real time: {', '.join(diagnosis.bad)}; the cures stand above"
        )


def _document(check: Check) -> dict[str, str]:
    return {
        "what": check.subject,
        "verdict": check.verdict,
        "found": check.observation,
        "cure": check.cure,
    }


def _show(diagnosis: Diagnosis) -> None:
    console.print_table(
        "This computer",
        ["what", "verdict", "found"],
        [[check.subject, check.verdict, check.observation] for check in diagnosis.checks],
        text=["verdict", "found"],
    )
    for check in diagnosis.checks:
        if check.cure:
            console.print_line(f"{check.subject}: {check.cure}")
