"""``rig emulate``: the simulated rig behind the serial protocol."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from daq.cli import terminal as console
from daq.errors import ConfigError
from daq.hal import Simulation
from daq.lookup.files import load_rig
from daq.run.realtime import RealTime
from daq.serial.emulation import faults
from daq.serial.emulation.emulator import emulate
from daq.serial.emulation.endpoints import port_of


def emulate_command(
    rig: str,
    link: Path | None,
    tcp: int | None,
    fault: list[str],
    drift: float,
    seed: int,
    journal: Path | None,
    as_json: bool,
) -> None:
    """Serve a simulated rig on a port until Ctrl-C."""
    if "help" in fault:
        _list_faults(as_json)
        return
    chosen = [faults.parse(text) for text in fault]
    config, device = load_rig(rig)
    if not isinstance(device, Simulation):
        raise ConfigError(
            f"{rig}: its backend is {config.backend!r}; only the simulated one can be emulated. "
            "Name a rig file with 'backend: simulated'"
        )

    def ready(port: str) -> None:
        RealTime().begin("prefer")
        if as_json:
            console.print_json({"port": port, "pid": os.getpid()})
        else:
            console.print_line(port)
            console.report_note(
                f"{config.name} answers there; run it with:  "
                f"rig run prbs.yaml --rig serial.yaml --port {port}"
            )
        sys.stdout.flush()

    port = port_of(link, tcp)
    emulate(device, config.name, port, chosen, 1e-6 * drift, seed, journal, ready)


def _list_faults(as_json: bool) -> None:
    if as_json:
        kinds = faults.KINDS.items()
        console.print_json(
            {name: {"default": value, "does": text} for name, (value, text) in kinds}
        )
        return
    console.print_table(
        "Faults for --fault NAME[=VALUE][@PHASE[+SECONDS]]",
        ["name", "default", "what it does"],
        [
            [name, "-" if value is None else f"{value:g}", text]
            for name, (value, text) in faults.KINDS.items()
        ],
        text=["what it does"],
    )
    console.print_line(
        "Phases: open, calibration, homing, run, safe. Without one a fault is there from the start."
    )
