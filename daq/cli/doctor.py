"""``rig doctor``: does this computer suit a rig in real time, and what to do where it does not."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Option

from daq.cli import options, terminal
from daq.errors import ConfigError, RunError

if TYPE_CHECKING:
    from daq.diagnose.computer import Check


def doctor(
    names: Annotated[
        list[str] | None,
        Argument(metavar="PORT", help="Device names; default all that exist."),
    ] = None,
    rig: Annotated[
        str | None, Option(metavar="RIG.yaml", help="Open this rig, outputs at zero, and ask it.")
    ] = None,
    port: options.PortName = None,
    rate: Annotated[
        float | None,
        Option(
            metavar="HZ",
            min=1.0,
            help="Sample rate to try; default 800, or the fastest of a slower device.",
        ),
    ] = None,
    loopback: Annotated[
        bool,
        Option(
            "--loopback",
            help="Measure when outputs come: +-0.5 V on the motor's, amplifiers unplugged.",
        ),
    ] = False,
    wakes: Annotated[
        int,
        Option(
            metavar="N",
            min=2,
            max=1_000_000,
            help="Times to wake from sleep, half of them under load.",
        ),
    ] = 20_000,
    out: options.RunsFolder = Path("runs"),
    json: options.AsJson = False,
) -> None:
    """Check whether this computer suits a rig in real time.

    What does not is told with its cure. With --rig or --port it asks the device as well, and
    samples for five seconds with both outputs at zero.
    """
    from daq.diagnose.computer import diagnose
    from daq.serial.ports import ports_of

    if loopback and rig is None:
        raise ConfigError("--loopback: no rig is named", cure="add --rig RIG.yaml")
    if rig is None and port is not None:
        rig = "serial.yaml"
    if rate is not None and rig is None:
        raise ConfigError("--rate: no device is named", cure="add --port PORT or --rig RIG.yaml")
    checks = [] if rig is None else _of_rig(rig, port, loopback, rate)
    named = [*(names or []), *filter(None, [port])]
    ports = None if rig is not None and not named else ports_of(named)
    checks += diagnose(ports, out, wakes)
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
                terminal.print_text(f"{check.subject}: {check.cure}")
    if bad:
        problem = f"not fit for a rig in real time: {', '.join(bad)}"
        raise RunError(problem, cure="the cures stand above")


def _of_rig(name: str, port: str | None, loopback: bool, rate: float | None) -> list[Check]:
    from daq.diagnose.device import diagnose_rig
    from daq.lookup.rigs import rig_on

    _, device = rig_on(name, port, watch=terminal.report_event)
    return diagnose_rig(device, name, loopback, rate)
