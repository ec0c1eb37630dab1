"""Limits of the shaft: its speed by the count, its travel, and what stays wound up."""

import math

import numpy as np

from daq.config.rig import COUNT_GRAIN
from daq.hal import FloatArray, Phase, Samples
from daq.limits.base import TURN, Limit, Trip, first_row

_SHARE = 0.1  # of the limit, that the grain may take


class CountedSpeed(Limit):
    """Speed by the encoder's count, whatever the device's estimate says of it.

    count: angle of one [rad]. Where a count in a sample is a large step, as with a coarse encoder,
    the speed is judged over several samples.
    """

    def __init__(self, limit: float, count: float) -> None:
        self._limit, self._grain = limit, COUNT_GRAIN * count

    def begin(self, phase: Phase, sample_rate: float) -> None:
        """The first angles of a phase follow none."""
        self._dt = 1.0 / sample_rate
        span = max(1, math.ceil(self._grain * sample_rate / (_SHARE * self._limit)))
        self._theta = np.full(span, math.nan)
        self._tick = np.arange(-span, 0)

    def check(self, samples: Samples) -> Trip | None:
        """Compare every angle with the one a few samples before; lost ones give it more time."""
        span = len(self._theta)
        if span == 1 == len(samples):
            return self._check_one(samples)
        theta = np.concatenate([self._theta, samples.theta])
        tick = np.concatenate([self._tick, samples.tick])
        self._theta, self._tick = theta[-span:], tick[-span:]
        change = np.abs(theta[span:] - theta[:-span]) - self._grain
        seconds = (tick[span:] - tick[:-span]) * self._dt
        row = first_row(change > self._limit * seconds)
        return (
            None if row is None else (row, self._reason(change[row] / seconds[row], samples, row))
        )

    def _check_one(self, samples: Samples) -> Trip | None:
        theta, tick = samples.theta.item(), samples.tick.item()
        change = abs(theta - self._theta.item()) - self._grain
        seconds = (tick - self._tick.item()) * self._dt
        self._theta[0], self._tick[0] = theta, tick
        if not change > self._limit * seconds:
            return None
        return 0, self._reason(change / seconds, samples, 0)

    def _reason(self, speed: float, samples: Samples, row: int) -> str:
        return (
            f"the encoder's count moves at {speed:.4g} rad/s, beyond the limit of "
            f"{self._limit:g} rad/s; the device's estimate is {samples.omega.item(row):.4g} rad/s"
        )


class _Position:
    """Turns since it was made, through phases whose angles need not follow one another."""

    def __init__(self) -> None:
        self.before = 0.0  # turns, at the beginning of the phase
        self._first = self._last = math.nan

    def restart(self) -> None:
        """A phase begins."""
        if not math.isnan(self._last):
            self.before += (self._last - self._first) / TURN
        self._first = self._last = math.nan

    def see(self, theta: FloatArray) -> bool:
        """Take note of a block's angles; whether they are the first of a phase."""
        self._last = theta.item(-1)
        if math.isnan(self._first):
            self._first = theta.item(0)
            return True
        return False

    def ahead(self, turns: float) -> float:
        """How far [rad] from the first angle of the phase the shaft has so many turns."""
        return (turns - self.before) * TURN

    def angle(self, turns: float) -> float:
        """The angle [rad] of this phase at which the shaft has so many turns."""
        return self._first + self.ahead(turns)

    def turns(self, angle: float) -> float:
        """How many turns the shaft has at an angle [rad] of this phase."""
        return self.before + (angle - self._first) / TURN


class Travel(Limit):
    """Turns of the shaft from where it stood when the rig was opened."""

    def __init__(self, low: float, high: float) -> None:
        self._low, self._high = low, high
        self._position = _Position()

    def begin(self, phase: Phase, sample_rate: float) -> None:
        """Turns are counted on."""
        self._position.restart()

    def window(self) -> tuple[float, float]:
        """The two ends."""
        return self._position.ahead(self._low), self._position.ahead(self._high)

    def check(self, samples: Samples) -> Trip | None:
        """Compare the angle with the two ends."""
        theta = samples.theta
        if self._position.see(theta):
            self._least, self._most = map(self._position.angle, (self._low, self._high))  # rad
        if len(theta) == 1 and self._least <= theta.item() <= self._most:
            return None
        row = first_row((theta < self._least) | (theta > self._most))
        return None if row is None else (row, self._reason(theta.item(row)))

    def _reason(self, angle: float) -> str:
        return (
            f"the shaft is {self._position.turns(angle):.4g} turns from where it began, "
            f"outside its travel of [{self._low:g}, {self._high:g}] turns"
        )


class Winding(Limit):
    """Turns wound up by the homing of which some must be left during the run."""

    def __init__(self, least: float) -> None:
        self._least_turns = least
        self._position: _Position | None = None
        self._sign, self._least = 0.0, -math.inf

    def begin(self, phase: Phase, sample_rate: float) -> None:
        """Turns count from the homing on, and must be left from the run on."""
        if phase is Phase.HOMING:
            self._position = _Position()
        elif self._position is not None:
            self._position.restart()
            if phase is Phase.RUN:
                self._sign = math.copysign(1.0, self._position.before)

    def window(self) -> tuple[float, float]:
        """Open to where more is wound up."""
        if self._position is None or self._sign == 0.0:
            return -math.inf, math.inf
        end = self._position.ahead(self._sign * self._least_turns)
        return (end, math.inf) if self._sign > 0.0 else (-math.inf, end)

    def check(self, samples: Samples) -> Trip | None:
        """Compare the angle with where the cable is nearly wound off."""
        position, theta = self._position, samples.theta
        if position is None:
            return None
        if position.see(theta):
            self._least = self._sign * position.angle(self._sign * self._least_turns)
        if self._sign == 0.0 or (len(theta) == 1 and self._sign * theta.item() >= self._least):
            return None
        row = first_row(self._sign * theta < self._least)
        if row is None:
            return None
        left = self._sign * position.turns(theta.item(row))
        return row, (
            f"the cable is nearly unwound: {left:.3g} of {abs(position.before):.3g} turns are "
            f"left, and limits.winding is {self._least_turns:g}. Wind further (homing.turns), "
            "or hold the load with the motor's offset"
        )
