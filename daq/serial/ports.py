"""Which serial ports this computer has, and who answers on them."""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from daq.errors import DeviceError
from daq.serial.connection import Connection
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
class Inquiry:
    """Who answers on a port, or why nobody does; neither where nobody was asked."""

    port: PortFacts
    welcome: Welcome | None = None
    problem: str | None = None


def ports_of(names: Sequence[str]) -> list[PortFacts]:
    """Ports of these device names or URLs; without any, all that have hardware behind them."""
    ports = _system_ports()
    if not names:
        return ports
    by_name = {port.name: port for port in ports}
    return [by_name.get(name, PortFacts(name, "")) for name in names]


def inquire(ports: Sequence[PortFacts], baud: int) -> list[Inquiry]:
    """Ask all ports at once who is there; takes as long as the slowest answer."""
    with ThreadPoolExecutor(max(1, len(ports))) as pool:
        return list(pool.map(lambda port: _inquire(port, baud), ports))


def _inquire(port: PortFacts, baud: int) -> Inquiry:
    try:
        connection = Connection(port.name, baud)
    except DeviceError as error:
        return Inquiry(port, problem=error.mistakes[0].problem)
    connection.close()
    return Inquiry(port, connection.welcome)


def _system_ports() -> list[PortFacts]:
    from serial.tools import list_ports

    links = _BY_ID.iterdir() if _BY_ID.is_dir() else ()
    lasting_names = {os.path.realpath(link): str(link) for link in links}
    # The system names serial ports of mainboards that have none; those say nothing of hardware.
    ports = [port for port in list_ports.comports() if port.hwid not in {None, "n/a"}]
    facts = []
    for port in sorted(ports, key=lambda port: port.device):
        usb = f"{port.vid:04x}:{port.pid:04x}" if port.vid is not None else None
        _, milliseconds = latency_timer(port.device) or (None, None)
        lasting_name = lasting_names.get(os.path.realpath(port.device))
        facts.append(
            PortFacts(port.device, port.description or "", lasting_name, usb, milliseconds)
        )
    return facts
