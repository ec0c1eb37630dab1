"""A device in software at an endpoint: the reference state machine, run with faults on request."""

import contextlib
import json
import select
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from daq.errors import ConfigError
from daq.hal import Phase, Simulation
from daq.serial.emulation.board import SimulatedBoard, identity, warm_up
from daq.serial.emulation.endpoints import Port
from daq.serial.emulation.faults import Fault, Line
from daq.serial.emulation.machine import DeviceMachine
from daq.serial.messages import Welcome

_LONGEST_WAIT = 0.1  # s between two looks at faults and stop requests
_GARBAGE_BYTES = 64
_FORGIVEN = 0.005  # s that this process may wake late before it counts as a pause

Journal = Callable[[dict[str, Any]], object]


def emulate(
    simulation: Simulation,
    name: str,
    port: Port,
    faults: Sequence[Fault] = (),
    drift: float = 0.0,
    seed: int = 0,
    journal: Path | None = None,
    ready: Callable[[str], None] = lambda port: None,
) -> None:
    """Serve a simulated rig of some name on a port until Ctrl-C or SIGTERM.

    drift: of its clock against the computer's, as a quartz has it. seed: of the faults' chances.
    journal: a file of JSON lines on what became of the outputs. ready: is called with the port's
    name. Raises ConfigError for a port or a journal that cannot be.
    """
    max_rate = warm_up(simulation)
    electronics = simulation.board()
    welcome = identity(name, electronics, max_rate)
    sticks = any(fault.name == "stuck-encoder" for fault in faults)
    board = SimulatedBoard(electronics, watched=not sticks)
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, frame: stop.set())
    with _journal(journal) as note:
        port.connect()
        emulator = Emulator(board, welcome, port, faults, drift, seed, note)
        ready(port.name)
        emulator.run(stop.is_set)


@contextlib.contextmanager
def _journal(path: Path | None) -> Iterator[Journal]:
    """Writer of a file of JSON lines, each on disk before the device goes on."""
    if path is None:
        yield lambda entry: None
        return
    try:
        file = path.open("w", encoding="utf-8", buffering=1)
    except OSError as error:
        raise ConfigError(f"--journal {path}: {error.strerror}") from None
    with file:
        yield lambda entry: file.write(json.dumps(entry) + "\n")


class Emulator:
    """Runs a device machine in real time on a port, with its faults.

    journal: is called at each change of state, with the outputs and how long the host had been
    silent.
    """

    def __init__(
        self,
        board: SimulatedBoard,
        identity: Welcome,
        port: Port,
        faults: Sequence[Fault],
        drift: float,
        seed: int,
        journal: Journal,
    ) -> None:
        self._board = board
        self._identity = identity
        self._port = port
        self._rate = identity.clock * (1.0 + drift)
        self._machine = DeviceMachine(board, identity)
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
        self._awake_by = time.perf_counter()
        while not stopped():
            # The machine lives at this instant, before the port is read: a pause of this
            # process after it must not look like silence of the host.
            now = time.perf_counter()
            self._forgive(now - self._awake_by)
            self._trigger(now)
            self._come_back(now)
            self._receive(now)
            self._note()
            self._machine.poll(self._ticks(now))
            self._note()
            self._transmit(time.perf_counter())
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
            now = time.perf_counter()
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
        now = time.perf_counter()
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
                    self._identity = replace(self._identity, version=int(fault.value))
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
