"""``rig doctor``: does this computer suit a rig in real time, and what to do where it does not."""

from pathlib import Path
from typing import Annotated

from typer import Argument

from daq.cli import options, terminal
from daq.errors import RunError


def doctor(
    names: Annotated[
        list[str] | None,
        Argument(metavar="[PORT...]", help="Device names; default all that exist."),
    ] = None,
    out: options.RunsFolder = Path("runs"),
    json: options.AsJson = False,
) -> None:
    """Check whether this computer suits a rig in real time.

    What does not is told with its cure.
    """
    from daq.diagnose.computer import diagnose
    from daq.serial.ports import ports_of

    checks = diagnose(ports_of(names or []), out)
    bad = [check.subject for check in checks if check.verdict == "bad"]
    if json:
        rows = [
            {"what": c.subject, "verdict": c.verdict, "found": c.observation, "cure": c.cure}
            for c in checks
        ]
        terminal.print_json({"checks": rows, "good": not bad})
    else:
        cells = [[check.subject, check.verdict, check.observation] for check in checks]
        head = ["what", "verdict", "found"]
        terminal.print_table("This computer", head, cells, text=head)
        for check in checks:
            if check.cure:
                print(f"{check.subject}: {check.cure}")
    if bad:
        problem = f"not fit for a rig in real time: {', '.join(bad)}"
        raise RunError(problem, cure="the cures stand above")
