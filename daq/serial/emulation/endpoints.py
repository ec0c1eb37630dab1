"""Where a host connects to an emulator: a pty, or a TCP port of the loopback interface."""

import contextlib
import os
import socket
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from daq.errors import ConfigError

_COURTESY = 0.3  # s that a host has to go before the next is refused


class PtyPort:
    """A pseudo-terminal (Linux, macOS). ``link``: a name that stays when the pty's changes."""

    def __init__(self, link: Path | None) -> None:
        self.name = ""
        self._link = link
        self._ends: list[int] = []  # master and slave, while connected

    def files(self) -> list[int]:
        """Descriptors to wait on: the master's."""
        return self._ends[:1]

    def read(self) -> bytes:
        """Bytes received."""
        with contextlib.suppress(BlockingIOError):
            return os.read(self._ends[0], 65_536)
        return b""

    def write(self, data: bytes) -> int:
        """Number of bytes that the pty took."""
        if not self._ends:
            return len(data)
        with contextlib.suppress(BlockingIOError):
            return os.write(self._ends[0], data)
        return 0

    def connect(self) -> None:
        """Open a new pty."""
        if sys.platform == "win32":
            raise NotImplementedError("there are no pseudo-terminals; serve a TcpPort")
        import tty

        master, slave = self._ends = [*os.openpty()]
        # The slave stays open here: without a host there would be errors to read otherwise,
        # and the host's settings would not be raw before it has made them so.
        tty.setraw(slave)
        os.set_blocking(master, False)
        self.name = os.ttyname(slave)
        if self._link is not None:
            _point(self._link, self.name)
            self.name = str(self._link)

    def disconnect(self) -> None:
        """Close both ends, as when a cable is pulled; a host reads an error."""
        for descriptor in self._ends:
            os.close(descriptor)
        self._ends = []
        if self._link is not None:
            self._link.unlink(missing_ok=True)


class TcpPort:
    """A port of the loopback interface, for one host at a time."""

    def __init__(self, number: int) -> None:
        self._number = number
        self._listener: socket.socket | None = None
        self._host: socket.socket | None = None
        self._newcomer: socket.socket | None = None
        self._came = 0.0
        self.name = ""

    def files(self) -> list[int]:
        """Descriptors to wait on: the listener's and the host's."""
        return [item.fileno() for item in (self._listener, self._host) if item is not None]

    def read(self) -> bytes:
        """Bytes received; a new host is let in when there is none."""
        self._accept()
        if self._host is None:
            return b""
        try:
            data = self._host.recv(65_536)
        except BlockingIOError:
            return b""
        except OSError:
            data = b""
        if not data:
            self._drop_host()
        return data

    def write(self, data: bytes) -> int:
        """Number of bytes taken; without a host, all of them, for nobody."""
        if self._host is None:
            return len(data)
        try:
            return self._host.send(data)
        except BlockingIOError:
            return 0
        except OSError:
            self._drop_host()
            return len(data)

    def connect(self) -> None:
        """Listen."""
        self._listener = socket.socket()
        self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            self._listener.bind(("127.0.0.1", self._number))
        except (OSError, OverflowError) as error:
            raise ConfigError(
                f"--tcp {self._number}: cannot listen there ({error}); choose another number, or "
                "0 for any that is free"
            ) from None
        self._number = self._listener.getsockname()[1]
        self._listener.listen()
        self._listener.setblocking(False)
        self.name = f"socket://127.0.0.1:{self._number}"

    def disconnect(self) -> None:
        """Drop the host and stop listening."""
        self._drop_host()
        if self._listener is not None:
            self._listener.close()
            self._listener = None

    def _accept(self) -> None:
        """Let a host in. A second one waits a moment for the first to go, and is refused then."""
        if self._listener is not None and self._newcomer is None:
            with contextlib.suppress(BlockingIOError):
                self._newcomer, _ = self._listener.accept()
                self._came = time.perf_counter()
        if self._newcomer is None:
            return
        if self._host is None:
            self._host, self._newcomer = self._newcomer, None
            self._host.setblocking(False)
            self._host.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        elif time.perf_counter() - self._came > _COURTESY:
            self._newcomer.close()
            self._newcomer = None

    def _drop_host(self) -> None:
        if self._host is not None:
            self._host.close()
            self._host = None


Port = PtyPort | TcpPort  # where a host connects; reading and writing never wait


def port_of(link: Path | None, tcp: int | None) -> Port:
    """A pty, named by a link where one is given, or a TCP port; on Windows always the latter."""
    if tcp is not None or sys.platform == "win32":
        if link is not None:
            raise ConfigError("--link names a pty; leave it out where a TCP port is served")
        return TcpPort(tcp or 0)
    if link is not None:
        _refuse_file(link)
    return PtyPort(link)


@contextlib.contextmanager
def named(port: str, link: Path | None) -> Iterator[str]:
    """A name for a port until the end of the block: the link, which points to it, if there is one.

    Raises ConfigError where there is a file of that name.
    """
    if link is None:
        yield port
        return
    _refuse_file(link)
    _point(link, port)
    try:
        yield str(link)
    finally:
        link.unlink(missing_ok=True)


def _refuse_file(link: Path) -> None:
    if link.exists() and not link.is_symlink():
        raise ConfigError(f"--link {link}: there is a file of that name; choose another")


def _point(link: Path, target: str) -> None:
    """Make a symbolic link in one step, over an old one."""
    fresh = link.with_name(f".{link.name}.{os.getpid()}")
    try:
        fresh.symlink_to(target)
        fresh.replace(link)
    except OSError as error:
        raise ConfigError(f"--link {link}: cannot be made: {error.strerror}") from None
