"""Whether samples come at the rate that was asked for, by this computer's clock."""

import math
import time

from daq.errors import DeviceError

_TOLERANCE = 0.01  # share of the rate
_DELAY = 0.25  # s that line and computer may come to hold samples back longer than at first
_WINDOW = 1.0  # s of which the least delay counts


class Pace:
    """Compares numbers of samples with the time since before the first could be taken.

    No sample arrives before it is taken, so that one that comes too early proves a device too
    fast. One that comes late proves nothing, but that all of a second's come ever later does.
    """

    def __init__(self, sample_rate: float) -> None:
        self._rate = sample_rate
        self._began = time.perf_counter()
        self._least_delay = math.inf  # s, of this window
        self._first_delay = math.inf  # s, the least of the first window
        self._window_ends = _WINDOW

    def received(self, tick: int) -> None:
        """A sample has just arrived. Raises DeviceError for a rate that is not the one asked."""
        elapsed = time.perf_counter() - self._began
        due = tick / self._rate
        if due > (1.0 + _TOLERANCE) * elapsed:
            raise self._refusal(tick, elapsed, "more", "its timer runs too fast")
        self._least_delay = min(self._least_delay, elapsed - due)
        if elapsed < self._window_ends:
            return
        self._first_delay = min(self._first_delay, self._least_delay)
        if self._least_delay - self._first_delay > _TOLERANCE * elapsed + _DELAY:
            slow = "its timer runs too slowly, or it cannot sample so fast"
            raise self._refusal(tick, elapsed, "less", slow)
        self._least_delay, self._window_ends = math.inf, elapsed + _WINDOW

    def _refusal(self, tick: int, elapsed: float, compared: str, cause: str) -> DeviceError:
        return DeviceError(
            f"the device had taken {tick + 1} samples {elapsed:.4g} s after its start, {compared} "
            f"than {self._rate:g} Hz and this computer's clock allow: {cause}",
            cure="mend its timer, or what it says of its clock; every time, speed and parameter "
            "of such a log would be wrong",
        )
