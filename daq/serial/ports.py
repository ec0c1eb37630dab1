"""Which serial ports this computer has, and who answers on them."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from daq.errors import DeviceError
from daq.serial.backend import SerialDevice, SerialOptions
from daq.serial.link import latency_timer
from daq.serial.messages import Welcome

_BY_ID = Path("/dev/serial/by-id")


@dataclass(frozen=True)
class PortFacts:
    """A port as the system knows it.

    lasting_name: the name that stays the same wherever it is plugged in, where there is one.
    usb: vendor and product, ``16c0:0483``. latency_timer [ms], of adapters that have one.
    """

    name: str
    description: str
    lasting_name: str | None = None
    usb: str | None = None
    latency_timer: int | None = None


@dataclass(frozen=True)
class Answer:
    """Who answers on a port, or why nobody does."""

    port: PortFacts
    welcome: Welcome | None
    problem: str | None


def list_ports() -> list[PortFacts]:
    """All ports with hardware behind them."""
    from serial.tools import list_ports as system

    lasting = _lasting_names()
    found = []
    for port in sorted(system.comports(), key=lambda item: item.device):
        # The system names serial ports of mainboards that have none; those say nothing.
        if port.hwid in {None, "n/a"}:
            continue
        usb = f"{port.vid:04x}:{port.pid:04x}" if port.vid is not None else None
        timer = latency_timer(port.device)
        found.append(
            PortFacts(
                port.device,
                port.description or "",
                lasting.get(os.path.realpath(port.device)),
                usb,
                timer[1] if timer else None,
            )
        )
    return found


def named(names: Sequence[str]) -> list[PortFacts]:
    """Ports that a user names: device names or URLs."""
    known = {port.name: port for port in list_ports()}
    return [known.get(name, PortFacts(name, "")) for name in names]


def ask(ports: Sequence[PortFacts], baud: int) -> list[Answer]:
    """Ask all ports at once who is there; takes as long as the slowest answer."""
    if not ports:
        return []
    with ThreadPoolExecutor(len(ports)) as pool:
        return list(pool.map(lambda port: _ask(port, baud), ports))


def _ask(port: PortFacts, baud: int) -> Answer:
    try:
        return Answer(port, SerialDevice(SerialOptions(port=port.name, baud=baud)).who(), None)
    except DeviceError as error:
        return Answer(port, None, str(error).removeprefix(f"{port.name}: "))


def _lasting_names() -> dict[str, str]:
    if not _BY_ID.is_dir():
        return {}
    return {os.path.realpath(link): str(link) for link in _BY_ID.iterdir()}
