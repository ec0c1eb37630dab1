"""What is built for a microcontroller: its sizes, the template, the encoder's speed."""

import math
import re
import struct
import subprocess

import numpy as np
import pytest

from tests.firmware.build import SOURCE, make, needs

CLOCK = 84_000_000  # Hz
COUNTS = 8192  # a turn
MOST_TEXT, MOST_RAM = 24 * 1024, 96 * 1024  # bytes


@pytest.fixture(scope="module")
def elf():
    needs("make", "arm-none-eabi-gcc")
    return make(BOARD="stm32f405") / "stm32f405" / "rig.elf"


def test_the_firmware_fits(elf):
    done = subprocess.run(["arm-none-eabi-size", elf], capture_output=True, text=True, check=True)
    text, data, bss = map(int, done.stdout.splitlines()[1].split()[:3])
    print(f"text {text}, RAM {data + bss} bytes")
    assert text + data <= MOST_TEXT and data + bss <= MOST_RAM


def test_it_has_no_heap_and_the_stack_that_it_needs(elf):
    done = subprocess.run(["arm-none-eabi-nm", elf], capture_output=True, text=True, check=True)
    names = {line.split()[-1] for line in done.stdout.splitlines()}
    assert "rig_on_tick" in names
    assert not names & {"malloc", "free", "calloc", "_sbrk", "_malloc_r", "printf", "__aeabi_dadd"}
    # Every function of ours in one call after the other is more than any path through them.
    usage = [path.read_text("utf-8") for path in elf.parent.glob("*.su")]
    rows = re.findall(r"\t(\d+)\t(\w+)", "\n".join(usage))
    assert rows and all(kind == "static" for _, kind in rows)
    assert sum(int(size) for size, _ in rows) < 2048


def test_vectors_begin_with_the_stack_and_reset(elf):
    image = elf.with_name("rig.bin").read_bytes()
    stack, reset = struct.unpack_from("<II", image)
    assert stack == 0x20000000 + MOST_RAM and reset % 2 == 1
    assert 0x08000000 < reset < 0x08000000 + MOST_TEXT
    assert 0 not in struct.unpack_from("<97I", image), "every interrupt ends somewhere"


def test_a_copy_of_the_template_becomes_a_firmware():
    needs("make", "arm-none-eabi-gcc")
    image = (make(BOARD="template") / "template" / "rig.bin").read_bytes()
    stack, reset = struct.unpack_from("<II", image)
    assert stack == 0x20000000 + 64 * 1024 and 0x08000000 < reset < 0x08000000 + len(image)


def test_a_board_that_is_not_there_is_named_with_those_that_are():
    needs("make")
    words = ["make", "-C", SOURCE, "BOARD=nosuch"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode != 0 and "there is no boards/nosuch/board.ld" in done.stderr
    assert "stm32f405" in done.stderr and "a copy of boards/template" in done.stderr


# --- the encoder ------------------------------------------------------------------------------


def rates(angles, rate, origin=0, steps=2000):
    """What the firmware estimates at ticks of ``rate`` [Hz] for a motion, angles(t) in turns."""
    needs("make", "gcc")
    program = make("native") / "native" / "encoder"
    ticks = np.arange(400) / rate
    times = np.arange(len(ticks) * steps) / (rate * steps)
    counts = np.floor(angles(times) * COUNTS).astype(np.int64)
    edges = np.flatnonzero(np.diff(counts, prepend=counts[0]))
    rows = b""
    for k, now in enumerate(ticks):
        at = k * steps
        last = edges[np.searchsorted(edges, at, side="right") - 1] if (edges <= at).any() else 0
        stamps = [(round(t * CLOCK) + origin) % 2**32 for t in (times[last], now)]
        rows += struct.pack("<III", int(counts[at]) % 2**32, *stamps)
    words = [program, str(CLOCK), str(CLOCK // 10), str(int(counts[0]) % 2**32)]
    done = subprocess.run(words, input=rows, capture_output=True, check=True)
    return ticks, np.frombuffer(done.stdout, "<f4")


@pytest.mark.parametrize("turns", [0.03, 0.4, 5.0, 24.0, -0.03, -24.0])
@pytest.mark.parametrize("origin", [0, 2**32 - CLOCK // 20])
def test_a_steady_speed_is_measured_by_the_time_between_edges(turns, origin):
    ticks, estimated = rates(lambda t: turns * t, 4000.0, origin)
    after = np.abs(ticks * turns * COUNTS) > 3.0  # edges, of which two ticks have seen some
    after[:2] = False
    # Edges are timed here to 1/2000 of a tick.
    error = 1.0 / 2000 / 4000 * max(1.0, abs(turns) * COUNTS / 4000) * 2.0
    tolerance = 1e-4 + error * min(abs(turns) * COUNTS, 4000.0)
    np.testing.assert_allclose(estimated[after], turns * COUNTS, rtol=tolerance)


def test_a_shaft_that_stops_slows_down_and_stands_still():
    ticks, estimated = rates(lambda t: np.minimum(t, 0.0101) * 2.0, 1000.0)
    waiting = (ticks > 0.012) & (ticks < 0.1)
    assert estimated[11] == pytest.approx(2.0 * COUNTS, rel=0.01)
    assert (estimated[waiting] <= 1.0 / (ticks[waiting] - 0.0102)).all()
    assert (np.diff(estimated[waiting]) < 0.0).all()
    assert not estimated[ticks > 0.1111].any()


def test_a_reversal_is_no_speed():
    # To and fro over one edge: the same edge twice is no distance.
    _, estimated = rates(lambda t: 0.4 / COUNTS * np.sin(2.0 * math.pi * 50.0 * t), 4000.0)
    assert not estimated.any()
