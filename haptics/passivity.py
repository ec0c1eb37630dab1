"""Passivity of a rendered wall in sampled data, at all frequencies up to half the sample rate.

A shaft whose impedance is Z(s) = J s + b + Z', with Z' of hand and brake anything passive, has an
admittance Y = 1 / Z within the disc over [0, 1/b]. The torque of a wall goes to it by way of a
hold, a delay of ``ahead`` samples and the amplifier; its angle comes back sampled. With the law's
H(z) from angle to volts, P(s) from volts to torque over s, and the sum over all aliases
s_k = j (omega + 2 pi k / T),

    L = H (1 / T) sum_k P(s_k) Y_k,   Y_k anywhere in its disc,

so the sum lies in a disc with the centre C = sum P_k / (2 b_k T) and the radius
R = sum |P_k| / (2 b_k T). No passive hand and no passive brake makes the loop unstable if, at every
frequency,

    |1 + H C| > |H| R,

provided that the law by itself is stable, at a shaft that does not move: then the loop is stable
with Y = 0, which is in the disc, and stays so on the way to any other Y. A law that is not is
refused.

For an ideal amplifier this is Colgate and Schenkel's theorem ("Passivity of a class of
sampled-data systems", Journal of Robotic Systems 14, 1997),
b > T / 2 / (1 - cos omega T) Re((1 - e^(-j omega T)) H). The motor's back EMF is in b_k.

The brake is passive, but it gives no b: within its yield travel it is a spring without loss. It is
passive while its current is constant: switched on under load that spring gives energy. Nothing is
told of a law that shares its torque with the brake.

A hand that damps adds to b. A hand of a mass, a damper and a spring of k at most side by side lets
no impedance of the shaft fall below x = J omega - k / omega in its imaginary part; a mass behind a
spring does, just above their resonance. So of each phi from 0 to pi / 2

    Re e^(-j phi) Z >= d = b cos phi + x sin phi,

and where d > 0 Y is in the disc with the centre e^(-j phi) / 2 d and the radius 1 / 2 d. Each of
these discs holds all admittances, so that at every frequency one that proves it is enough.

And a hand leaves a wall and comes back, which is no linear loop: a
spring's torque phi(theta) is zero without, and rises by no more than K with the angle. With G from
that torque to the angle, H_r X / (1 - H_a X) of the law's H_r by reference and H_a by angle, X in
the disc above and G in its image, the hand comes to rest if for some multiplier
M = sum h_i (1 - z^-i), h_i >= 0,

    Re M (1 / K + G) > 0

at every frequency (Zames and Falb, "Stability conditions for systems with monotone and
slope-restricted nonlinearities", SIAM Journal on Control 6, 1968; sampled: Willems and Brockett,
"Some new rearrangement inequalities having application in stability analysis", IEEE Transactions on
Automatic Control 13, 1968). Clamped commands are such a phi as well.
"""

import itertools
import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from daq.hal import FloatArray
from daq.lookup.controllers import TunedController
from haptics.actuator_control import ActuatorControl
from haptics.dynamics import SHAFT, ActuatorDynamics
from haptics.linear_loop import LinearLaw
from haptics.operating_points import Branch

ComplexArray = NDArray[np.complex128]

_ALIASES = 10  # either side
_FREQUENCIES = 640
_BETWEEN = 0.99  # of what is found at them, for the least may lie between
_STIFFEST = 1e4  # N*m/rad
_BISECTIONS = 40
_DAMPINGS = 25
_SURE = 5.0  # %, of the draws may be below what is promised
_TAPS = 7  # of multipliers, beside two for each sample of delay
_UNSTABLE = 1e-4  # above 1, of a pole
_SAME = 0.05  # of a law's response: by which the observers of a linear one differ
_MIXTURES = np.linspace(0.0, 1.0, 11)
_TURNS = np.linspace(0.0, 0.5 * np.pi, 19)  # phi, of the discs


@dataclass(frozen=True)
class Hands:
    """Passive hands: damping [N*m*s/rad] at least, stiffness [N*m/rad] at most.

    Of a finite stiffness: hands whose reactance at omega > 0 is -stiffness / omega or more, such as
    a mass, a damper and a spring side by side.
    """

    damping: float = 0.0
    stiffness: float = math.inf


class UnknownPassivityError(ValueError):
    """A controller of whose passivity nothing is known; it says why."""


@dataclass(frozen=True)
class Tracker:
    """A speed by an alpha-beta tracker of the angle; of alpha and beta as a run has them."""

    alpha: float
    beta: float

    def response(self, z: ComplexArray, time: float) -> ComplexArray:
        """Speed by angle at points z, (n,) [1/s]."""
        alpha, beta = self.alpha, self.beta
        speed: ComplexArray = (
            beta / time * z * (z - 1.0) / (z * z - (2.0 - alpha - beta) * z + 1.0 - alpha)
        )
        return speed


@dataclass(frozen=True)
class WallLaw:
    """Responses of a law at z = exp(j omega T): volts of the motor by angle, and by reference.

    The motor's current, which a law may listen to, follows the volts as the model has it.
    """

    z: ComplexArray
    by_angle: ComplexArray
    by_reference: ComplexArray
    time: float

    @classmethod
    def of(
        cls, controller: TunedController, time: float, branch: Branch = "within yield"
    ) -> "WallLaw":
        """That of a controller on a branch of the hysteresis.

        Raises UnknownPassivityError for one that takes the torque sensor or uses the brake, or is
        unstable by itself.
        """
        control = controller.control
        if isinstance(control, ActuatorControl) and control.allocation != "motor":
            raise UnknownPassivityError(
                f"allocation: {control.allocation} shares a wall's torque with the brake, which "
                "comes and goes under load: nothing is promised of it; with allocation: motor "
                "something is"
            )
        if control.takes_torque:
            raise UnknownPassivityError(
                f"{control.controller} feeds the hand's torque back: its passivity is that of no "
                "impedance by angle alone, and nothing is promised of it"
            )
        program = control.program(controller.model, controller.parameters)
        law = LinearLaw.of(program, controller.model, branch)
        dynamics = ActuatorDynamics(controller.model, controller.parameters)
        winding = _sampled_winding(dynamics, time)
        largest = _largest_pole(law, *winding, control.ahead)
        if largest > 1.0 + _UNSTABLE:
            raise UnknownPassivityError(
                f"{control.controller} is unstable by itself, at a shaft that is held (a pole of "
                f"{largest:.4g} in sampled time): no hand makes its walls stable for certain, and "
                "nothing is promised of it; lower its gains or shares"
            )
        z = np.exp(1j * np.pi * np.geomspace(1e-3, 1.0, _FREQUENCIES))
        current = _sampled_current(*winding, z) / z**control.ahead
        rows = [law.F.shape[0]]
        inner = z[:, None, None] * np.eye(rows[0]) - law.F
        responses = np.linalg.solve(inner, np.broadcast_to(law.G, (len(z), *law.G.shape)))
        from_y = (law.H @ responses + law.D)[:, 0]  # of the motor's volts
        # The speed that a device measures acts on signs alone.
        fed_back = 1.0 - from_y[:, 3] * current
        return cls(z, from_y[:, 0] / fed_back, from_y[:, 4] / fed_back, time)


@dataclass(frozen=True)
class Port:
    """The shaft at which a wall is rendered: centres and radii, (m, n), of discs by frequency.

    damping [N*m*s/rad], friction [N*m]: of the sliding shaft without a current.
    """

    centre: ComplexArray
    radius: FloatArray
    damping: float
    friction: float

    @classmethod
    def of(
        cls, dynamics: ActuatorDynamics, z: ComplexArray, time: float, ahead: int,
        hands: Hands = Hands(),
    ) -> "Port":  # fmt: skip
        """That of an actuator whose brake is off, at frequencies z, in any of the hands."""
        omega = np.angle(z) / time
        s = 1j * (omega[:, None] + 2.0 * np.pi / time * np.arange(-_ALIASES, _ALIASES + 1))
        by_volts, by_speed = _currents(dynamics, s)
        constant = dynamics.motor_constant
        at_rest = dynamics.rest(0.0, 1.0, 0.0, 0.0), dynamics.rest(0.0, 0.0, 0.0, 0.0)
        damping = at_rest[1] - at_rest[0]
        emf = constant * by_speed
        b = np.maximum(damping + hands.damping - emf.real, 1e-12)
        # Within its yield travel the brake is one more spring.
        spring = hands.stiffness + _yield_stiffness(dynamics)
        size = np.abs(s.imag)
        x = dynamics.inertia * size - spring / size - emf.imag * np.sign(s.imag)
        centre, radius = discs(constant * by_volts, b, x, s, time, ahead)
        friction = abs(dynamics.rest(0.0, 0.0, dynamics.sliding, 0.0))
        return cls(centre, radius, damping, friction)

    def passive(self, H: ComplexArray) -> bool:
        """Whether volts by -H times the angle leave the port passive."""
        margin = np.abs(1.0 + H * self.centre) - np.abs(H) * self.radius
        return bool(np.all(np.any(margin > 0.0, axis=0)))

    def by_torque(self, law: WallLaw) -> tuple[ComplexArray, FloatArray]:
        """Centres and radii, (m, n), of discs of the angle by the torque that a law is asked for.

        An infinite radius: with that disc the law alone is not known to be stable in every hand.
        """
        a, C, R = law.by_angle, self.centre, self.radius
        bounded = np.isfinite(R)
        R = np.where(bounded, R, 0.0)
        stable = bounded & (np.abs(1.0 - a * C) > np.abs(a) * R)
        apart = np.where(stable, np.abs(1.0 - a * C) ** 2 - np.abs(a * R) ** 2, 1.0)
        centre = (C * np.conj(1.0 - a * C) + np.conj(a) * R**2) / apart
        radius = np.where(stable, np.abs(law.by_reference) * R / apart, np.inf)
        return law.by_reference * centre, radius


def discs(
    torque: ComplexArray, b: FloatArray, x: FloatArray, s: ComplexArray, time: float, ahead: int
) -> tuple[ComplexArray, FloatArray]:
    """Centres and radii of discs, (m, n), by torque per volt at all aliases s, (n, k).

    b, x: least real part of the impedance and, for positive frequencies, least imaginary one,
    (n, k); -infinity: none. time: of a sample [s]. The middle of the aliases is the frequency
    itself, whose disc is turned; of the others the smallest is taken.
    """
    P = torque * (1.0 - np.exp(-s * time)) / s * np.exp(-s * (ahead * time)) / s / time
    least = 2.0 * (b + 1j * np.maximum(x, 0.0) * np.sign(s.imag))
    middle = s.shape[1] // 2
    others = np.delete(P / least, middle, axis=1)
    turn = _TURNS[:, None] if np.isfinite(x[:, middle]).any() else _TURNS[:1, None]
    least_x = np.where(np.isfinite(x[:, middle]), x[:, middle], 0.0)  # without one: turn is 0
    d = b[:, middle] * np.cos(turn) + least_x * np.sin(turn)
    with np.errstate(divide="ignore"):
        half = np.where(d > 0.0, 0.5 / np.maximum(d, 0.0), np.inf)
    direct, bounded = P[:, middle], np.where(d > 0.0, half, 0.0)
    centre = others.sum(axis=1) + direct * bounded * np.exp(-1j * turn * np.sign(s[:, middle].imag))
    return centre, np.abs(others).sum(axis=1) + np.abs(direct) * half


@dataclass(frozen=True)
class WallPromise:
    """Stiffest passive walls, over plausible actuators.

    stiffness: passive with 95 % [N*m/rad], with a rendered damping [N*m*s/rad]; draws: the
    stiffest by actuator. colgate: 2 b / T; abbott: min(2 b / T, 2 f / count) of Abbott and Okamura
    ("Effects of position quantization and sampling rate on virtual-wall passivity", IEEE
    Transactions on Robotics 21, 2005), both without the delay of an answer and a damping.
    """

    stiffness: float
    damping: float
    draws: FloatArray
    colgate: float
    abbott: float


@dataclass(frozen=True)
class Passivity:
    """Passivity of walls that a controller renders.

    tracker: of the speed that a wall's damping sees. actuators: (n, n_parameters), the identified
    one first. hands: at the handle.
    """

    controller: TunedController
    tracker: Tracker
    actuators: FloatArray
    hands: Hands = Hands()

    @cached_property
    def law(self) -> WallLaw:
        """The controller's. Raises UnknownPassivityError as ``WallLaw.of`` does."""
        return WallLaw.of(self.controller, self._time)

    @cached_property
    def ports(self) -> list[Port]:
        """Of the actuators."""
        model, law = self.controller.model, self.law
        ahead = self.controller.control.ahead
        return [
            Port.of(ActuatorDynamics(model, p), law.z, self._time, ahead, self.hands)
            for p in self.actuators
        ]

    def stiffest(self, port: Port, damping: float) -> float:
        """Stiffest passive wall of a damping [N*m*s/rad] at a port; 0 where none is."""
        law = self.law
        speed = self.tracker.response(law.z, self._time)

        def passive(K: float) -> bool:
            """Whether a wall is. The wall's torque on the hand is -(K theta + B omega)."""
            return port.passive(law.by_reference * (K + damping * speed) - law.by_angle)

        low, high = 0.0, _STIFFEST
        if not passive(1e-6):
            return 0.0
        for _ in range(_BISECTIONS):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if passive(middle) else (low, middle)
            if high - low < 1e-4 * high:
                break
        return _BETWEEN * low

    @cached_property
    def _multiplier(self) -> ComplexArray:
        """The M of two terms that allows the identified actuator the stiffest spring."""
        z, port = self.law.z, self.ports[0]
        shares, best = _MIXTURES[:, None], (-1.0, z)
        terms = [1.0 - z**-i for i in range(1, _TAPS + 2 * self.controller.control.ahead)]
        for first, second in itertools.combinations(terms, 2):
            M = shares * first + (1.0 - shares) * second
            stiffness = self._by_multiplier(port, M)
            k = int(np.argmax(stiffness))
            best = max(best, (float(stiffness[k]), M[k]), key=lambda pair: pair[0])
        return best[1]

    def _by_multiplier(self, port: Port, M: ComplexArray) -> FloatArray:
        """The stiffest springs that multipliers M, (..., n), allow [N*m/rad], (...)."""
        C, R = port.by_torque(self.law)
        M = M[..., None, :]
        need = np.maximum(np.abs(M) * R - (M * C).real, 1e-300)
        stiffest: FloatArray = np.min(np.max(M.real / need, axis=-2), axis=-1)
        return np.minimum(stiffest, _STIFFEST)

    @cached_property
    def is_linear(self) -> bool:
        """Whether the law is the same within the yield travel and sliding."""
        sliding = WallLaw.of(self.controller, self._time, "sliding forwards").by_angle
        apart = np.abs(sliding - self.law.by_angle).max()
        return bool(apart <= _SAME * np.abs(self.law.by_angle).max())

    def springs(self) -> FloatArray:
        """Stiffest walls without damping that come to rest, entered and left, by actuator, (n,).

        Zeros for a law that is not linear, of which this cannot be told.
        """
        if not self.is_linear:
            return np.zeros(len(self.actuators))
        M = self._multiplier
        return _BETWEEN * np.array([float(self._by_multiplier(port, M)) for port in self.ports])

    def springs_promised(self) -> float:
        """The same with 95 %, over the actuators [N*m/rad]."""
        return float(np.percentile(self.springs(), _SURE))

    def promise(self, count: float) -> WallPromise:
        """The stiffest walls; count: angle of one of the encoder [rad]."""
        nominal = self.ports[0]
        dampings = np.linspace(0.0, 4.0 * nominal.damping, _DAMPINGS)
        by_damping = [self.stiffest(nominal, damping) for damping in dampings.tolist()]
        best = float(dampings[int(np.argmax(by_damping))])
        draws = np.array([self.stiffest(port, best) for port in self.ports])
        sure = float(np.percentile(draws, _SURE))
        colgate = np.array([2.0 * port.damping / self._time for port in self.ports])
        friction = np.array([2.0 * port.friction / count for port in self.ports])
        return WallPromise(
            sure,
            best,
            draws,
            float(np.percentile(colgate, _SURE)),
            float(np.percentile(np.minimum(colgate, friction), _SURE)),
        )

    @property
    def _time(self) -> float:
        return 1.0 / self.controller.control.sample_rate


def _yield_stiffness(dynamics: ActuatorDynamics) -> float:
    """Of the brake without a current, by a turn of a thousandth of its yield travel [N*m/rad]."""
    share = 1e-3
    torques = [dynamics.rest(0.0, 0.0, z, 0.0) for z in (0.0, share * dynamics.sliding)]
    return abs(torques[1] - torques[0]) * dynamics.stiffness / share


def _electrical(dynamics: ActuatorDynamics) -> tuple[FloatArray, FloatArray, FloatArray, int]:
    """A, columns of the motor's command and of the speed, place of its current."""
    names, inputs = dynamics.model.state_names, dynamics.model.input_names
    A, B, _, _ = dynamics.linear(0.0, 0.0, 0.0)
    inner = [i for i, name in enumerate(names) if name not in SHAFT]
    command, omega = inputs.index("applied_voltage_motor"), names.index("omega")
    place = inner.index(names.index("current_motor"))
    return A[np.ix_(inner, inner)], B[inner, command], A[inner, omega], place


def _currents(dynamics: ActuatorDynamics, s: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
    """Motor current by its command [A/V] and by the shaft's speed [A*s/rad], at points s."""
    A, command, omega, place = _electrical(dynamics)
    inner = s[..., None, None] * np.eye(len(A)) - A
    columns = np.stack([command, omega], axis=1)
    both = np.linalg.solve(inner, np.broadcast_to(columns, (*s.shape, *columns.shape)))
    by_volts, by_speed = (both[..., place, k].astype(np.complex128) for k in (0, 1))
    return by_volts, by_speed


def _sampled_winding(dynamics: ActuatorDynamics, time: float) -> tuple[FloatArray, FloatArray, int]:
    """A and column of a held command over a sample, and place of the motor's current."""
    A, command, _, place = _electrical(dynamics)
    n = len(A)
    block = np.zeros((n + 1, n + 1))
    block[:n, :n], block[:n, n] = A, command
    step = expm(block * time)
    return step[:n, :n], step[:n, n], place


def _sampled_current(A: FloatArray, b: FloatArray, place: int, z: ComplexArray) -> ComplexArray:
    """The motor's current by a held command, at points z of a sampled system [A/V]."""
    inner = z[:, None, None] * np.eye(len(A)) - A
    held = np.broadcast_to(b[:, None], (len(z), len(b), 1))
    response: ComplexArray = np.linalg.solve(inner, held)[:, place, 0].astype(np.complex128)
    return response


def _largest_pole(law: LinearLaw, A: FloatArray, b: FloatArray, place: int, ahead: int) -> float:
    """Of a law with the motor's current that its commands make, at a shaft that is held."""
    n, m = len(A), len(law.F)
    loop = np.zeros((n + m + ahead,) * 2)
    loop[:n, :n], loop[:n, n + m] = A, b  # the oldest command under way
    loop[n : n + m, n : n + m], loop[n : n + m, place] = law.F, law.G[:, 3]
    loop[n + m : -1, n + m + 1 :] = np.eye(ahead - 1)
    loop[-1, n : n + m], loop[-1, place] = law.H[0], law.D[0, 3]
    return float(np.abs(np.linalg.eigvals(loop)).max())
