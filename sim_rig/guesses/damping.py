"""Upper limits of the viscous dampings from the slope of torque over speed (4.5).

Of the torque that resists the shaft, at moments at which the speed is steady and the brake slides
under an unchanged command. Coulomb's jump at zero speed adds to the slope, so it is a limit.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sim_rig.guesses.electrical import SIGMAS, speed_of
from sim_rig.guesses.ranges import Interval, Ranges
from sysid.arrays import BoolArray, FloatArray
from sysid.problem.guesses import Measured, regression

_HALF = 4  # samples either side that a torque is averaged over
_SLIDING = 0.3  # rad in one direction after which the brake slides whatever its stiffness
_FEWEST = 8  # moments of steady speed that make a slope
_SETTLED = 6.0  # mean delays after a change of the brake's command


@dataclass(frozen=True)
class _Slope:
    """The most that torque over speed can be [N*m*s/rad]; current: the least of the brake [A]."""

    limit: float
    current: float
    moments: int
    record: str

    def text(self, K_m: str, under: str = "") -> str:
        """The source of a guess; K_m: the range it rests on."""
        return (
            f"slope of torque over omega, {self.limit:.3g} N*m*s/rad at most{under}, at "
            f"{self.moments} moments of steady speed in {self.record}, {K_m}"
        )


def narrow(ranges: Ranges, records: Sequence[Measured], brake_delay: float) -> None:
    """Narrow B_m, c0 and c1; brake_delay: mean delay of the brake's current [s]."""
    n_c, highest_n_c = ranges.intervals["n_c"]
    if n_c != highest_n_c or n_c == 0.0:
        return
    K_m, settling = ranges.intervals["K_m"], _SETTLED * brake_delay
    slopes = [slope for record in records for slope in _slopes(record, K_m, n_c, settling)]
    if not slopes:
        return
    flattest = min(slopes, key=lambda slope: slope.limit)
    source = flattest.text(ranges.text("K_m"))
    ranges.narrow("B_m", 0.0, flattest.limit / n_c**2, source)
    ranges.narrow("c0", 0.0, flattest.limit, source)
    carrying = [slope for slope in slopes if slope.current > 0.0]
    if carrying:
        flattest = min(carrying, key=lambda slope: slope.limit / slope.current)
        source = flattest.text(ranges.text("K_m"), f" under {flattest.current:.3g} A")
        ranges.narrow("c1", 0.0, flattest.limit / flattest.current, source)


def _slopes(record: Measured, K_m: Interval, n_c: float, settling: float) -> list[_Slope]:
    """One for each brake command under which there are enough moments."""
    speed = speed_of(record)
    if speed is None or "current_motor" not in record:
        return []
    load = record["torque"] if "torque" in record else np.zeros(len(speed))
    torques = [_smooth(load - n_c * constant * record["current_motor"]) for constant in K_m]
    current = _smooth(record["current_brake"]) if "current_brake" in record else None
    omega, command = _smooth(speed), record["applied_voltage_brake"]
    moments = _steady(omega, command, record.dt, settling)
    levels = command[_HALF : len(command) - _HALF]
    slopes = []
    for level in np.unique(levels[moments]):
        rows = moments & (levels == level)
        count = int(rows.sum())
        if count < _FEWEST:
            continue
        fits = [regression(torque[rows], [omega[rows], np.ones(count)]) for torque in torques]
        limits = [
            weights[0] + SIGMAS * math.sqrt(covariance[0, 0])
            for weights, covariance in filter(None, fits)
        ]
        if len(limits) == 2 and max(limits) > 0.0:
            carried = 0.0 if current is None else _at_least(np.abs(current[rows]))
            slopes.append(_Slope(max(limits), carried, count, record.name))
    return slopes


def _steady(omega: FloatArray, command: FloatArray, dt: float, settling: float) -> BoolArray:
    """Rows of the averaged speed at which it stands at a peak, the brake sliding undisturbed."""
    n = len(omega)
    change = np.diff(omega)
    peaks = np.zeros(n, dtype=bool)
    peaks[1:-1] = change[1:] * change[:-1] <= 0.0
    # Distance since the motion last turned round.
    angle = dt * np.cumsum(np.nan_to_num(omega))
    turned = np.concatenate([[True], np.sign(omega[1:]) != np.sign(omega[:-1])])
    since = np.maximum.accumulate(np.where(turned, np.arange(n), 0))
    sliding = np.abs(angle - angle[since]) >= _SLIDING
    # Rows since the command last changed, to the end of the average.
    rows = np.arange(len(command))
    changed = np.concatenate([[False], np.diff(command) != 0.0])
    last = np.maximum.accumulate(np.where(changed, rows, -len(command)))
    quiet = (rows - last)[2 * _HALF :] >= 2 * _HALF + settling / dt
    return peaks & sliding & quiet & np.isfinite(omega)


def _at_least(values: FloatArray) -> float:
    """A mean less what it may be off."""
    return max(0.0, float(values.mean() - SIGMAS * values.std() / math.sqrt(len(values))))


def _smooth(values: FloatArray) -> FloatArray:
    """Means over 2 _HALF + 1 samples; row k is that around sample k + _HALF."""
    return np.convolve(values, np.full(2 * _HALF + 1, 1.0 / (2 * _HALF + 1)), "valid")
