"""What all controllers of the actuator's torque have in common."""

import math
from collections.abc import Callable
from typing import Self

import numpy as np
from pydantic import Field

from daq.config.units import RadiansPerSecond
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
        "viscous_friction",
        "N*m*s/rad",
        "by which the sliding shaft's torque grows, from 1 to 30 rad/s",
        lambda d: (d.rest(0.0, 1.0, d.sliding, 0.0) - d.rest(0.0, 30.0, d.sliding, 0.0)) / 29.0,
    ),
    (
        "yield_angle",
        "rad",
        "by which the shaft turns before it slides",
        lambda d: 1.0 / d.stiffness,
    ),
)


_SLIDING = 2.0  # rad/s, of a shaft that slides as operating points have it, and more
_DOUBT = 0.25  # of the residual torque, that the speed's share of friction may be in doubt


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


class InverseControl(ActuatorControl):
    """Settings of a controller that takes the shaft's friction off by the model."""

    encoder_counts: int = Field(8192, ge=4, description="of the encoder in a revolution")
    friction_speed: RadiansPerSecond = Field(
        1000.0,
        gt=0.0,
        le=1000.0,
        description="up to which the model tells friction, which is held beyond; tune lowers it to "
        "where the identification leaves too much of it open",
    )

    def constants(self, dynamics: ActuatorDynamics) -> list[float]:
        """The same, and how far friction is trusted."""
        constants = super().constants(dynamics)
        constants[laws.FRICTION_SPEED] = self.friction_speed
        return constants

    def trusting(self, facts: tuple[Fact, ...]) -> Self:
        """With friction no further than it is known.

        A log of low speeds tells Coulomb from viscous friction badly, and the latter's share grows
        with the speed. What is taken off too much drives the shaft.
        """
        viscous, residual = (
            next(fact for fact in facts if fact.name == name)
            for name in ("viscous_friction", "residual_torque")
        )
        low, high = viscous.ends
        doubt = 0.5 * (high - low)
        if not doubt * self.friction_speed > _DOUBT * abs(residual.value):
            return self
        speed = max(_DOUBT * abs(residual.value) / doubt, _SLIDING)
        return self.model_copy(update={"friction_speed": float(f"{speed:.4g}")})
