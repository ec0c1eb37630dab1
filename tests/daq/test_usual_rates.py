"""Which sample rate a device and its computer keep up with, as ``rig characterise`` asks first."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from daq.diagnose import sampling
from daq.diagnose.sampling import fastest, kept_up_with
from daq.errors import DeviceError
from daq.hal import Flag, Mode
from daq.lookup.rigs import load_rig
from sim_rig.backend import SimulatedDevice


class Slow(SimulatedDevice):
    """The simulated rig as on a line: answers come too late above a rate, samples above another."""

    def __init__(self, options, max_rate, answers):
        super().__init__(options)
        self.max_rate, self.answers, self.late, self.closed = max_rate, answers, False, False

    def open(self):
        return replace(super().open(), max_rate=self.max_rate, virtual_time=False)

    def start(self, sample_rate, mode, guard):
        super().start(sample_rate, mode, guard)
        self.late = mode is Mode.CLOSED_LOOP and sample_rate > self.answers

    def receive(self):
        raw = super().receive()
        return replace(raw, flags=raw.flags | np.uint8(Flag.HELD)) if self.late else raw

    def close(self):
        super().close()
        self.closed = True


class Unhurried:
    """In place of the clock that would find a computed device too fast."""

    def __init__(self, rate):
        pass

    def received(self, tick):
        pass


@pytest.fixture(autouse=True)
def unhurried(monkeypatch):
    monkeypatch.setattr(sampling, "Pace", Unhurried)


def slow(max_rate=20_000.0, answers=np.inf):
    return Slow(load_rig("simulated.yaml")[1].options, max_rate, answers)


@pytest.mark.parametrize(
    ("max_rate", "answers", "rate"),
    [(20_000.0, np.inf, 2000.0), (20_000.0, 1200.0, 1000.0), (900.0, np.inf, 800.0)],
)
def test_the_fastest_usual_rate_that_is_kept_up_with_is_taken(max_rate, answers, rate):
    device, told = slow(max_rate, answers), []
    assert kept_up_with(device, 2000.0, told.append) == rate
    assert device.closed
    texts = [event.text for event in told if hasattr(event, "text")]
    assert ["closed loop at 2000 Hz" in text for text in texts] == [True] * (answers < 2000.0)


def test_a_device_that_keeps_up_with_nothing_is_refused_with_what_to_do():
    device = slow(answers=0.0)
    with pytest.raises(DeviceError, match=r"at 100 Hz.*commands too late.*send further ahead"):
        kept_up_with(device, 2000.0)
    with pytest.raises(DeviceError, match="samples at up to 50 Hz, no usual rate"):
        kept_up_with(slow(50.0), 2000.0)
    assert device.closed


def test_a_simulated_rig_keeps_up_with_any_rate_it_has():
    assert kept_up_with(load_rig("simulated.yaml")[1], 2000.0) == 2000.0
    assert fastest(load_rig("simulated.yaml")[1]) == 20_000.0
