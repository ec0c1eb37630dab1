"""The simulated user, who winds the load when asked, then lets go or moves the handle."""

import math
from collections.abc import Sequence

import numpy as np

from daq.hal import FloatArray

_TURN_TIME = 1.0  # s for a turn of the handle
_REST = 0.5  # s, holding still before letting go
_OVERWIND = 0.1  # turns beyond those asked for, as one winds against a spring


class SimulatedUser:
    """Grip and wrist motion over time.

    holds: whether the hand is the load itself, and never lets go. path: (time [s], angle [rad])
    from the start of the run, relative to where winding ended; the wrist moves through these
    points in straight lines, or smoothly, and stays at the last.
    """

    def __init__(
        self, holds: bool, path: Sequence[tuple[float, float]] = (), smooth: bool = False
    ) -> None:
        self._holds = holds
        self._path = np.array([(0.0, 0.0), *path]).T
        self._spline = None
        if smooth and path:
            from scipy.interpolate import CubicSpline  # half a second, of every simulated rig

            times, angles = self._path
            self._spline = CubicSpline(times, angles, bc_type="clamped")  # at rest at both ends
        self._run_start = math.inf
        self._rest_angle = 0.0
        self._turns = 0.0
        self._winding_start: float | None = None
        self._start_angle = 0.0

    @property
    def away(self) -> bool:
        """Whether no hand is near the handle, now and until the next ``wind``."""
        return self._winding_start is None and not self._holds

    def wind(self, turns: float, time: float, angle: float) -> None:
        """Begin to turn the handle by some turns, from an angle [rad]."""
        self._turns, self._winding_start, self._start_angle = turns, time, angle

    def move(self, time: float) -> None:
        """Begin to move along the path."""
        self._run_start = time

    def stop(self) -> None:
        """Do nothing more."""
        if self._winding_start is not None:
            self._rest_angle = self._start_angle + 2.0 * math.pi * (self._turns + _OVERWIND)
        self._winding_start = None

    def motion(self, times: FloatArray) -> FloatArray:
        """Grip, angle and speed of the wrist, (n, 3)."""
        motion = np.zeros((len(times), 3))
        motion[:, 0] = self._holds
        motion[:, 1] = self._rest_angle
        if self._winding_start is None:
            self._add_path(motion, times - self._run_start)
            return motion
        elapsed = times - self._winding_start
        duration = max(self._turns * _TURN_TIME, _TURN_TIME)
        share = np.clip(elapsed / duration, 0.0, 1.0)
        phase = 2.0 * math.pi * share
        # A raised cosine in speed: the hand starts and stops softly.
        angle = 2.0 * math.pi * (self._turns + _OVERWIND)
        motion[:, 0] = self._holds | (elapsed < duration + _REST)
        motion[:, 1] = self._start_angle + angle * (share - np.sin(phase) / (2.0 * math.pi))
        motion[:, 2] = angle / duration * (1.0 - np.cos(phase)) * (share < 1.0)
        return motion

    def _add_path(self, motion: FloatArray, elapsed: FloatArray) -> None:
        """Add angle and speed along the path to a hand at rest; elapsed: since the run began."""
        times, angles = self._path
        if elapsed[-1] < 0.0:
            return
        if self._spline is not None:
            within = np.clip(elapsed, 0.0, times[-1])
            motion[:, 1] += self._spline(within)
            motion[:, 2] = self._spline(within, 1)
            return
        motion[:, 1] += np.interp(elapsed, times, angles)
        speeds = np.append(np.diff(angles) / np.diff(times), 0.0)
        segment = np.searchsorted(times, elapsed, side="right") - 1
        motion[:, 2] = np.where(segment >= 0, speeds[segment], 0.0)
