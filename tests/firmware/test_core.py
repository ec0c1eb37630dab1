"""The core of the firmware on this computer, under the sanitizers, beside the Python device."""

import json
import math
import re
import struct
import subprocess
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from daq.serial import codec, messages
from daq.serial.messages import Status, Type
from tests.firmware.build import SOURCE, make, needs
from tests.firmware.sequences import (
    ANY,
    I32,
    PAYLOAD,
    Author,
    Firmware,
    Flood,
    Inputs,
    Line,
    Takes,
    TimerStops,
    Wait,
    difference,
    expected,
)
from tests.soak import mostly_soak

SHARES = [(first, 500) for first in range(0, 2_500, 500)]
PAGE = SOURCE.parent / "docs" / "serial-protocol.md"


@pytest.fixture(scope="module")
def native():
    needs("make", "gcc")
    return make("native") / "native"


@pytest.fixture
def firmware(native):
    program = Firmware(native / "replay")
    yield program
    program.close()


@pytest.mark.parametrize(("first", "n"), mostly_soak(SHARES, always=1))
def test_random_events_come_to_the_same_as_on_the_python_device(firmware, first, n):
    """All of them drawn by number: ``python -m benchmarks.firmware`` plays a million."""
    for seed in range(first, first + n):
        events = Author(seed).sequence()
        problem = difference(events, firmware)
        assert not problem, f"sequence {seed}: {problem}"


def test_the_sequences_reach_every_state_latch_and_answer():
    traces = [trace for seed in range(300) for trace in expected(Author(seed).sequence())]
    assert {(trace.state, trace.latch) for trace in traces} == {
        (state, latch) for state in (0, 1, 2) for latch in range(5)
    } - {(1, 2), (1, 3), (1, 4)}  # which no device comes to, for ARMED no clock runs
    replies = [frame[3] for trace in traces for frame in trace.frames if frame[0] == 0x82]
    assert {reply[1] for reply in replies} == set(range(6))
    flags = {int.from_bytes(r[24:28], "little") for t in traces for r in t.samples.values()}
    assert {0, 1, 2, 8, 16, 32, 33, 34, 40, 48} <= flags


@pytest.mark.parametrize("damaged", mostly_soak([150_000, 1_500_000]))
def test_no_damaged_frame_is_accepted(native, damaged):
    """``python -m benchmarks.firmware`` damages ten million."""
    frames = 16 * math.ceil(damaged / 15 / 2)  # of each of two; one in sixteen is whole

    def fuzz(seed):
        words = [native / "fuzz", str(frames), str(seed)]
        return subprocess.run(words, capture_output=True, text=True, check=False)

    with ThreadPoolExecutor(2) as pool:
        for done in pool.map(fuzz, (1, 2)):
            assert done.returncode == 0, done.stdout + done.stderr
            counts = json.loads(done.stdout)
            assert counts["frames"] == frames and counts["accepted"] == 0
            assert counts["whole"] == frames // 16


def test_the_examples_of_the_page_go_in_and_come_out(firmware):
    text = PAGE.read_text(encoding="utf-8").split("## Examples")[1]
    examples = dict(re.findall(r"\*\*([^\n*]+)\*\*[^\n]*\n\n```\n([0-9A-F \n]+)```", text))
    wire = {name: bytes.fromhex(code) for name, code in examples.items()}
    order = ("HELLO", "START", "COMMANDS", "GO", "PING", "SAFE")
    # The page's clock has 48 MHz, so that its period lasts 75 ms here.
    inputs = Inputs((0, 0, 0), 0, 0, 0.0, False)
    events = [inputs, *(Line(wire[name]) for name in order[:4]), Wait(0), Line(wire["PING"])]
    traces = firmware.play([*events, Line(wire["SAFE"])])
    answers = {frame[0]: frame for trace in traces for frame in trace.frames}
    session, numbers = 0x1234, (1, 2, 3, 4)
    replies = [frame for trace in traces for frame in trace.frames if frame[0] == 0x82]
    assert [frame[1:3] for frame in replies] == [(session, number) for number in numbers[1:]]
    # The run's number in GO is 1 as in START; 3 commands queued; clamps narrowed to the board's.
    assert traces[-1].state == 2 and traces[-1].latch == 1
    assert traces[5].applied == [(0, 1638, 229)]
    assert set(answers) == {0x81, 0x82, 0x91, 0x92}
    (status,) = (
        codec.Decoder().feed(wire["STATUS that follows"])
        if ("STATUS that follows" in wire)
        else codec.Decoder().feed(wire["STATUS"])
    )
    assert answers[0x92][3][:12] == status.payload[:12]


QUIET = Inputs((0, 0, 0), 0, 1, 0.0, False)
SESSION, PERIOD = 7, 250
HELLO = codec.encode(Type.HELLO, SESSION, 1, messages.pack_hello("test"))
GO = codec.encode(Type.GO, SESSION, 3, b"\1\0")
PING = codec.encode(Type.PING, SESSION, 0, bytes(8))


def start(mode=1, lowest=(-9, -9), highest=(9, 9)):
    payload = struct.pack(
        "<HBBIHH2h2h3i3iiifI", 1, mode, 0, PERIOD, 1000, 0, *lowest, *highest,
        *3 * (I32[0],), *3 * (I32[1],), *I32, math.inf, 2**32 - 1,
    )  # fmt: skip
    return codec.encode(Type.START, SESSION, 2, payload)


def samples_of(traces):
    return {tick: record for trace in traces for (_, tick), record in trace.samples.items()}


SELDOM = {
    "a session of 0": codec.encode(Type.HELLO, 0, 1, messages.pack_hello("test")),
    "a payload that is too long": codec.encode(Type.ANNOUNCE, SESSION, 2, bytes(PAYLOAD + 1)),
    "as long as may be, without zeros": codec.encode(0x7F, SESSION, 2, b"\1" * PAYLOAD),
    "a highest command below 0": start(highest=(-1, 9)),
    "a lowest command above 0": start(lowest=(-9, 1)),
}


@pytest.mark.parametrize("frame", SELDOM)
def test_what_seldom_comes_is_the_same_on_the_python_device_too(firmware, frame):
    assert not difference(amid(SELDOM[frame]), firmware)


def amid(frame):
    return [QUIET, Line(HELLO), Line(frame), Line(start() + GO), Wait(1000)]


def test_a_full_line_costs_samples_that_are_counted_and_no_others(firmware):
    traces = firmware.play(overflowing())
    samples = samples_of(traces)
    applied = [tick for trace in traces for tick, *_ in trace.applied]
    assert applied == list(range(len(applied))), "the device goes on"
    counts = {tick: int.from_bytes(record[12:16], "little") for tick, record in samples.items()}
    assert all(count == tick for tick, count in counts.items()), "and misplaces none"
    pongs = [frame[3] for trace in traces for frame in trace.frames if frame[0] == Type.PONG]
    overflow = Status.unpack(pongs[-1][24:]).overflow
    assert overflow == len(applied) - len(samples) > 500


def overflowing():
    """A run that goes on while the line takes nothing, for a while, then a little, then all."""
    wait = [Wait(200_000), Line(PING)]
    # A host that asks and asks fills even what is kept free for answers.
    return [
        QUIET, Line(HELLO + start() + GO), *wait, Takes(0), Line(40 * HELLO), *3 * wait,
        Line(300 * PING), Takes(5000), *2 * wait, Takes(ANY), *2 * wait,
    ]  # fmt: skip


def test_a_main_loop_that_hangs_loses_bytes_and_nothing_else(firmware):
    """More of them than there is room for; the frames that there was room for are answered."""
    pongs = [sum(frame[0] == Type.PONG for frame in t.frames) for t in firmware.play(HANGS)]
    room = 2048 // len(PING)
    assert sum(pongs[:-1]) == room and pongs[-1] == 1


HANGS = [QUIET, Line(HELLO), Flood(1000 * PING), Wait(1), Line(b"\0"), Line(PING)]


def test_a_timer_that_stops_is_no_longer_fed_for(firmware):
    """The independent watchdog then resets the board."""
    begun, _, late, later, *after = firmware.play(STOPS)[2:]
    assert begun.fed < late.fed < later.fed, "a tick may be 20 ms late"
    assert {trace.fed for trace in after} == {later.fed}, "and not a microsecond more"
    # Without a run nothing is due.
    idle = firmware.play([QUIET, Line(HELLO), TimerStops(), Wait(50_000), Wait(50_000)])
    assert idle[-1].fed > idle[-2].fed


STOPS = [
    QUIET, Line(HELLO + start() + GO), Wait(10 * PERIOD), TimerStops(), Wait(PERIOD + 20_000),
    Wait(0), Wait(1), Wait(30_000), Line(PING),
]  # fmt: skip


def test_branches_that_the_tests_take():
    needs("make", "gcc", "gcov")
    folder = make("coverage") / "coverage" / "native"
    subprocess.run([folder / "fuzz", "20000", "1"], check=True, capture_output=True)
    program = Firmware(folder / "replay")
    for seed in range(1500):
        program.play(Author(seed).sequence())
    for events in (*map(amid, SELDOM.values()), overflowing(), HANGS, STOPS):
        program.play(events)
    program.close()
    share, missed = branches(folder)
    print(f"{share:.1%} of the core's branches; not taken: {missed}")
    assert share > 0.955, missed


def branches(folder):
    """Share of the core's branches that were taken, and the lines of the others."""
    taken, missed = 0, []
    for notes in (folder / "core").glob("*.gcno"):
        if notes.stem == "encoder":
            continue  # which has tests of its own
        words = ["gcov", "--branch-probabilities", "--json-format", "--stdout", notes]
        done = subprocess.run(words, capture_output=True, text=True, cwd=SOURCE, check=True)
        for file in json.loads(done.stdout)["files"]:
            for line in file["lines"]:
                counts = [branch["count"] for branch in line["branches"]]
                taken += sum(count > 0 for count in counts)
                if not all(counts):
                    missed += [f"{Path(file['file']).name}:{line['line_number']}"] * counts.count(0)
    return taken / (taken + len(missed)), sorted(missed)


@pytest.mark.soak
def test_cppcheck_and_clang_tidy_have_nothing_to_say():
    needs("make", "cppcheck", "clang-tidy")
    make("lint")
