"""Torque by the inverse of the identified model.

With tau_r the torque that the hand is to feel, the motor has to give, beside it, what the shaft's
acceleration and its friction take:

    K_t i_m = tau_r + J domega/dt - rest(omega, z, theta, 0) - b(z) i_b

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

import abc
import math
from typing import Literal, Self

from pydantic import Field

from daq.config.units import Hertz, NewtonMetres, Part
from daq.experiment import Sample
from daq.torque import Fact
from haptics.actuator_control import ActuatorControl
from haptics.dynamics import ActuatorDynamics
from haptics.observer import Hand, SensorNoise, ShaftFilter, ShaftObserver
from sysid import ProcessModel
from sysid.arrays import FloatArray

_CERTAIN = 0.95  # of the inertia, the most that is ever taken off


class Feedforward(ActuatorControl):
    """Inverse of amplifiers, coil, hysteresis, friction and inertia."""

    controller: Literal["feedforward"] = Field(description="feedforward")
    inertia_share: Part = Field(
        0.95, ge=0.0, lt=1.0, description="of the inertia that the motor takes off the hand"
    )
    acceleration_filter: Hertz = Field(
        50.0, gt=0.0, le=1e4, description="bandwidth of the acceleration that is compensated"
    )
    encoder_counts: int = Field(8192, ge=4, description="of the encoder in a revolution")
    hand_walk: NewtonMetres = Field(
        0.03, gt=0.0, le=10.0, description="by which the hand's torque changes in a sample, roughly"
    )

    def tuned(
        self,
        model: ProcessModel,
        parameters: FloatArray,
        facts: tuple[Fact, ...],
    ) -> Self:
        """No more of the inertia than the least plausible one has."""
        inertia = next(fact for fact in facts if fact.name == "inertia")
        share = min(self.inertia_share, _CERTAIN * inertia.ends[0] / inertia.value)
        return self.model_copy(update={"inertia_share": float(f"{share:.4g}")})

    def law(self, model: ProcessModel, parameters: FloatArray) -> "FeedforwardLaw":
        """The inverse, its observer at rest."""
        return FeedforwardLaw(self, ActuatorDynamics(model, parameters))


class InverseLaw(abc.ABC):
    """The inverse of amplifiers, brake and friction; what else the shaft is to do, a subclass says.

    observer: of the shaft, by its filter.
    """

    def __init__(
        self, control: ActuatorControl, dynamics: ActuatorDynamics, shaft: ShaftFilter
    ) -> None:
        self._dynamics, self._allocation = dynamics, control.shared(dynamics)
        self._time = time = 1.0 / control.sample_rate
        self.observer = ShaftObserver(dynamics, time, shaft)
        self._brake = BrakeCurrent(dynamics.brake.delay, time, control.ahead)
        self._horizon = (control.ahead + 0.5) * time + dynamics.motor.delay
        self._most = control.motor_current / dynamics.motor.gain
        self._torque, self._tick = math.nan, -1

    def volts(self, sample: Sample, torque: float) -> tuple[float, float]:
        """Commands of motor and brake [V]."""
        dynamics = self._dynamics
        self._observe(sample)
        motion = self.observer.ahead(self._horizon)
        slope = 0.0 if math.isnan(self._torque) else (torque - self._torque) / self._time
        self._torque = torque
        rest = dynamics.rest(0.0, motion.omega, motion.z, motion.theta)
        needed = self.shaft_torque(torque, slope) - rest
        per_ampere = dynamics.brake_slope(motion.omega, motion.z, motion.theta)
        i_b = self._allocation.brake(needed, per_ampere)
        from_brake = per_ampere * self._brake.mean(i_b)
        i_m = self._allocation.motor(needed - from_brake)
        self.limited(dynamics.motor_constant * i_m + from_brake - needed)
        volts = (i_m - dynamics.motor.emf * motion.omega) / dynamics.motor.gain
        return min(max(volts, -self._most), self._most), i_b / dynamics.brake.gain

    @abc.abstractmethod
    def shaft_torque(self, torque: float, slope: float) -> float:
        """Torque on the shaft beside what overcomes friction [N*m].

        torque: that the hand is to feel now; slope: by which it changes [N*m/s].
        """

    def limited(self, missing: float) -> None:  # noqa: B027 - what has no memory need not know
        """Take note of what the limits of the currents leave of the torque, as it is [N*m]."""

    def _observe(self, sample: Sample) -> None:
        for _ in range(sample.tick - self._tick - 1 if self._tick >= 0 else 0):
            self._brake.next()  # samples that did not arrive
            self.observer.coast()
        self._tick = sample.tick
        current = self._brake.next()
        self.observer.update(sample.theta, sample.torque, sample.current_motor, current)


class FeedforwardLaw(InverseLaw):
    """The reference along its last slope, and the acceleration's share."""

    def __init__(self, control: Feedforward, dynamics: ActuatorDynamics) -> None:
        time, noise = 1.0 / control.sample_rate, SensorNoise(encoder_noise(control.encoder_counts))
        shaft = ShaftFilter.of(dynamics.inertia, time, noise, Hand(control.hand_walk))
        super().__init__(control, dynamics, shaft)
        self._share = control.inertia_share * dynamics.inertia
        self._smoothing = 1.0 - math.exp(-2.0 * math.pi * control.acceleration_filter * time)
        self._acceleration = 0.0

    def shaft_torque(self, torque: float, slope: float) -> float:
        """tau_r + k J domega/dt."""
        self._acceleration += self._smoothing * (self.observer.acceleration - self._acceleration)
        return torque + self._horizon * slope + self._share * self._acceleration


def encoder_noise(counts: int) -> float:
    """Standard deviation of an angle in counts of a revolution [rad]."""
    return 2.0 * math.pi / counts / math.sqrt(12.0)


class BrakeCurrent:
    """The brake's current by the currents asked for, a first-order lag behind them [A].

    The sensor's noise would be torque: 5 mA are 17 mN*m. delay, time: of the channel, of a sample
    [s].
    """

    def __init__(self, delay: float, time: float, ahead: int) -> None:
        self._decay = math.exp(-time / delay)
        self._mean = delay / time * (1.0 - self._decay)
        self._current = 0.0
        self._coming = [0.0] * (ahead + 1)

    def next(self) -> float:
        """The current at the next sample."""
        self._current = self._after(self._current, self._coming.pop(0))
        self._coming.append(self._coming[-1])
        return self._current

    def mean(self, target: float) -> float:
        """The mean current while the command holds that asks for a current [A]."""
        self._coming[-1] = target
        current = self._current
        for before in self._coming[:-1]:
            current = self._after(current, before)
        return target + (current - target) * self._mean

    def _after(self, current: float, target: float) -> float:
        return target + (current - target) * self._decay
