"""The firmware's ELF in QEMU, in virtual time, at 4 kHz, in lockstep with a plant."""

import math
import struct
from dataclasses import dataclass, replace

import numpy as np
import pytest

from tests.faults import line, serial_device
from tests.faults.board import STEP, Board, Setting
from tests.faults.board import Reading as Latched
from tests.faults.faults import FAULTS, Fault
from tests.faults.firmware import CLAMPED, HELD, INTERLOCK, UNDERFLOW, Ticker
from tests.firmware import lockstep
from tests.firmware.lockstep import CLOCK, IDLE, PERIOD, Host, InputCodes, Limits

NONE, SAFE, UNDERRUN, TRIPPED, WATCHDOG = range(5)
ZERO = (0, 0)


@dataclass
class Bench:
    """Inputs that a test writes."""

    reading: InputCodes

    def read(self, ticks, outputs):
        return self.reading


class Rig:
    """The rig of ``tests.faults``, with its fault, at the firmware's converters."""

    def __init__(self, setting):
        self.board = Board(setting)
        self.board.announce("run")

    def read(self, ticks, outputs):
        if ticks:
            self.board.drive(*(STEP * code for code in outputs), ticks / CLOCK)
        volts, count, rate, flags = self.board.latch()
        codes = tuple(round(value / STEP) for value in volts)
        rate = float(np.float32(rate))
        return InputCodes(codes, (count + 2**31) % 2**32 - 2**31, rate, bool(flags))


@pytest.fixture(scope="module")
def running():
    with lockstep.firmware() as firmware:
        yield firmware


@pytest.fixture
def host(running):
    host = Host(running, Bench(QUIET))
    host.connect()
    host.request(line.CLEAR)
    return host


def wave(n):
    """Commands that move everything."""
    return [
        (round(3000 * math.sin(0.05 * k) + 2500), round(200 + 150 * math.sin(0.03 * k)))
        for k in range(n)
    ]


# --- the tick ---------------------------------------------------------------------------------


@pytest.mark.parametrize("closed", [False, True])
def test_commands_are_applied_in_their_ticks_and_told(host, closed):
    commands = wave(1000)
    played = host.play(len(commands), commands, Limits(), closed)
    assert [s.tick for s in played.samples] == list(range(len(played.samples)))
    rows = played.samples[: len(commands)]
    assert [s.applied for s in rows] == commands and not any(s.flags for s in rows)
    assert played.outputs[: len(commands)] == commands
    assert set(played.times) == {PERIOD}


MOST_INSTRUCTIONS = 600  # of rig_on_tick, QEMU's converters among them, which cost nothing
"""At 168 MHz and two clocks an instruction 7 us, of 250 us at 4 kHz."""


def test_a_tick_costs_no_more_than_so_many_instructions(host):
    commands = [(20_000, -5)] * 300 + [(1, 1)] * 200
    runs = [host.play(600, commands, Limits(), closed) for closed in (False, True)]
    trip = {5: QUIET._replace(counts=2**31 - 1)}

    def at_tick(tick):
        host.plant.reading = trip.get(tick, QUIET)

    runs.append(host.play(100, commands, Limits(step=3), at_tick=at_tick))
    costs = [cost for played in runs for cost in played.costs]
    print(f"instructions of a tick: {max(costs):.0f} at most")
    assert 200 < max(costs) < MOST_INSTRUCTIONS


def test_without_commands_open_loop_is_zero_and_closed_loop_holds(host):
    commands = wave(300)
    played = host.play(400, commands, Limits(), closed=False)
    assert {s.flags for s in played.samples[300:]} == {UNDERFLOW}
    assert set(played.outputs[300:]) == {ZERO}
    played = host.play(400, commands, Limits(), closed=True)
    assert {s.flags for s in played.samples[300:]} == {HELD}
    assert set(played.outputs[300:]) == {commands[-1]}


def test_clamps_are_those_of_start(host):
    commands = [(20_000, -5), (-20_000, 2000), (16_384, 1245), (-16_384, 0)] * 50
    played = host.play(len(commands), commands, Limits())
    inside = [(16_384, 0), (-16_384, 1245), (16_384, 1245), (-16_384, 0)] * 50
    assert played.outputs[: len(commands)] == inside
    assert [s.flags for s in played.samples[: len(commands)]] == [CLAMPED, CLAMPED, 0, 0] * 50


# --- every limit, in the tick in which it is passed ---------------------------------------------

AT = 60  # tick
QUIET = InputCodes((0, 0, 0), 0, 0.0)


def analog(channel, code):
    codes = [0, 0, 0]
    codes[channel] = code
    return QUIET._replace(analog=tuple(codes))


LIMITS = {
    **{
        f"analog {channel} {name}": (
            Limits(analog_low=(-500,) * 3, analog_high=(700,) * 3),
            analog(channel, at),
            analog(channel, beyond),
        )
        for channel in range(3)
        for name, at, beyond in (("low", -500, -501), ("high", 700, 701))
    },
    "count low": (
        Limits(counts_low=-9), QUIET._replace(counts=-9), QUIET._replace(counts=-10),
    ),
    "count high": (Limits(counts_high=9), QUIET._replace(counts=9), QUIET._replace(counts=10)),
    "rate": (Limits(rate=1000.5), QUIET._replace(rate=1000.5), QUIET._replace(rate=1000.6)),
    "rate backwards": (
        Limits(rate=1000.5), QUIET._replace(rate=-1000.5), QUIET._replace(rate=-1000.6),
    ),
    "rate that is none": (Limits(), QUIET._replace(rate=math.inf), QUIET._replace(rate=math.nan)),
    "step": (Limits(step=12), QUIET._replace(counts=12), QUIET._replace(counts=25)),
    "step backwards": (Limits(step=12), QUIET._replace(counts=-12), QUIET._replace(counts=-25)),
    "step over the counter's end": (
        Limits(step=12), QUIET._replace(counts=12), QUIET._replace(counts=-(2**31)),
    ),
}  # fmt: skip


@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize("limit", LIMITS)
def test_a_limit_acts_in_its_own_tick_and_not_before(host, limit, closed):
    limits, at, beyond = LIMITS[limit]
    given = {AT - 2: at, AT - 1: beyond}  # the exchange of tick k is answered before it

    def at_tick(tick):
        host.plant.reading = given.get(tick, host.plant.reading)

    commands = wave(300)
    played = host.play(150, commands, limits, closed, at_tick=at_tick)
    host.plant.reading = QUIET
    assert played.given[AT - 1] == at
    assert played.outputs[:AT] == commands[:AT], "on the limit is within it"
    assert set(played.outputs[AT:]) == {ZERO}
    assert [s.tick for s in played.samples if s.flags] == [AT]
    assert played.samples[AT].flags == INTERLOCK and played.statuses[-1][2] == TRIPPED
    # Nothing but a new START ends it.
    again = host.play(100, wave(100), Limits(), closed)
    assert again.outputs[:99] == wave(99)


def test_a_silent_host_means_zero_after_the_watchdogs_time_until_it_is_cleared(host):
    def at_tick(tick):
        host.mute = tick >= 200

    played = host.play(700, wave(2000), Limits(), closed=True, watchdog=50, at_tick=at_tick)
    zero = next(k for k, output in enumerate(played.outputs) if output == ZERO)
    # 50 ms are 200 ticks; what came last was sent at 200 at the latest, commands far ahead of it.
    assert 370 <= zero <= 401 and set(played.outputs[zero:]) == {ZERO}
    assert played.statuses[-1][2] == WATCHDOG
    host.mute = False
    assert host.connect()[7] == WATCHDOG
    assert host.request(line.START, Limits().pack(1, 1, 50)) == line.LATCHED
    assert host.request(line.CLEAR) == line.OK
    assert host.play(50, wave(50), Limits()).outputs[:49] == wave(49)


def test_a_device_that_is_left_alone_stops_sampling(host):
    assert host.request(line.START, Limits().pack(9, 1, 50)) == line.OK
    assert host.request(line.GO, struct.pack("<H", 9)) == line.OK
    host.mute = True
    states = [host.step()[0].state for _ in range(9000)]
    # 2 s are 8000 ticks at 4 kHz.
    assert 7990 <= states.index(IDLE) <= 8020
    assert host._new(line.SAMPLES)
    host.mute = False


def test_safe_acts_while_it_runs(host):
    def at_tick(tick):
        if tick == 100:
            host._number += 1
            host.send(line.SAFE, b"")

    played = host.play(200, wave(400), Limits(), at_tick=at_tick)
    zero = played.outputs.index(ZERO)
    assert 100 <= zero <= 102 and set(played.outputs[zero:]) == {ZERO}
    assert played.statuses[-1][2] == SAFE


# --- the faults ---------------------------------------------------------------------------------

DEVICES = {
    "SAFE ignored", "applied echoed wrong", "samples lost", "device resets", "device mute",
    "device hangs",
}  # fmt: skip
"""Faults of a device's own, which this firmware is not."""

NO_CODE = {"current_motor NaN", "torque NaN"}  # which 16 bits cannot show
APPLICABLE = [name for name in FAULTS if name not in DEVICES | NO_CODE]
ONSET, TICKS = 0.02, 240  # s, ticks
GUARD = Limits(
    analog_low=(-15_000, -1300, -16_000),
    analog_high=(15_000, 1300, 16_000),
    counts_low=-16_000,
    counts_high=16_000,
    rate=150.0 * 8192 / (2.0 * math.pi),
    step=330,
)


class Recorded:
    """What the firmware was given, for ``Ticker``, which shares no code with it."""

    now = Fault()

    def __init__(self, given):
        self._given = iter(given)
        self.driven = []

    def latch(self):
        codes, count, rate, at_end = next(self._given)
        return Latched([STEP * code for code in codes], count, rate, 32 * at_end)

    def drive(self, motor, brake, period):
        self.driven.append((round(motor / STEP), round(brake / STEP)))

    def told_safe(self):
        pass

    told_volts = told_safe


@pytest.mark.parametrize("name", APPLICABLE)
def test_with_a_fault_every_tick_is_that_of_the_independent_device(host, name):
    fault = FAULTS[name]
    setting = Setting(seed=3, load=fault.loads[0], fault=name, at=ONSET)
    host.plant = Rig(setting)
    if fault.damaged:
        damage = np.random.default_rng(1)
        host.damage = lambda data: _turned(data) if damage.random() < fault.damaged else data
    pause = round(fault.pause * CLOCK / PERIOD)
    onset = round(ONSET * CLOCK / PERIOD)

    def at_tick(tick):
        host.mute = onset <= tick < onset + pause

    commands = wave(1000)
    n = TICKS if not pause else 700
    played = host.play(n, commands, GUARD, closed=True, at_tick=at_tick)
    host.mute, host.damage = False, bytes
    assert host.plant.board.active
    rows, driven = reference(played, commands)
    assert [(s.analog, s.count, s.rate, s.applied, s.flags) for s in played.samples] == rows
    assert played.outputs[: len(driven)] == driven[: len(played.outputs)]
    tripped = [s.tick for s in played.samples if s.flags & INTERLOCK]
    if tripped:
        assert set(played.outputs[tripped[0] :]) == {ZERO}


def _turned(data):
    """Bytes of which one is another."""
    return data if not data else bytes([*data[:-3], data[-3] ^ 0x10, *data[-2:]])


def reference(played, commands):
    """Rows and outputs of the independent tick on the same inputs, and with the commands that came.

    Commands that a bad line or a silent host kept back, and the watchdog, are taken from the
    samples' flags: this is about ticks.
    """
    request = line.Start(
        1, 1, PERIOD, 100, GUARD.lowest, GUARD.highest, GUARD.analog_low, GUARD.analog_high,
        GUARD.counts_low, GUARD.counts_high, GUARD.rate, GUARD.step,
    )  # fmt: skip
    board = Recorded(played.given)
    ticker = Ticker(board, PERIOD / CLOCK, True, serial_device._limits(request))
    rows = []
    for sample in played.samples:
        came = not sample.flags & HELD
        if came and sample.tick < len(commands):
            ticker.send(sample.tick, [STEP * code for code in commands[sample.tick]])
        cut = sample.applied == ZERO and not sample.flags and ticker.latch == NONE
        if cut and commands[sample.tick] != ZERO:
            ticker.make_safe(WATCHDOG)
        row = ticker.run()
        codes = tuple(round(value / STEP) for value in row.analog)
        applied = tuple(round(value / STEP) for value in row.applied)
        rows.append((codes, row.count, row.rate, applied, row.flags))
    return rows, board.driven


def test_every_fault_of_the_matrix_is_tried_or_has_its_reason():
    assert set(APPLICABLE) | DEVICES | NO_CODE == set(FAULTS)
    assert replace(GUARD).step == GUARD.step


# --- requests that come anyhow ------------------------------------------------------------------


def test_frames_of_another_session_and_bytes_at_random_change_nothing(host):
    rng = np.random.default_rng(5)

    def at_tick(tick):
        if tick % 10 == 0:
            stop = line.encoded(line.Frame(line.SAFE, 4711, 1, b""))
            host._out += rng.bytes(40) + b"\0" + stop

    commands = wave(600)
    played = host.play(500, commands, Limits(), at_tick=at_tick)
    assert played.outputs[:500] == commands[:500]
    refused = [frame for frame in host.frames if frame.session == 4711]
    assert len(refused) > 30 and all(frame.payload[1] == line.NO_SESSION for frame in refused)
