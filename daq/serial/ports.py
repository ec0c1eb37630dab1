"""Ports: which this computer has, and bytes in and out of one, of a pyserial URL or a TCP socket.

The only file of the package that touches an operating system.
"""

import contextlib
import errno
import os
import select
import socket
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from daq.errors import ConfigError, DeviceError, Mistake, UnreachedError
from daq.serial.messages import WATCHDOG_ZEROES

_PATIENCE = 0.01  # s that a read waits at most
_WRITE_PATIENCE = 0.5  # s that a port may take to accept a frame
_SLOW_TIMER = 2  # ms; an adapter's latency timer above it delays every sample
_BY_ID = Path("/dev/serial/by-id")
_FAILURES = (OSError, TypeError, ValueError)  # what pyserial raises of a port that has gone


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


def ports_of(names: Sequence[str]) -> list[PortFacts]:
    """Ports of these device names or URLs; without any, all that have hardware behind them."""
    from serial.tools import list_ports

    links = _BY_ID.iterdir() if _BY_ID.is_dir() else ()
    lasting_names = {os.path.realpath(link): str(link) for link in links}
    # The system names serial ports of mainboards that have none; those say nothing of hardware.
    hardware = [port for port in list_ports.comports() if port.hwid not in {None, "n/a"}]
    ports = {}
    for port in sorted(hardware, key=lambda port: port.device):
        lasting_name = lasting_names.get(os.path.realpath(port.device))
        usb = f"{port.vid:04x}:{port.pid:04x}" if port.vid is not None else None
        _, timer = latency_timer(port.device) or (None, None)
        description = port.description or ""
        ports[port.device] = PortFacts(port.device, description, lasting_name, usb, timer)
    return [ports.get(name, PortFacts(name, "")) for name in names] or list(ports.values())


def require_ports(names: Sequence[str]) -> None:
    """Raise ConfigError for device names that this computer does not have, with those it has.

    What answers at a URL only trying shows.
    """
    present = [port.lasting_name or port.name for port in ports_of(())]
    cure = "no serial port has hardware behind it: plug the device in"
    if present:
        cure = f"there {'is' if len(present) == 1 else 'are'} {', '.join(present)}"
    missing = [
        Mistake("there is no such port", cure, file=name)
        for name in names
        if "://" not in name and name not in present and not Path(name).exists()
    ]
    if missing:
        raise ConfigError.of(missing)


def _gone(port: str, error: Exception | None = None) -> DeviceError:
    if error is None and Path(port).exists() and (holder := _holder(port)):
        # Of two that wait for the same bytes one gets them, and the other an empty hand.
        problem = f"another program reads the same port{holder}"
        return DeviceError(problem, cure="close that one and run again", file=port)
    reason = "" if error is None else f" ({error})"
    return DeviceError(
        f"the port has gone{reason}; check the cable and the device's supply. {WATCHDOG_ZEROES}",
        file=port,
    )


class SerialLink:
    """A port by pyserial: a device name of any system, or a URL such as rfc2217://."""

    def __init__(self, port: str, baud: int) -> None:
        import serial

        self.warnings: list[str] = []
        self._port = port
        try:
            self._serial = serial.serial_for_url(
                port,
                baudrate=baud,
                timeout=_PATIENCE,
                write_timeout=_WRITE_PATIENCE,
                exclusive=True if os.name == "posix" else None,
            )
        except (OSError, ValueError) as error:
            raise _not_opened(port, error) from None
        if holder := _holder(port):
            # It got there first, and knows no lock.
            self.warnings.append(
                f"{port}: another program has it open too{holder} and may take what the device "
                "sends; close that one"
            )
        # pyserial asks before every read and after every write whether the port is ready. To ask a
        # terminal is to wait for the kernel's worker that hands on what has come: tens of
        # milliseconds on a busy computer, however urgent who asks. So ask no more than needed.
        descriptor = getattr(self._serial, "fd", None) if os.name == "posix" else None
        self._descriptor = descriptor if isinstance(descriptor, int) else None
        self._prepare()

    def read(self) -> bytes:
        """Bytes received, or none after 10 ms."""
        try:
            if self._descriptor is None:
                first: bytes = self._serial.read(1)
                waiting = self._serial.in_waiting if first else 0
                return first + self._serial.read(waiting) if waiting else first
            if not select.select([self._descriptor], [], [], _PATIENCE)[0]:
                return b""
            data = os.read(self._descriptor, 65_536)
        except BlockingIOError:
            return b""  # taken by somebody else, or a false alarm
        except _FAILURES as error:
            raise _gone(self._port, error) from None
        if not data:
            raise _gone(self._port)
        return data

    def write(self, data: bytes) -> None:
        """Send all of it."""
        left = data
        try:
            if self._descriptor is not None:
                with contextlib.suppress(BlockingIOError):
                    left = data[os.write(self._descriptor, data) :]
            if left:
                self._serial.write(left)
        except _FAILURES as error:
            raise _gone(self._port, error) from None

    def close(self) -> None:
        """Disconnect; never raises."""
        self._descriptor = None  # a number that the system may give to another file
        with contextlib.suppress(*_FAILURES):
            self._serial.close()

    def _prepare(self) -> None:
        """Drop old input, ask the adapter for low latency, and keep DTR up on closing."""
        with contextlib.suppress(*_FAILURES):
            self._serial.reset_input_buffer()
        if not sys.platform.startswith("linux") or "://" in self._port:
            return
        import termios

        # Ports without such a mode, CDC-ACM among them, do not delay.
        with contextlib.suppress(*_FAILURES, AttributeError):
            self._serial.set_low_latency_mode(True)
        # Boards that reset on an edge of DTR stay as they are.
        with contextlib.suppress(termios.error, *_FAILURES):
            attributes = termios.tcgetattr(self._serial.fileno())
            attributes[2] &= ~termios.HUPCL
            termios.tcsetattr(self._serial.fileno(), termios.TCSANOW, attributes)
        timer = latency_timer(self._port)
        if timer is not None and timer[1] > _SLOW_TIMER:
            self.warnings.append(
                f"{self._port}: its adapter waits up to {timer[1]} ms before it hands on samples; "
                f"as root: echo 1 > {timer[0]}"
            )


class SocketLink:
    """A TCP connection, ``socket://HOST:PORT``: an emulator, or a device server."""

    def __init__(self, port: str) -> None:
        self.warnings: list[str] = []
        self._port = port
        host, _, number = port.removeprefix("socket://").strip("/").rpartition(":")
        if not host or not number.isdigit():
            raise DeviceError("not an address; write socket://HOST:PORT", file=port)
        try:
            self._socket = socket.create_connection((host.strip("[]"), int(number)), timeout=2.0)
        except OSError as error:
            raise UnreachedError(
                f"nobody answers there ({error}); check address and port number, and that the "
                "emulator or device server is running",
                file=port,
            ) from None
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.settimeout(_WRITE_PATIENCE)

    def read(self) -> bytes:
        """Bytes received, or none after 10 ms."""
        try:
            if not select.select([self._socket], [], [], _PATIENCE)[0]:
                return b""
            data = self._socket.recv(65_536)
        except ConnectionError:
            data = b""
        except (OSError, ValueError) as error:
            raise _gone(self._port, error) from None
        if not data:
            raise self._closed()
        return data

    def write(self, data: bytes) -> None:
        """Send all of it."""
        try:
            self._socket.sendall(data)
        except ConnectionError:
            raise self._closed() from None
        except OSError as error:
            raise _gone(self._port, error) from None

    def close(self) -> None:
        """Disconnect; never raises."""
        self._socket.close()

    def _closed(self) -> DeviceError:
        return DeviceError(
            "the other side has closed the connection. It serves one program at a time: another "
            "may have it, or the emulator or device server has ended",
            file=self._port,
        )


Link = SerialLink | SocketLink  # its methods raise DeviceError when it is gone, but for close


def open_link(port: str, baud: int) -> Link:
    """Open a port by name or URL, for this program alone. DeviceError names the cure."""
    return SocketLink(port) if port.startswith("socket://") else SerialLink(port, baud)


def latency_timer(port: str) -> tuple[Path, int] | None:
    """File and value [ms] of a USB adapter's latency timer; None for ports that have none."""
    file = Path("/sys/class/tty") / Path(port).resolve().name / "device" / "latency_timer"
    try:
        return file, int(file.read_text())
    except (OSError, ValueError):
        return None


def _not_opened(port: str, error: Exception) -> UnreachedError:
    number = getattr(error, "errno", None)
    text = str(error)
    problem, cure = f"it cannot be opened ({text})", "'rig ports' lists those that there are"
    if number == errno.ENOENT or "FileNotFoundError" in text:
        problem = "there is no such port"
    elif number == errno.EACCES or "Permission" in text:
        problem, cure = "no permission", permission_cure(port)
        if os.name == "nt":
            problem, cure = "another program has it open", "close that first"
    elif number in {errno.EAGAIN, errno.EBUSY} or "exclusively lock" in text:
        problem, cure = f"another program has it open{_holder(port)}", "close that first"
    elif number in {errno.ENOTTY, errno.EISDIR} or f"({errno.ENOTTY}," in text:
        problem = "that is no serial port"
    return UnreachedError(problem, cure=cure, file=port)


def permission_cure(port: str) -> str:
    """Command that gives a user access to a port on this system."""
    group = "dialout"
    if sys.platform != "win32":
        import grp

        with contextlib.suppress(OSError, KeyError):
            group = grp.getgrgid(Path(port).stat().st_gid).gr_name
    return f"sudo usermod -a -G {group} $USER, then log out and in again"


def _holder(port: str) -> str:
    """Process that has the port open, in brackets, where the system tells."""
    device = Path(port).resolve()
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            words = " ".join(
                word if word.startswith("-") else Path(word).name  # folders say little, and much
                for word in (process / "cmdline").read_bytes().decode().split("\0")
            ).strip()
            # The other end of a pty holds it as well.
            if " emulate" in words or int(process.name) == os.getpid():
                continue
            if device in map(Path.readlink, (process / "fd").iterdir()):
                return f" (process {process.name}: {words[:80]})"
    return ""
