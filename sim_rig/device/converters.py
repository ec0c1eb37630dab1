"""Converters of the simulated rig: volts at its inputs and outputs as the electronics see them."""

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
    resolution: one step of the converters [V], zero for ideal ones without noise or range.
    """

    senses: FloatArray
    offsets: FloatArray
    noise: float
    resolution: float

    def commands(self, volts: FloatArray, guard: Guard) -> FloatArray:
        """What the outputs give for the commands, (n, 2) [V], within the guard's clamps."""
        given = np.empty(volts.shape)
        _give(volts, self.resolution, guard.command_low, guard.command_high, given)
        return given

    def read(self, true: FloatArray, noise: FloatArray, flags: IntArray) -> FloatArray:
        """Volts, (n, 3), of the plant's outputs true, (n, >= 3); flags are added to.

        noise: (n, 3), of unit variance.
        """
        volts = np.empty(noise.shape)
        _read(true, self.senses, self.offsets, self.noise, self.resolution, noise, volts, flags)
        return volts


@njit(cache=True, nogil=True)
def _give(
    volts: FloatArray, resolution: float, low: FloatArray, high: FloatArray, given: FloatArray
) -> None:
    for i in range(volts.shape[0]):
        for j in range(volts.shape[1]):
            value = volts[i, j]
            if resolution > 0.0:
                value = np.rint(value / resolution) * resolution
            given[i, j] = min(max(value, low[j]), high[j])


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
