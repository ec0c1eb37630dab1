"""What this program watches for a card that cannot: the rate of its counts, and limits."""

import math
from collections import deque
from itertools import islice

import numpy as np
import numpy.typing as npt

from daq.hal import FloatArray, Guard

_LONGEST = 16  # samples of which a rate is estimated


class RateEstimate:
    """Rate of a count by a first-order adaptive window, where no hardware times its edges.

    The longest window of the last samples whose ends a line joins with all between within a count
    (Janabi-Sharifi, Hayward and Chen, IEEE Trans. Control Syst. Technol. 8(6), 2000): long and
    quiet at steady speed, short where the speed changes.
    """

    def __init__(self, sample_rate: float) -> None:
        self._rate = sample_rate
        self._counts: deque[int] = deque(maxlen=_LONGEST + 1)

    def rates(self, counts: npt.NDArray[np.int64]) -> FloatArray:
        """Rates [1/s] at each of the counts (n,) that follow those before."""
        return np.array([self._next(count) for count in counts.tolist()]) * self._rate

    def _next(self, count: int) -> float:
        """Counts a sample."""
        self._counts.append(count)
        slope, low, high = 0.0, -math.inf, math.inf  # lines that come within one of all since
        for n, earlier in enumerate(islice(reversed(self._counts), 1, None), start=1):
            moved = count - earlier
            if not low <= moved / n <= high:
                break
            slope = moved / n
            low, high = max(low, (moved - 1) / n), min(high, (moved + 1) / n)
        return slope


class GuardWatch:
    """Compares the samples of a run, in their order, with the limits of a guard."""

    def __init__(self, guard: Guard) -> None:
        self._guard = guard
        self._first = self._last = np.nan

    def first_beyond(self, analog: FloatArray, counts: FloatArray, rates: FloatArray) -> int:
        """The first of the next n rows beyond a limit, or n; NaN is beyond every limit.

        analog: (n, 3) [V]. counts, rates: (n,), the latter in 1/s.
        """
        guard = self._guard
        if np.isnan(self._first):
            self._first = self._last = counts[0]
        moved, steps = counts - self._first, np.abs(np.diff(counts, prepend=self._last))
        self._last = counts[-1]
        within = ((guard.analog_low <= analog) & (analog <= guard.analog_high)).all(axis=1)
        within &= (guard.counts_low <= moved) & (moved <= guard.counts_high)
        within &= (np.abs(rates) <= guard.count_rate) & (steps <= guard.count_step)
        return len(counts) if within.all() else int(np.argmin(within))
