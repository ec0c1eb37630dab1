"""Random events for a device, what the Python device makes of them, and what the firmware does.

Both get the same bytes at the same instants, and the same inputs. The Python one is
``daq.serial.emulation.machine``, its guard that of the page on the protocol, in whole numbers.
"""

import math
import random
import struct
import subprocess
from dataclasses import dataclass, field

import numpy as np

from daq.hal import ANALOG_INPUTS, CHANNELS
from daq.serial import codec, messages
from daq.serial.emulation.machine import DeviceMachine
from daq.serial.messages import Channel, Type, Welcome

CLOCK = 1_000_000
SHORTEST = 250  # ticks of the clock
QUEUE, PAYLOAD = 64, 264
INTERLOCK, SATURATED = 8, 32
I32, U32 = (-(2**31), 2**31 - 1), 2**32
STEP = 20.0 / 65536
LOWEST, HIGHEST = (-16384, 0), (16384, 1245)

# --- events ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class Line:
    """Bytes that come from the host."""

    data: bytes

    def pack(self):
        return struct.pack("<BH", 0, len(self.data)) + self.data


@dataclass(frozen=True)
class Wait:
    """Time that passes."""

    ticks: int

    def pack(self):
        return struct.pack("<BI", 1, self.ticks)


@dataclass(frozen=True)
class Inputs:
    """What stands at the inputs from now on; the count changes by ``increment`` at every tick."""

    analog: tuple[int, int, int]
    count: int
    increment: int
    rate: float
    at_end: bool

    def pack(self):
        return struct.pack(
            "<B3iiifB", 2, *self.analog, self.count, self.increment, self.rate, self.at_end
        )


ANY = U32 - 1


@dataclass(frozen=True)
class Takes:
    """So many bytes the line takes from now on; ANY: without an end."""

    bytes: int

    def pack(self):
        return struct.pack("<BI", 3, self.bytes)


@dataclass(frozen=True)
class TimerStops:
    """The timer's interrupt comes no more."""

    def pack(self):
        return b"\x04"


@dataclass(frozen=True)
class Flood:
    """Bytes that come from the host while the main loop hangs."""

    data: bytes

    def pack(self):
        return struct.pack("<BH", 5, len(self.data)) + self.data


class Author:
    """Draws sequences in which most requests are ones that a device carries out."""

    def __init__(self, seed):
        self._random = random.Random(seed)
        self._session = self._seq = self._run = self._next = 0

    def sequence(self):
        """A dozen events or two."""
        self._session, self._seq, self._run, self._next = self._new_session(), 0, 0, 0
        chance = self._random
        events = [Line(self._hello())] if chance.random() < 0.95 else []
        if chance.random() < 0.8:
            events += [self._inputs(quiet=True), Line(self._start())]
            if chance.random() < 0.9:
                events.append(Line(self._commands() + self._go()))
        for _ in range(chance.randint(3, 14)):
            events.append(self._event())
        return [*events, Wait(chance.choice((0, 1, 5000)))]

    def _new_session(self):
        return self._random.choice((1, 2, 0x1234, 0xFFFF))

    def _event(self):
        kind = self._random.random()
        if kind < 0.36:
            return self._wait()
        if kind < 0.46:
            return self._inputs(quiet=self._random.random() < 0.6)
        frames = b"".join(self._frame() for _ in range(self._random.choice((1, 1, 1, 2, 3))))
        if kind > 0.95:
            frames = self._damaged(frames)
        return Line(frames)

    def _wait(self):
        chance = self._random
        longest = chance.choice((3_000, 3_000, 20_000, 60_000, 99_000, 101_000))
        if chance.random() < 0.04:
            longest = 2_500_000
        return Wait(chance.choice((0, 1, 249, 250, longest, chance.randint(0, longest))))

    def _inputs(self, quiet):
        chance = self._random
        if quiet:
            return Inputs((0, 5, -7), chance.randint(-5, 5), chance.choice((0, 0, 1)), 0.0, False)
        analog = tuple(chance.choice((0, 99, 100, 101, -100, -101, *I32)) for _ in range(3))
        count = chance.choice((0, 3, 10, 1000, *I32))
        increment = chance.choice((0, 1, -1, 4, 5, -5, 2**30, *I32))
        rate = chance.choice((0.0, 7.5, -7.5, 8.0, math.inf, -math.inf, math.nan))
        return Inputs(analog, count, increment, rate, chance.random() < 0.3)

    # --- frames ------------------------------------------------------------------------------

    def _frame(self):
        chance = self._random
        makers = (
            (self._commands, 8), (self._ping, 3), (self._start, 3), (self._go, 3), (self._safe, 1),
            (self._stop, 2), (self._clear, 1), (self._announce, 1), (self._hello, 1),
            (self._odd, 2),
        )  # fmt: skip
        (maker,) = chance.choices([m for m, _ in makers], [weight for _, weight in makers])
        return maker()

    def _encode(self, kind, payload, seq=0):
        chance = self._random
        session = self._session
        if chance.random() < 0.02:
            session = chance.choice((0, 1, 2, 7))
        if chance.random() < 0.02:
            payload = payload[:-1] if chance.random() < 0.5 else payload + b"\0"
        return codec.encode(kind, session, seq, payload[:PAYLOAD])

    def _request(self, kind, payload):
        """The next number mostly; one before, or one far off, now and then."""
        chance = self._random
        step = chance.choices((1, 0, -1, 2, 0x7FFF, 0x8000), (40, 3, 1, 1, 1, 1))[0]
        self._seq = (self._seq + step) % 65536
        return self._encode(kind, payload, self._seq)

    def _hello(self):
        chance = self._random
        if chance.random() < 0.3:
            self._session = self._new_session()
        version = chance.choice((1, 1, 1, 1, 1, 1, 2, 0))
        magic = b"HRIG" if chance.random() < 0.97 else b"HRIg"
        payload = struct.pack("<4sHH32s", magic, version, 0, b"somebody")
        if chance.random() < 0.1:
            payload = payload[: chance.randint(0, 40)]
        return codec.encode(Type.HELLO, self._session, chance.randint(0, 65535), payload)

    def _start(self):
        chance = self._random
        self._run, self._next = chance.choice((self._run, chance.randint(0, 3))), 0
        mode = chance.choices((0, 1, 2), (10, 10, 1))[0]
        period = chance.choices((250, 500, 1250, 10_000, 300_000, 249, 0), (9, 9, 9, 3, 1, 1, 1))[0]
        watchdog = chance.choices((0, 20, 100, 10_000, 10_001), (4, 4, 4, 2, 1))[0]
        low = chance.choice(((-16384, 0), (-100, -10), (-32768, -32768), (0, 0)))
        high = chance.choice(((16384, 1245), (100, 10), (32767, 32767), (0, 0)))
        if chance.random() < 0.05:
            low, high = (1, 0), (5, -1)
        analog = [I32[0]] * 3, [I32[1]] * 3
        counts, rate, step = I32, math.inf, U32 - 1
        if chance.random() < 0.4:
            analog = [-100] * 3, [100] * 3
            counts = chance.choice((I32, (-10, 10), (10, -10)))
            rate = chance.choice((math.inf, 7.5, 0.0, -1.0, math.nan))
            step = chance.choice((U32 - 1, 4, 0, 2**31))
        payload = struct.pack(
            "<HBBIHH2h2h3i3iiifI", self._run, mode, chance.randint(0, 1), period, watchdog, 0,
            *low, *high, *analog[0], *analog[1], *counts, rate, step,
        )  # fmt: skip
        return self._request(Type.START, payload)

    def _run_number(self):
        run = self._run if self._random.random() < 0.95 else self._random.randint(0, 3)
        return struct.pack("<H", run)

    def _go(self):
        return self._request(Type.GO, self._run_number())

    def _stop(self):
        return self._request(Type.STOP, self._run_number())

    def _safe(self):
        return self._request(Type.SAFE, b"")

    def _clear(self):
        return self._request(Type.CLEAR, b"")

    def _announce(self):
        phase = self._random.choice((0, 1, 2, 3, 4, 5, 6, 255))
        return self._request(Type.ANNOUNCE, struct.pack("<B3xf", phase, self._random.random()))

    def _commands(self):
        chance = self._random
        n = chance.choice((0, 1, 1, 1, 5, 20, 40, 64))
        offset = chance.choices((0, -1, 1, -10, 10, 64, 2**32 - 1), (30, 3, 3, 1, 1, 1, 1))[0]
        first = (self._next + offset) % U32
        self._next = min(first + n, U32 - 100) if first < 2**31 else self._next
        codes = [
            (chance.choice((0, 1, -99, 100, 101, 20_000, -32768)), chance.choice((0, 9, 11, -3)))
            for _ in range(n)
        ]
        count = n if chance.random() < 0.98 else n + 1
        payload = self._run_number() + struct.pack("<HI", count, first)
        payload += b"".join(struct.pack("<2h", *pair) for pair in codes)
        return self._encode(Type.COMMANDS, payload, chance.randint(0, 65535))

    def _ping(self):
        chance = self._random
        return self._encode(
            Type.PING, struct.pack("<Q", chance.getrandbits(64)), chance.getrandbits(16)
        )

    def _odd(self):
        """Types that a host does not send, with any payload."""
        chance = self._random
        kind = chance.choice((0x00, 0x08, 0x0F, 0x12, 0x7F, 0x81, 0x82, 0x90, 0xFF))
        return self._request(kind, chance.randbytes(chance.choice((0, 2, 8, 60, PAYLOAD))))

    def _damaged(self, frames):
        chance = self._random
        data = bytearray(frames)
        for _ in range(chance.randint(1, 4)):
            at = chance.randrange(len(data))
            data[at] ^= 1 << chance.randrange(8)
        return bytes(data[chance.randrange(2) :]) + chance.randbytes(chance.randrange(5))


# --- the Python device ------------------------------------------------------------------------


@dataclass
class Trace:
    """What an event came to. frames: (type, session, seq, payload) in order, samples left out, and
    numbers of STATUS. samples: (tick, record, time). applied: (tick, motor, brake) of every tick.
    fed: how often the firmware has fed the independent watchdog.
    """

    frames: list = field(default_factory=list)
    samples: dict = field(default_factory=dict)
    applied: list = field(default_factory=list)
    state: int = 0
    latch: int = 0
    outputs: tuple = (0, 0)
    announced: tuple = (0, 0.0)
    fed: int = 0


class Board:
    """Inputs as told; the guard by the page."""

    def __init__(self):
        self.inputs = Inputs((0, 0, 0), 0, 0, 0.0, False)
        self.count = 0
        self.outputs = [0, 0]
        self.applied = []
        self.announced = (0, 0.0)
        self._tripped = True

    def connect(self):
        self.outputs = [0, 0]

    def announce(self, phase, turns):
        self.announced = (phase, turns)

    def start(self, rate, guard):
        self._guard, self._tripped = guard, False
        self._tick, self._first, self._before = 0, None, None
        self.zero()

    def play(self, commands):
        records = np.zeros(len(commands), messages.SAMPLE_DTYPE)
        for record, command in zip(records, commands.tolist(), strict=True):
            flags = self._latch(record)
            if not self._tripped and self._beyond():
                self._tripped = True
                flags |= INTERLOCK
            self.outputs = [0, 0] if self._tripped else command
            record["applied"], record["flags"] = self.outputs, flags
            self.applied.append((self._tick, *self.outputs))
            self._tick += 1
        return records

    def zero(self):
        self.outputs = [0, 0]

    def _latch(self, record):
        record["analog"], record["counts"] = self.inputs.analog, self.count
        record["count_rate"] = self.inputs.rate
        self._latched = self.count
        self.count = _wrapped(self.count + self.inputs.increment)
        return SATURATED * self.inputs.at_end

    def _beyond(self):
        guard, count = self._guard, self._latched
        if self._first is None:
            self._first = self._before = count
        step, self._before = abs(_wrapped(count - self._before)), count
        bounds = zip(guard.analog_low, self.inputs.analog, guard.analog_high, strict=True)
        return not (
            all(low <= code <= high for low, code, high in bounds)
            and guard.counts_low <= _wrapped(count - self._first) <= guard.counts_high
            and abs(self.inputs.rate) <= guard.count_rate
            and step <= guard.count_step
        )


def _wrapped(count):
    return (count + 2**31) % U32 - 2**31


def identity():
    """What the native board says of itself."""
    inputs = [Channel(name, "V", STEP, 0.0, -10.0, 10.0) for name in ANALOG_INPUTS]
    ends = zip(CHANNELS, LOWEST, HIGHEST, strict=True)
    outputs = [Channel(name, "V", STEP, 0.0, low * STEP, high * STEP) for name, low, high in ends]
    counter = Channel("encoder", "count", 1.0, 0.0, *map(float, I32))
    return Welcome(
        "host", "hybrid-rig 1", "0", CLOCK, CLOCK / SHORTEST, QUEUE, PAYLOAD, 100, 10_000,
        (*inputs, *outputs, counter),
    )  # fmt: skip


def expected(events):
    """What the Python device makes of a sequence, a Trace an event."""
    board = Board()
    machine = DeviceMachine(board, identity())
    now, traces = 0, []
    for event in events:
        board.applied, sent = [], []
        if isinstance(event, Line):
            machine.receive(event.data, now)
        elif isinstance(event, Inputs):
            board.inputs, board.count = event, event.count
        else:
            now = _pass(machine, now, now + event.ticks, sent)
        data = b"".join([*sent, *iter(machine.take, None)])
        trace = Trace(applied=board.applied, state=int(machine.state), latch=int(machine.latch))
        trace.outputs, trace.announced = tuple(board.outputs), board.announced
        _sort(data, trace)
        traces.append(trace)
    return traces


def _pass(machine, now, end, sent):
    """Let time pass as a program around the machine does: from event to event."""
    machine.poll(now)
    while (event := machine.next_event()) is not None and event <= end:
        machine.poll(max(event, now))
        now = max(event, now)
        sent += iter(machine.take, None)
    machine.poll(end)
    return end


def _sort(data, trace):
    """Frames that a device sent, into a trace."""
    for kind, session, seq, payload in codec.Decoder().feed(data):
        if kind == Type.SAMPLES:
            block = messages.Block.unpack(payload)
            for index, record in enumerate(block.records):
                trace.samples[block.status.run, block.first + index] = record.tobytes()
        else:
            trace.frames.append((kind, session, 0 if kind == Type.STATUS else seq, payload))


# --- the firmware -------------------------------------------------------------------------------


class Firmware:
    """The native ``replay`` program: sequences in, traces out."""

    def __init__(self, program, **environment):
        self._process = subprocess.Popen(
            [program],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env=environment or None,
        )

    def play(self, events):
        """What the firmware makes of a sequence, a Trace an event."""
        script = b"".join(event.pack() for event in events)
        self._process.stdin.write(struct.pack("<I", len(script)) + script)
        self._process.stdin.flush()
        head = self._process.stdout.read(4)
        assert len(head) == 4, self._process.stderr.read().decode()
        data = self._process.stdout.read(struct.unpack("<I", head)[0])
        traces, place = [], 0
        for _ in events:
            trace, place = self._trace(data, place)
            traces.append(trace)
        return traces

    def close(self):
        """End it; raises what a sanitizer has said."""
        self._process.stdin.close()
        status = self._process.wait(timeout=30)
        errors = self._process.stderr.read().decode()
        self._process.stdout.close()
        self._process.stderr.close()
        assert status == 0, errors

    def _trace(self, data, place):
        trace = Trace()
        (n,) = struct.unpack_from("<I", data, place)
        _sort(data[place + 4 : place + 4 + n], trace)
        place += 4 + n
        (n,) = struct.unpack_from("<H", data, place)
        rows = struct.iter_unpack("<I2h", data[place + 2 : place + 2 + 8 * n])
        trace.applied = list(rows)
        place += 2 + 8 * n
        end = struct.Struct("<BBhhBfI")
        trace.state, trace.latch, *rest, trace.fed = end.unpack_from(data, place)
        trace.outputs, trace.announced = tuple(rest[:2]), tuple(rest[2:])
        return trace, place + end.size


def difference(events, firmware):
    """Where the firmware and the Python device differ, in words; "" where they do not."""
    pairs = zip(events, expected(events), firmware.play(events), strict=True)
    for place, (event, python, c) in enumerate(pairs):
        for name in ("frames", "applied", "state", "latch", "outputs"):
            if getattr(python, name) != getattr(c, name):
                values = getattr(python, name), getattr(c, name)
                return f"event {place}, {event}: {name}: Python {values[0]}, C {values[1]}"
        both = python.samples.keys() & c.samples.keys()
        if wrong := [key for key in both if python.samples[key] != c.samples[key]]:
            key = wrong[0]
            return f"event {place}: sample {key}: {python.samples[key]} and {c.samples[key]}"
    return ""
