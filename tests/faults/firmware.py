"""The tick of a device, from the page on the serial protocol: latch, then apply.

Volts and counts; both adapters run it, one with codes around it.
"""

import math
from typing import NamedTuple

CLAMPED, HELD, INTERLOCK, UNDERFLOW, SATURATED = 1, 2, 8, 16, 32
NONE, SAFE, UNDERRUN, TRIPPED, WATCHDOG = range(5)  # latches


class Limits(NamedTuple):
    """The guard: volts (2,), (2,), (3,), (3,), and counts, as in ``daq.hal.Guard``."""

    command_low: tuple[float, ...]
    command_high: tuple[float, ...]
    analog_low: tuple[float, ...]
    analog_high: tuple[float, ...]
    counts_low: float = -math.inf
    counts_high: float = math.inf
    count_rate: float = math.inf
    count_step: float = math.inf


class Row(NamedTuple):
    """One sample."""

    tick: int
    analog: list[float]
    count: int
    rate: float
    applied: list[float]
    flags: int


class Ticker:
    """Tick by tick on a board, from one start to the next."""

    def __init__(self, board, period, closed, limits):
        self.board, self.period, self.closed, self.limits = board, period, closed, limits
        self.tick = 0
        self.latch = NONE
        self.last = [0.0, 0.0]
        self._queue = {}
        self._count = None  # at tick 0, and at the tick before

    def send(self, tick, volts):
        """A command for a tick; one that is past is dropped. Whether it came in time."""
        if tick < self.tick:
            return False
        if self.latch == NONE or self.board.now.ignores_safe:
            self._queue[tick] = volts
        return True

    def waiting(self):
        """How many commands are queued."""
        return len(self._queue)

    def make_safe(self, latch):
        """Zero outputs for this reason, unless there is one already."""
        if self.board.now.ignores_safe:
            return
        self.latch = self.latch or latch
        self._queue.clear()
        self.last = [0.0, 0.0]
        self.board.told_safe()

    def run(self):
        """One tick; its Row."""
        analog, count, rate, flags = self.board.latch()
        volts, flags = self._command(flags)
        if self.latch == NONE and self._beyond(analog, count, rate):
            flags = flags & SATURATED | INTERLOCK
            self.make_safe(TRIPPED)
            volts = self.last
        self._count = (count if self._count is None else self._count[0], count)
        self.last = volts
        if any(volts):
            self.board.told_volts()
        self.board.drive(*volts, self.period)
        row = Row(self.tick, analog, count, rate, self.board.now.echo(volts), flags)
        self.tick += 1
        return row

    def _command(self, flags):
        command = self._queue.pop(self.tick, None)
        if self.latch != NONE:
            return [0.0, 0.0], flags | UNDERFLOW * (self.latch == UNDERRUN)
        if command is not None:
            ends = zip(self.limits.command_low, command, self.limits.command_high, strict=True)
            volts = [min(max(low, value), high) for low, value, high in ends]
            return volts, flags | CLAMPED * (volts != list(command))
        if self.closed:
            return self.last, flags | HELD
        self.make_safe(UNDERRUN)
        return self.last, flags | UNDERFLOW

    def _beyond(self, analog, count, rate):
        limits = self.limits
        ends = zip(limits.analog_low, analog, limits.analog_high, strict=True)
        if any(value < low or value > high for low, value, high in ends):
            return True
        first, before = self._count or (count, count)
        return (
            not limits.counts_low <= count - first <= limits.counts_high
            or abs(rate) > limits.count_rate
            or abs(count - before) > limits.count_step
        )
