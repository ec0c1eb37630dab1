"""A device in software at the end of a pty or a TCP port: the reference state machine, run.

It knows no plant: whoever starts it brings the ``Board``.
"""

from __future__ import annotations

import contextlib
import math
import os
import select
import socket
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from daq.errors import ConfigError
from daq.hal import CHANNELS, Phase
from daq.serial.emulation.faults import Fault, Line
from daq.serial.emulation.machine import Board, DeviceMachine
from daq.serial.messages import Codes, Records, Start, Welcome

_LONGEST_WAIT = 0.1  # s between two looks at faults and stop requests
_GARBAGE_BYTES = 64
_FORGIVEN = 0.005  # s that this process may wake late before it counts as a pause
_COURTESY = 0.3  # s that a host has to go before the next one is refused


class Port(Protocol):
    """Where the host connects."""

    name: str

    def files(self) -> list[int]:
        """What to wait on for bytes or for a host."""

    def read(self) -> bytes:
        """What has come, without waiting."""

    def write(self, data: bytes) -> int:
        """How many of the bytes the port took, without waiting."""

    def connect(self) -> None:
        """Be there; a host may come."""

    def disconnect(self) -> None:
        """Be gone, as when a cable is pulled."""


class PtyPort:
    """A pseudo-terminal (Linux, macOS). ``link``: a name that stays when the pty's changes."""

    def __init__(self, link: Path | None) -> None:
        self.name = ""
        self._link = link
        self._master = self._slave = -1

    def files(self) -> list[int]:
        """The master's end."""
        return [self._master] if self._master >= 0 else []

    def read(self) -> bytes:
        """What has come, without waiting."""
        with contextlib.suppress(BlockingIOError):
            return os.read(self._master, 65_536)
        return b""

    def write(self, data: bytes) -> int:
        """How many of the bytes the pty took."""
        if self._master < 0:
            return len(data)
        with contextlib.suppress(BlockingIOError):
            return os.write(self._master, data)
        return 0

    def connect(self) -> None:
        """Open a new pty."""
        if sys.platform == "win32":
            raise NotImplementedError("there are no pseudo-terminals; serve a TcpPort")
        import tty

        self._master, self._slave = os.openpty()
        # The slave stays open here: without a host there would be errors to read otherwise,
        # and the host's settings would not be raw before it has made them so.
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.name = os.ttyname(self._slave)
        if self._link is not None:
            _point(self._link, self.name)
            self.name = str(self._link)

    def disconnect(self) -> None:
        """Close both ends; a host reads an error."""
        for descriptor in (self._master, self._slave):
            if descriptor >= 0:
                os.close(descriptor)
        self._master = self._slave = -1
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
        """Listener and host."""
        return [item.fileno() for item in (self._listener, self._host) if item is not None]

    def read(self) -> bytes:
        """What has come, without waiting; a new host is let in when there is none."""
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
        """How many of the bytes were taken; without a host, all of them, for nobody."""
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
                self._came = time.monotonic()
        if self._newcomer is None:
            return
        if self._host is None:
            self._host, self._newcomer = self._newcomer, None
            self._host.setblocking(False)
            self._host.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        elif time.monotonic() - self._came > _COURTESY:
            self._newcomer.close()
            self._newcomer = None

    def _drop_host(self) -> None:
        if self._host is not None:
            self._host.close()
            self._host = None


_NO_COUNTS: dict[str, Any] = {
    "counts_low": -(2**31), "counts_high": 2**31 - 1,
    "count_rate": math.inf, "count_step": 2**32 - 1,
}  # fmt: skip
"""Of START: nothing of the counter is watched."""


class WatchedBoard:
    """A board with a counter that can be stuck; it tells the phase and what its outputs are."""

    def __init__(self, board: Board, sticks: bool = False) -> None:
        self.phase = Phase.OPEN
        self.stuck = False
        self._sticks = sticks  # sooner or later, and no guard of the board's sees the shaft then
        self.outputs = [0] * len(CHANNELS)
        self._board = board
        self._count = 0

    def connect(self) -> None:
        """A host has come."""
        self.phase = Phase.OPEN
        self._board.connect()

    def announce(self, phase: int, turns: float) -> None:
        """A phase begins."""
        phases = list(Phase)
        self.phase = phases[phase] if phase < len(phases) else self.phase
        self._board.announce(phase, turns)

    def start(self, rate: float, limits: Start) -> None:
        """Prepare a run."""
        self._board.start(rate, replace(limits, **_NO_COUNTS) if self._sticks else limits)

    def play(self, commands: Codes) -> Records:
        """The next ticks."""
        records = self._board.play(commands)
        if self.stuck:
            records["counts"], records["count_rate"] = self._count, 0.0
        self._count = int(records["counts"][-1])
        self.outputs = records["applied"][-1].tolist()
        return records

    def zero(self) -> None:
        """Outputs to zero."""
        self.outputs = [0] * len(CHANNELS)
        self._board.zero()


class Emulator:
    """Runs a device machine in real time on a port, with its faults.

    drift: of its clock against the computer's, as a quartz has it. journal: told of every change
    of state, with the outputs and how long the host had been silent.
    """

    def __init__(
        self,
        board: Board,
        identity: Welcome,
        port: Port,
        faults: Sequence[Fault] = (),
        drift: float = 0.0,
        seed: int = 0,
        journal: Callable[[dict[str, Any]], None] = lambda entry: None,
    ) -> None:
        self._board = WatchedBoard(board, any(fault.name == "stuck-encoder" for fault in faults))
        self._identity = identity
        self._port = port
        self._rate = identity.clock * (1.0 + drift)
        self._machine = DeviceMachine(self._board, identity)
        self._journal = journal
        self._noted: tuple[Any, ...] = ()
        self._waiting = list(faults)  # for their instant
        self._active: dict[str, float] = {}
        self._inward, self._outward = Line(seed), Line(seed + 1)
        self._noise = np.random.default_rng(seed)
        self._phase: Phase | None = None
        self._phase_at = 0.0
        self._quiet_until = 0.0
        self._back_at: float | None = None
        self._booting_until = 0.0
        self._unsent = b""

    def run(self, stopped: Callable[[], bool]) -> None:
        """Serve until ``stopped`` says so."""
        self._awake_by = self._now()
        while not stopped():
            # The machine lives at this instant, before the port is read: a pause of this
            # process after it must not look like silence of the host.
            now = self._now()
            self._forgive(now - self._awake_by)
            self._trigger(now)
            self._come_back(now)
            self._receive(now)
            self._note()
            self._machine.poll(self._ticks(now))
            self._note()
            self._transmit(self._now())
            self._wait()
        self._port.disconnect()

    def _forgive(self, overslept: float) -> None:
        """A pause of this process is no silence of a host that shares its computer."""
        if overslept > _FORGIVEN:
            self._machine.heard += self._ticks(overslept)

    def _note(self) -> None:
        """A line in the journal when something about the device has changed."""
        machine = self._machine
        state = (self._board.phase, machine.state, machine.latch, any(self._board.outputs))
        if state != self._noted:
            self._noted = state
            now = self._now()
            self._journal(
                {
                    "seconds": now,
                    "phase": self._board.phase.value,
                    "state": machine.state.name,
                    "latch": machine.latch.name,
                    "outputs": self._board.outputs,
                    "silence_seconds": now - machine.heard / self._rate,
                }
            )

    def _now(self) -> float:
        return time.perf_counter()

    def _ticks(self, now: float) -> int:
        return int(now * self._rate)

    # --- bytes --------------------------------------------------------------------------------

    def _receive(self, now: float) -> None:
        data = self._port.read() if self._port.files() else b""
        if data and "garbage" in self._active:
            self._unsent += self._noise.bytes(_GARBAGE_BYTES)
        if now < self._booting_until:
            return
        if data:
            self._inward.put(data, now, self._line_faults())
        arrived = self._inward.ready(now)
        if arrived:
            self._machine.receive(arrived, self._ticks(now))

    def _transmit(self, now: float) -> None:
        if now < self._quiet_until:
            return
        silent = "mute" in self._active or "garbage" in self._active
        # What the port does not take stays with the machine, which counts what that costs.
        while not self._unsent and (frame := self._machine.take()) is not None:
            if not silent:
                self._outward.put(frame, now, self._line_faults())
            self._unsent = self._outward.ready(now)
            self._push()
        if not self._unsent:
            self._unsent = self._outward.ready(now)
        self._push()

    def _push(self) -> None:
        if self._unsent:
            self._unsent = self._unsent[self._port.write(self._unsent) :]

    def _line_faults(self) -> dict[str, float]:
        names = ("bit-errors", "drop", "duplicate", "split", "merge", "delay", "jitter")
        return {name: self._active[name] for name in names if name in self._active}

    def _wait(self) -> None:
        now = self._now()
        until = [now + _LONGEST_WAIT]
        event = self._machine.next_event()
        if event is not None:
            until.append((event + 1) / self._rate)
        quiet = now < self._quiet_until
        # What the port does not take, or must not get yet, is not waited for here.
        lines = [self._inward] if quiet or self._unsent else [self._inward, self._outward]
        until += [at for line in lines if (at := line.next_arrival()) is not None]
        until += [at for at in (self._quiet_until, self._back_at) if at is not None and at > now]
        timeout = max(0.0, min(until) - now)
        self._awake_by = now + timeout
        files = self._port.files()
        writing = files[-1:] if self._unsent and not quiet else []
        if files:
            select.select(files, writing, [], timeout)
        else:
            time.sleep(timeout)

    # --- faults -------------------------------------------------------------------------------

    def _trigger(self, now: float) -> None:
        if self._board.phase is not self._phase:
            self._phase, self._phase_at = self._board.phase, now
        for fault in list(self._waiting):
            if fault.phase is not None and (
                fault.phase is not self._phase or now < self._phase_at + fault.after
            ):
                continue
            self._waiting.remove(fault)
            if fault.once:
                self._happen(fault, now)
            else:
                self._active[fault.name] = fault.value
                self._board.stuck = self._board.stuck or fault.name == "stuck-encoder"
                if fault.name == "version":
                    self._identity = Welcome(
                        **{**vars(self._identity), "version": int(fault.value)}
                    )
                    self._machine = DeviceMachine(self._board, self._identity)

    def _happen(self, fault: Fault, now: float) -> None:
        if fault.name == "overflow":
            self._machine.lose(int(fault.value))
        elif fault.name == "stall":
            self._quiet_until = now + fault.value
        else:
            self._inward.clear()
            self._outward.clear()
            self._unsent = b""
            if fault.name == "reboot":
                self._board.zero()
                self._machine = DeviceMachine(self._board, self._identity)
                self._booting_until = now + fault.value
            else:
                self._port.disconnect()
                self._back_at = now + fault.value

    def _come_back(self, now: float) -> None:
        if self._back_at is not None and now >= self._back_at:
            self._back_at = None
            self._port.connect()


def _point(link: Path, target: str) -> None:
    """Make a symbolic link in one step, over an old one."""
    fresh = link.with_name(f".{link.name}.{os.getpid()}")
    try:
        fresh.symlink_to(target)
        fresh.replace(link)
    except OSError as error:
        raise ConfigError(f"--link {link}: cannot be made: {error.strerror}") from None
