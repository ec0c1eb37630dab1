"""What an encoder shows of a shaft, against its own estimate of the speed and the currents.

Each bound is so wide that no healthy rig of the file's ratings reaches it.
"""

import math
from typing import NamedTuple

import numpy as np

from daq.config.rig import Stall
from daq.hal import FloatArray, Phase, Samples
from daq.limits.base import TURN, Limit, Trip

_IDLE, _SEEN = 0.02, 0.25  # of silent: motions that do not count; of the other's path, at least
_FORGOTTEN = 20.0  # times the angle of disagreement that is turned until half of it is forgotten
_AT_REST = 1.5  # counts by which a shaft at rest may flicker
_AGAINST = 0.1  # of the largest speed, gained against the motor's current
_GRAIN = 2.0  # counts in a sample by which an estimate of the speed may be off
_LASTING = 0.02  # s in which the currents' torque fades behind them
_BLOCK = 16  # samples, from which arrays are faster than single values
_BEYOND = 3  # samples in a row that contradict the currents


class _Path:
    """How far a signal runs, to and fro; motions within a dead band are none."""

    def __init__(self, band: float) -> None:
        self._band = band
        self._slack = self.length = 0.0

    def extend(self, change: float) -> None:
        """The signal has changed."""
        self._slack += change
        beyond = abs(self._slack) - self._band
        if beyond > 0.0:
            self.length += beyond
            self._slack = math.copysign(self._band, self._slack)


class Disagreement(Limit):
    """The encoder's count and the estimate of its speed must tell the same angle.

    Their difference is summed over the turns of the shaft, the older ones with less weight: an
    estimate that lags at every change of speed is ahead again at the next. A shaft that turns to
    and fro shows nothing in that sum: the paths of both are compared as well.
    """

    tells_faults = True

    def __init__(self, turns: float) -> None:
        self._most = turns * TURN

    def begin(self, phase: Phase, sample_rate: float) -> None:
        """Start anew."""
        self._dt = 1.0 / sample_rate
        self._theta, self._omega, self._tick = math.nan, 0.0, -1
        self._difference = self._path = 0.0  # rad
        self._follow()

    def _follow(self) -> None:
        # What one swings through is looked for in the other with a narrower dead band, so that
        # one which lags a little is not blind to what the other just sees.
        wide = _IDLE * self._most
        self._counted, self._counted_all = _Path(wide), _Path(0.25 * wide)
        self._estimated, self._estimated_all = _Path(wide), _Path(0.25 * wide)

    def check(self, samples: Samples) -> Trip | None:
        """Sum up; what the shaft did between samples of which some are lost is unknown."""
        columns = samples.tick.tolist(), samples.theta.tolist(), samples.omega.tolist()
        for row, (tick, theta, omega) in enumerate(zip(*columns, strict=True)):
            if tick == self._tick + 1 and tick > 0:
                self._sum_up(theta - self._theta, 0.5 * (omega + self._omega) * self._dt)
            self._theta, self._omega, self._tick = theta, omega, tick
            if not abs(self._difference) <= self._most:
                return row, self._reason(f"now {omega:.4g} rad/s", abs(self._difference))
            if max(self._counted.length, self._estimated.length) > self._most:
                if self._one_is_silent():
                    paths = self._counted.length, self._estimated.length
                    return row, self._reason("to and fro", abs(paths[0] - paths[1]))
                self._follow()
        return None

    def _sum_up(self, counted: float, estimated: float) -> None:
        self._difference += counted - estimated
        self._path += abs(counted) + abs(estimated)
        if self._path > _FORGOTTEN * self._most:
            self._difference *= 0.5
            self._path *= 0.5
        self._counted.extend(counted)
        self._counted_all.extend(counted)
        self._estimated.extend(estimated)
        self._estimated_all.extend(estimated)

    def _one_is_silent(self) -> bool:
        counted, estimated = self._counted_all.length, self._estimated_all.length
        return estimated < _SEEN * self._counted.length or counted < _SEEN * self._estimated.length

    def _reason(self, how: str, angle: float) -> str:
        return (
            f"the encoder's count and the device's estimate of the speed, {how}, "
            f"differ by {angle / TURN:.3g} turns: one of them fails. Check the "
            "encoder's cable and both channels, and sensors.encoder of the rig's file"
        )


class Push(NamedTuple):
    """Motor currents [A] of a sample: measured; at work, as Drive tells; that turns the shaft."""

    measured: float
    at_work: float
    needed: float


class Drive:
    """What the motor does to the shaft, and what brake and load allow, by ``encoder.stall``.

    gains: of the amplifiers [A/V], or None. An amplifier or a sensor that is dead shows no
    current, so that of the command is at work where it is larger.
    """

    def __init__(self, stall: Stall, gains: tuple[float | None, float | None]) -> None:
        self._motor, self._brake = stall.motor, stall.brake
        self._motor_gain, self._brake_gain = (gain or 0.0 for gain in gains)
        self._samples: Samples | None = None
        self._pushes: list[Push] = []

    def of(self, samples: Samples) -> list[Push]:
        """Of every sample; several limits ask for the same."""
        if samples is not self._samples:
            columns = (
                samples.current_motor,
                samples.current_brake,
                samples.applied_voltage_motor,
                samples.applied_voltage_brake,
            )
            rows = zip(*(column.tolist() for column in columns), strict=True)
            self._samples, self._pushes = samples, [self._push(*row) for row in rows]
        return self._pushes

    def of_block(self, samples: Samples) -> tuple[FloatArray, FloatArray]:
        """Currents at work, and those that turn the shaft, each (n,), of a block of samples."""
        commanded = self._motor_gain * samples.applied_voltage_motor
        motor = samples.current_motor
        at_work = np.where(np.abs(commanded) > np.abs(motor), commanded, motor)
        of_command = self._brake_gain * np.abs(samples.applied_voltage_brake)
        against = np.maximum(np.abs(samples.current_brake), of_command)
        return at_work, self._motor * (1.0 + against / self._brake)

    def _push(self, motor: float, brake: float, volts_motor: float, volts_brake: float) -> Push:
        commanded = self._motor_gain * volts_motor
        at_work = commanded if abs(commanded) > abs(motor) else motor
        against = max(abs(brake), self._brake_gain * abs(volts_brake))
        return Push(motor, at_work, self._motor * (1.0 + against / self._brake))


class Stalled(Limit):
    """A motor that must turn the shaft while the encoder shows no motion."""

    def __init__(self, stall: Stall, drive: Drive, count: float) -> None:
        self._drive, self._time = drive, stall.time
        self._flicker = _AT_REST * count  # rad

    def begin(self, phase: Phase, sample_rate: float) -> None:
        """Start anew."""
        self._dt = 1.0 / sample_rate
        self._rest, self._driven = math.nan, 0.0  # rad, s

    def check(self, samples: Samples) -> Trip | None:
        """Sum up the drive at a shaft that stands still: seconds times what it is of the least."""
        if len(samples.theta) < _BLOCK:
            pushes = self._drive.of(samples)
            each = [push.at_work / push.needed for push in pushes]
            return self._standing(samples.theta.tolist(), each, 0)
        # A step of twice the flicker leaves any place of rest: what is before it is forgotten.
        left = np.flatnonzero(~(np.abs(np.diff(samples.theta)) <= 2.0 * self._flicker)) + 1
        at_work, needed = self._drive.of_block(samples)
        ratios = at_work / needed
        strong = np.where(np.abs(ratios) >= 1.0, np.abs(ratios) * self._dt, 0.0)
        begins = np.concatenate([[0], left])
        most = np.add.reduceat(strong, begins)
        most[0] += abs(self._driven)
        watched = ~(most <= self._time)
        watched[-1] = True  # where it stands at the end counts in the next block
        ends = np.append(left, len(strong))
        for begin, end in zip(begins[watched].tolist(), ends[watched].tolist(), strict=True):
            part = samples.theta[begin:end].tolist(), ratios[begin:end].tolist()
            if begin:
                self._rest = math.nan
            trip = self._standing(*part, begin)
            if trip is not None:
                return trip
        return None

    def _standing(self, angles: list[float], ratios: list[float], first: int) -> Trip | None:
        """Sum up over neighbouring samples, the first of them of that row."""
        for row, (theta, ratio) in enumerate(zip(angles, ratios, strict=True), first):
            if not abs(theta - self._rest) <= self._flicker:
                self._rest, self._driven = theta, 0.0
                continue
            # With its sign: what shakes the shaft to and fro need not be seen.
            self._driven += ratio * self._dt if abs(ratio) >= 1.0 else 0.0
            if abs(self._driven) > self._time:
                return row, (
                    f"the encoder stands still at {abs(ratio):.3g} times the current that must "
                    "turn the shaft (encoder.stall): the shaft is blocked, the brake does not let "
                    "go, or encoder, motor or amplifier is dead"
                )
        return None


class Contrary(Limit):
    """A shaft that gains speed against a motor current which must turn it."""

    tells_faults = True
    stops = False

    def __init__(self, drive: Drive, speed: float) -> None:
        self._drive, self._most = drive, _AGAINST * speed

    def begin(self, phase: Phase, sample_rate: float) -> None:
        """Start anew."""
        self._omega, self._against = math.nan, 0.0  # rad/s

    def check(self, samples: Samples) -> Trip | None:
        """Sum up the speed gained against the current, less what is lost against it."""
        trip = None
        rows = zip(samples.omega.tolist(), self._drive.of(samples), strict=True)
        for row, (omega, (current, _, needed)) in enumerate(rows):
            gained = abs(omega) - abs(self._omega)
            self._omega = omega
            if abs(current) >= needed and current * omega < 0.0 and not math.isnan(gained):
                self._against = max(0.0, self._against + gained)
            if self._against > self._most:
                trip = trip or (row, self._reason())
                self._against = 0.0
        return trip

    def _reason(self) -> str:
        return (
            f"the shaft has gained {self._most:.3g} rad/s against the motor's current; compare the "
            "signs of sensors.encoder and sensors.current_motor in the rig's file with the "
            "hardware, or look for a load that is stronger than the motor"
        )


class Acceleration(Limit):
    """The speed changes no faster than motor, brake and load can make it during the run.

    From the speeds that were possible in the sample before and the largest acceleration follow
    those that are possible now; a speed outside them, three times in a row, was not the shaft's.

    per_ampere: acceleration of the bare shaft [rad/s^2] by an ampere of the motor, at most. count:
    angle of one [rad].
    """

    tells_faults = True

    def __init__(self, drive: Drive, per_ampere: float, count: float) -> None:
        self._drive, self._per_ampere, self._count = drive, per_ampere, count

    def begin(self, phase: Phase, sample_rate: float) -> None:
        """Any speed is possible at first; in homing, a hand is stronger than motor and brake."""
        self._watching = phase is Phase.RUN
        self._dt = 1.0 / sample_rate
        self._margin = _GRAIN * self._count * sample_rate
        self._fading = math.exp(-self._dt / _LASTING)
        self._low, self._high = -math.inf, math.inf  # rad/s
        self._tick, self._current, self._beyond = -1, 0.0, 0

    def check(self, samples: Samples) -> Trip | None:
        """Narrow down the speeds that are possible."""
        if not self._watching:
            return None
        if len(samples.omega) >= _BLOCK and self._beyond == 0 and self._all_possible(samples):
            return None
        columns = samples.tick.tolist(), samples.omega.tolist(), self._drive.of(samples)
        for row, (tick, omega, push) in enumerate(zip(*columns, strict=True)):
            self._current = max(abs(push.at_work) + push.needed, self._fading * self._current)
            change = self._per_ampere * self._current * (tick - self._tick) * self._dt
            self._tick = tick
            low, high = self._low, self._high
            # While they are contradicted they stay: a single wrong speed is within them again.
            if self._beyond == 0:
                low, high = low - change, high + change
            if low - self._margin <= omega <= high + self._margin:
                low, high = max(low, omega - self._margin), min(high, omega + self._margin)
                self._beyond = 0
            else:
                self._beyond += 1
            self._low, self._high = low, high
            if self._beyond >= _BEYOND:
                return row, self._reason(omega, low, high)
        return None

    def _all_possible(self, samples: Samples) -> bool:
        """Whether no speed of a block is outside those possible, which are narrowed down then."""
        at_work, needed = self._drive.of_block(samples)
        faded = np.arange(1, len(at_work) + 1) * (self._dt / _LASTING)
        with np.errstate(divide="ignore"):  # no current before the first sample
            grown = np.log(np.append(self._current, np.abs(at_work) + needed))
        grown[1:] += faded
        currents = np.exp(np.maximum.accumulate(grown)[1:] - faded)
        passed = np.diff(samples.tick, prepend=self._tick) * self._dt
        change = np.cumsum(self._per_ampere * currents * passed)  # at most, since the block began
        omega, margin = samples.omega, self._margin
        low = np.maximum.accumulate(np.append(self._low, omega - margin + change))
        high = np.minimum.accumulate(np.append(self._high, omega + margin - change))
        above = low[:-1] - change - margin <= omega
        possible = bool(np.all(above & (omega <= high[:-1] + change + margin)))
        if possible:
            self._low, self._high = low.item(-1) - change[-1], high.item(-1) + change[-1]
            self._tick, self._current = samples.tick.item(-1), currents.item(-1)
        return possible

    def _reason(self, omega: float, low: float, high: float) -> str:
        return (
            f"the speed came to {omega:.4g} rad/s, where currents and inertia allow {low:.4g} to "
            f"{high:.4g} rad/s (encoder.acceleration): the encoder has lost counts or its "
            "direction, or something struck the shaft. Check its cable and both channels"
        )
