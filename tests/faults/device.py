"""The board behind the hardware abstraction layer, in virtual time: ``device.py:VirtualDevice``."""

from dataclasses import fields
from typing import Literal

import numpy as np
from pydantic import Field

from daq.config.base import Section
from daq.config.units import Hertz, Seconds, Volts
from daq.errors import DeviceError
from daq.hal import DeviceInfo, Mode, RawSamples
from tests.faults.board import STEP, Board, Setting
from tests.faults.firmware import SAFE, WATCHDOG, Limits, Ticker

QUEUE = 4096
_BLOCK = 0.02  # s of samples that nobody waits for
_WATCHDOG = 0.1  # s
_PATIENCE = 1.0  # s without a sample after which a host gives up


class Options(Section):
    """Which plant, and which fault when; ``truth``: a file for what really happened."""

    seed: int = Field(0, ge=0, description="of plant and noise; 0 is the plant in the middle")
    load: Literal["free", "pulley", "locked", "hand"] = Field("free", description="on the shaft")
    sensor: Literal["between", "load"] = Field("between", description="where torque is measured")
    noise: Volts = Field(0.010, ge=0.0, description="rms, on every analog input")
    offset: Volts = Field(0.020, ge=0.0, description="largest, of every analog input")
    fault: str = Field("", description="its name; none without")
    size: float | None = Field(None, description="of the fault, in place of its own")
    phase: Literal["open", "calibration", "homing", "run"] = Field("run", description="of fault")
    at: Seconds = Field(0.0, ge=0.0, description="instant of the fault in its phase")
    truth: str = Field("", description="file for what really happened; none without")
    max_rate: Hertz = Field(20_000.0, gt=0.0, description="highest sample rate")

    @property
    def cable(self):
        """Whether the load hangs on one."""
        return self.load == "pulley"

    @property
    def setting(self):
        """For the board."""
        return Setting(**{field.name: getattr(self, field.name) for field in fields(Setting)})


class VirtualDevice:
    """A board whose clock waits for the host; ``board.truth`` is what really happened."""

    Options = Options

    def __init__(self, options):
        self.options = options
        self.board = Board(options.setting)
        self._ticker = None
        self._opened = False
        self._period = 1.0 / 800.0  # s, also of the time after the last run
        self._lost = 0  # ticks

    def open(self):
        self._opened = True
        volts = (-10.0, 10.0)
        return DeviceInfo("faulty board", self.options.max_rate, QUEUE, volts, virtual_time=True)

    def announce(self, phase, turns=0.0):
        self.board.announce(phase.value, turns)

    def start(self, sample_rate, mode, guard):
        if not self._opened:
            raise DeviceError("the board is not connected; open it first")
        self._period = 1.0 / sample_rate
        arrays = (guard.command_low, guard.command_high, guard.analog_low, guard.analog_high)
        limits = Limits(
            *(tuple(array.tolist()) for array in arrays),
            guard.counts_low, guard.counts_high, guard.count_rate, guard.count_step,
        )  # fmt: skip
        self._ticker = Ticker(self.board, self._period, mode is Mode.CLOSED_LOOP, limits)

    def send(self, tick, commands):
        ticker = self._running()
        if 0.0 <= self.board.since_fault < self.board.now.pause:
            return  # nobody spoke
        volts = np.round(np.asarray(commands) / STEP) * STEP
        for row, command in enumerate(volts.tolist()):
            ticker.send(tick + row, command)

    def room(self):
        return QUEUE - self._running().waiting()

    def receive(self):
        ticker, now = self._running(), self.board.now
        if now.ends:
            self._end(ticker, now.ends)
        if now.pause > _WATCHDOG:
            self._watchdog(ticker)
        block = max(1, round(_BLOCK / self._period))
        waiting = ticker.waiting()
        waited_for = ticker.closed and not ticker.latch and waiting < block
        size = 1 if waited_for else min(block, waiting) or block
        rows = [ticker.run() for _ in range(size)]
        kept = [row for row in rows if self.board.rng.random() >= self.board.now.lost]
        return _samples(kept) if kept else self.receive()

    def stop(self):
        self.safe()
        if self._ticker is not None and not self.board.now.ignores_safe:
            self._ticker = None

    def safe(self):
        if self._ticker is not None and self.board.now.ends != "hung":
            self._ticker.make_safe(SAFE)

    def close(self):
        self.safe()
        if self._opened:
            last = [0.0, 0.0] if self._ticker is None else self._ticker.last
            self.board.coast(*last, self._period)
            if self.options.truth:
                self.board.truth.write(self.options.truth)
        self._ticker, self._opened = None, False

    def _running(self):
        if self._ticker is None:
            first = "start it first" if self._opened else "open it, then start it first"
            raise DeviceError(f"the board is not sampling; {first}")
        return self._ticker

    def _end(self, ticker, how):
        """A device that will say nothing more; what it does meanwhile."""
        if how == "reset":
            ticker.make_safe(SAFE)
        for _ in range(round(_PATIENCE / self._period)):
            if how == "hung":
                self.board.drive(*ticker.last, self._period)
            else:
                ticker.run()
        raise DeviceError(
            f"the board has sent no sample for {_PATIENCE:g} s; look at its cable and its supply"
        )

    def _watchdog(self, ticker):
        """The host is silent for longer than the device waits."""
        for _ in range(round(_WATCHDOG / self._period)):
            ticker.run()
        ticker.make_safe(WATCHDOG)
        raise DeviceError("the board heard nothing for 100 ms and made itself safe")


def _samples(rows):
    """Rows as the block that the layer above takes."""
    ticks, analog, counts, rates, applied, flags = zip(*rows, strict=True)
    return RawSamples(
        tick=np.array(ticks),
        analog=np.array(analog, dtype=np.float64),
        counts=np.array(counts, dtype=np.float64),
        count_rate=np.array(rates, dtype=np.float64),
        applied=np.array(applied, dtype=np.float64),
        flags=np.array(flags),
    )
