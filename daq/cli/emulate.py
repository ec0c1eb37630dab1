"""``rig emulate``: the simulated rig behind the serial protocol."""

import os
import sys
from pathlib import Path
from typing import Annotated

import typer

from daq.cli import terminal
from daq.cli.options import AsJson, RigName


def emulate(
    rig: RigName = "simulated.yaml",
    link: Annotated[
        Path | None,
        typer.Option("--link", metavar="PATH", help="A name for the pty that stays the same."),
    ] = None,
    tcp: Annotated[
        int | None,
        typer.Option(
            "--tcp",
            metavar="NUMBER",
            help="Serve a loopback TCP port in place of a pty; 0 for any. Default on Windows.",
        ),
    ] = None,
    fault: Annotated[
        list[str] | None,
        typer.Option(
            "--fault",
            metavar="NAME[=VALUE][@PHASE[+SECONDS]]",
            help="What goes wrong; may be repeated. 'help' lists the faults.",
        ),
    ] = None,
    drift: Annotated[
        float, typer.Option("--drift", metavar="PPM", help="Of the device's clock.")
    ] = 0.0,
    seed: Annotated[int, typer.Option("--seed", metavar="N", help="Of the faults' chances.")] = 0,
    journal: Annotated[
        Path | None,
        typer.Option("--journal", metavar="FILE", help="Log of what became of the outputs, JSON."),
    ] = None,
    json: AsJson = False,
) -> None:
    """Put the simulated rig behind the serial protocol.

    It serves in real time until Ctrl-C, and prints the port that rig run --rig serial.yaml --port
    takes.
    """
    from daq.errors import ConfigError
    from daq.hal import Simulation
    from daq.lookup.rigs import load_rig
    from daq.run.realtime import RealTime
    from daq.serial.emulation import faults
    from daq.serial.emulation.emulator import Emulator
    from daq.serial.emulation.endpoints import port_of

    if "help" in (fault or []):
        _list_faults(json)
        return
    chosen = [faults.parse(text) for text in fault or []]
    config, device = load_rig(rig, watch=terminal.report_event)
    if not isinstance(device, Simulation):
        raise ConfigError(
            f"its backend is {config.backend!r}",
            cure=(
                "only the simulated one can be emulated. Name a rig file with 'backend: simulated'"
            ),
            file=rig,
        )

    def ready(port: str) -> None:
        RealTime().begin("prefer")
        if json:
            terminal.print_json({"port": port, "pid": os.getpid()})
        else:
            terminal.print_line(port)
            terminal.report_note(
                f"{config.name} answers there; run it with:  "
                f"rig run prbs.yaml --rig serial.yaml --port {port}"
            )
        sys.stdout.flush()

    port = port_of(link, tcp)
    emulator = Emulator(device, config.name, port, chosen, 1e-6 * drift, seed)
    emulator.serve(journal, ready)


def _list_faults(json: bool) -> None:
    from daq.serial.emulation import faults

    if json:
        kinds = faults.KINDS.items()
        terminal.print_json(
            {name: {"default": value, "does": text} for name, (value, text) in kinds}
        )
        return
    terminal.print_table(
        "Faults for --fault NAME[=VALUE][@PHASE[+SECONDS]]",
        ["name", "default", "what it does"],
        [
            [name, "-" if value is None else f"{value:g}", text]
            for name, (value, text) in faults.KINDS.items()
        ],
        text=["what it does"],
    )
    terminal.print_line(
        "Phases: open, calibration, homing, run, safe. Without one a fault is there from the start."
    )
