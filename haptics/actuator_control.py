"""What all controllers of the actuator's torque have in common."""

import math
from collections.abc import Callable

import numpy as np
from pydantic import Field

from daq.torque import Fact, OperatingPoint, TorqueControl
from haptics import laws
from haptics.allocation import Allocation, Preference
from haptics.dynamics import ActuatorDynamics
from haptics.operating_points import operating_points
from haptics.program import ProgramLaw
from sysid import ProcessModel
from sysid.arrays import FloatArray

_FACTS: tuple[tuple[str, str, str, Callable[[ActuatorDynamics], float]], ...] = (
    ("motor_constant", "N*m/A", "motor torque by current", lambda d: d.motor_constant),
    ("motor_gain", "A/V", "of the motor's amplifier, at rest", lambda d: d.motor.gain),
    ("motor_delay", "s", "mean delay from command to current", lambda d: d.motor.delay),
    ("brake_gain", "A/V", "of the brake's amplifier, at rest", lambda d: d.brake.gain),
    ("brake_delay", "s", "mean delay from command to current", lambda d: d.brake.delay),
    ("inertia", "kg*m^2", "of both rotors", lambda d: d.inertia),
    (
        "brake_constant",
        "N*m/A",
        "brake torque by current, sliding",
        lambda d: -d.brake_slope(0.0, d.sliding, 0.0),
    ),
    (
        "residual_torque",
        "N*m",
        "of the sliding shaft without a current, at 1 rad/s",
        lambda d: -d.rest(0.0, 1.0, d.sliding, 0.0),
    ),
    (
        "yield_angle",
        "rad",
        "by which the shaft turns before it slides",
        lambda d: 1.0 / d.stiffness,
    ),
)


class ActuatorControl(TorqueControl):
    """Settings of a controller that shares a torque between motor and brake."""

    allocation: Preference = Field(
        "heating",
        description="motor: the brake stays off; heating: what heats the windings least; "
        "stiction: the brake gives only what the motor cannot",
    )

    def facts(
        self, model: ProcessModel, parameters: FloatArray, draws: FloatArray
    ) -> tuple[Fact, ...]:
        """Constants, inertia, delays and friction of the actuator."""
        nominal = ActuatorDynamics(model, parameters)
        plausible = [ActuatorDynamics(model, draw) for draw in draws]
        return tuple(
            Fact(name, value(nominal), unit, np.array([value(each) for each in plausible]), meaning)
            for name, unit, meaning, value in _FACTS
        )

    def operating_points(
        self, model: ProcessModel, parameters: FloatArray
    ) -> tuple[OperatingPoint, ...]:
        """Within the brake's yield travel and sliding either way, up to its largest current."""
        return operating_points(model, parameters, np.linspace(0.0, self.brake_current, 4).tolist())

    def most_volts(self, model: ProcessModel, parameters: FloatArray) -> tuple[float, float]:
        """Those of the largest currents, at rest."""
        dynamics = ActuatorDynamics(model, parameters)
        return self.motor_current / dynamics.motor.gain, self.brake_current / dynamics.brake.gain

    def shared(self, dynamics: ActuatorDynamics) -> Allocation:
        """How a torque is shared."""
        limits = self.motor_current, self.brake_current
        return Allocation(self.allocation, dynamics.motor_constant, dynamics.resistances, limits)

    def law(self, model: ProcessModel, parameters: FloatArray) -> ProgramLaw:
        """The program, from rest."""
        return ProgramLaw(self.program(model, parameters), model)

    def constants(self, dynamics: ActuatorDynamics) -> list[float]:
        """What all laws know of the actuator, (``laws.CONSTANTS``,)."""
        time, delay = 1.0 / self.sample_rate, dynamics.brake.delay
        decay = math.exp(-time / delay)
        values = {
            laws.TIME: time,
            laws.HORIZON: (self.ahead + 0.5) * time + dynamics.motor.delay,
            laws.AHEAD: float(self.ahead),
            laws.INERTIA: dynamics.inertia,
            laws.STIFFNESS: dynamics.stiffness,
            laws.FRICTION: 1.0,
            laws.YIELD_SHARE: 1.0,
            laws.SLIDING: abs(dynamics.sliding),
            laws.MOTOR_GAIN: dynamics.motor.gain,
            laws.MOTOR_EMF: dynamics.motor.emf,
            laws.MOST_VOLTS: self.motor_current / dynamics.motor.gain,
            laws.BRAKE_GAIN: dynamics.brake.gain,
            laws.BRAKE_DECAY: decay,
            laws.BRAKE_MEAN: delay / time * (1.0 - decay),
            laws.BRAKE_SLOPE: dynamics.brake_slope(0.0, dynamics.sliding, 0.0),
        }
        shared = dict(enumerate(self.shared(dynamics).constants))
        return [float({**values, **shared}.get(k, 0.0)) for k in range(laws.CONSTANTS)]
