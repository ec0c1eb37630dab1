"""The simulated user: winds the load when asked, then keeps off, or moves the handle in the run."""

import math
from collections.abc import Sequence

import numpy as np

from daq.hal import FloatArray

_TURN_TIME = 1.0  # s, the pace at the handle
_REST = 0.5  # s, holding still before letting go
_OVERWIND = 0.1  # turns


class SimulatedUser:
    """Grip and wrist motion over time.

    holds: a hand that is the load itself never lets go, and stays where it has wound to. path:
    (time [s], angle [rad]) from the start of the run and from there on, through which such a
    hand moves its wrist in straight lines, and stays at the last.
    """

    def __init__(self, holds: bool, path: Sequence[tuple[float, float]] = ()) -> None:
        self._holds = holds
        self._path = np.array([(0.0, 0.0), *path]).T
        self._run_start = math.inf
        self._rest_angle = 0.0
        self._turns = 0.0
        self._start: float | None = None
        self._from = 0.0

    @property
    def away(self) -> bool:
        """Whether no hand is near the handle, now and until the next ``wind``."""
        return self._start is None and not self._holds

    def wind(self, turns: float, time: float, angle: float) -> None:
        """Begin to turn the handle by some turns, from an angle [rad]."""
        self._turns, self._start, self._from = turns, time, angle

    def move(self, time: float) -> None:
        """Begin to move along the path."""
        self._run_start = time

    def stop(self) -> None:
        """Do nothing more."""
        if self._start is not None:
            self._rest_angle = self._from + 2.0 * math.pi * (self._turns + _OVERWIND)
        self._start = None

    def motion(self, times: FloatArray) -> FloatArray:
        """Grip, angle and speed of the wrist, (n, 3)."""
        hand = np.zeros((len(times), 3))
        hand[:, 0] = self._holds
        hand[:, 1] = self._rest_angle
        if self._start is None:
            self._follow(hand, times - self._run_start)
            return hand
        elapsed = times - self._start
        length = max(self._turns * _TURN_TIME, _TURN_TIME)
        share = np.clip(elapsed / length, 0.0, 1.0)
        # A raised cosine in speed: the hand starts and stops softly. It winds a little
        # further than asked, as one does against a spring.
        angle = 2.0 * math.pi * (self._turns + _OVERWIND)
        hand[:, 0] = self._holds | (elapsed < length + _REST)
        hand[:, 1] = self._from + angle * (share - np.sin(2 * math.pi * share) / (2 * math.pi))
        hand[:, 2] = angle / length * (1.0 - np.cos(2.0 * math.pi * share)) * (share < 1.0)
        return hand

    def _follow(self, hand: FloatArray, elapsed: FloatArray) -> None:
        """Angle and speed along the path, added to a hand at rest."""
        when, angles = self._path
        if elapsed[-1] < 0.0:
            return
        hand[:, 1] += np.interp(elapsed, when, angles)
        speeds = np.append(np.diff(angles) / np.diff(when), 0.0)
        place = np.searchsorted(when, elapsed, side="right") - 1
        hand[:, 2] = np.where(place >= 0, speeds[place], 0.0)
