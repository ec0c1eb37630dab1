"""The estimate of speed that a loop is given, from the encoder's angle."""

import math
from typing import Annotated

from pydantic import Field

from daq.config.units import Hertz

TrackerBandwidth = Annotated[Hertz, Field(gt=0.0, le=1e4)]
TRACKER_BANDWIDTH = 150.0  # Hz


def tracker_gains(bandwidth: float, elapsed: float) -> tuple[float, float]:
    """alpha and beta of a critically damped tracker, by its bandwidth [Hz] and the time passed."""
    decay = math.exp(-2.0 * math.pi * bandwidth * elapsed)
    return 1.0 - decay * decay, (1.0 - decay) ** 2


class SpeedTracker:
    """Speed from the encoder's angle by a critically damped tracking loop (an alpha-beta filter).

    It has no error at constant speed, whatever the encoder's resolution, and attenuates what is
    faster than its bandwidth as two first-order low-pass filters of that cutoff in a row. It
    needs no count rate of the device. Gains by Brookner, "Tracking and Kalman Filtering Made
    Easy", 1998.
    """

    def __init__(self, bandwidth: float) -> None:
        self._bandwidth = bandwidth
        self._time = math.nan
        self._elapsed = self._alpha = self._beta = 0.0
        self._angle = self.speed = 0.0

    def update(self, time: float, angle: float) -> float:
        """Speed [rad/s] by an angle [rad] at ``time`` [s]; the first call finds it at rest."""
        elapsed = time - self._time
        self._time = time
        if not elapsed > 0.0:
            self._angle = angle
            return self.speed
        if elapsed != self._elapsed:
            self._elapsed = elapsed
            self._alpha, self._beta = tracker_gains(self._bandwidth, elapsed)
        self._angle += elapsed * self.speed
        missed = angle - self._angle
        self._angle += self._alpha * missed
        self.speed += self._beta / elapsed * missed
        return self.speed
