"""Frames on the wire: COBS, CRC-32 and length around a typed payload. No I/O.

    00 | COBS( type u8, 0 u8, session u16, seq u16, length u16, payload, crc32 u32 ) | 00

All numbers little-endian. A frame is accepted only when its COBS code, its length field and its
CRC all agree; whatever else came between two zero bytes is counted and dropped.
"""

import struct
import zlib
from dataclasses import dataclass
from typing import NamedTuple

from cobs import cobs

MAX_PAYLOAD = 4096  # bytes that no frame's payload exceeds, in either direction
_HEADER = struct.Struct("<BBHHH")
_CRC = struct.Struct("<I")
_SMALLEST = _HEADER.size + _CRC.size
# CRC-32 of whatever ends with its own CRC-32, in the order of bytes on the wire.
_RESIDUE = 0x2144DF1C
# COBS adds one byte per 254 and one more.
_LONGEST = _SMALLEST + MAX_PAYLOAD + (_SMALLEST + MAX_PAYLOAD) // 254 + 1


class Frame(NamedTuple):
    """A frame that passed every check. seq counts modulo 65536."""

    type: int
    session: int
    seq: int
    payload: bytes


def encode(type_: int, session: int, seq: int, payload: bytes = b"") -> bytes:
    """One frame ready to be written, zero bytes at both ends.

    The leading zero ends whatever noise or cut frame stood on the line before.
    """
    if len(payload) > MAX_PAYLOAD:
        raise ValueError(f"a payload of {len(payload)} bytes; at most {MAX_PAYLOAD} fit a frame")
    body = _HEADER.pack(type_, 0, session, seq & 0xFFFF, len(payload)) + payload
    coded: bytes = cobs.encode(body + _CRC.pack(zlib.crc32(body)))
    return b"\0" + coded + b"\0"


def decode(coded: bytes) -> Frame | None:
    """The frame that stood between two zero bytes, or None when anything about it is wrong."""
    if len(coded) > _LONGEST:
        return None
    try:
        body: bytes = cobs.decode(coded)
    except cobs.DecodeError:
        return None
    if len(body) < _SMALLEST:
        return None
    type_, reserved, session, seq, length = _HEADER.unpack_from(body)
    if length != len(body) - _SMALLEST or reserved != 0 or zlib.crc32(body) != _RESIDUE:
        return None
    return Frame(type_, session, seq, body[_HEADER.size : -_CRC.size])


@dataclass
class Decoder:
    """Frames out of a stream of bytes, however reads cut it.

    received: bytes fed. accepted, rejected: frames that passed, and pieces between zeros that
    did not.
    """

    received: int = 0
    accepted: int = 0
    rejected: int = 0
    _partial: bytes = b""

    def feed(self, data: bytes) -> list[Frame]:
        """The frames that the data complete."""
        self.received += len(data)
        *pieces, rest = (self._partial + data).split(b"\0")
        # What is longer than any frame stays so, and is rejected at the next zero.
        self._partial = rest[: _LONGEST + 1]
        decoded = [decode(piece) for piece in pieces if piece]
        frames = [frame for frame in decoded if frame is not None]
        self.accepted += len(frames)
        self.rejected += len(decoded) - len(frames)
        return frames
