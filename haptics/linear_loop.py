"""The loop of controller, actuator and hand, linear about an operating point.

The law is linearised as it is run: central differences of one step of its program. Between samples
the actuator is discretised exactly, its commands held, and answered ``ahead`` ticks later.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from daq.torque import LawProgram
from haptics import laws
from haptics.dynamics import ActuatorDynamics
from haptics.operating_points import Branch, operating_point
from haptics.program import law_functions
from sysid import ProcessModel
from sysid.arrays import FloatArray

BoolArray = NDArray[np.bool_]
Step = Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]

_DIFFERENCE = 1e-6
_SETTLED = 400  # samples until a law has settled
_SPEED = 1.0  # rad/s
_UNSTABLE = 1e-4  # above 1, beyond what differences leave of an eigenvalue of 1
_FREQUENCIES = 200
_DIRECTIONS: dict[Branch, float] = {
    "within yield": 0.0,
    "sliding forwards": 1.0,
    "sliding backwards": -1.0,
}


@dataclass(frozen=True)
class LinearLaw:
    """s+ = F s + G y, u = H s + D y of a law about a motion.

    y: angle, speed, torque sensor, motor current, reference. u: commands of motor and brake [V].
    states: which of the law's memory s is, (n_states,).
    """

    F: FloatArray
    G: FloatArray
    H: FloatArray
    D: FloatArray
    states: BoolArray

    @classmethod
    def of(
        cls, program: LawProgram, model: ProcessModel, branch: Branch = "within yield"
    ) -> "LinearLaw":
        """That of a program on a branch of the hysteresis."""
        run = getattr(law_functions(model), program.entry)
        c, p = list(program.constants), list(program.parameters)

        def step(s: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
            later, volts = s.tolist(), [0.0, 0.0]
            run(*y.tolist(), 0, later, c, p, volts)
            return np.array(later), np.array(volts)

        return cls.about(step, program.n_states, c[laws.TIME], branch)

    @classmethod
    def about(
        cls, step: Step, n: int, time: float, branch: Branch, states: BoolArray | None = None
    ) -> "LinearLaw":
        """That of a step (s, y) -> (s+, u) of n states, from rest.

        states: (n,), those that carry something; by default all that y moves and that move u.
        """
        speed = _DIRECTIONS[branch] * _SPEED
        s, y = np.zeros(n), np.zeros(5)
        for k in range(_SETTLED):
            y[:2] = speed * k * time, speed
            s, _ = step(s, y)
        y[0] += speed * time
        columns = []
        for j in range(n + 5):
            change = np.zeros(n + 5)
            change[j] = _DIFFERENCE
            ahead = step(s + change[:n], y + change[n:])
            back = step(s - change[:n], y - change[n:])
            columns.append(
                np.concatenate([a - b for a, b in zip(ahead, back, strict=True)])
                / (2.0 * _DIFFERENCE)
            )
        J = np.stack(columns, axis=1)
        if states is None:
            linked = J != 0.0
            states = _reached(linked[:n, :n], linked[:n, n:].any(axis=1))
            states &= _reached(linked[:n, :n].T, linked[n:, :n].any(axis=0))
        small = J[np.append(states, [True] * 2)][:, np.append(states, [True] * 5)]
        m = int(states.sum())
        return cls(small[:m, :m], small[:m, m:], small[m:, :m], small[m:, m:], states)


def _reached(linked: BoolArray, first: BoolArray) -> BoolArray:
    """States that these move, and those that they move in turn; linked: (n, n), by column."""
    before, reached = np.zeros_like(first), first.copy()
    while np.any(reached != before):
        before = reached
        reached = before | linked[:, before].any(axis=1)
    return reached


@dataclass(frozen=True)
class LoopMargins:
    """How far a loop is from instability, broken at the motor's command.

    sensitivity: largest |S| up to half the sample rate. disk: the disk margin 1 / max |S - 1/2|:
    gain and phase may change within (2 - disk) / (2 + disk) to its inverse. Infinite and 0 for an
    unstable loop.
    """

    sensitivity: float
    disk: float

    @property
    def stable(self) -> bool:
        """Whether the loop is stable."""
        return self.disk > 0.0


def loop_margins(
    law: LinearLaw, dynamics: ActuatorDynamics, branch: Branch, hand: tuple[float, float],
    time: float, ahead: int,
) -> LoopMargins:  # fmt: skip
    """Margins in a hand of stiffness [N*m/rad] and damping [N*m*s/rad]."""
    A, b, c = _closed(law, dynamics, branch, hand, time, ahead)
    if np.abs(np.linalg.eigvals(A)).max() > 1.0 + _UNSTABLE:
        return LoopMargins(np.inf, 0.0)
    z = np.exp(1j * np.geomspace(2e-3, np.pi, _FREQUENCIES))
    inner = z[:, None, None] * np.eye(len(b)) - A
    S = 1.0 + np.linalg.solve(inner, np.tile(b[:, None], (len(z), 1, 1)))[:, :, 0] @ c
    return LoopMargins(float(np.abs(S).max()), float(1.0 / np.abs(S - 0.5).max()))


def felt_responses(
    law: LinearLaw, dynamics: ActuatorDynamics, hand: tuple[float, float],
    z: NDArray[np.complex128], time: float, ahead: int,
) -> NDArray[np.complex128]:  # fmt: skip
    """The torque felt by the reference at points z, (n,), of a sliding shaft in a hand."""
    branch: Branch = "sliding forwards"
    A, _, _ = _closed(law, dynamics, branch, hand, time, ahead)
    _, _, C = sampled_actuator(dynamics, branch, hand, time)
    n, m = C.shape[1], len(law.F)
    b, c = np.zeros(len(A)), np.zeros(len(A))
    b[n : n + m], b[-2:], c[:n] = law.G[:, 4], law.D[:, 4], -C[2]
    inner = z[:, None, None] * np.eye(len(A)) - A
    felt: NDArray[np.complex128] = (
        np.linalg.solve(inner, np.tile(b[:, None], (len(z), 1, 1)))[:, :, 0] @ c
    )
    return felt


def sampled_actuator(
    dynamics: ActuatorDynamics, branch: Branch, hand: tuple[float, float], time: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """A, B (two commands) and C (angle, speed, hand's torque, motor current) over a sample."""
    model: ProcessModel = dynamics.model
    linear = operating_point(dynamics, branch, 0.0).linear
    omega, theta, i_m = (model.state_names.index(k) for k in ("omega", "theta", "current_motor"))
    motor, brake, load = (
        model.input_names.index(k)
        for k in ("applied_voltage_motor", "applied_voltage_brake", "torque")
    )
    n = len(model.states)
    touch = np.zeros(n)
    touch[theta], touch[omega] = -hand[0], -hand[1]
    rates = np.zeros((n + 2, n + 2))
    rates[:n, :n] = linear.A + np.outer(linear.B[:, load], touch)
    rates[:n, n:] = linear.B[:, [motor, brake]]
    step = expm(rates * time)
    unit = np.eye(n)
    return step[:n, :n], step[:n, n:], np.stack([unit[theta], unit[omega], touch, unit[i_m]])


def _closed(
    law: LinearLaw, dynamics: ActuatorDynamics, branch: Branch, hand: tuple[float, float],
    time: float, ahead: int,
) -> tuple[FloatArray, FloatArray, FloatArray]:  # fmt: skip
    """A, b, c of the closed loop from volts added at the motor to its command."""
    Phi, Gamma, C = sampled_actuator(dynamics, branch, hand, time)
    n, m, q = len(Phi), len(law.F), 2 * ahead
    A = np.zeros((n + m + q, n + m + q))
    applied = slice(n + m, n + m + 2)  # the oldest command
    A[:n, :n], A[:n, applied] = Phi, Gamma
    A[n : n + m, :n], A[n : n + m, n : n + m] = law.G[:, :4] @ C, law.F
    A[n + m : -2, n + m + 2 :] = np.eye(q - 2)
    A[-2:, :n], A[-2:, n : n + m] = law.D[:, :4] @ C, law.H
    b, c = np.zeros(len(A)), np.zeros(len(A))
    b[:n], c[n + m] = Gamma[:, 0], 1.0
    return A, b, c
