"""``rig emulate``: the simulated rig behind the serial protocol."""

import os
import sys
from pathlib import Path
from typing import Annotated

from typer import Option

from daq.cli import options, terminal
from daq.errors import ConfigError


def emulate(
    rig: options.RigName = "simulated.yaml",
    link: Annotated[
        Path | None, Option(metavar="PATH", help="A name for the pty that stays the same.")
    ] = None,
    tcp: Annotated[
        int | None,
        Option(
            metavar="NUMBER",
            help="Serve a loopback TCP port in place of a pty; 0 for any. Default on Windows.",
        ),
    ] = None,
    fault: Annotated[
        list[str] | None,
        Option(
            metavar="NAME[=VALUE][@PHASE[+SECONDS]]",
            help="What goes wrong; may be repeated. 'help' lists the faults.",
        ),
    ] = None,
    drift: Annotated[float, Option(metavar="PPM", help="Of the device's clock.")] = 0.0,
    seed: Annotated[int, Option(metavar="N", help="Of the faults' chances.")] = 0,
    journal: Annotated[
        Path | None, Option(metavar="FILE", help="Log of what became of the outputs, JSON.")
    ] = None,
    firmware: Annotated[
        Path | None,
        Option(
            metavar="ELF",
            help="In place of the emulator run this firmware in QEMU, the simulated rig behind it.",
        ),
    ] = None,
    json: options.AsJson = False,
) -> None:
    """Put the simulated rig behind the serial protocol.

    It serves in real time until Ctrl-C, and prints the port that rig run --rig serial.yaml --port
    takes.
    """
    from daq.hal import Simulation
    from daq.lookup.rigs import load_rig
    from daq.run.realtime import RealTime
    from daq.serial.emulation import faults, rehearsal
    from daq.serial.emulation.emulator import Emulator
    from daq.serial.emulation.endpoints import port_of

    if "help" in (fault or []):
        _list_faults(json)
        return
    chosen = [faults.parse(text) for text in fault or []]
    if firmware is not None and (chosen or drift):
        raise ConfigError(
            "--firmware: it has none of the emulator's --fault and --drift",
            cure="leave them out, or leave out --firmware",
        )
    config, device = load_rig(rig, watch=terminal.report_event)
    if not isinstance(device, Simulation):
        cure = (
            "only the simulated one can be emulated. Leave --rig out for it, or name a rig file "
            "with 'backend: simulated'"
        )
        raise ConfigError(f"its backend is {config.backend!r}", cure=cure, file=rig)

    def ready(port: str) -> None:
        RealTime().begin("prefer")
        if json:
            terminal.print_json({"port": port, "pid": os.getpid()})
        else:
            print(port)
            terminal.report(
                "note",
                f"{config.name} answers there; run it with:  "
                f"rig run prbs.yaml --rig serial.yaml --port {port}",
            )
        sys.stdout.flush()

    if firmware is not None:
        rehearsal.serve(device, firmware, link, tcp, journal, ready)
        return
    port = port_of(link, tcp)
    emulator = Emulator(device, config.name, port, chosen, 1e-6 * drift, seed)
    emulator.serve(journal, ready)


def _list_faults(json: bool) -> None:
    from daq.serial.emulation import faults

    kinds = [(name, *kind) for name, kind in faults.KINDS.items()]
    if json:
        terminal.print_json({name: {"default": value, "does": text} for name, value, text in kinds})
        return
    title = "Faults for --fault NAME[=VALUE][@PHASE[+SECONDS]]"
    head = ["name", "default", "what it does"]
    rows = [[name, "-" if value is None else f"{value:g}", text] for name, value, text in kinds]
    terminal.print_table(title, head, rows, text=["what it does"])
    print(
        "Phases: open, calibration, homing, run, safe. Without one a fault is there from the start."
    )
