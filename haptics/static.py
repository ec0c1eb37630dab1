"""Torque by constants: the baseline.

What most controllers of hybrid devices assume: motor torque is a constant times its current, brake
torque another constant times its own and against the motion, and currents follow at once what the
amplifiers' gains make of the commands. Friction, inertia, hysteresis and delays are left out.
"""

from typing import Literal

from pydantic import Field

from daq.config.units import RadiansPerSecond
from daq.torque import LawProgram
from haptics import laws
from haptics.actuator_control import ActuatorControl
from haptics.dynamics import ActuatorDynamics
from haptics.program import law_program
from sysid import ProcessModel
from sysid.arrays import FloatArray


class Static(ActuatorControl):
    """Motor constant and a static map of the brake; the baseline."""

    controller: Literal["static"] = Field(description="static")
    standstill: RadiansPerSecond = Field(
        0.5, ge=0.0, le=100.0, description="speed below which the brake stays off"
    )

    def program(self, model: ProcessModel, parameters: FloatArray) -> LawProgram:
        """u_b = i_b / G_b, u_m = (tau - b sign(omega) i_b) / (K G_m), i_b by the allocation."""
        constants = self.constants(ActuatorDynamics(model, parameters))
        constants[laws.STANDSTILL] = self.standstill
        return law_program("static", model, parameters, constants)
