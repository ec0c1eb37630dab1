"""Limits of what sensors that work can show: jumps, readings frozen to the bit."""

import abc
import math

import numpy as np

from daq.hal import FloatArray, Phase, Samples
from daq.limits.base import Limit, Trip, first_row

_FOLLOWS = 0.1  # V of change of a command that must show in its current
_RARER = 10  # times the longest standstill of the calibration that an input may stand still


class Jump(Limit):
    """Angle from one sample to the next: no shaft turns faster than this."""

    tells_faults = True

    def __init__(self, fastest: float) -> None:
        self._fastest = fastest

    def begin(self, phase: Phase, sample_rate: float) -> None:
        """The first angle of a phase follows none."""
        self._most = self._fastest / sample_rate  # rad per tick
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
        row = first_row(steps > self._most * ticks)
        return None if row is None else (row, self._reason(steps[row], int(ticks[row])))

    def _reason(self, step: float, ticks: int) -> str:
        speed = step / ticks * self._fastest / self._most
        return (
            f"the encoder jumped by {step:.4g} rad, as if at {speed:.4g} rad/s; no more than "
            f"{self._fastest:g} rad/s is possible. Check its cable and shield"
        )


class _Standstill(Limit):
    """A quantity that reads the same to the bit from sample to sample, judged while it does."""

    def __init__(self, name: str) -> None:
        self._name = name

    def begin(self, phase: Phase, sample_rate: float) -> None:
        """Start anew."""
        self._value = math.nan
        self._rate = sample_rate
        self._changed(0)

    def check(self, samples: Samples) -> Trip | None:
        """Judge every sample that reads what the one before did."""
        values: FloatArray = getattr(samples, self._name)
        if len(values) == 1:
            changes = values.item() != self._value
        else:
            changes = values[0] != self._value and (values[1:] != values[:-1]).all()
        if changes:
            self._value = values.item(-1)
            self._changed(len(values))
            return None
        for row, value in enumerate(values.tolist()):
            if value != self._value:
                self._value = value
                self._changed(1)
                continue
            reason = self._stood(samples, row)
            if reason is not None:
                return row, reason
        return None

    def _changed(self, n_samples: int) -> None:
        """So many samples, none of which reads what the one before did."""
        self._standing = 0.0  # how much speaks against it since it stands still

    @abc.abstractmethod
    def _stood(self, samples: Samples, row: int) -> str | None:
        """One more sample that reads the same; why that cannot be."""


class Frozen(_Standstill):
    """An input that reads the same to the bit for longer than its noise, or its command, allows.

    Noise is what the calibration shows: an input that then changes all the time may not stand
    still for ``seconds``, nor for ten times as long as it ever did. A current that stands still
    while its command is another one does not follow it, with noise or without.
    """

    def __init__(self, name: str, seconds: float, command: str | None) -> None:
        super().__init__(name)
        self._seconds = seconds
        self._command = f"applied_voltage_{command}" if command else None
        self._longest = self._seen = 0  # samples of the calibration

    def begin(self, phase: Phase, sample_rate: float) -> None:
        """Learn from the calibration, watch from then on."""
        self._learning = phase is Phase.CALIBRATION
        self._least = max(2, round(self._seconds * sample_rate))  # samples that any verdict takes
        has_noise = self._seen > 0 and _RARER * self._longest <= self._seen
        # Samples it may stand still.
        self._most = max(self._least, _RARER * self._longest) if has_noise else math.inf
        super().begin(phase, sample_rate)

    def _changed(self, n_samples: int) -> None:
        self._unchanged = self._disobeyed = 0  # samples, those under another command than at first
        self._first_command = math.nan  # V, since it stands still
        if self._learning and n_samples:
            self._seen += n_samples
            self._longest = max(self._longest, 1)

    def _stood(self, samples: Samples, row: int) -> str | None:
        command = getattr(samples, self._command).item(row) if self._command else 0.0
        self._unchanged += 1
        if math.isnan(self._first_command):
            self._first_command = command
        if abs(command - self._first_command) >= _FOLLOWS:
            self._disobeyed += 1
        if self._learning:
            self._seen += 1
            self._longest = max(self._longest, self._unchanged + 1)
            return None
        if self._unchanged >= self._most:
            seconds = self._unchanged / self._rate
            cause = ", and its noise never let it before; check its sensor and converter"
        elif self._disobeyed >= self._least:
            seconds = self._disobeyed / self._rate
            cause = " under a changed command; check the amplifier and its current sensor"
        else:
            return None
        return f"{self._name} has read {self._value:.6g} to the bit for {seconds:.3g} s{cause}"
