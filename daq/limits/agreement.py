"""Currents against their commands, and the torque sensor against the motor's current.

Each bound is so wide that no healthy rig of the file's ratings reaches it.
"""

import math

from daq.hal import Phase, Samples
from daq.limits.base import Limit, Trip

_STEADY = 0.2  # of a slow speed, by which it may change while torques are compared
_AVERAGED = 0.1  # s of which the torques are compared
_WIDE = 0.4  # of the motor's torque by which the sensor may differ from it, beside the friction
_SETTLED = 0.025  # s in which a current has come to follow its command
_EVIDENCE = 0.05  # s for which it does not
_EXCESS, _LACK = 1.5, 0.5  # of the current that the command asks for, at most and at least
_JUDGED = 1.5  # times the floor, from which a lack is judged
_FLOOR = 0.05  # of the current's limit, at least, for offsets and noise
_NOISE = 4.0  # standard deviations in the calibration


class TorqueAgreement(Limit):
    """The torque between motor and brake is the motor's, at a speed that does not change.

    constant: torque per ampere [N*m/A]. friction: torque [N*m] that the motor's own may take.
    slow: a slow speed [rad/s].
    """

    tells_faults = True
    stops = False

    def __init__(self, constant: float, friction: float, slow: float) -> None:
        self._constant, self._friction = constant, friction
        self._steady = _STEADY * slow

    def begin(self, phase: Phase, sample_rate: float) -> None:
        """Offsets are taken off from homing on, when a hand moves the shaft."""
        self._watching = phase is Phase.RUN
        self._length = max(1, math.ceil(_AVERAGED * sample_rate))
        self._differs = 0
        self._clear()

    def _clear(self) -> None:
        self._n, self._torque, self._current = 0, 0.0, 0.0  # samples, sums of N*m and A
        self._slowest, self._fastest = math.inf, -math.inf  # rad/s

    def check(self, samples: Samples) -> Trip | None:
        """Compare the means of a tenth of a second, and the next where they differ."""
        trip = None
        columns = samples.torque, samples.current_motor, samples.omega
        rows = zip(*(column.tolist() for column in columns), strict=True)
        for row, (torque, current, omega) in enumerate(rows if self._watching else ()):
            self._n += 1
            self._torque += torque
            self._current += current
            self._slowest, self._fastest = min(self._slowest, omega), max(self._fastest, omega)
            if self._n == self._length:
                trip = self._compare(row) or trip
                self._clear()
        return trip

    def _compare(self, row: int) -> Trip | None:
        torque, current = self._torque / self._n, self._current / self._n
        motor = self._constant * current
        if self._fastest - self._slowest > self._steady or abs(motor) < 2.0 * self._friction:
            return None
        differs = abs(torque - motor) > _WIDE * abs(motor) + self._friction
        self._differs = self._differs + 1 if differs else 0
        return (row, self._reason(torque, current, motor)) if self._differs >= 2 else None

    def _reason(self, torque: float, current: float, motor: float) -> str:
        return (
            f"torque is {torque:.3g} N*m, where the motor's {current:.3g} A give {motor:.3g} N*m "
            "(sensors.torque.motor_constant). Check the torque sensor's cable and supply, and "
            "sign and scale of sensors.torque"
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

    tells_faults = True

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
        least = min(abs(low), abs(high)) if low * high > 0.0 else 0.0
        if least > self._floor and current * low < 0.0 and abs(current) > _LACK * least:
            return (
                f"{comparison}. It has the other sign: turn 'sign' of sensors.{self._name} in the "
                "rig's file, if it is the sensor's; else the wires of the amplifier's output"
            )
        if self._excess > _EVIDENCE:
            return (
                f"{comparison}. Check amplifier and current sensor: gain, an output that sticks, "
                "or the two channels swapped"
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
