"""Bytes of the serial protocol, from docs/serial-protocol.md: frames and payloads of a device."""

import struct
import zlib
from typing import NamedTuple

HELLO, START, GO, STOP, SAFE, CLEAR, ANNOUNCE, LAW = range(0x01, 0x09)
COMMANDS, PING = 0x10, 0x11
WELCOME, REPLY, SAMPLES, PONG, STATUS = 0x81, 0x82, 0x90, 0x91, 0x92
OK, NO_SESSION, WRONG_STATE, BAD_VALUE, LATCHED, UNKNOWN = range(6)

VERSION = 1
MAGIC = b"HRIG"
MOST_PAYLOAD = 4096
LENGTHS = {START: 60, GO: 2, STOP: 2, SAFE: 0, CLEAR: 0, ANNOUNCE: 8}  # of requests
NOTHING_PASSES_I32 = (-(2**31), 2**31 - 1)
NOTHING_PASSES_U32 = 2**32 - 1

_HEADER = struct.Struct("<BBHHH")
_CRC = struct.Struct("<I")
_START = struct.Struct("<HBxIHxx2h2h3i3iiifI")
_WELCOME = struct.Struct("<4sHBBIfIHHHxx32s32s32s")
_CHANNEL = struct.Struct("<16s8s4d")
_STATUS = struct.Struct("<HBBIIIII")
_REPLY = struct.Struct("<BBxx")
_SAMPLES = struct.Struct("<IHxxQ")
_SAMPLE = struct.Struct("<3iif2hI")
_PONG = struct.Struct("<QQQ")
_COMMANDS = struct.Struct("<HHI")
_MOST_ZEROS_APART = 254


class Frame(NamedTuple):
    """What a frame holds."""

    kind: int
    session: int
    number: int
    payload: bytes


class Start(NamedTuple):
    """The payload of START."""

    run: int
    mode: int
    period: int
    watchdog: int
    lowest: tuple[int, int]
    highest: tuple[int, int]
    guard_low: tuple[int, int, int]
    guard_high: tuple[int, int, int]
    counts_low: int
    counts_high: int
    rate: float
    step: int


class Status(NamedTuple):
    """Where the device is in its run."""

    run: int
    state: int
    latch: int
    tick: int
    queued_until: int
    credit_until: int
    late: int
    overflow: int

    def pack(self):
        return _STATUS.pack(*self)


def stuffed(data):
    """COBS: no zeros; each is replaced by the distance to the next, 254 at most."""
    out = bytearray()
    for part in data.split(b"\0"):
        for at in range(0, len(part) + 1, _MOST_ZEROS_APART):
            piece = part[at : at + _MOST_ZEROS_APART]
            out += bytes([len(piece) + 1]) + piece
    return bytes(out)


def unstuffed(code):
    """What COBS was made of; None for what is none."""
    out, at = bytearray(), 0
    while at < len(code):
        distance = code[at]
        part = code[at + 1 : at + distance]
        if distance == 0 or len(part) != distance - 1 or b"\0" in part:
            return None
        out += part
        at += distance
        if distance <= _MOST_ZEROS_APART and at < len(code):
            out.append(0)
    return bytes(out)


def encoded(frame):
    """A frame on the wire."""
    header = _HEADER.pack(frame.kind, 0, frame.session, frame.number, len(frame.payload))
    body = header + frame.payload
    return b"\0" + stuffed(body + _CRC.pack(zlib.crc32(body))) + b"\0"


def decoded(code):
    """The frame between two zeros; None for what a receiver drops."""
    body = unstuffed(code)
    if body is None or len(body) < _HEADER.size + _CRC.size:
        return None
    kind, zero, session, number, length = _HEADER.unpack_from(body)
    payload = body[_HEADER.size : -_CRC.size]
    (crc,) = _CRC.unpack(body[-_CRC.size :])
    if zero or length != len(payload) or crc != zlib.crc32(body[: -_CRC.size]):
        return None
    return Frame(kind, session, number, payload)


def start(payload):
    """A Start."""
    values = _START.unpack(payload)
    return Start(
        *values[:4], values[4:6], values[6:8], values[8:11], values[11:14], *values[14:]
    )  # fmt: skip


def commands(payload):
    """Run, first tick and codes [(motor, brake), ...]; None where the length is wrong."""
    if len(payload) < _COMMANDS.size:
        return None
    run, n, tick = _COMMANDS.unpack_from(payload)
    if len(payload) != _COMMANDS.size + 4 * n:
        return None
    return run, tick, list(struct.iter_unpack("<2h", payload[_COMMANDS.size :]))


def welcome(latch, clock, max_rate, queue, watchdog, channels):
    """Payload of WELCOME; channels: (name, unit, scale, lowest, highest) each."""
    texts = (b"faulty board", b"tests 1", b"0001")
    head = _WELCOME.pack(
        MAGIC, VERSION, len(channels), latch, clock, max_rate, queue, MOST_PAYLOAD,
        *watchdog, *texts,
    )  # fmt: skip
    return head + b"".join(
        _CHANNEL.pack(name.encode(), unit.encode(), scale, 0.0, lowest, highest)
        for name, unit, scale, lowest, highest in channels
    )


def reply(kind, result, status):
    """Payload of REPLY."""
    return _REPLY.pack(kind, result) + status.pack()


def pong(host_time, heard, sent, status):
    """Payload of PONG; clocks in ticks."""
    return _PONG.pack(host_time, heard, sent) + status.pack()


def samples(status, tick, clock, rows):
    """Payload of SAMPLES; rows: (codes (3,), count, rate, applied codes (2,), flags)."""
    return status.pack() + _SAMPLES.pack(tick, len(rows), clock) + b"".join(
        _SAMPLE.pack(*codes, _wrapped(count), rate, *applied, flags)
        for codes, count, rate, applied, flags in rows
    )  # fmt: skip


def _wrapped(count):
    """A counter of 32 bits."""
    return (count + 2**31) % 2**32 - 2**31
