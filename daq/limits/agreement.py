"""What must agree while a rig works: count and speed, shaft and motor, currents and commands.

Each bound is so wide that no healthy rig of the file's ratings reaches it.
"""

import math

from daq.config.rig import Stall
from daq.hal import Phase, Samples
from daq.limits.base import TURN, Limit, Trip

_FORGOTTEN = 20.0  # times the angle of disagreement that is turned until half of it is forgotten
_AT_REST = 1.5  # counts by which a shaft at rest may flicker
_AGAINST = 0.2  # of the largest speed, gained against the motor's current
_SETTLED = 0.025  # s in which a current has come to follow its command
_EVIDENCE = 0.05  # s for which it does not
_EXCESS, _LACK = 1.5, 0.5  # of the current that the command asks for, at most and at least
_JUDGED = 1.5  # times the floor, from which a lack is judged
_FLOOR = 0.05  # of the current's limit, at least, for offsets and noise
_NOISE = 4.0  # standard deviations in the calibration


class Disagreement(Limit):
    """The encoder's count and the estimate of its speed must tell the same angle.

    Their difference is summed over the turns of the shaft, the older ones with less weight: an
    estimate that lags at every change of speed is ahead again at the next.
    """

    def __init__(self, turns: float) -> None:
        self._most = turns * TURN

    def begin(self, phase: Phase, sample_rate: float) -> None:
        """Start anew."""
        self._dt = 1.0 / sample_rate
        self._theta, self._omega, self._tick = math.nan, 0.0, -1
        self._difference = self._path = 0.0  # rad

    def check(self, samples: Samples) -> Trip | None:
        """Sum up; what the shaft did between samples of which some are lost is unknown."""
        columns = samples.tick.tolist(), samples.theta.tolist(), samples.omega.tolist()
        for row, (tick, theta, omega) in enumerate(zip(*columns, strict=True)):
            if tick == self._tick + 1 and tick > 0:
                counted = theta - self._theta
                estimated = 0.5 * (omega + self._omega) * self._dt
                self._difference += counted - estimated
                self._path += abs(counted) + abs(estimated)
            self._theta, self._omega, self._tick = theta, omega, tick
            if not abs(self._difference) <= self._most:
                return row, self._reason(omega)
            if self._path > _FORGOTTEN * self._most:
                self._difference *= 0.5
                self._path *= 0.5
        return None

    def _reason(self, omega: float) -> str:
        return (
            f"the encoder's count and the device's estimate of the speed, now {omega:.4g} rad/s, "
            f"differ by {abs(self._difference) / TURN:.3g} turns: one of them fails. Check the "
            "encoder's cable and both channels, and sensors.encoder of the rig's file"
        )


class Drive:
    """What the motor asks of the shaft, and what the brake allows, by ``encoder.stall``.

    gains: of the amplifiers [A/V], or None. An amplifier or a sensor that is dead shows no
    current, so that of the command counts as well.
    """

    def __init__(self, stall: Stall, gains: tuple[float | None, float | None]) -> None:
        self._motor, self._brake = stall.motor, stall.brake
        self._motor_gain, self._brake_gain = (gain or 0.0 for gain in gains)

    def ratios(self, samples: Samples, *, measured: bool = False) -> list[float]:
        """Motor current over that which must turn the shaft, of every sample, with its sign.

        measured: by the sensor alone.
        """
        columns = (
            samples.current_motor,
            samples.current_brake,
            samples.applied_voltage_motor,
            samples.applied_voltage_brake,
        )
        if len(samples) == 1:
            return [self._ratio(*(column.item() for column in columns), measured)]
        rows = zip(*(column.tolist() for column in columns), strict=True)
        return [self._ratio(*row, measured) for row in rows]

    def _ratio(
        self, motor: float, brake: float, volts_motor: float, volts_brake: float, measured: bool
    ) -> float:
        commanded = self._motor_gain * volts_motor
        if not measured and abs(commanded) > abs(motor):
            motor = commanded
        against = max(abs(brake), self._brake_gain * abs(volts_brake))
        return motor / (self._motor * (1.0 + against / self._brake))


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
        """Sum up the time of standing still, by how much more the motor asks than it must."""
        ratios = self._drive.ratios(samples)
        for row, (theta, ratio) in enumerate(zip(samples.theta.tolist(), ratios, strict=True)):
            if not abs(theta - self._rest) <= self._flicker:
                self._rest, self._driven = theta, 0.0
                continue
            self._driven = self._driven + abs(ratio) * self._dt if abs(ratio) >= 1.0 else 0.0
            if self._driven > self._time:
                return row, (
                    f"the encoder stands still at {abs(ratio):.3g} times the current that must "
                    "turn the shaft (encoder.stall): the shaft is blocked, the brake does not let "
                    "go, or encoder, motor or amplifier is dead"
                )
        return None


class Contrary(Limit):
    """A shaft that gains speed against a motor current which must turn it."""

    stops = False

    def __init__(self, drive: Drive, speed: float) -> None:
        self._drive, self._most = drive, _AGAINST * speed

    def begin(self, phase: Phase, sample_rate: float) -> None:
        """Start anew."""
        self._omega, self._against = math.nan, 0.0  # rad/s

    def check(self, samples: Samples) -> Trip | None:
        """Sum up the speed gained against the current, while it is strong enough."""
        trip = None
        ratios = self._drive.ratios(samples, measured=True)
        for row, (omega, ratio) in enumerate(zip(samples.omega.tolist(), ratios, strict=True)):
            gained = math.copysign(1.0, ratio) * (omega - self._omega)
            self._omega = omega
            driven = abs(ratio) >= 1.0 and not math.isnan(gained)
            self._against = max(0.0, self._against - gained) if driven else 0.0
            if self._against > self._most and ratio * omega < 0.0:
                trip = trip or (row, self._reason())
                self._against = 0.0
        return trip

    def _reason(self) -> str:
        return (
            f"the shaft has gained {self._most:.3g} rad/s against the motor's current; compare the "
            "signs of sensors.encoder and sensors.current_motor in the rig's file with the "
            "hardware, or look for a load that is stronger than the motor"
        )


class CurrentAgreement(Limit):
    """The current of an amplifier of known gain follows its command.

    The command asks for the currents between the least and the largest of the last 25 ms. A healthy
    amplifier never gives more, nor the other sign; less only a motor's at speed, where the back EMF
    has used up its supply. Either is judged once it has held for 50 ms more than it has not. Four
    standard deviations of the calibration are noise, and say nothing.

    slow: speed [rad/s] up to which the amplifier must give half of what is asked; infinite for the
    brake's, without back EMF.
    """

    def __init__(self, channel: str, gain: float, limit: float, slow: float) -> None:
        self._name, self._command = f"current_{channel}", f"applied_voltage_{channel}"
        self._amplifier = f"amplifiers.{channel}"
        self._gain, self._floor, self._slow = gain, _FLOOR * limit, slow
        self._seen, self._sum, self._squares = 0, 0.0, 0.0  # samples, A, A^2 of the calibration

    def begin(self, phase: Phase, sample_rate: float) -> None:
        """Learn from the calibration; then start anew, from zero outputs."""
        self._learning = phase is Phase.CALIBRATION
        if self._seen:
            variance = self._squares / self._seen - (self._sum / self._seen) ** 2
            self._floor = max(self._floor, _NOISE * math.sqrt(max(0.0, variance)))
        self._dt = 1.0 / sample_rate
        self._half = max(1, math.ceil(0.5 * _SETTLED * sample_rate))  # samples of half the window
        self._filled = 0
        self._low = self._high = self._low_before = self._high_before = 0.0  # A, of the halves
        self._excess = self._lack = 0.0  # s

    def check(self, samples: Samples) -> Trip | None:
        """Compare every sample with the commands before it."""
        currents: list[float] = getattr(samples, self._name).tolist()
        if self._learning:
            self._seen += len(currents)
            self._sum += sum(currents)
            self._squares += sum(current * current for current in currents)
            return None
        rows = zip(
            currents, getattr(samples, self._command).tolist(), samples.omega.tolist(), strict=True
        )
        for row, (current, volts, omega) in enumerate(rows):
            low, high = min(self._low, self._low_before), max(self._high, self._high_before)
            self._weigh(current, low, high, abs(omega) <= self._slow)
            self._extend(self._gain * volts)
            if self._excess > _EVIDENCE or self._lack > _EVIDENCE:
                return row, self._reason(current, low, high)
        return None

    def _weigh(self, current: float, low: float, high: float, slow: bool) -> None:
        """Gather evidence, in seconds for the worse or the better."""
        most, least = _EXCESS * max(high, 0.0), _EXCESS * min(low, 0.0)
        within = least - self._floor <= current <= most + self._floor
        self._excess = max(0.0, self._excess + (-self._dt if within else self._dt))
        if high < 0.0:
            current, low = -current, -high
        if slow and low > _JUDGED * self._floor:
            enough = current >= _LACK * low
            self._lack = max(0.0, self._lack + (-self._dt if enough else self._dt))

    def _reason(self, current: float, low: float, high: float) -> str:
        comparison = (
            f"{self._name} is {current:.3g} A, and by {self._amplifier} the command of the last "
            f"{1e3 * _SETTLED:g} ms asks for {low:.3g} to {high:.3g} A"
        )
        if self._excess > _EVIDENCE:
            return (
                f"{comparison}. Check amplifier and current sensor: gain, sign, an output that "
                "sticks"
            )
        return (
            f"{comparison}. Check whether the amplifier is on, its supply, and that its output and "
            "the current sensor are connected"
        )

    def _extend(self, current: float) -> None:
        """Take the current that a command asks for into the window, which has two halves."""
        if self._filled == self._half:
            self._low_before, self._high_before = self._low, self._high
            self._low = self._high = current
            self._filled = 0
        self._low, self._high = min(self._low, current), max(self._high, current)
        self._filled += 1
