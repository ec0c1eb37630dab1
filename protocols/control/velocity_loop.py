"""A velocity loop on the motor: the settings of its protocols, and the loop itself."""

from collections.abc import Sequence
from typing import Annotated, Literal

from pydantic import Field

from daq.config.base import Section
from daq.config.units import Unit
from daq.errors import RunError
from daq.experiment import ClosedLoop, Sample
from protocols.control.bounds import MOTOR_LIMIT, MotorLimit
from protocols.control.pid import Pid, VelocityGains
from protocols.control.speed_tracker import TRACKER_BANDWIDTH, SpeedTracker, TrackerBandwidth


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
        """Motor command [V] that holds the strongest brake, None where a rating is missing.

        The amplifiers of motor and brake are taken to be alike.
        """
        constant, brake = self.ratings.torque_constant, self.ratings.brake_constant
        if constant is None or brake is None:
            return None
        return max(map(abs, brake_commands)) * brake / constant


class VelocityServo:
    """Makes the shaft follow a velocity, by the speed that it tracks.

    limit: largest command, either way [V]. fastest: speed beyond which the run is ended [rad/s].
    bandwidth: of the tracked speed [Hz]. cure: end of the text of that RunError.
    """

    def __init__(
        self, gains: VelocityGains, limit: float, fastest: float, bandwidth: float, cure: str
    ) -> None:
        self._tracker = SpeedTracker(bandwidth)
        self._pid = Pid(gains, -limit, limit)
        self._fastest, self._cure = fastest, cure

    def track(self, sample: Sample) -> float:
        """Speed of the shaft [rad/s], by the sample's angle."""
        return self._tracker.update(sample.time, sample.theta)

    def volts(self, time: float, reference: float, speed: float) -> float:
        """The motor's command. Raises RunError for a shaft that is too fast."""
        if abs(speed) > self._fastest:
            raise RunError(
                f"the shaft turns at {speed:.4g} rad/s, beyond {self._fastest:.4g} rad/s, while "
                f"{reference:.4g} rad/s were asked for; lower the gains under 'loop' if it "
                f"rings{self._cure}"
            )
        return self._pid.output(time, reference, speed)
