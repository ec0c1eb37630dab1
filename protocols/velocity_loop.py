"""What the protocols that turn the shaft by a velocity loop on the motor have in common."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from daq.config.base import Section
from daq.config.units import Hertz, Unit, Volts
from daq.experiment import ClosedLoop
from protocols.pid import VelocityGains


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
    speed_filter: Hertz = Field(
        150.0, gt=0.0, le=1e4, description="bandwidth of the speed that the loop sees"
    )
    motor_limit: Volts = Field(
        4.5, gt=0.0, le=10.0, description="largest motor command, either way"
    )
    torque_sensor: Literal["between", "load"] = Field(
        description="between motor and brake, or at the load"
    )
    ratings: Ratings = Field(Ratings(), description="what data sheets say of motor and brake")
