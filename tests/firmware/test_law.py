"""A torque controller that the firmware runs, in QEMU at 4 kHz, beside the same in Python."""

import math
import struct

import numpy as np
import pytest

from daq.device_code import device_code
from daq.experiment import Sample
from daq.lookup.controllers import load_controller
from daq.serial import messages
from tests.faults import line
from tests.faults.board import STEP, Setting
from tests.faults.firmware import CLAMPED, HELD, INTERLOCK, UNDERFLOW
from tests.firmware.build import make, needs
from tests.firmware.lockstep import CLOCK, PERIOD, EmulatedFirmware, Host, Limits
from tests.firmware.test_lockstep import QUIET, WATCHDOG, ZERO, Bench, Rig
from tests.haptics.test_torque_tracking import controller

LAW = 128  # flag
ANGLE, CURRENT, TORQUE, REFERENCE = 2.0 * math.pi / 8192, 0.5 * STEP, 0.706 * STEP, 1e-4
RATE = CLOCK / PERIOD
FULL_SCALE = 4.04 / STEP, 0.36 / STEP  # codes, largest of the commands
ON, OFF, BLEND = 100, 900, 160  # ticks


@pytest.fixture(scope="module")
def tuned(tmp_path_factory):
    folder = tmp_path_factory.mktemp("law")
    return load_controller(str(controller(folder, "lqg", sample_rate=RATE)), folder)


@pytest.fixture(scope="module")
def running(tuned):
    needs("make", "arm-none-eabi-gcc", "qemu-system-arm")
    folder = tuned.path.parent / "code"
    folder.mkdir()
    device_code(tuned.path, "single").save(folder, "law")
    with EmulatedFirmware(make(BOARD="qemu", LAW=folder) / "qemu-law" / "rig.elf", True) as qemu:
        yield qemu


@pytest.fixture
def host(running):
    host = Host(running, Rig(Setting(seed=3, load="hand", sensor="load")))
    host.connect()
    host.request(line.CLEAR)
    return host


def law(host, on, first, blend=BLEND, **scales):
    """A payload of LAW."""
    values = {"angle": ANGLE, "current_motor": (CURRENT, 0.0), "torque": (TORQUE, 0.0)}
    values |= {"counts_zero": 0, "reference": REFERENCE, **scales}
    return messages.Law(host._run, on, first, blend, **values).pack()


def orders(host, *payloads):
    """An at_tick that sends payloads of LAW at tick 0."""

    def at_tick(tick):
        if tick == 0:
            for payload in payloads:
                host._number += 1
                host.send(line.LAW, payload(host))

    return at_tick


def references(n):
    """Codes: outputs up to ON, then references of up to 0.2 N*m."""
    wave = [(round(2000 * math.sin(0.02 * k)), 0) for k in range(n)]
    return [(1000, 300)] * ON + wave[ON:]


def answers(tuned, played, commands, first, last):
    """Outputs of Python's law at ticks ``first`` + 1 to ``last``, by what the device was given."""
    at_work, codes = tuned.law(), []
    for tick in range(first, last):
        (i_m, i_b, torque), count, rate, _ = played.given[tick]
        rate = float(np.float32(rate))
        sample = Sample(
            tick - first, tick / RATE, CURRENT * i_m, CURRENT * i_b, TORQUE * torque,
            ANGLE * count, ANGLE * rate, 0,
        )  # fmt: skip
        volts = at_work.volts(sample, REFERENCE * commands[tick][0])
        codes.append([value / STEP for value in volts])
    return np.array(codes)


def test_the_device_answers_as_python_does_and_goes_there_without_a_jump(host, tuned):
    commands = references(OFF) + [(-500, 0)] * 400

    def at_tick(tick):
        orders(host, lambda host: law(host, True, ON))(tick)
        # An order takes the place of one that waits.
        orders(host, lambda host: law(host, False, OFF))(tick - ON - 5)

    played = host.play(len(commands), commands, Limits(), at_tick=at_tick)
    outputs = np.array(played.outputs[: len(commands) - 1])
    expected = answers(tuned, played, commands, ON, OFF - 1)  # at ON + 1 to OFF - 1
    assert np.abs(expected[:, 0]).max() > 0.3 * FULL_SCALE[0]
    # On the way from what stood at ON.
    part = np.minimum(np.arange(1, len(expected) + 1) / BLEND, 1.0)[:, None]
    ways = outputs[ON - 1] + part * (expected - outputs[ON - 1])
    error = np.abs(outputs[ON + 1 : OFF] - ways) / FULL_SCALE
    print(f"largest difference: {error.max():.1e} of full scale")
    assert error.max() < 1e-3
    # And away to what the host commands.
    part = np.minimum(np.arange(BLEND + 50) / BLEND, 1.0)[:, None]
    ways = outputs[OFF - 1] + part * (np.array([-500, 0]) - outputs[OFF - 1])
    assert np.abs(outputs[OFF : OFF + len(ways)] - ways).max() <= 1.0
    # No jump: a step of the way and what the target moves meanwhile.
    for at, targets in ((ON, expected[:BLEND]), (OFF, np.tile([-500.0, 0.0], (BLEND, 1)))):
        steps = np.abs(np.diff(outputs[at - 1 : at + BLEND], axis=0))
        way = np.abs(targets - outputs[at - 1]).max(axis=0) / BLEND
        moves = np.abs(np.diff(targets, axis=0)).max(axis=0)
        assert (steps <= way + moves + 1.0).all()
    flags = [sample.flags & ~CLAMPED for sample in played.samples[: len(commands)]]
    assert flags[:ON] == [0] * ON and set(flags[ON : OFF + BLEND]) == {LAW}
    assert not any(flags[OFF + BLEND :])
    print(f"instructions of a tick: {max(played.costs):.0f} at most")
    assert max(played.costs) < MOST_INSTRUCTIONS


def test_a_law_that_comes_again_begins_from_rest(host, tuned):
    switches = {0: (True, ON), 110: (False, 200), 210: (True, 300)}

    def at_tick(tick):
        if tick in switches:
            orders(host, lambda host: law(host, *switches[tick], blend=10))(0)

    commands = references(500)
    commands[200:300] = [ZERO] * 100
    played = host.play(len(commands), commands, Limits(), at_tick=at_tick)
    expected = answers(tuned, played, commands, 300, 499)[10:]
    outputs = np.array(played.outputs[311:500])
    assert np.abs((outputs - expected[: len(outputs)]) / FULL_SCALE).max() < 1e-3


MOST_INSTRUCTIONS = 2000
"""Of rig_on_tick with lqg: at two clocks each 24 us of 250 at 168 MHz."""


@pytest.mark.parametrize("closed", [False, True])
def test_a_limit_that_the_law_passes_acts_in_its_own_tick(host, closed):
    most = round(0.5 / CURRENT)  # 0.5 A; the reference asks for 1.4
    limits = Limits(analog_high=(most, 2**31 - 1, 2**31 - 1))
    commands = [ZERO] * ON + [(2000, 0)] * 900
    at_tick = orders(host, lambda host: law(host, True, ON))
    played = host.play(len(commands), commands, limits, closed, at_tick=at_tick)
    beyond = next(k for k, reading in enumerate(played.given) if reading.analog[0] > most)
    assert ON < beyond < ON + 2 * BLEND
    assert [s.tick for s in played.samples if s.flags & INTERLOCK] == [beyond]
    assert played.outputs[beyond - 1] != ZERO and set(played.outputs[beyond:]) == {ZERO}


def test_a_silent_host_means_zero_while_the_law_runs(host):
    start = orders(host, lambda host: law(host, True, ON))

    def at_tick(tick):
        start(tick)
        host.mute = tick >= 300

    played = host.play(700, references(2000), Limits(), watchdog=50, at_tick=at_tick)
    host.mute = False
    last = max(k for k, output in enumerate(played.outputs) if output != ZERO)
    # 50 ms are 200 ticks; the last frame came a hundred before the silence at most.
    assert 400 <= last <= 500
    assert played.statuses[-1][2] == WATCHDOG


def test_clamps_are_above_the_law_and_a_reference_that_is_missing_is_held_or_ends_it(host):
    limits = Limits(lowest=(-900, 0), highest=(900, 5))
    commands = [ZERO] * ON + [(2000, 0)] * 300
    at_tick = orders(host, lambda host: law(host, True, ON))
    played = host.play(600, commands, limits, at_tick=at_tick)
    assert np.abs(played.outputs).max() == 900
    assert {s.flags for s in played.samples[450:]} <= {LAW | HELD, LAW | HELD | CLAMPED}
    assert any(s.flags & CLAMPED for s in played.samples)
    played = host.play(600, commands, limits, closed=False, at_tick=at_tick)
    assert {s.flags for s in played.samples[400:]} == {UNDERFLOW}
    assert set(played.outputs[400:]) == {ZERO}


def test_an_answer_that_is_no_number_is_a_limit_passed(host):
    at_tick = orders(host, lambda host: law(host, True, ON, angle=3e38))
    host.plant = Bench(QUIET._replace(counts=7))
    played = host.play(300, [(100, 100)] * 300, Limits(), at_tick=at_tick)
    tripped = [s.tick for s in played.samples if s.flags & INTERLOCK]
    assert len(tripped) == 1 and set(played.outputs[tripped[0] :]) == {ZERO}


@pytest.mark.parametrize("on", [True, False])
def test_an_order_behind_its_tick_changes_nothing(host, on):
    """Late to come, commands go on; late to go, the law does, to references that are zero."""
    start = orders(host, *([] if on else [lambda host: law(host, True, ON)]))

    def at_tick(tick):
        start(tick)
        if tick == 250:
            host._number += 1
            host.send(line.LAW, law(host, on, 200))

    commands = [(500, 20)] * 200 + [ZERO] * 200
    played = host.play(400, commands, Limits(), at_tick=at_tick)
    flags = [sample.flags & LAW for sample in played.samples[:400]]
    assert flags == ([0] * 400 if on else [0] * ON + [LAW] * 300)
    if on:
        assert played.outputs[: len(commands) - 1] == commands[:-1]


HALF_BROKEN = """
typedef float rig_real;
typedef struct { rig_real volts[2]; int ticks; } rig_controller;
#define RIG_CONTROLLER_AHEAD 1
#define RIG_CONTROLLER_FINGERPRINT "00000000"
#define RIG_CONTROLLER_PERIOD 0.00025f
void rig_controller_reset(rig_controller *law);
void rig_controller_step(rig_controller *law, rig_real theta, rig_real omega, rig_real torque,
                         rig_real current_motor, rig_real reference, int lost);
"""
HALF_BROKEN_STEP = """
#include "half.h"
void rig_controller_reset(rig_controller *law) { law->ticks = 0; }
void rig_controller_step(rig_controller *law, rig_real theta, rig_real omega, rig_real torque,
                         rig_real current_motor, rig_real reference, int lost) {
    (void)theta, (void)omega, (void)torque, (void)current_motor, (void)reference, (void)lost;
    law->ticks++;
    law->volts[0] = (law->ticks < 50) ? 0.0f : 0.0f / (rig_real)(law->ticks - law->ticks);
    law->volts[1] = 100.0f;
}
"""


def test_where_one_answer_is_no_number_the_other_is_not_given_either(tmp_path):
    needs("make", "arm-none-eabi-gcc", "qemu-system-arm")
    (tmp_path / "half.h").write_text(f"#ifndef HALF\n#define HALF{HALF_BROKEN}#endif\n")
    (tmp_path / "half.c").write_text(HALF_BROKEN_STEP)
    make(BOARD="qemu", LAW=tmp_path, BUILD=tmp_path)
    with EmulatedFirmware(tmp_path / "qemu-law" / "rig.elf", True) as qemu:
        host = Host(qemu, Bench(QUIET))
        host.connect()
        at_tick = orders(host, lambda host: law(host, True, ON, blend=0))
        limits = Limits(highest=(1000, 1000))
        played = host.play(300, [(0, 0)] * 300, limits, at_tick=at_tick)
    (tripped,) = [s.tick for s in played.samples if s.flags & INTERLOCK]
    assert played.outputs[tripped - 1] == (0, 1000), "until then within its limit"
    assert set(played.outputs[tripped:]) == {ZERO}


def test_what_no_law_can_mean_is_refused(host):
    assert host.request(line.LAW, law(host, True, 0)) == line.WRONG_STATE, "no run"
    host._run += 1
    assert host.request(line.START, Limits().pack(host._run, 1, 100)) == line.OK
    good = law(host, True, 0)
    assert host.request(line.LAW, good) == line.OK
    assert host.request(line.LAW, good[:-1]) == line.BAD_VALUE
    assert host.request(line.LAW, struct.pack("<H", 9999) + good[2:]) == line.WRONG_STATE
    assert host.request(line.LAW, good[:2] + b"\2" + good[3:]) == line.BAD_VALUE
    for name in ("angle", "reference"):
        wrong = law(host, True, 0, **{name: math.nan})
        assert host.request(line.LAW, wrong) == line.BAD_VALUE
    assert host.request(line.GO, struct.pack("<H", host._run)) == line.OK
    assert host.request(line.LAW, good) == line.WRONG_STATE, "its tick has passed"
    slow = Limits().pack(host._run, 1, 100)
    slow = slow[:4] + struct.pack("<I", 2 * PERIOD) + slow[8:]
    assert host.request(line.START, slow) == line.OK
    assert host.request(line.LAW, good) == line.BAD_VALUE, "tuned for another period"
