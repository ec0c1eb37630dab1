"""Messages in the frames: types, layouts and numbers.

All layouts are fixed, little-endian and without gaps that are not named; docs/serial-protocol.md
has them as byte tables. Unpacking raises one of ``MALFORMED`` for a payload of the wrong length or
with a number that means nothing; a receiver counts it like a frame with a wrong CRC.
"""

import enum
import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
import numpy.typing as npt

from daq.hal import ANALOG_INPUTS, CHANNELS, Mode

MALFORMED = (struct.error, ValueError, IndexError)  # raised by a payload that is not of its type

VERSION = 1
WATCHDOG_ZEROES = "A device that follows the protocol zeroes its outputs when it hears nothing"
MAGIC = b"HRIG"

COMMAND_DTYPE = np.dtype("<i2")  # a command on the wire: a converter code per channel and tick
SAMPLE_DTYPE = np.dtype(
    [
        ("analog", "<i4", (len(ANALOG_INPUTS),)),
        ("counts", "<i4"),
        ("count_rate", "<f4"),
        ("applied", "<i2", (len(CHANNELS),)),
        ("flags", "<u4"),
    ]
)
"""One sample on the wire, 28 bytes: converter codes, quadrature counts and their rate [1/s]."""

Records = npt.NDArray[np.void]
Codes = npt.NDArray[np.int16]

CHANNEL_NAMES = (*ANALOG_INPUTS, *CHANNELS, "encoder")  # in the order of the channel table

# What the numbers of a WELCOME can be; the queue is more than a frame of commands, and less than
# a host is asked for memory.
LEGAL = {
    "clock": (1_000, 2**32 - 1),
    "max_rate": (1.0, 1e6),
    "queue": (16, 1 << 20),
    "max_payload": (64, 4096),
    "watchdog_default": (1, 60_000),
    "watchdog_longest": (10, 60_000),
}
_PLAUSIBLE = 0.1, 1000.0  # V, of all of a converter's codes
_LEAST_CODES = 16  # of an input


class Type(enum.IntEnum):
    """First byte of a frame. Below 0x80 from the host, from 0x80 on from the device."""

    HELLO = 0x01
    START = 0x02
    GO = 0x03
    STOP = 0x04
    SAFE = 0x05
    CLEAR = 0x06
    ANNOUNCE = 0x07
    LAW = 0x08
    COMMANDS = 0x10
    PING = 0x11
    WELCOME = 0x81
    REPLY = 0x82
    SAMPLES = 0x90
    PONG = 0x91
    STATUS = 0x92


class State(enum.IntEnum):
    """State of a device."""

    IDLE = 0
    ARMED = 1
    RUNNING = 2


class Latch(enum.IntEnum):
    """Why a device's outputs are held at zero."""

    NONE = 0
    SAFE = 1
    UNDERFLOW = 2
    INTERLOCK = 3
    WATCHDOG = 4


class Result(enum.IntEnum):
    """Answer to a request."""

    OK = 0
    NO_SESSION = 1
    WRONG_STATE = 2
    BAD_VALUE = 3
    LATCHED = 4
    UNKNOWN = 5


# By their numbers on the wire; quicker than the enums.
_STATES, _LATCHES, _MODES = tuple(State), tuple(Latch), tuple(Mode)

NOTHING = struct.Struct("<")  # payload of SAFE and CLEAR
RUN = struct.Struct("<H")  # payload of GO and STOP: the run
ANNOUNCE = struct.Struct("<B3xf")  # the phase's number in the order of daq.hal.Phase, and turns
PING = struct.Struct("<Q")  # the host's own time, which the device only returns
_VERSIONED = struct.Struct("<4sH")
_HELLO = struct.Struct("<4sH2x32s")
_WELCOME = struct.Struct("<4sHBBIfIHHH2x32s32s32s")
_CHANNEL = struct.Struct("<16s8sdddd")
_STATUS = struct.Struct("<HBBIIIII")
_REPLY = struct.Struct("<BB2x")
_START = struct.Struct("<HBxIH2x2h2h3i3i2ifI")
_COMMANDS = struct.Struct("<HHI")
_LAW = struct.Struct("<HBxIH2xi6f")
_PONG = struct.Struct("<QQQ")
_SAMPLES = struct.Struct("<IH2xQ")
_SAMPLES_HEAD = struct.Struct(_STATUS.format + _SAMPLES.format[1:])

COMMANDS_OVERHEAD = _COMMANDS.size
SAMPLES_OVERHEAD = _SAMPLES_HEAD.size


def version_of(payload: bytes) -> int:
    """Protocol version that a HELLO or WELCOME of any version names."""
    magic, version = _VERSIONED.unpack_from(payload)
    if magic != MAGIC:
        raise ValueError("neither HELLO nor WELCOME")
    return int(version)


def _text(field: bytes) -> str:
    return field.split(b"\0", 1)[0].decode("utf-8", "replace")


def pack_hello(host: str) -> bytes:
    """Payload of HELLO, which opens a session. host: who it is, for a device's own log."""
    return _HELLO.pack(MAGIC, VERSION, host.encode()[:31])


@dataclass(frozen=True)
class Channel:
    """A row of the channel table: value = scale * code + offset, in ``unit``.

    low, high: what the input can measure, or the most that the output will ever give.
    """

    name: str
    unit: str
    scale: float
    offset: float
    low: float
    high: float

    def complaint(self) -> str | None:
        """What no converter or counter can mean by a value, with what is legal."""
        numbers = (self.scale, self.offset, self.low, self.high)
        if not all(map(math.isfinite, numbers)) or self.scale == 0.0:
            fields = "scale {:g}, offset {:g}, range {:g} to {:g}".format(*numbers)
            return f"channel {self.name}: {fields}; legal are finite numbers and a scale beside 0"
        if not self.low < self.high:
            return f"channel {self.name}: its range is {self.low:g} to {self.high:g}"
        if self.name in (*ANALOG_INPUTS, *CHANNELS) and (problem := self._implausible()):
            return f"channel {self.name}: {problem}; mend its scale in the channel table"
        if self.name == "encoder" and self.scale != 1.0:
            return f"channel encoder: its scale is {self.scale:g}; legal is one count per code"
        if self.name in CHANNELS and (self.offset != 0.0 or not self.low <= 0.0 <= self.high):
            return f"channel {self.name}: its code 0 is not 0 V, which is what safe means"
        return None

    def _implausible(self) -> str | None:
        """What no converter's volts are: all of an output's codes, or an input's range."""
        if self.name in CHANNELS:
            volts, what = abs(self.scale) * 2.0**16, "the 65536 codes of the output span"
        else:
            volts, what = self.high - self.low, "the input's range is"
            codes = volts / abs(self.scale)
            if not _LEAST_CODES <= codes <= 2.0**32:
                return f"a scale of {self.scale:g} V makes {codes:.3g} codes of its {volts:g} V"
        least, most = _PLAUSIBLE
        if least <= volts <= most:
            return None
        return f"{what} {volts:.3g} V; legal are {least:g} to {most:g} V"

    def pack(self) -> bytes:
        """The row's 56 bytes."""
        name, unit = self.name.encode()[:15], self.unit.encode()[:7]
        return _CHANNEL.pack(name, unit, self.scale, self.offset, self.low, self.high)


@dataclass(frozen=True)
class Welcome:
    """A device says who it is and what it can do.

    clock: ticks of its clock per second [Hz]. max_rate [Hz]. queue: commands it holds ahead.
    max_payload: longest it takes. watchdog_default, watchdog_longest [ms]. channels: in
    ``CHANNEL_NAMES`` order.
    """

    device: str
    firmware: str
    serial: str
    clock: int
    max_rate: float
    queue: int
    max_payload: int
    watchdog_default: int
    watchdog_longest: int
    channels: tuple[Channel, ...]
    latch: Latch = Latch.NONE
    version: int = VERSION

    def pack(self) -> bytes:
        """Payload of the frame."""
        head = (MAGIC, self.version, len(self.channels), self.latch, self.clock, self.max_rate)
        limits = (self.queue, self.max_payload, self.watchdog_default, self.watchdog_longest)
        names = (name.encode()[:31] for name in (self.device, self.firmware, self.serial))
        rows = b"".join(channel.pack() for channel in self.channels)
        return _WELCOME.pack(*head, *limits, *names) + rows

    @classmethod
    def unpack(cls, payload: bytes) -> Self:
        """The message of this version."""
        fields = _WELCOME.unpack_from(payload)
        _, version, n, latch = fields[:4]
        facts: tuple[int, float, int, int, int, int] = fields[4:10]
        device, firmware, serial = map(_text, fields[10:])
        rows = list(_CHANNEL.iter_unpack(payload[_WELCOME.size :]))
        if len(rows) != n:
            raise ValueError("another number of channels")
        channels = tuple(Channel(_text(name), _text(unit), *row) for name, unit, *row in rows)
        return cls(device, firmware, serial, *facts, channels, Latch(latch), version)

    def complaint(self) -> str | None:
        """What no device can mean by a field, with its name, value and legal values."""
        names = tuple(channel.name for channel in self.channels)
        if names != CHANNEL_NAMES:
            had = ", ".join(names) or "none"
            return f"it has the channels {had}, not {', '.join(CHANNEL_NAMES)}"
        for name, (least, most) in LEGAL.items():
            value = getattr(self, name)
            if not least <= value <= most:  # NaN is not within
                return f"its {name} is {value:g}; legal are {least:g} to {most:g}"
        if self.watchdog_default > self.watchdog_longest:
            shorter = f"watchdog_longest of {self.watchdog_longest} ms"
            return f"its watchdog_default of {self.watchdog_default} ms is beyond its {shorter}"
        complaints = (channel.complaint() for channel in self.channels)
        return next(filter(None, complaints), None)


class Status(NamedTuple):
    """State of a device, in each REPLY, SAMPLES, PONG and STATUS.

    tick: the next to be latched. queued_until: tick after the last command received in order.
    credit_until: first tick for which there is no room yet. late: commands that came after
    their tick. overflow: samples dropped because the line took no more.
    """

    run: int
    state: State
    latch: Latch
    tick: int
    queued_until: int
    credit_until: int
    late: int
    overflow: int

    def pack(self) -> bytes:
        """The 24 bytes."""
        return _STATUS.pack(*self)

    @classmethod
    def of(cls, run: int, state: int, latch: int, *counts: int) -> Self:
        """The numbers of a payload."""
        return cls(run, _STATES[state], _LATCHES[latch], *counts)

    @classmethod
    def unpack(cls, payload: bytes) -> Self:
        """A STATUS payload."""
        return cls.of(*_STATUS.unpack(payload))


class Reply(NamedTuple):
    """A device's answer to a request, which carries the request's seq in its header."""

    request: int
    result: Result
    status: Status

    def pack(self) -> bytes:
        """Payload of the frame."""
        return _REPLY.pack(self.request, self.result) + self.status.pack()

    @classmethod
    def unpack(cls, payload: bytes) -> Self:
        """The message."""
        request, result = _REPLY.unpack_from(payload)
        return cls(request, Result(result), Status.unpack(payload[_REPLY.size :]))


class CodedGuard(NamedTuple):
    """A ``daq.hal.Guard`` in converter codes and counts; a range's ends: not watched."""

    command_low: Sequence[int]
    command_high: Sequence[int]
    analog_low: Sequence[int]
    analog_high: Sequence[int]
    counts_low: int
    counts_high: int
    count_rate: float
    count_step: int


class Start(NamedTuple):
    """Arm a run. period: clock ticks per sample. watchdog [ms].

    A device narrows the guard's clamps to its own limits.
    """

    run: int
    mode: Mode
    period: int
    watchdog: int
    guard: CodedGuard

    def pack(self) -> bytes:
        """Payload of the frame."""
        command_low, command_high, analog_low, analog_high, *counts = self.guard
        codes = (*command_low, *command_high, *analog_low, *analog_high)
        mode = _MODES.index(self.mode)
        return _START.pack(self.run, mode, self.period, self.watchdog, *codes, *counts)

    @classmethod
    def unpack(cls, payload: bytes) -> Self:
        """The message."""
        run, mode, period, watchdog, *codes = _START.unpack(payload)
        guard = CodedGuard(codes[:2], codes[2:4], codes[4:7], codes[7:10], *codes[10:])
        return cls(run, _MODES[mode], period, watchdog, guard)


def pack_commands(run: int, first: int, codes: Codes) -> bytes:
    """Payload of COMMANDS for consecutive ticks from ``first``; codes: (n, 2)."""
    return _COMMANDS.pack(run, len(codes), first) + codes.astype(COMMAND_DTYPE).tobytes()


def unpack_commands(payload: bytes) -> tuple[int, int, Codes]:
    """Run, first tick and codes, (n, 2)."""
    run, count, first = _COMMANDS.unpack_from(payload)
    codes = np.frombuffer(payload, COMMAND_DTYPE, offset=_COMMANDS.size)
    return run, first, codes.reshape(count, len(CHANNELS))


class Law(NamedTuple):
    """Let the device's own torque controller answer from tick ``first`` on, or commands again.

    blend: ticks over which the outputs move over. angle: rad of a count, from ``counts_zero`` on.
    current_motor [A], torque [N*m]: of a code, and of code 0. reference: N*m of a command's code.

    >>> Law(1, True, 400, 160, 0, 7.7e-4, (1.5e-4, 0.0), (2.2e-4, 0.01), 1e-4).on
    True
    """

    run: int
    on: bool
    first: int
    blend: int
    counts_zero: int
    angle: float
    current_motor: tuple[float, float]
    torque: tuple[float, float]
    reference: float

    def pack(self) -> bytes:
        """Payload of the frame."""
        scales = (self.angle, *self.current_motor, *self.torque, self.reference)
        return _LAW.pack(self.run, self.on, self.first, self.blend, self.counts_zero, *scales)

    @classmethod
    def unpack(cls, payload: bytes) -> Self:
        """The message."""
        run, on, first, blend, zero, angle, *pairs, reference = _LAW.unpack(payload)
        current, torque = (pairs[0], pairs[1]), (pairs[2], pairs[3])
        return cls(run, bool(on), first, blend, zero, angle, current, torque, reference)


class Pong(NamedTuple):
    """Answer to PING: its stamp, and the device's clock at its arrival and at the answer."""

    stamp: int
    received: int
    answered: int
    status: Status

    def pack(self) -> bytes:
        """Payload of the frame."""
        return _PONG.pack(*self[:3]) + self.status.pack()

    @classmethod
    def unpack(cls, payload: bytes) -> Self:
        """The message."""
        stamp, received, answered = _PONG.unpack_from(payload)
        return cls(stamp, received, answered, Status.unpack(payload[_PONG.size :]))


class Block(NamedTuple):
    """Consecutive samples from tick ``first`` on, latched from device time ``time`` on.

    records: (n,) of ``SAMPLE_DTYPE``.
    """

    status: Status
    first: int
    time: int
    records: Records

    def pack(self) -> bytes:
        """Payload of SAMPLES."""
        head = _SAMPLES.pack(self.first, len(self.records), self.time)
        return self.status.pack() + head + self.records.tobytes()

    @classmethod
    def unpack(cls, payload: bytes) -> Self:
        """The message; the records are a view of it."""
        *status, first, count, time = _SAMPLES_HEAD.unpack_from(payload)
        records = np.frombuffer(payload, SAMPLE_DTYPE, offset=SAMPLES_OVERHEAD)
        if not 0 < len(records) == count:
            raise ValueError("another number of samples")
        return cls(Status.of(*status), first, time, records)


def joined(blocks: Sequence[Block]) -> Records:
    """The records of consecutive blocks, (n,)."""
    if len(blocks) == 1:
        return blocks[0].records
    # numpy would compare the types of all their fields first, which takes longer than the rest.
    return np.frombuffer(b"".join([block.records.data for block in blocks]), SAMPLE_DTYPE)
