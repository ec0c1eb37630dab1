"""Frames: what is accepted was sent, however the line treats it."""

import zlib

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from daq.hal import Mode
from daq.serial import codec, messages
from daq.serial.codec import Decoder, decode, encode

payloads = st.binary(max_size=codec.MAX_PAYLOAD)
numbers = st.integers(0, 0xFFFF)
frames = st.tuples(st.integers(0, 255), numbers, numbers, payloads)


def consistent_overhead(data):
    """COBS as its paper states it (Cheshire and Baker 1999), written without the library."""
    out, block = bytearray(), bytearray()
    for byte in data:
        if byte == 0:
            out += bytes([len(block) + 1]) + block
            block = bytearray()
        else:
            block.append(byte)
            if len(block) == 254:
                out += b"\xff" + block
                block = bytearray()
    return bytes(out + bytes([len(block) + 1]) + block)


@given(frames)
@settings(deadline=None, derandomize=True)
def test_a_frame_is_what_the_document_says(frame):
    kind, session, seq, payload = frame
    body = bytes([kind, 0])
    body += b"".join(n.to_bytes(2, "little") for n in (session, seq, len(payload))) + payload
    body += zlib.crc32(body).to_bytes(4, "little")
    wire = encode(kind, session, seq, payload)
    assert wire[:1] == wire[-1:] == b"\0" and b"\0" not in wire[1:-1]
    # A block of 254 at the very end may or may not be followed by an empty one.
    assert wire[1:-1] in {consistent_overhead(body), consistent_overhead(body)[:-1]}
    assert decode(wire[1:-1]) == frame


@given(st.lists(frames, max_size=6), st.data())
@settings(max_examples=60, deadline=None, derandomize=True)
def test_frames_come_out_whole_and_in_order_however_reads_cut_them(sent, data):
    stream = b"".join(encode(*frame) for frame in sent)
    cuts = data.draw(st.lists(st.integers(0, len(stream)), max_size=20).map(sorted))
    decoder, got = Decoder(), []
    for begin, end in zip([0, *cuts], [*cuts, len(stream)], strict=True):
        got += decoder.feed(stream[begin:end])
    assert got == sent
    assert (decoder.accepted, decoder.rejected) == (len(sent), 0)


@given(st.lists(frames, min_size=1, max_size=4), st.data())
@settings(
    max_examples=300, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow]
)
def test_what_a_bad_line_makes_of_frames_is_refused(sent, data):
    stream = bytearray(b"".join(encode(*frame) for frame in sent))
    for _ in range(data.draw(st.integers(1, 8))):
        at = data.draw(st.integers(0, len(stream) - 1))
        kind = data.draw(st.sampled_from(["flip", "cut", "insert", "overwrite", "move"]))
        piece = bytes(stream[at : at + data.draw(st.integers(1, 40))])
        if kind == "flip":
            stream[at] ^= 1 << data.draw(st.integers(0, 7))
        elif kind == "cut":
            del stream[at : at + len(piece)]
            stream = stream or bytearray(b"\0")
        elif kind == "insert":
            stream[at:at] = data.draw(st.binary(max_size=20))
        elif kind == "overwrite":
            stream[at] = data.draw(st.integers(0, 255))
        else:
            stream += piece
    for frame in Decoder().feed(bytes(stream) + b"\0"):
        assert frame in sent, "no frame may come out that was not put in"


def test_noise_before_a_frame_does_not_spoil_it():
    frame = (1, 2, 3, b"abc")
    assert Decoder().feed(b"\x17\x80noise" + encode(*frame)) == [frame]


def test_noise_without_end_neither_grows_nor_stops_the_decoder():
    decoder = Decoder()
    for _ in range(100):
        assert decoder.feed(b"\x55" * 10_000) == []
    assert decoder.received == 1_000_000 and len(decoder._partial) < 5_000
    assert decoder.feed(encode(7, 1, 1, b"still here")) == [(7, 1, 1, b"still here")]


@pytest.mark.parametrize("missing", [-1, 1])
def test_a_length_that_does_not_fit_is_refused_even_with_its_crc_right(missing):
    payload = b"four"
    body = bytes([9, 0]) + b"\1\0\2\0" + (len(payload) + missing).to_bytes(2, "little") + payload
    body += zlib.crc32(body).to_bytes(4, "little")
    assert decode(consistent_overhead(body)) is None


def test_a_payload_beyond_the_largest_is_refused_at_both_ends():
    with pytest.raises(ValueError, match="at most 4096"):
        encode(1, 1, 1, bytes(codec.MAX_PAYLOAD + 1))
    body = bytes([1, 0, 1, 0, 1, 0]) + (5000).to_bytes(2, "little") + b"x" * 5000
    assert decode(consistent_overhead(body + zlib.crc32(body).to_bytes(4, "little"))) is None


# --- messages -------------------------------------------------------------------------------

STATUS = messages.Status(7, messages.State.RUNNING, messages.Latch.NONE, 100, 200, 300, 4, 5)


@given(st.integers(1, 100), st.integers(0, 2**32 - 1), st.integers(0, 2**64 - 1))
@settings(deadline=None, derandomize=True)
def test_a_block_of_samples_comes_back_as_it_was(n, first, time):
    rng = np.random.default_rng(n)
    records = np.zeros(n, messages.SAMPLE_DTYPE)
    for name in ("analog", "counts", "applied", "flags"):
        info = np.iinfo(records[name].dtype)
        records[name] = rng.integers(info.min, info.max, records[name].shape, endpoint=True)
    records["count_rate"] = rng.standard_normal(n)
    block = messages.Block.unpack(messages.Block(STATUS, first, time, records).pack())
    assert (block.status, block.first, block.time) == (STATUS, first, time)
    assert np.array_equal(block.records, records)


@pytest.mark.parametrize(
    ("unpack", "payload"),
    [
        (messages.Status.unpack, STATUS.pack()),
        (messages.Block.unpack, messages.Block(
            STATUS, 0, 0, np.zeros(3, messages.SAMPLE_DTYPE)).pack()),
        (messages.Reply.unpack, messages.Reply(2, messages.Result.OK, STATUS).pack()),
        (messages.Pong.unpack, messages.Pong(1, 2, 3, STATUS).pack()),
        (messages.unpack_commands, messages.pack_commands(1, 2, np.zeros((3, 2), "<i2"))),
        (messages.ANNOUNCE.unpack, messages.ANNOUNCE.pack(2, 5.0)),
        (messages.RUN.unpack, messages.RUN.pack(3)),
        (messages.Law.unpack, messages.Law(
            1, True, 9, 5, -3, 0.5, (0.25, 1.0), (2.0, 3.0), 0.125).pack()),
        (messages.PING.unpack, messages.PING.pack(3)),
        (messages.Start.unpack, messages.Start(
            1, Mode.OPEN_LOOP, 60_000, 100, messages.CodedGuard(
                (-1, 0), (1, 1), (-5,) * 3, (5,) * 3, -9, 9, 1e3, 4)).pack()),
        (messages.Welcome.unpack, messages.Welcome(
            "d", "f", "s", 1, 1.0, 1, 64, 100, 1000,
            (messages.Channel("a", "V", 1.0, 0.0, 0.0, 1.0),)).pack()),
    ],
)  # fmt: skip
def test_a_payload_of_the_wrong_length_is_none_at_all(unpack, payload):
    assert unpack(payload) is not None
    for wrong in (payload[:-1], payload + b"\0", b""):
        with pytest.raises(messages.MALFORMED):
            unpack(wrong)
