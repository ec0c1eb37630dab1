"""Limits of where the shaft may be: its travel, and what stays wound up."""

import math

from daq.hal import FloatArray, Phase, Samples
from daq.limits.base import TURN, Limit, Trip, first_row


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
