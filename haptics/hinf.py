"""Torque by structured H-infinity: the gains of LQG, for many actuators and hands at once.

The structure is that of ``haptics.lqg``: its program, with the filter's gain L, the regulator's
gains, its lead and the share of friction within the yield travel as free numbers x, 14 of them. LQG
makes them of one actuator and one hand; here they are those with the largest margin in the worst
of a family: plausible actuators, in hands of both ends and the middle of ``hand_range``, within the
yield travel and sliding. Each member i is the closed loop of the program itself, linearised and
sampled, with S_i its sensitivity at the motor's command and e_i = T_i W v the torque that is
missing at the hand:

    minimise over x  max_i,omega  |S_i(omega)|
    subject to       |sqrt(omega) T_i W| <= max(gamma_i, 0.6 max_omega gamma_i),  loops stable.

W has the spectra of the reference, the wrist's motion, the sensors' noise and friction that the
model lacks; sqrt(omega) makes of the error's spectrum that of an octave. gamma_i(omega) is the same
of the gains that LQG gives, where the search begins: the error may grow where it is small, and
nowhere else. No number goes further than half of itself from LQG's: where the hysteresis turns
round no linear member is right, and what is promised far from there does not hold.

That is a multi-model H-infinity problem of fixed structure (Apkarian and Noll, "Nonsmooth
H-infinity synthesis", IEEE Transactions on Automatic Control 51, 2006), on a grid of frequencies.
It is solved by ``haptics.minimax``; the slopes of the responses are exact,
dT = C (z - A)^-1 (dA (z - A)^-1 B + dB).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.linalg import expm

from daq.config.units import Part
from daq.torque import LawProgram
from haptics import laws
from haptics.dynamics import SHAFT, ActuatorDynamics
from haptics.feedforward import encoder_noise
from haptics.linear_loop import LinearLaw, sampled_actuator
from haptics.lqg import TorqueFeedback
from haptics.minimax import ComplexArray, Responses, least_largest
from haptics.operating_points import Branch, operating_point
from haptics.program import compiled_laws
from sysid import ModelError, ProcessModel
from sysid.arrays import FloatArray

_FREQUENCIES = 50
_LOWEST = 0.3  # Hz
# Spectra: rms, end of the band [Hz], order of what ends it.
_REFERENCE = 0.14, 10.0, 4  # N*m, of a multisine of 0.2 N*m
_WRIST = 4.0, 3.0, 2  # rad/s
_FRICTION = 5e-3, 20.0, 1  # N*m
_ALLOWED = 0.6  # of LQG's largest error of an octave, at any frequency
_FARTHEST = 0.5  # from LQG's gains, in parts of each
_SLIDING = 0.99  # of the z that slides
_UNSTABLE = 1e-4  # above 1, of an eigenvalue
_DIFFERENCE = 1e-4  # of the free numbers
_LEAST = 1e-9
_BRANCHES: tuple[Branch, ...] = ("within yield", "sliding forwards")
_DISTURBANCES = 6  # volts at the motor; hand, reference, noise of both sensors, shaft


class Hinf(TorqueFeedback):
    """Structured H-infinity over plausible actuators and hands; takes the torque sensor."""

    controller: Literal["hinf"] = Field(description="hinf")
    gains: list[Part] = Field(
        [], max_length=64, description="of filter and regulator, as tune finds them; empty: lqg's"
    )

    def tuned_over(self, model: ProcessModel, parameters: FloatArray, draws: FloatArray) -> Self:
        """With the gains of the largest margin in the worst of the draws' extremes and hands.

        Those of LQG where a plausible loop is unstable with them.
        """
        family = [parameters, *extremes(model, draws)]
        loops = LoopFamily(self.model_copy(update={"gains": []}), model, parameters, family)
        x = np.zeros(len(loops.free))
        if loops.respond(x, False) is not None:
            x = least_largest(loops.respond, x, _FARTHEST)
        gains = [float(f"{gain:.7g}") for gain in loops.gains(x)]
        return self.model_copy(update={"gains": gains})

    def loop_program(self, model: ProcessModel, parameters: FloatArray) -> LawProgram:
        """The regulator on top of the inverse, with these gains."""
        program = super().loop_program(model, parameters)
        if not self.gains:
            return program
        constants = list(program.constants)
        free = places(self.ahead)
        if len(free) != len(self.gains):
            raise ModelError(
                f"gains: {len(self.gains)} numbers, but with ahead: {self.ahead} there are "
                f"{len(free)}; tune again"
            )
        for place, gain in zip(free, self.gains, strict=True):
            constants[place] = gain
        return replace(program, constants=tuple(constants))


def places(ahead: int) -> list[int]:
    """Of the free numbers among the constants of a law."""
    filters = range(laws.FILTER_L, laws.FILTER_L + 2 * laws.FILTER_ORDER)
    regulator = range(laws.REGULATOR, laws.REGULATOR + 1 + ahead)
    return [*filters, *regulator, laws.LEAD, laws.YIELD_SHARE]


def extremes(model: ProcessModel, draws: FloatArray) -> list[FloatArray]:
    """Draws with the most and the least gain from command to speed, and stiffness of the brake."""
    if not len(draws):
        return []
    actuators = [ActuatorDynamics(model, draw) for draw in draws]
    speed = [d.motor_constant * d.motor.gain / d.inertia for d in actuators]
    spring = [-d.rest(0.0, 0.0, d.sliding, 0.0) * d.stiffness for d in actuators]
    chosen = {int(place(values)) for values in (speed, spring) for place in (np.argmin, np.argmax)}
    return [draws[k] for k in sorted(chosen)]


@dataclass(frozen=True)
class Member:
    """An actuator in a hand on a branch of its hysteresis, over a sample.

    x+ = Phi x + Gamma u + touched h with u of both commands and h of the hand's own torque; C of
    angle, speed, hand's torque and motor current. weights: (n, 5) spectra of the disturbances.
    """

    branch: Branch
    Phi: FloatArray
    Gamma: FloatArray
    C: FloatArray
    touched: FloatArray
    weights: FloatArray

    @classmethod
    def of(
        cls, dynamics: ActuatorDynamics, branch: Branch, hand: tuple[float, float],
        control: TorqueFeedback, frequencies: FloatArray,
    ) -> "Member":  # fmt: skip
        """That of a hand of stiffness [N*m/rad] and damping [N*m*s/rad]."""
        time, names = 1.0 / control.sample_rate, dynamics.model.state_names
        Phi, Gamma, C = sampled_actuator(dynamics, branch, hand, time)
        linear = operating_point(dynamics, branch, 0.0).linear
        load = linear.B[:, dynamics.model.input_names.index("torque")]
        omega, _, theta = (names.index(name) for name in SHAFT)
        n = len(names)
        rates = np.zeros((n + 1, n + 1))
        rates[:n, :n], rates[:n, n] = linear.A, load
        rates[:n, theta] -= hand[0] * load
        rates[:n, omega] -= hand[1] * load
        # A hand that keeps the shaft within its yield travel does not move.
        moving = 0.0 if branch == "within yield" else 1.0
        impedance = np.abs(hand[0] / (2j * np.pi * frequencies) + hand[1])
        noise = math.sqrt(2.0 * time)
        ones = np.ones_like(frequencies)
        weights = [
            moving * impedance * _band(frequencies, *_WRIST),
            _band(frequencies, *_REFERENCE),
            ones * noise * encoder_noise(control.encoder_counts),
            ones * noise * control.torque_noise,
            _band(frequencies, *_FRICTION),
        ]
        touched = expm(rates * time)[:n, n]
        return cls(branch, Phi, Gamma, C, touched, np.stack(weights, axis=1))

    def loop(
        self, law: Sequence[FloatArray], ahead: int, *, fixed: bool = True
    ) -> tuple[FloatArray, FloatArray]:
        """A, B of the closed loop with F, G, H, D of a law; fixed: with the actuator's own part.

        States: the actuator's, the law's, the commands under way, the oldest first.
        """
        F, G, H, D = law
        n, m = len(self.Phi), len(F)
        A = np.zeros((n + m + 2 * ahead,) * 2)
        B = np.zeros((len(A), _DISTURBANCES))
        if fixed:
            A[:n, :n], A[:n, n + m : n + m + 2] = self.Phi, self.Gamma
            A[n + m : -2, n + m + 2 :] = np.eye(2 * ahead - 2)
            B[:n, 0], B[:n, 1], B[:n, 5] = self.Gamma[:, 0], self.touched, self.touched
        for rows, by_state, by_sample in ((slice(n, n + m), F, G), (slice(-2, None), H, D)):
            A[rows, :n], A[rows, n : n + m] = by_sample[:, :4] @ self.C, by_state
            B[rows, 1:5] = by_sample[:, [2, 4, 0, 2]]
        return A, B

    def outputs(self, m: int, ahead: int) -> tuple[FloatArray, FloatArray]:
        """C, D of the motor's command and the torque missing, with a law of m states."""
        n = len(self.Phi)
        C, D = np.zeros((2, n + m + 2 * ahead)), np.zeros((2, _DISTURBANCES))
        C[0, n + m], D[0, 0] = 1.0, 1.0
        C[1, :n], D[1, 1:3] = self.C[2], 1.0
        return C, D


def _band(frequencies: FloatArray, rms: float, end: float, order: int) -> FloatArray:
    """Root of a spectrum that is flat up to ``end`` [Hz], with this rms."""
    spectrum: FloatArray = rms / math.sqrt(end) / np.sqrt(1.0 + (frequencies / end) ** (2 * order))
    return spectrum


class LoopFamily:
    """The loops of all actuators, hands and branches, by the free numbers.

    free: places of those among the law's constants that are not zero. x: their changes, in parts.
    """

    def __init__(
        self, control: Hinf, model: ProcessModel, parameters: FloatArray,
        actuators: Sequence[FloatArray],
    ) -> None:  # fmt: skip
        self._control, self._model = control, model
        program = control.loop_program(model, parameters)
        self._entry, self._n = compiled_laws(model)[program.entry], program.n_states
        self._constants, self._p = np.array(program.constants), np.array(program.parameters)
        self.places = places(control.ahead)
        self.free = [place for place in self.places if abs(self._constants[place]) > _LEAST]
        half = 0.5 * control.sample_rate
        self._f = np.geomspace(_LOWEST, 0.999 * half, _FREQUENCIES)
        self._z = np.exp(2j * np.pi * self._f / control.sample_rate)
        scales = 1.0 / control.hand_range, 1.0, control.hand_range
        self._members = [
            Member.of(
                ActuatorDynamics(model, values), branch,
                (scale * control.hand_stiffness, scale * control.hand_damping), control, self._f,
            )
            for values in actuators for branch in _BRANCHES for scale in scales
        ]  # fmt: skip
        # Which of its memory the law uses is the same for all x.
        self._states: dict[Branch, NDArray[np.bool_]] = {}
        linear = {branch: self._linear(np.zeros(len(self.free)), branch) for branch in _BRANCHES}
        self._states = {branch: law.states for branch, law in linear.items()}
        self._allowed = [self._limit(member, linear[member.branch]) for member in self._members]

    def _limit(self, member: Member, law: LinearLaw) -> FloatArray:
        """Errors of an octave that are allowed with a member, by LQG's law."""
        responses = self._responses(member, law, [])
        if responses is None:
            return np.ones_like(self._f)
        errors = np.linalg.norm(responses[0][:, 1:], axis=1)
        limit: FloatArray = np.maximum(errors, _ALLOWED * errors.max())
        return limit

    def gains(self, x: FloatArray) -> list[float]:
        """All gains, in the order of ``places``."""
        constants = self._placed(x)
        return [float(constants[place]) for place in self.places]

    def respond(self, x: FloatArray, slopes: bool) -> Responses | None:
        """F: sensitivities. G: errors of an octave in parts of those allowed; friction's share."""
        linear = {branch: self._linear(x, branch) for branch in _BRANCHES}
        changes = {branch: self._changes(x, branch) if slopes else [] for branch in _BRANCHES}
        F, G, F_x, G_x = [], [], [], []
        for member, allowed in zip(self._members, self._allowed, strict=True):
            responses = self._responses(member, linear[member.branch], changes[member.branch])
            if responses is None:
                return None
            T, T_x = responses
            F.append(T[:, :1])
            F_x.append(T_x[:, :1])
            G.append((T[:, 1:] / allowed[:, None]).astype(complex))
            G_x.append((T_x[:, 1:] / allowed[:, None, None]).astype(complex))
        share = self._constants[laws.YIELD_SHARE] * (np.array(self.free) == laws.YIELD_SHARE)
        whole = np.zeros((1, _DISTURBANCES - 1, len(x) if slopes else 0))
        whole[0, 0] = share[: whole.shape[-1]]
        G.append(np.eye(1, _DISTURBANCES - 1) * self._placed(x)[laws.YIELD_SHARE] + 0j)
        G_x.append(whole + 0j)
        return Responses(*map(np.concatenate, (F, G, F_x, G_x)))

    def _placed(self, x: FloatArray) -> FloatArray:
        constants = self._constants.copy()
        constants[self.free] *= 1.0 + x
        return constants

    def _linear(self, x: FloatArray, branch: Branch) -> LinearLaw:
        constants, time = self._placed(x), 1.0 / self._control.sample_rate
        # Sliding without a torque is at two kinks of the law, which would make its slopes jump: the
        # brake comes on for one sign of the torque, and all of the friction is compensated.
        constants[laws.PREFERENCE] = laws.BY_MOTOR
        if branch != "within yield":
            constants[laws.SLIDING] *= _SLIDING

        def step(s: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
            later, volts = s.copy(), np.zeros(2)
            self._entry(*y.tolist(), 0, later, constants, self._p, volts)
            return later, volts

        return LinearLaw.about(step, self._n, time, branch, self._states.get(branch))

    def _changes(self, x: FloatArray, branch: Branch) -> list[list[FloatArray]]:
        """Slopes of F, G, H and D by each free number."""
        slopes = []
        for unit in np.eye(len(x)) * _DIFFERENCE:
            ends = [self._linear(x + sign * unit, branch) for sign in (1.0, -1.0)]
            pairs = zip(*(_matrices(end) for end in ends), strict=True)
            slopes.append([(above - below) / (2.0 * _DIFFERENCE) for above, below in pairs])
        return slopes

    def _responses(
        self, member: Member, law: LinearLaw, changes: Sequence[Sequence[FloatArray]]
    ) -> tuple[ComplexArray, ComplexArray] | None:
        """S and the weighted errors of an octave, (n, 6), with slopes; None if unstable."""
        ahead = self._control.ahead
        A, B = member.loop(_matrices(law), ahead)
        C, D = member.outputs(len(law.F), ahead)
        if np.abs(np.linalg.eigvals(A)).max() > 1.0 + _UNSTABLE:
            return None
        inner = self._z[:, None, None] * np.eye(len(A)) - A
        X: ComplexArray = np.linalg.solve(inner, np.broadcast_to(B, (len(inner), *B.shape)))
        weights = member.weights * np.sqrt(self._f)[:, None]

        def picked(T: ComplexArray) -> ComplexArray:
            """S from the motor, and the error from all others."""
            parts: ComplexArray = np.concatenate([T[:, 0, :1], T[:, 1, 1:] * weights], axis=1)
            return parts

        slopes = np.zeros((len(inner), _DISTURBANCES, len(changes)), dtype=complex)
        if changes:
            columns = np.broadcast_to(C.T, (len(inner), *C.T.shape))
            Y = np.linalg.solve(inner.transpose(0, 2, 1), columns).transpose(0, 2, 1)
            for k, change in enumerate(changes):
                dA, dB = member.loop(change, ahead, fixed=False)
                slopes[..., k] = picked((Y @ (dA @ X + dB)).astype(complex))
        return picked((C @ X + D).astype(complex)), slopes


def _matrices(law: LinearLaw) -> list[FloatArray]:
    return [law.F, law.G, law.H, law.D]
