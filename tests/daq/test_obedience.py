"""Devices that apply what they were not told to, and say so, or give flags for it."""

import numpy as np
import pytest

from daq.config.rig import LimitSettings
from daq.hal import Flag, Mode, Samples
from daq.limits.device import Obedience
from tests.daq.support import only_capture, record_of, rig, write_experiment, write_rig

RATE, N = 800.0, 400
OPEN, CLOSED = Mode
PLAIN, CLAMPED, HELD = 0, int(Flag.CLAMPED), int(Flag.HELD)
ZEROED = int(Flag.INTERLOCK), int(Flag.UNDERFLOW)


def samples(command, applied, flags):
    """Of the motor; the brake does as it is told."""
    zero = np.zeros(N)
    command, applied = (np.broadcast_to(values, N).astype(float) for values in (command, applied))
    columns = dict.fromkeys(Samples.__dataclass_fields__, zero)
    columns |= {"tick": np.arange(N), "flags": np.broadcast_to(flags, N).astype(np.int64)}
    columns |= {"cmd_voltage_motor": command, "applied_voltage_motor": applied}
    return Samples(**columns)


def first_trip(whole, size, mode=CLOSED, **limits):
    obedience = Obedience(LimitSettings(**limits), 0.01, mode, RATE)
    for start in range(0, N, size):
        rows = slice(start, start + size)
        trip = obedience.check(Samples(**{name: v[rows] for name, v in vars(whole).items()}))
        if trip is not None:
            return start + trip[0], trip[1]
    return None


def at(tick, before, after):
    return np.where(np.arange(N) < tick, before, after)


SINE = 2.0 * np.sin(0.05 * np.arange(N))
HELD_SINE = np.where(np.arange(N) % 4 < 2, SINE, np.roll(SINE, 1))
HELD_SINE[3::4] = SINE[1::4]
RIGHT = {
    "as commanded": (CLOSED, SINE, SINE + 0.005, PLAIN),
    "the range's end": (CLOSED, 4.0 * SINE, np.clip(4.0 * SINE, -5.0, 5.0), CLAMPED),
    "held now and then": (
        CLOSED, SINE, HELD_SINE, np.where(np.arange(N) % 4 < 2, PLAIN, HELD)),
    "held until one arrives": (CLOSED, at(160, 1.0, 2.0), 1.0, at(160, PLAIN, HELD)),
    "held at zero for ever": (CLOSED, at(40, 0.0, 2.0), 0.0, at(40, PLAIN, HELD)),
    "zeroed": (OPEN, SINE, at(99, SINE, 0.0), at(99, PLAIN, ZEROED[1])),
}  # fmt: skip
WRONG = {
    "twice as much": (OPEN, 1.0, at(70, 1.0, 2.0), at(70, PLAIN, CLAMPED), 70),
    "the other sign": (CLOSED, 1.0, at(70, 1.0, -1.0), at(70, PLAIN, CLAMPED), 70),
    "something from the first sample on": (CLOSED, 0.0, 2.0, HELD, 0),
    "something of its own": (CLOSED, SINE, at(80, SINE, 3.0), at(80, PLAIN, HELD), 80),
    "held in open loop": (OPEN, SINE, at(80, SINE, 0.0), at(80, PLAIN, HELD), 80),
    "not zeroed": (OPEN, 1.0, 1.0, at(99, PLAIN, ZEROED[1]), 99),
    "not zeroed by its guard": (CLOSED, 1.0, 1.0, at(99, PLAIN, ZEROED[0]), 99),
    "no number": (CLOSED, 1.0, at(7, 1.0, np.nan), at(7, PLAIN, HELD), 7),
    "no flag": (CLOSED, SINE, at(120, SINE, 0.0), PLAIN, 120),
    # A fourth of a second is 200 samples.
    "held too long": (CLOSED, at(100, 1.0, 2.0), 1.0, at(100, PLAIN, HELD), 300),
}  # fmt: skip


@pytest.mark.parametrize("size", [1, 37, N])
@pytest.mark.parametrize("name", RIGHT)
def test_what_its_flags_explain_is_obedience(name, size):
    mode, command, applied, flags = RIGHT[name]
    changes = {"late": 1.0} if name == "held until one arrives" else {}
    assert first_trip(samples(command, applied, flags), size, mode, **changes) is None


@pytest.mark.parametrize("size", [1, 37, N])
@pytest.mark.parametrize("name", WRONG)
def test_what_its_flags_do_not_explain_is_not(name, size):
    mode, command, applied, flags, tick = WRONG[name]
    trip = first_trip(samples(command, applied, flags), size, mode, late=0.25)
    assert trip is not None and trip[0] == tick
    words = "no command has reached the device for 0.25 s" if "long" in name else "another voltage"
    assert words in trip[1]


def test_a_slew_lets_a_command_be_approached_from_where_it_was():
    approach = np.maximum(3.0 - 0.01 * np.arange(N), -1.0)
    whole = samples(at(1, 3.0, -1.0), approach, CLAMPED)
    assert first_trip(whole, 1, slew={"motor": 8.0}) is None
    assert first_trip(whole, 1) is not None


_LATCHED = '''
"""The simulated rig, whose amplifier drives while the device is latched."""
from dataclasses import replace

from sim_rig.backend import SimulatedDevice


class Latched(SimulatedDevice):
    latched = False

    def start(self, sample_rate, mode, guard):
        super().start(sample_rate, mode, guard)
        self.latched = False

    def safe(self):
        self.latched = True
        super().safe()

    def receive(self):
        raw = super().receive()
        return replace(raw, analog=raw.analog + [0.5, 0.0, 0.0]) if self.latched else raw
'''


def test_zero_at_a_new_start_does_not_outweigh_what_safe_leaves(tmp_path):
    (tmp_path / "latched.py").write_text(_LATCHED)
    write_experiment(tmp_path / "e.yaml")
    write_rig(
        tmp_path / "rig.yaml", backend="latched.py:Latched", options={}, amplifiers={"motor": 0.5}
    )
    result = rig("run", "e.yaml", "--rig", "rig.yaml", cwd=tmp_path)
    assert result.returncode == 1
    assert "switch off the amplifier: zero outputs are not confirmed" in result.stderr
    outputs = record_of(only_capture(tmp_path))["outputs"]
    assert outputs["confirmed"] is False and "current_motor reads 0.25" in outputs["problem"]


_REFUSING = '''
"""The simulated rig, which zeroes its outputs and fails to say so."""
from sim_rig.backend import SimulatedDevice


class Refusing(SimulatedDevice):
    def safe(self):
        super().safe()
        raise OSError("the relay sticks")

    stop = close = SimulatedDevice.safe
'''


def test_a_device_that_fails_in_safe_is_named_though_its_outputs_are_zero(tmp_path):
    (tmp_path / "refusing.py").write_text(_REFUSING)
    write_experiment(tmp_path / "e.yaml")
    write_rig(tmp_path / "rig.yaml", backend="refusing.py:Refusing", options={})
    result = rig("run", "e.yaml", "--rig", "rig.yaml", cwd=tmp_path)
    record = record_of(only_capture(tmp_path))
    assert result.returncode == 0 and record["outputs"]["confirmed"] is True
    (warning,) = record["connection"]["warnings"]
    assert "failed in safe()" in warning and "the relay sticks" in warning
    assert "the relay sticks" in result.stderr
