"""Limits of what is measured: currents, their heat, torque, speed."""

import numpy as np

from daq.config.rig import Overload
from daq.hal import Flag, FloatArray, Phase, Samples
from daq.limits.base import Limit, Trip, first_row

_LARGEST = float(np.finfo(np.float64).max)  # any finite number is within it
_INTERLOCK = int(Flag.INTERLOCK)


class Magnitude(Limit):
    """A measured quantity within plus or minus a limit, or at least a finite number."""

    def __init__(self, name: str, limit: float | None, unit: str) -> None:
        self._name, self._unit = name, unit
        self._limit = _LARGEST if limit is None else limit

    def check(self, samples: Samples) -> Trip | None:
        """Compare every sample; what is no number compares as beyond."""
        values: FloatArray = getattr(samples, self._name)
        if len(values) == 1 and -self._limit <= values.item() <= self._limit:
            return None
        row = first_row(~(np.abs(values) <= self._limit))
        if row is None:
            return None
        value = values[row]
        if not np.isfinite(value):
            return row, f"{self._name} is {value}, which is no measurement; check its sensor"
        return row, (
            f"{self._name} is {value:.4g} {self._unit}, "
            f"beyond its limit of {self._limit:g} {self._unit}"
        )


class DeviceFound(Limit):
    """What the device itself found beyond its guard."""

    tells_faults = True

    def check(self, samples: Samples) -> Trip | None:
        """Look for the device's flag."""
        flags = samples.flags
        if len(flags) == 1 and not flags.item() & _INTERLOCK:
            return None
        row = first_row((flags & _INTERLOCK) != 0)
        return None if row is None else (row, "the device found an input beyond its limit")


def i2t_levels(
    level: float, current: FloatArray, seconds: FloatArray, continuous: float
) -> FloatArray:
    """i^2 t above a continuous current after each sample, (n,) [A^2 s].

    level: before the first. current: (n,) [A], for seconds: (n,) each. The level rises and falls
    with i^2 - continuous^2 and never below zero.
    """
    steps = (current * current - continuous * continuous) * seconds
    total = level + np.cumsum(steps)
    # What a walk that is held at zero gains on a free one: how far the free one went below.
    levels: FloatArray = total - np.minimum(np.minimum.accumulate(total), 0.0)
    return levels


class I2t(Limit):
    """Heat of a winding: i^2 t above a continuous current stays within a budget."""

    def __init__(self, name: str, load: Overload) -> None:
        self._name, self._continuous, self._budget = name, load.continuous, load.budget
        self._square = load.continuous**2
        self._level = 0.0

    def begin(self, phase: Phase, sample_rate: float) -> None:
        """The heat stays; only time begins anew."""
        self._dt, self._tick = 1.0 / sample_rate, -1

    def check(self, samples: Samples) -> Trip | None:
        """Sum up; a sample stands for the time since the one before."""
        current: FloatArray = getattr(samples, self._name)
        if len(current) == 1:
            tick, value = samples.tick.item(), current.item()
            seconds = (tick - self._tick) * self._dt
            self._tick = tick
            self._level = max(0.0, self._level + (value * value - self._square) * seconds)
            return None if self._level <= self._budget else (0, self._reason(self._level))
        steps = np.diff(samples.tick, prepend=self._tick) * self._dt
        levels = i2t_levels(self._level, current, steps, self._continuous)
        self._tick, self._level = int(samples.tick[-1]), float(levels[-1])
        row = first_row(levels > self._budget)
        return None if row is None else (row, self._reason(levels[row]))

    def _reason(self, level: float) -> str:
        return (
            f"{self._name} has reached {level:.4g} A^2*s above {self._continuous:g} A, beyond "
            f"its budget of {self._budget:g} A^2*s; let the winding cool down"
        )
