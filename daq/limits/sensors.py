"""Limits of what sensors that work can show: jumps, silence, readings frozen to the bit."""

from __future__ import annotations

import math

import numpy as np

from daq.config.rig import Stall
from daq.hal import FloatArray, Phase, Samples
from daq.limits.base import TURN, Limit, Trip, changes, within

_FOLLOWS = 0.1  # V of change of a command that must show in its current
_RARER = 10  # times the longest standstill of the calibration that an input may stand still


class Jump(Limit):
    """Angle from one sample to the next: no shaft turns faster than this."""

    def __init__(self, fastest: float) -> None:
        self._fastest = fastest
        self._most = math.inf  # rad per tick
        self._theta, self._tick = math.nan, -1

    def begin(self, phase: Phase, sample_rate: float) -> None:
        """The first angle of a phase follows none."""
        self._most = self._fastest / sample_rate
        self._theta, self._tick = math.nan, -1

    def check(self, samples: Samples) -> Trip | None:
        """Compare neighbours; lost samples give the shaft more time."""
        theta = samples.theta
        last, before = self._theta, self._tick
        self._theta, self._tick = theta.item(-1), samples.tick.item(-1)
        if len(theta) == 1:
            step = abs(self._theta - last)
            if not step > self._most * (self._tick - before):
                return None
            return 0, self._reason(step, self._tick - before)
        steps = np.abs(np.diff(theta, prepend=last))
        ticks = np.diff(samples.tick, prepend=before)
        beyond = steps > self._most * ticks
        if not beyond.any():
            return None
        row = int(np.argmax(beyond))
        return row, self._reason(steps[row], int(ticks[row]))

    def _reason(self, step: float, ticks: int) -> str:
        speed = step / ticks * self._fastest / self._most
        return (
            f"the encoder jumped by {step:.4g} rad, as if at {speed:.4g} rad/s; no more than "
            f"{self._fastest:g} rad/s is possible. Check its cable and shield"
        )


class Silence(Limit):
    """The speed estimate and the count of the encoder must agree on whether the shaft turns."""

    def __init__(self, turns: float) -> None:
        self._most = turns * TURN
        self._dt = 1.0
        self._theta, self._turned = math.nan, 0.0

    def begin(self, phase: Phase, sample_rate: float) -> None:
        """Start anew."""
        self._dt = 1.0 / sample_rate
        self._theta, self._turned = math.nan, 0.0

    def check(self, samples: Samples) -> Trip | None:
        """Sum up the speed while the count stands still."""
        theta = samples.theta
        if changes(theta, self._theta):
            self._theta, self._turned = theta.item(-1), 0.0
            return None
        for row, angle in enumerate(theta.tolist()):
            if angle != self._theta:
                self._theta, self._turned = angle, 0.0
                continue
            self._turned += abs(samples.omega.item(row)) * self._dt
            if self._turned > self._most:
                return row, (
                    f"the speed estimate says that the shaft turned by {self._turned / TURN:.3g} "
                    f"turns, and the encoder's count stands still; check the encoder"
                )
        return None


class Stalled(Limit):
    """A current that must turn the shaft while the encoder shows not one count."""

    def __init__(self, stall: Stall) -> None:
        self._stall = stall
        self._most = 0
        self._theta, self._still = math.nan, 0

    def begin(self, phase: Phase, sample_rate: float) -> None:
        """Start anew."""
        self._most = max(1, round(self._stall.time * sample_rate))
        self._theta, self._still = math.nan, 0

    def check(self, samples: Samples) -> Trip | None:
        """Count the samples in which it stands still and must not."""
        theta, motor = samples.theta, samples.current_motor
        if changes(theta, self._theta) or within(motor, self._stall.motor):
            self._theta, self._still = theta.item(-1), 0
            return None
        for row, angle in enumerate(theta.tolist()):
            if angle != self._theta or not self._pulls(samples, row):
                self._theta, self._still = angle, 0
                continue
            self._still += 1
            if self._still >= self._most:
                return row, (
                    f"the encoder has stood still for {self._stall.time:g} s at a motor current "
                    f"of {motor[row]:.3g} A with the brake off: the shaft is blocked, or the "
                    "encoder dead"
                )
        return None

    def _pulls(self, samples: Samples, row: int) -> bool:
        return (
            abs(samples.current_motor.item(row)) >= self._stall.motor
            and abs(samples.current_brake.item(row)) <= self._stall.brake
        )


class Frozen(Limit):
    """An input that reads the same to the bit for longer than its noise, or its command, allows.

    Noise is what the calibration shows: an input that then changes all the time may not stand
    still for ``seconds``, nor for ten times as long as it ever did. A current that stands still
    while its command is another one does not follow it, with noise or without.
    """

    def __init__(self, name: str, seconds: float, command: str | None) -> None:
        self._name, self._seconds = name, seconds
        self._command = f"applied_voltage_{command}" if command else None
        self._rate = 1.0
        self._longest = self._seen = 0  # samples of the calibration
        self._learning = False
        self._most = math.inf  # samples it may stand still
        self._least = 1  # samples that any verdict takes
        self._value, self._still, self._away, self._asked = math.nan, 0, 0, math.nan

    def begin(self, phase: Phase, sample_rate: float) -> None:
        """Learn from the calibration, watch from then on."""
        self._learning = phase is Phase.CALIBRATION
        self._rate = sample_rate
        self._least = max(2, round(self._seconds * sample_rate))
        self._value, self._still, self._away = math.nan, 0, 0
        known = self._seen > 0 and _RARER * self._longest <= self._seen
        self._most = max(self._least, _RARER * self._longest) if known else math.inf

    def check(self, samples: Samples) -> Trip | None:
        """Count how long it has read the same."""
        values: FloatArray = getattr(samples, self._name)
        if changes(values, self._value):
            self._changed(values.item(-1), len(values))
            return None
        asked: FloatArray | None = getattr(samples, self._command) if self._command else None
        for row, value in enumerate(values.tolist()):
            if value != self._value:
                self._changed(value, 1)
                continue
            reason = self._stood(0.0 if asked is None else asked.item(row))
            if reason is not None:
                return row, reason
        return None

    def _changed(self, value: float, seen: int) -> None:
        self._value, self._still, self._away, self._asked = value, 0, 0, math.nan
        if self._learning:
            self._seen += seen
            self._longest = max(self._longest, 1)

    def _stood(self, asked: float) -> str | None:
        """One more sample of the same value under a command [V]; why that cannot be."""
        self._still += 1
        if self._asked != self._asked:  # not yet known
            self._asked = asked
        if abs(asked - self._asked) >= _FOLLOWS:
            self._away += 1
        if self._learning:
            self._seen += 1
            self._longest = max(self._longest, self._still + 1)
            return None
        if self._still >= self._most:
            return (
                f"{self._name} has read {self._value:.6g} to the bit for "
                f"{self._still / self._rate:.3g} s, and its noise never let it before; "
                "check its sensor and converter"
            )
        if self._away >= self._least:
            return (
                f"{self._name} has read {self._value:.6g} to the bit for "
                f"{self._away / self._rate:.3g} s under a changed command; check the amplifier "
                "and its current sensor"
            )
        return None
