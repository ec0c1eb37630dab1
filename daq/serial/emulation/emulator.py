"""A simulated rig as a device in software: its board, and the machine served at an endpoint."""

import json
import math
import os
import select
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from daq.errors import ConfigError
from daq.hal import ANALOG_INPUTS, CHANNELS, Electronics, Guard, Mode, Phase, RawSamples, Simulation
from daq.serial import messages
from daq.serial.emulation.endpoints import Port
from daq.serial.emulation.faults import EVENTS, Fault, Line
from daq.serial.emulation.machine import DeviceMachine
from daq.serial.messages import Channel, CodedGuard, Codes, Records, Welcome

_LONGEST_WAIT = 0.1  # s between two looks at faults and stop requests
_GARBAGE_BYTES = 64
_FORGIVEN = 0.005  # s that this process may wake late before it counts as a pause
_CLOCK = 48_000_000  # Hz, of a microcontroller with USB
_QUEUE = 16_384  # commands; 64 KiB of its memory
_LARGEST_BLOCK = 256  # ticks that the simulated rig computes at once


class SimulatedBoard:
    """A simulated rig as ``machine.Board``. Its time is the machine's: it plays ticks on request.

    watched: whether the guard's limits of the counter act. phase: of the run. outputs: codes that
    both have. stuck: whether the counter stands still.
    """

    def __init__(self, electronics: Electronics, watched: bool = True) -> None:
        self.phase = Phase.OPEN
        self.outputs = [0] * len(CHANNELS)
        self.stuck = False
        self._device, self._peek = electronics.device, electronics.latch
        self._step_in, self._step_out = electronics.step_in, electronics.step_out
        self._watched = watched
        self._tick = self._count = 0

    def connect(self) -> None:
        """The rig as it stands when somebody switches it on, its load let down."""
        self.phase = Phase.OPEN
        self._device.open()

    def announce(self, phase: int, turns: float) -> None:
        """The simulated user winds the handle when asked to."""
        phases = list(Phase)
        if phase < len(phases):
            self.phase = phases[phase]
            self._device.announce(self.phase, turns)

    def start(self, rate: float, guard: CodedGuard) -> None:
        """Sampling from tick 0 on."""
        counts = (guard.counts_low, guard.counts_high, guard.count_rate, guard.count_step)
        commands = np.array([guard.command_low, guard.command_high]) * self._step_out
        analog = np.array([guard.analog_low, guard.analog_high]) * self._step_in
        volts = Guard(*commands, *analog, *(counts if self._watched else ()))
        # Each tick comes with its command: missing ones are the machine's matter.
        self._device.start(rate, Mode.CLOSED_LOOP, volts)
        self._tick = 0

    def play(self, commands: Codes) -> Records:
        """Simulate n ticks."""
        records = np.zeros(len(commands), dtype=messages.SAMPLE_DTYPE)
        for at in range(0, len(commands), _LARGEST_BLOCK):
            part = slice(at, at + _LARGEST_BLOCK)
            self._play(commands[part], records[part])
        if self.stuck:
            records["counts"], records["count_rate"] = self._count, 0.0
        self._count = int(records["counts"][-1])
        self.outputs = records["applied"][-1].tolist()
        return records

    def zero(self) -> None:
        """Outputs to zero until the next start."""
        self.outputs = [0] * len(CHANNELS)
        self._device.safe()

    def advance(self, outputs: tuple[int, int]) -> None:
        """One tick with these codes, of which nobody wants the sample."""
        self._device.send(self._tick, np.array([outputs]) * self._step_out)
        self._device.receive()
        self._tick += 1

    def latch(self) -> Records:
        """The inputs at the next tick, before its command; one record."""
        records = np.zeros(1, dtype=messages.SAMPLE_DTYPE)
        self._code(self._peek(), records)
        return records

    def _play(self, commands: Codes, records: Records) -> None:
        self._device.send(self._tick, commands.astype(np.float64) * self._step_out)
        raw = self._device.receive()
        self._code(raw, records)
        self._tick += len(raw.tick)

    def _code(self, raw: RawSamples, records: Records) -> None:
        records["analog"] = np.rint(raw.analog / self._step_in)
        # As a counter of 32 bits shows them.
        records["counts"] = (np.rint(raw.counts).astype(np.int64) + 2**31) % 2**32 - 2**31
        records["count_rate"] = raw.count_rate
        records["applied"] = np.rint(raw.applied / self._step_out)
        records["flags"] = raw.flags


def identity(name: str, electronics: Electronics, max_rate: float) -> Welcome:
    """WELCOME of a microcontroller with such converters."""
    low, high = electronics.volts
    inputs = [Channel(item, "V", electronics.step_in, 0.0, low, high) for item in ANALOG_INPUTS]
    outputs = [Channel(item, "V", electronics.step_out, 0.0, low, high) for item in CHANNELS]
    counts = np.iinfo(np.int32)
    counter = Channel("encoder", "count", 1.0, 0.0, float(counts.min), float(counts.max))
    return Welcome(
        device=name,
        firmware="emulator 1",
        serial="simulated",
        clock=_CLOCK,
        max_rate=max_rate,
        queue=_QUEUE,
        max_payload=1024,
        watchdog_default=100,
        watchdog_longest=10_000,
        channels=(*inputs, *outputs, counter),
    )


def warm_up(simulation: Simulation) -> float:
    """Compile what the rig computes with, before a host waits for it; its highest rate [Hz]."""
    device = simulation.board().device
    wide = np.full(3, 1e9)
    info = device.open()
    device.start(1000.0, Mode.CLOSED_LOOP, Guard(np.full(2, -1.0), np.full(2, 1.0), -wide, wide))
    for tick, n in ((0, 1), (1, 20)):
        device.send(tick, np.zeros((n, len(CHANNELS))))
        device.receive()
    device.close()
    return info.max_rate


def opened_journal(path: Path | None) -> TextIO:
    """The file of a journal, written line by line; ConfigError where there can be none."""
    path = path or Path(os.devnull)
    try:
        return path.open("w", encoding="utf-8", buffering=1)
    except OSError as error:
        raise ConfigError(f"--journal {path}: {error.strerror}") from None


class Emulator:
    """A simulated rig behind the device's state machine, served in real time on a port.

    name: of the device. drift: of its clock against the computer's, as a quartz has it. seed: of
    the faults' chances.
    """

    def __init__(
        self, rig: Simulation, name: str, port: Port, faults: list[Fault], drift: float, seed: int
    ) -> None:
        max_rate = warm_up(rig)
        electronics = rig.board()
        sticks = any(fault.name == "stuck-encoder" for fault in faults)
        self._board = SimulatedBoard(electronics, watched=not sticks)
        self._identity = identity(name, electronics, max_rate)
        self._machine = DeviceMachine(self._board, self._identity)
        self._port = port
        self._rate = self._identity.clock * (1.0 + drift)
        self._noted: tuple[Any, ...] = ()
        self._waiting = list(faults)  # for their instant
        self._active: dict[str, float] = {}
        self._inward, self._outward = Line(seed), Line(seed + 1)
        self._noise = np.random.default_rng(seed)
        self._phase: Phase | None = None
        self._phase_at = self._quiet_until = self._booting_until = 0.0
        self._back_at = math.inf
        self._unsent = b""

    def serve(self, journal: Path | None, ready: Callable[[str], None]) -> None:
        """Serve until Ctrl-C or SIGTERM.

        journal: a file of JSON lines on what became of the outputs, and how long the host had been
        silent. ready: is called with the port's name. Raises ConfigError for a port or a journal
        that cannot be.
        """
        stop = threading.Event()
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda number, frame: stop.set())
        with opened_journal(journal) as self._journal:
            self._port.connect()
            ready(self._port.name)
            self._awake_by = time.perf_counter()
            while not stop.is_set():
                self._cycle()
            self._port.disconnect()

    def _cycle(self) -> None:
        # The machine lives at this instant, before the port is read: a pause of this process,
        # before or after it, must not look like silence of the host.
        now = time.perf_counter()
        if now - self._awake_by > _FORGIVEN:
            self._machine.heard += self._ticks(now - self._awake_by)
        self._trigger(now)
        if now >= self._back_at:
            self._back_at = math.inf
            self._port.connect()
        self._receive(now)
        self._note()
        self._machine.poll(self._ticks(now))
        self._note()
        self._transmit(time.perf_counter())
        self._wait()

    def _note(self) -> None:
        """A line in the journal when something about the device has changed."""
        machine = self._machine
        state = (self._board.phase, machine.state, machine.latch, any(self._board.outputs))
        if state != self._noted:
            self._noted = state
            now = time.perf_counter()
            entry = {
                "seconds": now,
                "phase": self._board.phase.value,
                "state": machine.state.name,
                "latch": machine.latch.name,
                "outputs": self._board.outputs,
                "silence_seconds": now - machine.heard / self._rate,
            }
            self._journal.write(json.dumps(entry) + "\n")

    def _ticks(self, now: float) -> int:
        return int(now * self._rate)

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
            # The time after reading: no frame may be answered with one before it was sent.
            self._machine.receive(arrived, self._ticks(time.perf_counter()))

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
            self._unsent = self._unsent[self._port.write(self._unsent) :]

    def _line_faults(self) -> dict[str, float]:
        names = ("bit-errors", "drop", "duplicate", "split", "merge", "delay", "jitter")
        return {name: self._active[name] for name in names if name in self._active}

    def _wait(self) -> None:
        now = time.perf_counter()
        until = [now + _LONGEST_WAIT, self._back_at, self._inward.next_arrival()]
        event = self._machine.next_event()
        if event is not None:
            until.append((event + 1) / self._rate)
        quiet = now < self._quiet_until
        # What the port does not take, or must not get yet, is not waited for here.
        if quiet:
            until.append(self._quiet_until)
        elif not self._unsent:
            until.append(self._outward.next_arrival())
        timeout = max(0.0, min(until) - now)
        self._awake_by = now + timeout
        files = self._port.files()
        writing = files[-1:] if self._unsent and not quiet else []
        if files:
            select.select(files, writing, [], timeout)
        else:
            time.sleep(timeout)

    def _trigger(self, now: float) -> None:
        if self._board.phase is not self._phase:
            self._phase, self._phase_at = self._board.phase, now
        for fault in list(self._waiting):
            due = fault.phase is self._phase and now >= self._phase_at + fault.after
            if fault.phase is not None and not due:
                continue
            self._waiting.remove(fault)
            if fault.name in EVENTS:
                self._happen(fault, now)
            else:
                self._active[fault.name] = fault.value
                self._board.stuck = self._board.stuck or fault.name == "stuck-encoder"
                if fault.name == "version":
                    self._identity = replace(self._identity, version=int(fault.value))
                    self._machine = DeviceMachine(self._board, self._identity)

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
                self._board.zero()
                self._machine = DeviceMachine(self._board, self._identity)
                self._booting_until = now + fault.value
            else:
                self._port.disconnect()
                self._back_at = now + fault.value
