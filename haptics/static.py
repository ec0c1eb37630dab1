"""Torque by constants: the baseline.

What most controllers of hybrid devices assume: motor torque is a constant times its current, brake
torque another constant times its own and against the motion, and currents follow at once what the
amplifiers' gains make of the commands. Friction, inertia, hysteresis and delays are left out.
"""

from typing import Literal

from pydantic import Field

from daq.config.units import RadiansPerSecond
from daq.experiment import Sample
from haptics.actuator_control import ActuatorControl
from haptics.dynamics import ActuatorDynamics
from sysid import ProcessModel
from sysid.arrays import FloatArray


class Static(ActuatorControl):
    """Motor constant and a static map of the brake; the baseline."""

    controller: Literal["static"] = Field(description="static")
    standstill: RadiansPerSecond = Field(
        0.5, ge=0.0, le=100.0, description="speed below which the brake stays off"
    )

    def law(self, model: ProcessModel, parameters: FloatArray) -> "StaticLaw":
        """The maps as they are."""
        return StaticLaw(self, ActuatorDynamics(model, parameters))


class StaticLaw:
    """u_b = i_b / G_b, u_m = (tau + k_b sign(omega) i_b) / (K G_m), i_b by the allocation."""

    def __init__(self, control: Static, dynamics: ActuatorDynamics) -> None:
        self._allocation = control.shared(dynamics)
        self._standstill = control.standstill
        self._sliding = -dynamics.brake_slope(0.0, dynamics.sliding, 0.0)
        self._gains = dynamics.motor.gain, dynamics.brake.gain

    def volts(self, sample: Sample, torque: float) -> tuple[float, float]:
        """Commands of motor and brake [V]."""
        speed, slope = sample.omega, 0.0
        if abs(speed) > self._standstill:
            slope = -self._sliding if speed > 0.0 else self._sliding
        i_b = self._allocation.brake(torque, slope)
        i_m = self._allocation.motor(torque - slope * i_b)
        return i_m / self._gains[0], i_b / self._gains[1]
