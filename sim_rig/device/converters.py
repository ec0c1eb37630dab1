"""Converters of the simulated rig, and the interlock that checks their readings at every tick."""

from dataclasses import dataclass

import numpy as np
from numba import njit

from daq.hal import Flag, FloatArray, Guard, IntArray

RANGE = 10.0  # V, either side of zero

_SATURATED = int(Flag.SATURATED)


@dataclass(frozen=True)
class Converters:
    """Analog inputs and outputs.

    senses: (3,), volts per SI unit of each input. offsets: (3,) [V]. noise: rms [V].
    resolution: one step of the converters [V]; zero for ideal ones, without noise or range.
    """

    senses: FloatArray
    offsets: FloatArray
    noise: float
    resolution: float

    def commands(self, volts: FloatArray, guard: Guard) -> FloatArray:
        """Voltages that the outputs apply for the commands, (n, 2) [V], clamped by the guard."""
        applied = np.empty(volts.shape)
        _apply(volts, self.resolution, guard.command_low, guard.command_high, applied)
        return applied

    def read(self, true: FloatArray, noise: FloatArray, flags: IntArray) -> FloatArray:
        """Readings, (n, 3) [V], of the plant's true outputs, (n, >= 3).

        noise: (n, 3), of unit variance. flags: (n,), where saturated samples are marked.
        """
        volts = np.empty(noise.shape)
        _read(true, self.senses, self.offsets, self.noise, self.resolution, noise, volts, flags)
        return volts


class Interlock:
    """Checks the samples of a run, in their order, against the limits of a guard."""

    def __init__(self, guard: Guard) -> None:
        self._analog = np.array([guard.analog_low, guard.analog_high], dtype=np.float64)
        self._bounds = np.array(
            [guard.counts_low, guard.counts_high, guard.count_rate, guard.count_step]
        )
        self._counts = np.array([np.nan, np.nan])  # at tick 0, and at the tick before

    def first_beyond(self, volts: FloatArray, counts: FloatArray, rates: FloatArray) -> int:
        """The first of the next n rows that is beyond a limit, or n.

        volts: (n, 3). counts, rates: (n,), the latter in 1/s. NaN is beyond every limit.
        """
        return int(_first_beyond(volts, counts, rates, self._analog, self._bounds, self._counts))


@njit(cache=True, nogil=True)
def _apply(
    volts: FloatArray, resolution: float, low: FloatArray, high: FloatArray, applied: FloatArray
) -> None:
    for i in range(volts.shape[0]):
        for j in range(volts.shape[1]):
            value = volts[i, j]
            if resolution > 0.0:
                value = np.rint(value / resolution) * resolution
            applied[i, j] = min(max(value, low[j]), high[j])


@njit(cache=True, nogil=True)
def _read(
    true: FloatArray,
    senses: FloatArray,
    offsets: FloatArray,
    deviation: float,
    resolution: float,
    noise: FloatArray,
    volts: FloatArray,
    flags: IntArray,
) -> None:
    for i in range(volts.shape[0]):
        for j in range(volts.shape[1]):
            value = true[i, j] * senses[j]
            if resolution > 0.0:
                value += offsets[j] + deviation * noise[i, j]
                if not abs(value) < RANGE:
                    flags[i] |= _SATURATED
                value = np.rint(value / resolution) * resolution
                value = min(max(value, -RANGE), RANGE - resolution)
            volts[i, j] = value


@njit(cache=True, nogil=True)
def _first_beyond(
    volts: FloatArray,
    counts: FloatArray,
    rates: FloatArray,
    analog: FloatArray,
    bounds: FloatArray,
    memory: FloatArray,
) -> int:
    n: int = volts.shape[0]
    if np.isnan(memory[0]):
        memory[:] = counts[0]
    first, last = memory[0], memory[1]
    for i in range(n):
        for j in range(volts.shape[1]):
            if not analog[0, j] <= volts[i, j] <= analog[1, j]:
                return i
        if not bounds[0] <= counts[i] - first <= bounds[1] or not abs(rates[i]) <= bounds[2]:
            return i
        if not abs(counts[i] - last) <= bounds[3]:
            return i
        last = counts[i]
    memory[1] = last
    return n
