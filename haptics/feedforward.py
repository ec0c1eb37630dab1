"""Torque by the inverse of the identified model.

With tau_r the torque that the hand is to feel, the motor has to give, beside it, what the shaft's
acceleration and its friction take:

    K_t i_m = tau_r + k J domega/dt - f rest(omega, z, theta, 0) - b(z) i_b

with shares k of the inertia and f of the friction.

Speed, acceleration and the hysteresis variable z are observed from the encoder and the currents;
b(z), what an ampere of the brake gives in this state, is signed, so the brake is asked for a torque
only where it opposes the motion, and the motor makes good what stiction is left. A command is
answered by a current in the middle of the interval in which it holds, later by the amplifier's mean
delay: all quantities are predicted to then, the reference along its last slope. This is the inverse
of amplifier and coil up to the first power of frequency; the motor's back EMF is taken off.

The acceleration is fed back positively: with a share k of the inertia, and the low-pass filter F of
the acceleration, the loop of a free shaft is 1 - k (J_model / J) F(s) e^(-s d), which is stable
whatever the delay d while k J_model / J < 1. ``tuned`` keeps k so for all plausible J.
"""

import math
from typing import Literal, Self

from pydantic import Field

from daq.config.units import Hertz, NewtonMetres, Part
from daq.torque import Fact, LawProgram
from haptics import laws
from haptics.actuator_control import InverseControl
from haptics.dynamics import ActuatorDynamics
from haptics.observer import Hand, SensorNoise, ShaftFilter
from haptics.program import law_program
from sysid import ProcessModel
from sysid.arrays import FloatArray

_CERTAIN = 0.95  # of the inertia, the most that is ever taken off


class Feedforward(InverseControl):
    """Inverse of amplifiers, coil, hysteresis, friction and inertia."""

    controller: Literal["feedforward"] = Field(description="feedforward")
    inertia_share: Part = Field(
        0.95, ge=0.0, lt=1.0, description="of the inertia that the motor takes off the hand"
    )
    friction_share: Part = Field(
        1.0,
        ge=0.0,
        le=1.0,
        description="of the friction that the motor takes off; no wall is passive with any",
    )
    acceleration_filter: Hertz = Field(
        50.0, gt=0.0, le=1e4, description="bandwidth of the acceleration that is compensated"
    )
    hand_walk: NewtonMetres = Field(
        0.03, gt=0.0, le=10.0, description="by which the hand's torque changes in a sample, roughly"
    )

    def tuned(
        self,
        model: ProcessModel,
        parameters: FloatArray,
        facts: tuple[Fact, ...],
    ) -> Self:
        """No more of the inertia than the least plausible one has, and friction as it is known."""
        inertia = next(fact for fact in facts if fact.name == "inertia")
        share = min(self.inertia_share, _CERTAIN * inertia.ends[0] / inertia.value)
        return self.trusting(facts).model_copy(update={"inertia_share": float(f"{share:.4g}")})

    def program(self, model: ProcessModel, parameters: FloatArray) -> LawProgram:
        """The inverse."""
        dynamics, time = ActuatorDynamics(model, parameters), 1.0 / self.sample_rate
        noise = SensorNoise(encoder_noise(self.encoder_counts))
        shaft = ShaftFilter.of(dynamics.inertia, time, noise, Hand(self.hand_walk))
        constants = shaft.placed(self.constants(dynamics))
        constants[laws.FRICTION] = self.friction_share
        constants[laws.SHARE] = self.inertia_share * dynamics.inertia
        smoothing = 1.0 - math.exp(-2.0 * math.pi * self.acceleration_filter * time)
        constants[laws.SMOOTHING] = smoothing
        return law_program("feedforward", model, parameters, constants)


def encoder_noise(counts: int) -> float:
    """Standard deviation of an angle in counts of a revolution [rad]."""
    return 2.0 * math.pi / counts / math.sqrt(12.0)
