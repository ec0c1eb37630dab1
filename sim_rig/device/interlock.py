"""The device's own interlock, checked every tick as a board does in its timer's interrupt."""

import numpy as np
from numba import njit

from daq.hal import FloatArray, Guard


class Interlock:
    """Limits of a guard, checked over the samples of a run in their order."""

    def __init__(self, guard: Guard) -> None:
        self._analog = np.array([guard.analog_low, guard.analog_high], dtype=np.float64)
        self._bounds = np.array(
            [guard.counts_low, guard.counts_high, guard.count_rate, guard.count_step]
        )
        self._counts = np.array([np.nan, np.nan])  # at tick 0, and at the tick before

    def first_beyond(self, volts: FloatArray, counts: FloatArray, rates: FloatArray) -> int:
        """The first of the next n rows that is beyond a limit, or n.

        volts: (n, 3). counts, rates: (n,), the latter in 1/s. What is no number is beyond any.
        """
        return int(_first_beyond(volts, counts, rates, self._analog, self._bounds, self._counts))


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
