"""What lies behind a fake card: a clock, a plant that moves while the clock runs, a watchdog.

It knows neither the backends nor the makers' libraries; a fake library maps its calls onto this.
Time is virtual, and passes while a call blocks, or the computer's own.
"""

import json
import math
import os
import time
from collections import deque
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from daq.hal import Guard, Mode, Phase
from sim_rig.backend import SimulatedDevice, Simulation

SUBSTEPS = 10  # of a tick, in which an output may change
_RC = 1e-3  # s, of the loop-back


@dataclass
class Settings:
    """Of a bench.

    time: virtual or real. phase: samples, whole or with a tenth, by which outputs that the card
    times come behind its inputs; a list has one for each start. loopback: what the motor's current
    input is wired to: nothing, the motor's output by a wire, or over an RC. fault: (method, n): at
    the n-th call of the method of a library the card is gone, or once only. hand: starts in which
    somebody winds the load by ``turns``; let_down: those before which it was let down. journal: a
    file of what became of the outputs. watchdog, overwrites: whether the card has the one, and goes
    on where its buffer is full.
    """

    time: str = "virtual"
    plant: dict = field(default_factory=lambda: {"seed": 5})
    phase: float | list = 0.0
    loopback: str = ""
    fault: tuple = ("", 0)
    once: bool = False
    hand: tuple = ()
    let_down: tuple = ()
    turns: float = 5.0
    journal: str = ""
    watchdog: bool = True
    overwrites: bool = True


SETTINGS = Settings(**json.loads(os.environ.get("RIG_FAKE", "{}")))
_worlds = {}


def world(name):
    """The bench that a card of that name is connected to."""
    if name not in _worlds:
        _worlds[name] = World(SETTINGS)
    return _worlds[name]


def clock():
    """The time of the benches."""
    return next((bench.now() for bench in _worlds.values()), 0.0)


def forget():
    """Power everything down."""
    _worlds.clear()


class MisuseError(AssertionError):
    """A call that the maker's documentation does not allow, and for which it names no error."""


class UnpluggedError(Exception):
    """The card is gone."""


@dataclass
class Writer:
    """Samples to put out. first: the clock's edge of the first; None before it is started."""

    capacity: int
    rows: deque = field(default_factory=deque)
    first: int | None = None
    offset: int = 0  # substeps behind the edge
    ran_dry: bool = False
    again: bool = False  # put out for ever, as some cards do unless told otherwise


@dataclass
class Reader:
    """Samples latched. mode: error, overwrite or discard, where there is no room."""

    capacity: int
    mode: str = "error"
    rows: deque = field(default_factory=deque)
    first: int | None = None
    overflows: int = 0
    failed: bool = False


class World:
    """Plant, outputs, clock and watchdog."""

    def __init__(self, settings):
        self.settings = settings
        self.outputs = np.zeros(2)
        self.history = []  # (time, volts) of every change
        self.calls = {}
        self.gone = False
        self.starts = 0
        self.readers, self.writers = [], []
        self._device = SimulatedDevice(Simulation(**settings.plant))
        self._device.open()
        self._now = 0.0
        self._rate = None
        self._charge = 0.0
        self._timeout = self._deadline = None
        self.expired = False
        self.states = None
        self.count = 0.0
        self.rows_latched = 0

    # --- time ---------------------------------------------------------------------------

    def now(self):
        return self._now if self.settings.time == "virtual" else time.perf_counter()

    def pass_time(self, seconds):
        """The host does something else meanwhile."""
        if self.settings.time == "virtual":
            self._now += seconds
        else:
            time.sleep(seconds)

    def count_call(self, name):
        """A call of a library; UnpluggedError from the one on at which the card is gone."""
        self.calls[name] = self.calls.get(name, 0) + 1
        method, at = self.settings.fault
        if self.gone or (name == method and self.calls[name] == at):
            self.gone = not self.settings.once
            raise UnpluggedError(name)
        self.sync()

    # --- clock --------------------------------------------------------------------------

    def start_clock(self, rate):
        """Edges from now on, the first a period away; a clock that runs keeps running."""
        if self._rate is not None:
            if rate != self._rate:
                raise MisuseError(f"the clock runs at {self._rate} Hz already")
            return
        self._rate, self._origin = rate, self.now()
        self._edge, self._substep = -1, SUBSTEPS  # nothing before the first edge
        self.starts += 1
        if self.starts in self.settings.let_down:
            self._device.open()
        wide = np.full(3, 1e9)
        guard = Guard(np.full(2, -20.0), np.full(2, 20.0), -wide, wide)
        self._device.start(rate * SUBSTEPS, Mode.CLOSED_LOOP, guard)
        self._tick = 0
        winds = self.starts in self.settings.hand
        self._device.announce(Phase.HOMING if winds else Phase.RUN, self.settings.turns)

    def stop_clock(self):
        """No edges any more; the plant stands still until the next."""
        self._rate = None

    def begin(self, item):
        """A reader or writer starts: at the next edge, a writer behind it by the bench's phase."""
        item.first = self._edge + 1
        if isinstance(item, Writer):
            phase = self.settings.phase
            if isinstance(phase, list):
                phase = phase[(self.starts - 1) % len(phase)]
            whole = math.floor(phase + 1e-9)
            reader = min((r.first for r in self.readers if r.first is not None), default=item.first)
            item.first = reader + whole
            item.offset += round((phase - whole) * SUBSTEPS)
            for _ in range(self._edge + 1 - item.first):
                item.rows.popleft()  # put out before the first sample
            self.writers.append(item)
        else:
            self.readers.append(item)

    def end(self, item):
        """A reader or writer stops."""
        item.first = None
        self.readers = [r for r in self.readers if r is not item]
        self.writers = [w for w in self.writers if w is not item]
        if not self.readers and not self.writers:
            self.stop_clock()

    def sync(self):
        """Let everything happen that is due by now."""
        now = self.now()
        self._expire(now)
        if self._rate is None:
            return
        while True:
            due = self._origin + (self._edge + 2) / self._rate
            if due > now + 1e-12:
                break
            self._finish_tick()
            self._next_edge()
        elapsed = (now - self._origin) * self._rate - (self._edge + 1)
        self._run(min(SUBSTEPS, math.floor(elapsed * SUBSTEPS + 1e-9)))

    def wait_for_edge(self):
        """Block until the clock's next edge."""
        if self._rate is None:
            raise MisuseError("waiting for a clock that does not run would never end")
        due = self._origin + (self._edge + 2) / self._rate
        if self.settings.time == "virtual":
            self._now = max(self._now, due)
        else:
            while (left := due - time.perf_counter()) > 0:
                time.sleep(left)
        self.sync()

    def _finish_tick(self):
        self._run(SUBSTEPS)

    def _next_edge(self):
        self._edge += 1
        self._substep = 0
        self._expire(self._origin + (self._edge + 1) / self._rate)
        self._run(1)

    def _run(self, until):
        """Simulate the tick's substeps up to ``until``; the first latches."""
        while self._substep < until:
            here, charge = self._substep, self._charge
            for writer in self.writers:
                if here == min(writer.offset, SUBSTEPS - 1):
                    self._put_out(writer)
            changes = [w.offset for w in self.writers if w.offset > here]
            end = min([until, *changes]) if here else 1
            raw = self._simulate(end - here)
            if here == 0:
                self._latch(raw, charge)
            self._substep = end

    def _simulate(self, n):
        """Substeps with the outputs that there are; what was latched at their beginning."""
        self._device.send(self._tick, np.full((n, len(self.outputs)), self.outputs))
        raw = self._device.receive()
        assert len(raw.tick) == n
        self._tick += n
        keep = (
            math.exp(-n / (self._rate * SUBSTEPS * _RC)) if self.settings.loopback == "rc" else 0.0
        )
        self._charge = keep * self._charge + (1.0 - keep) * self.outputs[0]
        return raw

    def _put_out(self, writer):
        if writer.first is None or self._edge < writer.first or writer.ran_dry:
            return
        if not writer.rows:
            writer.ran_dry = True  # and the converters keep what they had
            return
        row = writer.rows.popleft()
        if writer.again:
            writer.rows.append(row)
        self.set_outputs(row)

    def _latch(self, raw, charge):
        analog = raw.analog[0].copy()
        if self.settings.loopback:
            analog[0] = charge
        self.count = raw.counts[0]
        row = analog, raw.counts[0], raw.count_rate[0]
        self.rows_latched += 1
        for reader in self.readers:
            if reader.first is None or self._edge < reader.first or reader.failed:
                continue
            if len(reader.rows) == reader.capacity:
                reader.overflows += 1
                if reader.mode == "error":
                    reader.failed = True
                    continue
                if reader.mode == "discard":
                    continue
                reader.rows.popleft()
            reader.rows.append(row)

    # --- outputs and watchdog ------------------------------------------------------------

    def set_outputs(self, volts):
        if self.expired:
            return  # it holds them
        self._change(volts)

    def _change(self, volts):
        volts = np.array(volts, dtype=float)
        if not np.array_equal(volts, self.outputs):
            self.note("outputs", volts=volts.tolist(), watchdog=self._timeout)
        self.outputs = volts
        self.history.append((self.now(), volts.tolist()))

    def arm(self, timeout, states):
        self._timeout, self.states = timeout, states
        self._deadline = self.now() + timeout
        self.note("armed", watchdog=timeout, states=list(states))

    def reload(self):
        """Whether it came in time."""
        self._expire(self.now())
        if self.expired or self._timeout is None:
            return not self.expired
        self._deadline = self.now() + self._timeout
        return True

    def clear(self):
        """Forget that the watchdog has expired; one that runs begins anew."""
        self.expired = False
        if self._deadline is not None:
            self._deadline = self.now() + self._timeout

    def disarm(self):
        self._timeout = self._deadline = None
        self.note("disarmed")

    @property
    def armed(self):
        return self._deadline is not None

    def _expire(self, now):
        if self._deadline is not None and not self.expired and now > self._deadline:
            self._change(self.states)
            self.expired = True
            self.note("expired")

    def note(self, what, **facts):
        if self.settings.journal:
            with Path(self.settings.journal).open("a") as journal:
                journal.write(json.dumps({"what": what, "at": time.perf_counter(), **facts}) + "\n")
