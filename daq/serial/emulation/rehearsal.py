"""The firmware in QEMU with a simulated rig behind it, in real time."""

import contextlib
import json
import math
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any, TextIO

import numpy as np

from daq.errors import DeviceError
from daq.hal import ANALOG_INPUTS, CHANNELS, Flag, Phase, Simulation
from daq.run.realtime import RealTime
from daq.serial.emulation.emulator import SimulatedBoard, opened_journal, warm_up
from daq.serial.emulation.endpoints import named
from daq.serial.emulation.qemu import EmulatedFirmware, Exchange, InputCodes
from daq.serial.messages import CodedGuard, Latch, State

CLOCK = 1_000_000  # Hz, of the firmware's board in QEMU
_LATE = 0.02  # s that are worth a line of the journal
_PROCESSOR = 36  # of the fields of /proc/self/stat behind the name: the core it is on (man 5 proc)
_AT_REST = InputCodes((0,) * len(ANALOG_INPUTS), 0, 0.0)
_LEAST, _MOST = np.iinfo(np.int32).min, np.iinfo(np.int32).max
_SATURATED = int(Flag.SATURATED)
# The firmware has limits; the plant has none.
_UNLIMITED = CodedGuard(
    (-(2**15),) * len(CHANNELS), (2**15 - 1,) * len(CHANNELS),
    (_LEAST,) * len(ANALOG_INPUTS), (_MOST,) * len(ANALOG_INPUTS),
    _LEAST, _MOST, math.inf, 2**32 - 1,
)  # fmt: skip


class SimulatedPlant:
    """A simulated rig at the firmware's inputs and outputs; between runs it stands still."""

    def __init__(self, rig: Simulation) -> None:
        warm_up(rig)
        self._board = SimulatedBoard(rig.board(), watched=False)
        self._session = self._announced = self._runs = 0
        self._reading = _AT_REST

    def read(self, exchange: Exchange) -> InputCodes:
        """What stands at the inputs, after what the firmware tells has happened."""
        board = self._board
        if exchange.session != self._session:
            self._session = exchange.session
            board.connect()
        if exchange.announced != self._announced:
            self._announced = exchange.announced
            board.announce(exchange.phase, exchange.turns)
        if exchange.state != State.RUNNING:
            return self._reading
        if exchange.runs != self._runs:
            self._runs = exchange.runs
            board.start(CLOCK / exchange.period, _UNLIMITED)
        else:
            board.advance(exchange.outputs)
        (record,) = board.latch().tolist()
        analog, count, rate, _, flags = record
        self._reading = InputCodes(analog, count, rate, bool(flags & _SATURATED))
        return self._reading


def serve(
    rig: Simulation,
    elf: Path,
    link: Path | None,
    tcp: int | None,
    journal: Path | None,
    ready: Callable[[str], None],
) -> None:
    """Run the firmware until Ctrl-C or SIGTERM; ``ready`` is called with the name of its port.

    elf: the firmware for QEMU. link: a name for its pty that stays. tcp: serve this port of the
    loopback interface in its place. journal: a file of JSON lines on what became of the outputs,
    and by how much QEMU was late. Raises ConfigError for files and ports that cannot be,
    DeviceError where QEMU ends.
    """
    plant = SimulatedPlant(rig)
    with contextlib.ExitStack() as stack:
        notes = Journal(stack.enter_context(opened_journal(journal)))
        RealTime().begin("prefer")
        _share_core()
        firmware = stack.enter_context(EmulatedFirmware(elf, tcp=tcp))
        ended = _asked_to_end(firmware)
        ready(stack.enter_context(named(firmware.port, link)))
        try:
            while not ended.is_set():
                exchange = firmware.exchange()
                notes.add(exchange)
                firmware.answer(plant.read(exchange))
        except DeviceError:
            if not ended.is_set():
                raise


def _asked_to_end(firmware: EmulatedFirmware) -> threading.Event:
    """Set by Ctrl-C and SIGTERM, which end QEMU, for it may stand still."""
    ended = threading.Event()

    def end(number: int, frame: FrameType | None) -> None:
        ended.set()
        firmware.kill()

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, end)
    return ended


def _share_core() -> None:
    """Keep this process, and QEMU that it starts, on one core.

    They wait for each other at every tick and never compute at the same time. Were a core woken for
    each, a tick would take twice as long, and QEMU hand over half the line's bytes.
    """
    if sys.platform == "linux":
        behind_name = Path("/proc/self/stat").read_text(encoding="ascii").rpartition(")")[2]
        os.sched_setaffinity(0, {int(behind_name.split()[_PROCESSOR])})


class Journal:
    """Lines on what the firmware told: when its state changes, and when it is late."""

    def __init__(self, file: TextIO) -> None:
        self._file = file
        self._noted: tuple[Any, ...] = ()

    def add(self, exchange: Exchange) -> None:
        """A line, if there is something new."""
        state = (exchange.phase, exchange.state, exchange.latch, any(exchange.outputs))
        if state == self._noted and exchange.late < _LATE:
            return
        self._noted = state
        phases = list(Phase)
        entry = {
            "seconds": time.perf_counter(),
            "phase": phases[min(exchange.phase, len(phases) - 1)].value,
            "state": State(exchange.state).name,
            "latch": Latch(exchange.latch).name,
            "outputs": list(exchange.outputs),
            "late_seconds": exchange.late,
        }
        self._file.write(json.dumps(entry) + "\n")
