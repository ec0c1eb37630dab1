"""A trigger as of an oscilloscope: where a channel passes a level, and what is shown around it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from daq.hal import FloatArray, IntArray
from daq.logs.columns import UNITS
from daq.scope.history import History

BEFORE = 0.2  # of the stretch that is shown: what comes before the trigger
_HYSTERESIS = 0.02  # of all that the channel has covered: what counts as noise at the level
_MOST = 65_536  # rows that are searched at a time


@dataclass
class Trigger:
    """A channel's level and direction, and when it was passed last [s].

    at: None before the first time. A passage counts when all of its stretch has been recorded; of
    a run that has ended without one, the last.
    """

    channel: str
    level: float
    rising: bool
    at: float | None = None
    _after: float = -math.inf  # no passage before this one counts

    def look(
        self, history: History, columns: tuple[str, ...], width: float, ended: bool = False
    ) -> bool:
        """Look for the newest passage around which ``width`` seconds are there; whether it is new.

        Those that the picture of the last one shows do not count: it would run instead of stand.
        ended: no more samples come.
        """
        if self.channel not in columns or not history.n_rows:
            return False
        end = history.span[1]
        if self._look_until(end - (1.0 - BEFORE) * width, history, columns, width):
            return True
        return ended and self.at is None and self._look_until(end, history, columns, width)

    def _look_until(
        self, ready: float, history: History, columns: tuple[str, ...], width: float
    ) -> bool:
        place = columns.index(self.channel)
        begin = max(history.span[0], self._after - width)
        if ready <= begin:
            return False  # as after the last passage of a run that has ended
        rows = history.rows(begin, ready, _MOST)
        times, values = rows[:, columns.index("t")], rows[:, place]
        noise = _HYSTERESIS * float(history.spread[place])
        passed = times[passages(values, self.level, self.rising, noise)]
        passed = passed[(passed > self._after) & (passed <= ready)]
        if not len(passed):
            return False
        self.at = float(passed[-1])
        self._after = self.at + (1.0 - BEFORE) * width
        return True

    def forget(self) -> None:
        """Take the newest passage again, also one that was found before."""
        self.at, self._after = None, -math.inf

    def text(self) -> str:
        """What it waits for, and when that came last."""
        level = f"{self.level:.4g} {UNITS.get(self.channel, '')}".rstrip()
        what = f"{self.channel} {'rises' if self.rising else 'falls'} through {level}"
        return f"{what}: " + ("not yet" if self.at is None else f"last at {self.at:.6g} s")


def passages(values: FloatArray, level: float, rising: bool, noise: float = 0.0) -> IntArray:
    """Rows of values (n,) that are the first beyond a level, since they were short of it by more
    than ``noise``; what is not finite is neither.

    >>> import numpy as np
    >>> passages(np.array([0.0, 1.0, 0.9, 1.0, 0.0, 2.0]), 1.0, rising=True, noise=0.5).tolist()
    [1, 5]
    """
    sign = 1.0 if rising else -1.0
    above = sign * (values - level)
    side = np.where(above >= 0.0, 1, np.where(above < -noise, -1, 0))
    rows = np.flatnonzero(side)
    sides = side[rows]
    passed: IntArray = rows[1:][(sides[:-1] < 0) & (sides[1:] > 0)]
    return passed
