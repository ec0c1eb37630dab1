"""docs/serial-protocol.md is what the code does: its examples, byte tables and numbers."""

import re
import struct
from pathlib import Path

import numpy as np
import pytest

from daq.hal import Mode, Phase
from daq.serial import codec, host, messages
from daq.serial.emulation import machine as device
from daq.serial.messages import (
    Block,
    Channel,
    CodedGuard,
    Latch,
    Pong,
    Reply,
    Result,
    Start,
    State,
    Status,
    Type,
    Welcome,
)

TEXT = (Path(__file__).parents[3] / "docs" / "serial-protocol.md").read_text(encoding="utf-8")
SESSION = 0x1234
ARMED = Status(1, State.ARMED, Latch.NONE, 0, 0, 512, 0, 0)
PRELOADED = Status(1, State.ARMED, Latch.NONE, 0, 3, 512, 0, 0)
RUNNING = Status(1, State.RUNNING, Latch.NONE, 1, 3, 513, 0, 0)
START = Start(
    1, Mode.OPEN_LOOP, 60_000, 100, CodedGuard(
        (-16384, 0), (16384, 1245), (-15729, -1245, -(2**31)), (15729, 1245, 2**31 - 1),
        -(2**31), 40_960, 260_760.0, 1629,
    ),
)  # fmt: skip
COMMANDS = np.array([[1638, 229], [1638, 229], [-1638, 0]], dtype="<i2")


def _record():
    record = np.zeros(1, messages.SAMPLE_DTYPE)
    record["analog"], record["counts"], record["count_rate"] = [[18, -30, -59]], -2, 0.0
    record["applied"] = [[1638, 229]]
    return record


STEP = 20.0 / 65536
WELCOME = Welcome(
    "bench 2", "1.0.3", "0007", 48_000_000, 4000.0, 512, 256, 100, 1000,
    (
        *(
            Channel(name, "V", STEP, 0.0, low, high)
            for name, low, high in (
                ("current_motor", -10.0, 10.0), ("current_brake", -10.0, 10.0),
                ("torque", -10.0, 10.0), ("motor", -5.0, 5.0), ("brake", 0.0, 0.38),
            )
        ),
        Channel("encoder", "count", 1.0, 0.0, -(2.0**31), 2.0**31 - 1),
    ),
)  # fmt: skip

EXAMPLES = {
    "HELLO": (Type.HELLO, 1, messages.pack_hello("ana@lab")),
    "WELCOME": (Type.WELCOME, 1, WELCOME.pack()),
    "START": (Type.START, 2, START.pack()),
    "REPLY to START": (Type.REPLY, 2, Reply(Type.START, Result.OK, ARMED).pack()),
    "COMMANDS": (Type.COMMANDS, 7, messages.pack_commands(1, 0, COMMANDS)),
    "STATUS": (Type.STATUS, 1, PRELOADED.pack()),
    "GO": (Type.GO, 3, messages.RUN.pack(1)),
    "SAMPLES": (Type.SAMPLES, 2, Block(RUNNING, 0, 96_000_000, _record()).pack()),
    "PING": (Type.PING, 8, messages.PING.pack(1_000_000_000)),
    "PONG": (Type.PONG, 8, Pong(1_000_000_000, 96_000_480, 96_000_490, RUNNING).pack()),
    "SAFE": (Type.SAFE, 4, b""),
}


def written(name):
    """The bytes of an example as the document prints them."""
    found = re.search(rf"\*\*{re.escape(name)}\*\*[^\n]*\n\n```\n(.*?)```", TEXT, re.S)
    assert found, f"{name} is not in the document"
    return bytes.fromhex(re.sub(r"#.*", "", found[1]))


@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_is_what_goes_over_the_wire(name):
    kind, seq, payload = EXAMPLES[name]
    assert written(name) == codec.encode(kind, SESSION, seq, payload)
    assert codec.Decoder().feed(written(name)) == [(kind, SESSION, seq, payload)]


def test_the_worked_example_goes_step_by_step():
    body = codec.cobs.decode(written("HELLO")[1:-1])
    assert written("Body of HELLO") == body
    check = struct.unpack("<I", body[-4:])[0]
    assert f"0x{check:08X}" in TEXT


SIZES = {
    "Header": codec._HEADER.size,
    "HELLO": messages._HELLO.size,
    "WELCOME": messages._WELCOME.size,
    "Channel": messages._CHANNEL.size,
    "START": messages._START.size,
    "GO, STOP": messages.RUN.size,
    "ANNOUNCE": messages.ANNOUNCE.size,
    "LAW": messages._LAW.size,
    "COMMANDS": messages._COMMANDS.size,
    "PING": messages.PING.size,
    "REPLY": messages._REPLY.size + messages._STATUS.size,
    "Status": messages._STATUS.size,
    "PONG": messages._PONG.size + messages._STATUS.size,
    "SAMPLES": messages.SAMPLES_OVERHEAD,
    "Sample": messages.SAMPLE_DTYPE.itemsize,
}


@pytest.mark.parametrize("name", SIZES)
def test_a_byte_table_adds_up(name):
    found = re.search(rf"### {re.escape(name)}\n.*?\n(\| *offset.*?)\n\n", TEXT, re.S)
    assert found, f"there is no table of {name}"
    at = 0
    for row in found[1].splitlines()[2:]:
        offset, size = (cell.strip() for cell in row.split("|")[1:3])
        assert int(offset) == at, row
        at += int(size)
    assert at == SIZES[name]


def test_numbers_of_types_states_latches_and_results_are_those_of_the_code():
    for kind in (Type, State, Latch, Result):
        for item in kind:
            digits = f"0x{item.value:02X}" if kind is Type else str(item.value)
            assert re.search(rf"\| {digits} +\| {item.name} +\|", TEXT), (digits, item.name)
    phases = ", ".join(f"{number} {phase.value}" for number, phase in enumerate(Phase))
    assert phases in TEXT


def test_times_and_sizes_are_those_of_the_code():
    for fact in (
        f"{codec.MAX_PAYLOAD} bytes",
        f"{1e3 * host.RETRY:.0f} ms",
        f"{1e3 * host.HELLO_RETRY:.0f} ms",
        f"{device.LINGER_SECONDS:g} s",
        f"{1e3 * device.BLOCK_SECONDS:.0f} ms",
    ):
        assert fact in TEXT, fact
