"""Whether samples come at the rate that was asked for, by this computer's clock."""

import time
from collections.abc import Callable
from itertools import pairwise

from daq.errors import DeviceError

_TOLERANCE = 0.01  # share of the rate
_WINDOW = 0.25  # s, at first, of which the promptest sample is kept
_KEPT = 64  # windows; beyond, neighbours are joined
_QUARTERS = 4
_LEAST = 2  # windows in a quarter, which a computer held up does not spend without a prompt sample
_DELAY = 0.007  # s, besides, from quarter to quarter

_Arrival = tuple[float, float]
"""Delay and arrival [s] of a sample, by when it was due."""


class Pace:
    """Compares numbers of samples with the time since before the first could be taken.

    No sample arrives before it is taken, so that one that comes too early proves a device too
    fast. One that comes late proves nothing, for line and computer may have held it up; but now
    and then they let one through. Where the promptest of every quarter of a time is later than
    that of the quarter before, the device is too slow.
    """

    def __init__(self, sample_rate: float, clock: Callable[[], float] = time.perf_counter) -> None:
        self._rate = sample_rate
        self._clock = clock
        self._began = clock()
        self._window = _WINDOW
        self._promptest: list[_Arrival] = []  # of each window
        self._window_ends = 0.0

    def received(self, tick: int) -> None:
        """A sample has just arrived. Raises DeviceError for a rate that is not the one asked."""
        elapsed = self._clock() - self._began
        due = tick / self._rate
        if due > (1.0 + _TOLERANCE) * elapsed:
            raise self._refusal(tick, elapsed, "more", "its timer runs too fast")
        arrival = elapsed - due, elapsed
        if elapsed < self._window_ends:
            self._promptest[-1] = min(self._promptest[-1], arrival)
            return
        if self._falls_behind():
            slow = "its timer runs too slowly, or it cannot sample so fast"
            raise self._refusal(tick, elapsed, "less", slow)
        if len(self._promptest) == _KEPT:
            pairs = zip(self._promptest[::2], self._promptest[1::2], strict=True)
            self._promptest = [min(pair) for pair in pairs]
            self._window *= 2.0
        self._promptest.append(arrival)
        self._window_ends = elapsed + self._window

    def _falls_behind(self) -> bool:
        """Whether the delay has grown from quarter to quarter of any time that has just ended."""
        least, most = _LEAST, len(self._promptest) // _QUARTERS
        return any(self._grows(size) for size in range(least, most + 1))

    def _grows(self, size: int) -> bool:
        """Whether it has in each of the last quarters of so many windows."""
        starts = range(-_QUARTERS * size, 0, size)
        quarters = [self._promptest[start : start + size or None] for start in starts]
        return all(_later(last, this) for last, this in pairwise(quarters))

    def _refusal(self, tick: int, elapsed: float, compared: str, cause: str) -> DeviceError:
        return DeviceError(
            f"the device had taken {tick + 1} samples {elapsed:.4g} s after its start, {compared} "
            f"than {self._rate:g} Hz and this computer's clock allow: {cause}",
            cure="mend its timer, or what it says of its clock; every time, speed and parameter "
            "of such a log would be wrong",
        )


def _later(last: list[_Arrival], this: list[_Arrival]) -> bool:
    """Whether each window's promptest came later than all of the quarter before."""
    (least, begin), (delay, end) = min(last), min(this)
    return max(last)[0] < delay and delay - least > _TOLERANCE * (end - begin) + _DELAY
