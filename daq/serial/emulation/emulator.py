"""A device in software at an endpoint: the reference state machine, run with faults on request."""

import json
import os
import select
import signal
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from daq.errors import ConfigError
from daq.hal import Phase, Simulation
from daq.serial.emulation.board import SimulatedBoard, identity, warm_up
from daq.serial.emulation.endpoints import Port
from daq.serial.emulation.faults import EVENTS, Fault, Line
from daq.serial.emulation.machine import DeviceMachine
from daq.serial.messages import Welcome

_LONGEST_WAIT = 0.1  # s between two looks at faults and stop requests
_GARBAGE_BYTES = 64
_FORGIVEN = 0.005  # s that this process may wake late before it counts as a pause


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
    path = journal or Path(os.devnull)
    try:
        file = path.open("w", encoding="utf-8", buffering=1)
    except OSError as error:
        raise ConfigError(f"--journal {path}: {error.strerror}") from None
    with file:
        port.connect()
        emulator = Emulator(board, welcome, port, list(faults), drift, seed, file)
        ready(port.name)
        emulator.run(stop.is_set)


@dataclass
class Emulator:
    """Runs a device machine in real time on a port, with its faults.

    waiting: faults whose instant has not come. drift: of the device's clock. seed: of the faults'
    chances. journal: a line of JSON at each change of state, with the outputs and how long the host
    had been silent.
    """

    board: SimulatedBoard
    identity: Welcome
    port: Port
    waiting: list[Fault]
    drift: float
    seed: int
    journal: TextIO

    def __post_init__(self) -> None:
        self._rate = self.identity.clock * (1.0 + self.drift)
        self._machine = DeviceMachine(self.board, self.identity)
        self._noted: tuple[Any, ...] = ()
        self._active: dict[str, float] = {}
        self._inward, self._outward = Line(self.seed), Line(self.seed + 1)
        self._noise = np.random.default_rng(self.seed)
        self._phase: Phase | None = None
        self._back_at: float | None = None
        self._phase_at = self._quiet_until = self._booting_until = 0.0
        self._unsent = b""

    def run(self, stopped: Callable[[], bool]) -> None:
        """Serve until ``stopped`` says so."""
        self._awake_by = time.perf_counter()
        while not stopped():
            # The machine lives at this instant, before the port is read: a pause of this
            # process, before or after it, must not look like silence of the host.
            now = time.perf_counter()
            if now - self._awake_by > _FORGIVEN:
                self._machine.heard += self._ticks(now - self._awake_by)
            self._trigger(now)
            if self._back_at is not None and now >= self._back_at:
                self._back_at = None
                self.port.connect()
            self._receive(now)
            self._note()
            self._machine.poll(self._ticks(now))
            self._note()
            self._transmit(time.perf_counter())
            self._wait()
        self.port.disconnect()

    def _note(self) -> None:
        """A line in the journal when something about the device has changed."""
        machine = self._machine
        state = (self.board.phase, machine.state, machine.latch, any(self.board.outputs))
        if state != self._noted:
            self._noted = state
            now = time.perf_counter()
            entry = {
                "seconds": now,
                "phase": self.board.phase.value,
                "state": machine.state.name,
                "latch": machine.latch.name,
                "outputs": self.board.outputs,
                "silence_seconds": now - machine.heard / self._rate,
            }
            self.journal.write(json.dumps(entry) + "\n")

    def _ticks(self, now: float) -> int:
        return int(now * self._rate)

    # --- bytes --------------------------------------------------------------------------------

    def _receive(self, now: float) -> None:
        data = self.port.read() if self.port.files() else b""
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
            self._push(now)
        self._push(now)

    def _push(self, now: float) -> None:
        """Write what the port did not take the last time, or what has come through the line."""
        self._unsent = self._unsent or self._outward.ready(now)
        if self._unsent:
            self._unsent = self._unsent[self.port.write(self._unsent) :]

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
        files = self.port.files()
        writing = files[-1:] if self._unsent and not quiet else []
        if files:
            select.select(files, writing, [], timeout)
        else:
            time.sleep(timeout)

    # --- faults -------------------------------------------------------------------------------

    def _trigger(self, now: float) -> None:
        if self.board.phase is not self._phase:
            self._phase, self._phase_at = self.board.phase, now
        for fault in list(self.waiting):
            due = fault.phase is self._phase and now >= self._phase_at + fault.after
            if fault.phase is not None and not due:
                continue
            self.waiting.remove(fault)
            if fault.name in EVENTS:
                self._happen(fault, now)
            else:
                self._active[fault.name] = fault.value
                self.board.stuck = self.board.stuck or fault.name == "stuck-encoder"
                if fault.name == "version":
                    self.identity = replace(self.identity, version=int(fault.value))
                    self._machine = DeviceMachine(self.board, self.identity)

    def _happen(self, fault: Fault, now: float) -> None:
        if fault.name == "overflow":
            self._machine.to_lose += int(fault.value)
        elif fault.name == "stall":
            self._quiet_until = now + fault.value
        else:
            self._inward.clear()
            self._outward.clear()
            self._unsent = b""
            if fault.name == "reboot":
                self.board.zero()
                self._machine = DeviceMachine(self.board, self.identity)
                self._booting_until = now + fault.value
            else:
                self.port.disconnect()
                self._back_at = now + fault.value
