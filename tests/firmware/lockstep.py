"""A host and a plant in the firmware's own virtual time, an exchange of QEMU after the other."""

import itertools
import math
import struct
from dataclasses import dataclass, field

from daq.serial.emulation.qemu import EmulatedFirmware, InputCodes
from tests.faults import line
from tests.firmware.build import make, needs

CLOCK = 1_000_000  # Hz
PERIOD = 250  # ticks of the clock: 4 kHz
PING_EVERY = 25_000  # ticks of the clock
IDLE, ARMED, RUNNING = range(3)
_MOST_BYTES = 512  # to the firmware in an exchange
_CHUNK = 64  # commands of a frame
_AHEAD = 200  # ticks
_PATIENCE = 3000  # exchanges for an answer
_SAMPLE = struct.Struct("<3iif2hI")
_SESSIONS = itertools.cycle(range(1, 65536))
_STATUS = struct.Struct("<HBBIIIII")


@dataclass(frozen=True)
class Sample:
    """A row of SAMPLES."""

    tick: int
    analog: tuple[int, int, int]
    count: int
    rate: float
    applied: tuple[int, int]
    flags: int


@dataclass
class Limits:
    """Of START, in codes and counts."""

    lowest: tuple[int, int] = (-16384, 0)
    highest: tuple[int, int] = (16384, 1245)
    analog_low: tuple[int, int, int] = (-(2**31),) * 3
    analog_high: tuple[int, int, int] = (2**31 - 1,) * 3
    counts_low: int = -(2**31)
    counts_high: int = 2**31 - 1
    rate: float = math.inf
    step: int = 2**32 - 1

    def pack(self, run, mode, watchdog):
        return struct.pack(
            "<HBxIHxx2h2h3i3iiifI", run, mode, PERIOD, watchdog, *self.lowest, *self.highest,
            *self.analog_low, *self.analog_high, self.counts_low, self.counts_high, self.rate,
            self.step,
        )  # fmt: skip


@dataclass
class Played:
    """A run. samples: as they came. given: what was answered at every tick. outputs: what the
    outputs were after every tick. times: ticks of the clock between two of them. costs:
    instructions of every tick. statuses: of all SAMPLES.
    """

    samples: list = field(default_factory=list)
    given: list = field(default_factory=list)
    outputs: list = field(default_factory=list)
    times: list = field(default_factory=list)
    costs: list = field(default_factory=list)
    statuses: list = field(default_factory=list)


class Host:
    """A host that says what it is told to, by frames of ``tests.faults.line``.

    plant: ``read(ticks, outputs) -> InputCodes``, called at every exchange. mute: whether it says
    nothing. damage: a function of bytes sent.
    """

    def __init__(self, firmware, plant):
        self._firmware, self.plant = firmware, plant
        self._number = self._run = 0
        self._out = self._heard = b""
        self._now = self._pinged = 0
        self.mute, self.damage = False, bytes
        self.frames = []
        self._played, self._at_tick = Played(), lambda tick: None

    def connect(self):
        """A new session."""
        self._session = next(_SESSIONS)
        self.send(line.HELLO, struct.pack("<4sH34x", b"HRIG", 1))
        return self._until(line.WELCOME)

    def request(self, kind, payload=b""):
        """A request; its result."""
        self._number = (self._number + 1) % 65536
        self.send(kind, payload)
        return self._until(line.REPLY)[1]

    def play(self, n, commands, limits, closed=True, watchdog=100, at_tick=lambda tick: None):
        """A run of n ticks: ``commands`` (codes) from tick 0 on; ``at_tick(tick)`` at each."""
        self._run, self._played, self._at_tick = self._run % 65535 + 1, Played(), at_tick
        played = self._played
        assert self.request(line.START, limits.pack(self._run, int(closed), watchdog)) == line.OK
        sent = self._send_commands(commands, 0, _AHEAD)
        assert self.request(line.GO, struct.pack("<H", self._run)) == line.OK
        while not played.samples or played.samples[-1].tick < n - 1:
            self.step()
            if not self.mute and sent < min(len(commands), len(played.given) + _AHEAD):
                sent = self._send_commands(commands, sent, sent + _CHUNK)
            for frame in self._new(line.SAMPLES):
                self._note(frame.payload, played)
        self._played, self._at_tick = Played(), lambda tick: None
        if not self.mute:
            self.request(line.STOP, struct.pack("<H", self._run))
        return played

    def step(self):
        """One exchange; what the firmware told and what it was answered."""
        exchange = self._firmware.exchange()
        self._now += exchange.ticks
        if exchange.state == RUNNING and self._now - self._pinged >= PING_EVERY and not self.mute:
            self._pinged = self._now
            self.send(line.PING, bytes(8))
        reading = self.plant.read(exchange.ticks, exchange.outputs)
        if exchange.state == RUNNING:
            self._tick(exchange, reading)
        data, self._out = self._out[:_MOST_BYTES], self._out[_MOST_BYTES:]
        self._firmware.answer(reading, self.damage(data))
        self._hear(exchange.line)
        return exchange, reading

    def _tick(self, exchange, reading):
        """This exchange is that of a tick; it says what the one before has put out."""
        played = self._played
        if played.given:
            played.outputs.append(exchange.outputs)
            played.times.append(exchange.ticks)
            played.costs.append(exchange.cost)
        played.given.append(reading)
        self._at_tick(len(played.given) - 1)

    def send(self, kind, payload):
        """A frame, in the next exchanges."""
        self._out += line.encoded(line.Frame(kind, self._session, self._number, payload))

    def _send_commands(self, commands, begin, end):
        for first in range(begin, end, _CHUNK):
            part = commands[first : min(first + _CHUNK, end)]
            codes = b"".join(struct.pack("<2h", *pair) for pair in part)
            if part:
                self.send(line.COMMANDS, struct.pack("<HHI", self._run, len(part), first) + codes)
        return end

    def _hear(self, data):
        *codes, self._heard = (self._heard + data).split(b"\0")
        self.frames += [line.decoded(code) for code in codes if code]
        assert None not in self.frames, "the firmware sent what is no frame"

    def _new(self, kind):
        mine = (kind, self._session)
        matching = [frame for frame in self.frames if (frame.kind, frame.session) == mine]
        self.frames = [frame for frame in self.frames if (frame.kind, frame.session) != mine]
        return matching

    def _until(self, kind):
        for _ in range(_PATIENCE):
            self.step()
            if frames := self._new(kind):
                return frames[-1].payload
        raise AssertionError(f"no answer of type {kind:#x}")

    def _note(self, payload, played):
        status = _STATUS.unpack_from(payload)
        first, n, _, _ = struct.unpack_from("<IHHQ", payload, 24)
        rows = _SAMPLE.iter_unpack(payload[40:])
        if status[0] != self._run:
            return
        played.statuses.append(status)
        assert len(payload) == 40 + 28 * n
        for tick, (a, b, c, count, rate, motor, brake, flags) in enumerate(rows, start=first):
            played.samples.append(Sample(tick, (a, b, c), count, rate, (motor, brake), flags))


def firmware(**options):
    """The ELF in QEMU, in virtual time; skips where tools lack."""
    needs("make", "arm-none-eabi-gcc", "qemu-system-arm")
    return EmulatedFirmware(elf(), virtual=True, **options)


def elf():
    """The firmware of the board in QEMU, built."""
    return make(BOARD="qemu") / "qemu" / "rig.elf"


__all__ = ["Host", "InputCodes", "Limits", "Played", "elf", "firmware"]
