"""Torque by feedback: LQG with a disturbance observer, on top of the inverse.

What the inverse leaves is a first-order plant behind a delay. With e = tau_r + h, the torque that
is missing at the hand, m the torque on the shaft beside friction, and delta = m - tau_r + d,

    J omega' = delta + e,  e' = -(B / J) (delta + e) + w + tau_r',

for a hand with damping B. The Kalman filter of ``haptics.observer`` tells h, w and the disturbance
d from encoder, currents and torque sensor. e stays zero with delta* = (J / B) (w + tau_r'), which
is what accelerates the shaft along with the hand; about it the regulator minimises

    sum e^2 + effort (change of delta)^2

over sampled time, with the commands that are under way as states: the delay is in the design. As it
is the change that is fed back, and the state is the torque that was given, limits of the currents
wind nothing up.

The hand is not known. ``tuned`` raises the effort until the loop is stable, with a largest
sensitivity of ``sensitivity`` at the motor, for hands from 1 / ``hand_range`` to ``hand_range``
times the design's at both ends of what the identification leaves of inertia and motor constant.

That loop has friction taken off exactly. Within the yield travel friction is a spring, and taking
it off a sample late leaves a light hand little margin. So the share that is taken off is scheduled
by the hysteresis: ``yield_share`` of it at z = 0, all of it where the brake slides. ``tuned``
lowers it until the program's own loop, linearised there, has the same margin.
"""

import itertools
import math
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import Field
from scipy.linalg import expm, solve_discrete_are

from daq.config.units import NewtonMetres, Part, Seconds, Unit
from daq.torque import Fact, LawProgram
from haptics import laws
from haptics.actuator_control import InverseControl
from haptics.dynamics import ActuatorDynamics
from haptics.feedforward import encoder_noise
from haptics.linear_loop import LinearLaw, loop_margins
from haptics.observer import Hand, SensorNoise, ShaftFilter
from haptics.program import law_program
from haptics.reference_shape import ReferenceShape
from sysid import ModelError, ProcessModel
from sysid.arrays import FloatArray

_EFFORTS = np.geomspace(1.0, 1e6, 25)  # in parts of the least
_FREQUENCIES = 60
_DOUBT = 0.5  # N*m/s, slope of a reference that tells of the hand as much as the design
_SHARES = np.linspace(1.0, 0.3, 8)


class TorqueFeedback(InverseControl):
    """Settings of a filter and a regulator on top of the inverse; LQG makes their gains."""

    takes_torque: ClassVar[bool] = True

    torque_noise: NewtonMetres = Field(
        0.010,
        gt=0.0,
        le=10.0,
        description="of the torque sensor, rms, as the filter reckons with it: more than it has "
        "makes a calmer loop",
    )
    hand_damping: Annotated[float, Unit("N*m*s/rad")] = Field(
        0.018, gt=0.0, le=10.0, description="of the hand that the regulator is designed for"
    )
    hand_stiffness: Annotated[float, Unit("N*m/rad")] = Field(
        0.16, ge=0.0, le=100.0, description="of that hand"
    )
    hand_range: Part = Field(
        4.0, ge=1.0, le=100.0, description="factor either way of the hands that must be stable"
    )
    hand_rate: Annotated[float, Unit("N*m/s")] = Field(
        0.6, gt=0.0, le=1e3, description="by which its motion changes torque's slope in a sample"
    )
    hand_memory: Seconds = Field(
        0.5, gt=0.0, le=100.0, description="over which the hand that shapes the reference is told"
    )
    disturbance: NewtonMetres = Field(
        2e-4, gt=0.0, le=1.0, description="by which unknown friction changes in a sample"
    )
    effort: Part = Field(
        0.3, gt=0.0, le=1e6, description="weight of the motor's changes, the least; tune raises it"
    )
    yield_share: Part = Field(
        1.0,
        gt=0.0,
        le=1.0,
        description="of the friction taken off, that within the yield travel; tune lowers it",
    )
    sensitivity: Part = Field(
        3.0, gt=1.0, le=10.0, description="largest of the loop at the motor, over all these hands"
    )

    def tuned(
        self,
        model: ProcessModel,
        parameters: FloatArray,
        facts: tuple[Fact, ...],
    ) -> Self:
        """The least effort at which every plausible loop is stable with a margin.

        Then the largest share of the friction within the yield travel that leaves it, if any does.
        """
        dynamics = ActuatorDynamics(model, parameters)
        by_name = {fact.name: fact for fact in facts}
        inertias, constants = (by_name[name].ends for name in ("inertia", "motor_constant"))
        strengths = [constant / dynamics.motor_constant for constant in constants]
        hands = np.geomspace(1.0 / self.hand_range, self.hand_range, 5).tolist()
        trusting, peak = self.trusting(facts), math.inf
        for effort in (self.effort * _EFFORTS).tolist():
            control = trusting.model_copy(update={"effort": float(f"{effort:.4g}")})
            loop = TorqueLoop(control, dynamics)
            cases = itertools.product({*inertias}, {*strengths}, hands)
            peak = max(loop.peak_sensitivity(*case) for case in cases)
            if peak <= self.sensitivity:
                return control.scheduled(model, parameters)
        raise ModelError(
            f"no effort keeps the loop's sensitivity within {self.sensitivity:g} for all hands up "
            f"to {self.hand_range:g} times either way (at most {peak:.3g} is left); raise "
            "sensitivity, or lower hand_range or hand_rate"
        )

    def scheduled(self, model: ProcessModel, parameters: FloatArray) -> Self:
        """With the share of the friction within the yield travel that its margin asks for."""
        dynamics, time = ActuatorDynamics(model, parameters), 1.0 / self.sample_rate
        hands = np.geomspace(1.0 / self.hand_range, self.hand_range, 3).tolist()
        peaks = {}
        for share in (self.yield_share * _SHARES).tolist():
            control = self.model_copy(update={"yield_share": float(f"{share:.4g}")})
            law = LinearLaw.of(control.loop_program(model, parameters), model)
            peaks[control.yield_share] = max(
                loop_margins(
                    law,
                    dynamics,
                    "within yield",
                    (hand * self.hand_stiffness, hand * self.hand_damping),
                    time,
                    self.ahead,
                ).sensitivity
                for hand in hands
            )
            if peaks[control.yield_share] <= self.sensitivity:
                return control
        best = min(peaks, key=lambda share: peaks[share])
        return self.model_copy(update={"yield_share": best})

    def program(self, model: ProcessModel, parameters: FloatArray) -> LawProgram:
        """The regulator on top of the inverse, the reference shaped by the hand."""
        loop = self.loop_program(model, parameters)
        hand = self.hand_stiffness, self.hand_damping
        shape = ReferenceShape.of(loop, model, hand, self.hand_range)
        return replace(loop, constants=shape.placed(loop.constants))

    def loop_program(self, model: ProcessModel, parameters: FloatArray) -> LawProgram:
        """The same without shaping the reference."""
        dynamics = ActuatorDynamics(model, parameters)
        constants = self.shaft_filter(dynamics.inertia).placed(self.constants(dynamics))
        constants = Regulator.of(self, dynamics.inertia).placed(constants)
        constants[laws.YIELD_SHARE] = self.yield_share
        constants[laws.HAND_DAMPING] = self.hand_damping
        constants[laws.HAND_MEMORY] = 1.0 - math.exp(-1.0 / self.hand_memory / self.sample_rate)
        constants[laws.HAND_DOUBT] = _DOUBT**2
        constants[laws.HAND_RANGE] = self.hand_range
        return law_program("lqg", model, parameters, constants)

    def shaft_filter(self, inertia: float) -> ShaftFilter:
        """The observer's filter."""
        noise = SensorNoise(encoder_noise(self.encoder_counts), self.torque_noise)
        hand = Hand(damping=self.hand_damping, rate=self.hand_rate, disturbance=self.disturbance)
        return ShaftFilter.of(inertia, 1.0 / self.sample_rate, noise, hand)


@dataclass(frozen=True)
class Regulator:
    """The regulator about delta*.

    gain: (1 + ahead,), of e and of the deltas under way, the oldest first. lead: J / B [s].
    """

    gain: FloatArray
    lead: float

    @classmethod
    def of(cls, control: TorqueFeedback, inertia: float) -> "Regulator":
        """That of least e^2 + effort (change of delta)^2."""
        decay = math.exp(-control.hand_damping / inertia / control.sample_rate)
        n = 1 + control.ahead
        A, B = np.zeros((n, n)), np.zeros((n, 1))
        A[0, :2] = decay, decay - 1.0
        A[1:-1, 2:] = np.eye(n - 2)
        A[-1, -1] = B[-1, 0] = 1.0
        Q, R = np.zeros((n, n)), np.array([[control.effort]])
        Q[0, 0] = 1.0
        P = solve_discrete_are(A, B, Q, R)
        gain = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)[0]
        return cls(gain, inertia / control.hand_damping)

    def placed(self, constants: list[float]) -> list[float]:
        """Constants of a law with these in their places."""
        placed = list(constants)
        placed[laws.AHEAD], placed[laws.LEAD] = float(len(self.gain) - 1), self.lead
        placed[laws.REGULATOR : laws.REGULATOR + len(self.gain)] = self.gain.tolist()
        return placed


class Lqg(TorqueFeedback):
    """LQG with a disturbance observer on top of the inverse; takes the torque sensor."""

    controller: Literal["lqg"] = Field(description="lqg")


class TorqueLoop:
    """Filter, regulator and delay around a shaft in a hand, friction taken off."""

    def __init__(self, control: TorqueFeedback, dynamics: ActuatorDynamics) -> None:
        self._control, self._inertia = control, dynamics.inertia
        self._filter = control.shaft_filter(dynamics.inertia)
        self._constants = Regulator.of(control, dynamics.inertia).placed([0.0] * laws.CONSTANTS)

    def peak_sensitivity(self, inertia: float, strength: float, hand: float) -> float:
        """Largest sensitivity at the motor up to half the sample rate; infinite if unstable.

        inertia [kg*m^2]: the shaft's. strength: the motor's constant, hand: the hand's damping and
        stiffness, in parts of the design's.
        """
        A, b, c = self._closed(inertia, strength, hand)
        if np.abs(np.linalg.eigvals(A)).max() >= 1.0:
            return math.inf
        z = np.exp(1j * np.geomspace(1e-3, math.pi, _FREQUENCIES))
        inner = z[:, None, None] * np.eye(len(b)) - A
        responses = np.linalg.solve(inner, np.tile(b[:, None], (len(z), 1, 1)))[:, :, 0] @ c
        return float(np.abs(1.0 + responses).max())

    def _closed(
        self, inertia: float, strength: float, hand: float
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """A, b, c of the closed loop from a torque added at the motor to its command."""
        control, shaft = self._control, self._filter
        B, K = hand * control.hand_damping, hand * control.hand_stiffness
        rates = np.zeros((3, 3))
        rates[0, 1] = 1.0
        rates[1] = np.array([-K, -B, 1.0]) / inertia
        plant = expm(rates / control.sample_rate)
        n = 2 + len(shaft.b) + 2 * control.ahead
        constants, memory = self._constants, [0.0] * laws.STATES

        def step(s: FloatArray, added: float) -> tuple[FloatArray, float]:
            """A sample: angle and speed, filter, commands under way, deltas; and the command."""
            motion, x = s[:2], s[2 : 2 + len(shaft.b)]
            commands, deltas = np.split(s[2 + len(shaft.b) :], 2)
            memory[laws.DELTAS : laws.DELTAS + control.ahead] = deltas.tolist()
            answer = laws.regulate(float(x[2]), float(x[3]), memory, constants)
            command = answer - float(x[4])
            applied = float(commands[0]) + added
            motion = plant[:2, :2] @ motion + plant[:2, 2] * strength * applied
            guess = shaft.predicted(x, applied)
            x = shaft.corrected(guess, float(motion[0]), float(-K * motion[0] - B * motion[1]))
            queue = [*commands[1:], command]
            later = memory[laws.DELTAS : laws.DELTAS + control.ahead]
            return np.concatenate([motion, x, queue, later]), float(commands[0])

        columns = [step(unit, 0.0) for unit in np.eye(n)]
        A = np.stack([later for later, _ in columns], axis=1)
        c = np.array([command for _, command in columns])
        return A, step(np.zeros(n), 1.0)[0], c
