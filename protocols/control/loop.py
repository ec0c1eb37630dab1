"""Sampled loops: PID, slow references, the speed's estimate, bounds; and the velocity loop."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from daq.config.base import Section
from daq.config.units import Hertz, Seconds, Unit, Volts
from daq.errors import RunError
from daq.experiment import ClosedLoop, FreeSetting, RunFrame, Sample, Shaft
from daq.hal import FloatArray

MotorLimit = Annotated[
    Volts, Field(gt=0.0, le=10.0, description="largest motor command, either way")
]
MOTOR_LIMIT = 4.5  # V
BRAKE_SLOPE = 0.5  # V/s; a brake let go at once would let the shaft leap
# Of a design's loops: the largest command in parts of the motor's range; command at an error of the
# fastest speed, in parts of the same; time in which the integral does as much again [s].
_LARGEST, _STIFFNESS, _INTEGRAL_TIME = (0.1, 0.9), (0.5, 10.0), (0.02, 0.5)
TrackerBandwidth = Annotated[Hertz, Field(gt=0.0, le=1e4)]
TRACKER_BANDWIDTH = 150.0  # Hz


def command_bounds(
    motor_limit: float, brake_commands: Sequence[float]
) -> tuple[FloatArray, FloatArray]:
    """Lowest and highest commands of motor and brake, (2,) each [V]; zero is within them."""
    lowest, highest = min(0.0, *brake_commands), max(0.0, *brake_commands)
    return np.array([-motor_limit, lowest]), np.array([motor_limit, highest])


class VelocityGains(Section):
    """Gains of a velocity loop."""

    proportional: Annotated[float, Unit("V*s/rad")] = Field(ge=0.0, description="proportional gain")
    integral: Annotated[float, Unit("V/rad")] = Field(0.0, ge=0.0, description="integral gain")
    derivative: Annotated[float, Unit("V*s^2/rad")] = Field(
        0.0, ge=0.0, description="derivative gain, on the measured velocity"
    )
    derivative_filter: Seconds = Field(
        0.005, ge=0.0, le=10.0, description="time constant of the derivative's low-pass filter"
    )


class Pid:
    """PID with limited output, in volts.

    u = K_p e + K_i ∫ e dt - K_d dy/dt with e = reference - y. The derivative is of the measurement
    alone, so that a step of the reference does not kick, by backward differences behind a
    first-order low-pass filter (Åström & Hägglund, "PID Controllers: Theory, Design, and Tuning",
    1995). Against windup the integral goes no further than the limit that the error drives the
    output to (conditional integration). It starts without a bump: the first output is zero,
    whatever the error, if there is an integral to take the difference up.
    """

    def __init__(self, gains: VelocityGains, lowest: float, highest: float) -> None:
        self._gains, self._lowest, self._highest = gains, lowest, highest
        self._time = math.nan
        self._measured = self._integral = self._derivative = 0.0

    def output(self, time: float, reference: float, measured: float) -> float:
        """Volts that answer a measurement at ``time`` [s], which rises from call to call."""
        gains, error = self._gains, reference - measured
        elapsed, volts = time - self._time, gains.proportional * error
        step = 0.0
        if elapsed > 0.0:
            weight = gains.derivative_filter + elapsed
            rate = (measured - self._measured) / weight
            self._derivative = gains.derivative_filter / weight * self._derivative + rate
            volts = volts - gains.derivative * self._derivative + self._integral
            step = gains.integral * elapsed * error
        elif gains.integral > 0.0:  # the first call
            self._integral = -volts
            volts = 0.0
        self._time, self._measured = time, measured
        # The integral goes on as far as the limit that it drives to, and no further.
        if step > 0.0:
            step = min(step, max(self._highest - volts, 0.0))
        else:
            step = max(step, min(self._lowest - volts, 0.0))
        self._integral += step
        return min(max(volts + step, self._lowest), self._highest)


class Ramp:
    """A reference that follows its target no faster than ``slope`` per second."""

    def __init__(self, slope: float, value: float = 0.0) -> None:
        self.value, self._slope = value, slope

    def towards(self, target: float, elapsed: float) -> float:
        """The reference ``elapsed`` seconds later."""
        most = self._slope * elapsed
        self.value += min(max(target - self.value, -most), most)
        return self.value


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
        self._bandwidth, self._time = bandwidth, math.nan
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


@dataclass(frozen=True)
class VelocityServo:
    """Makes the shaft follow a velocity, by the speed that it tracks.

    fastest: speed beyond which the run is ended [rad/s]. cure: end of the text of that RunError.
    """

    pid: Pid
    tracker: SpeedTracker
    fastest: float
    cure: str

    def drive(self, sample: Sample, reference: float) -> tuple[float, float]:
        """Motor command [V] and tracked speed. Raises RunError for a shaft that is too fast."""
        speed = self.tracker.update(sample.time, sample.theta)
        if abs(speed) > self.fastest:
            raise RunError(
                f"the shaft turns at {speed:.4g} rad/s, beyond {self.fastest:.4g} rad/s, while "
                f"{reference:.4g} rad/s were asked for; lower the gains under 'loop' if it "
                f"rings{self.cure}"
            )
        return self.pid.output(sample.time, reference, speed), speed


class Ratings(Section):
    """What data sheets say: for the check of the commands and, at the load, for the torque."""

    torque_constant: Annotated[float, Unit("N*m/A")] | None = Field(
        None, gt=0.0, description="of the motor: rated torque by rated current"
    )
    motor_damping: Annotated[float, Unit("N*m*s/rad")] = Field(
        0.0, ge=0.0, description="viscous damping of the motor, where it is known"
    )
    brake_constant: Annotated[float, Unit("N*m/A")] | None = Field(
        None, gt=0.0, description="of the brake: rated torque by rated current"
    )


class VelocityLoop(ClosedLoop):
    """A velocity loop on the motor, and where torque is measured."""

    loop: VelocityGains = Field(description="gains of the velocity loop")
    speed_filter: TrackerBandwidth = Field(
        TRACKER_BANDWIDTH, description="bandwidth of the speed that the loop sees"
    )
    motor_limit: MotorLimit = MOTOR_LIMIT
    torque_sensor: Literal["between", "load"] = Field(
        description="between motor and brake, or at the load"
    )
    ratings: Ratings = Field(Ratings(), description="what data sheets say of motor and brake")

    @staticmethod
    def loop_settings(frame: RunFrame) -> dict[str, FreeSetting]:
        """Settings of the loop that a design may choose."""
        least, most = (share * min(-frame.motor[0], frame.motor[1]) for share in _LARGEST)
        return {
            "motor_limit": FreeSetting(least, most, calm=least),
            "stiffness": FreeSetting(*_STIFFNESS, log=True),
            "integral_time": FreeSetting(*_INTEGRAL_TIME, log=True),
        }

    @staticmethod
    def loop_keys(values: Mapping[str, float], frame: RunFrame, shaft: Shaft) -> dict[str, Any]:
        """Keys that all velocity loops have, at values of the free settings."""
        reach = min(-frame.motor[0], frame.motor[1])
        proportional = values["stiffness"] * reach / shaft.speed
        ratings = (
            {} if shaft.torque_constant is None else {"torque_constant": shaft.torque_constant}
        )
        return {
            "loop": {
                "proportional": proportional,
                "integral": proportional / values["integral_time"],
            },
            "motor_limit": values["motor_limit"],
            "torque_sensor": shaft.torque_sensor,
            "ratings": ratings,
        }

    @staticmethod
    def driven_shaft(frame: RunFrame) -> Shaft | None:
        """The shaft that a design's loops may drive; None where they cannot, or tell no torque."""
        shaft = frame.shaft
        drives = frame.motor[0] < 0.0 < frame.motor[1] and frame.brake[1] > 0.0
        if shaft is None or not drives:
            return None
        tells = shaft.torque_sensor == "between" or shaft.torque_constant is not None
        return shaft if tells else None

    def servo(self, fastest: float, cure: str) -> VelocityServo:
        """The loop's servo for one run; fastest and cure as of ``VelocityServo``."""
        pid = Pid(self.loop, -self.motor_limit, self.motor_limit)
        return VelocityServo(pid, SpeedTracker(self.speed_filter), fastest, cure)

    def require_torque_constant(self) -> None:
        """ValueError where the brake's torque cannot be read from the motor's current."""
        if self.torque_sensor == "load" and self.ratings.torque_constant is None:
            raise ValueError(
                "ratings.torque_constant: with the torque sensor at the load the brake's torque is "
                "read from the motor's current; give the motor's constant, rated torque by rated "
                "current, such as '0.14 N*m/A'"
            )

    def require_strength(self, brake_commands: Sequence[float]) -> None:
        """ValueError where the motor cannot turn the strongest brake, by the ratings."""
        needed = self.holding_command(brake_commands)
        if needed is not None and needed > self.motor_limit:
            raise ValueError(
                f"brake_commands: at {max(brake_commands):g} V the brake takes about "
                f"{needed:.2g} V of the motor by its ratings, beyond motor_limit, "
                f"{self.motor_limit:g} V; lower the brake command"
            )

    def holding_command(self, brake_commands: Sequence[float]) -> float | None:
        """Motor command [V] that holds the strongest brake; None where a rating is missing."""
        constant, brake = self.ratings.torque_constant, self.ratings.brake_constant
        if constant is None or brake is None:
            return None
        return max(map(abs, brake_commands)) * brake / constant
