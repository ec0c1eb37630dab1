"""Hysteretic torque of the brake: Bouc-Wen, Dahl and LuGre, exact and smooth.

All three share the torque alpha(i) z + c(i) omega, with alpha and c rising with the size of the
coil's current; they differ in how z follows the motion, and LuGre adds a part of dz/dt.

The torque depends on |i|: with i itself an undershoot of the current below zero would make a
passive brake deliver energy. The smooth forms put tanh(rho x) in place of the sign of x, so that
they can be differentiated everywhere.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from sim_rig.physics.options import Hysteresis
from sim_rig.physics.parameters import PartConstraint, fixed, log_range
from sysid import ModelError, Parameter

# (omega, z, p) -> dz/dt, p the hysteresis's own parameters
Rate = Callable[[Any, Any, Any], Any]
# (current, omega, z, dz/dt, p) -> torque that resists the motion
Torque = Callable[[Any, Any, Any, Any, Any], Any]

_RATED_CURRENT = 0.19  # A, up to which alpha(i) and c(i) must not be negative


@dataclass(frozen=True)
class HysteresisModel:
    """Parameters and equations of one hysteresis model.

    constraints: those of section 3.4.2, except that parameters are positive, which their physical
    minimum ensures. z_range: of the hysteresis variable when a record begins; it is not zero where
    friction holds a load. equations: rate and torque as text.
    """

    parameters: tuple[Parameter, ...]
    rate: Rate
    torque: Torque
    constraints: tuple[PartConstraint, ...]
    equations: tuple[str, str]
    z_range: tuple[float, float]
    z_unit: str = "1"


def hysteresis(kind: Hysteresis, smooth: bool = False, exponent: float = 1.0) -> HysteresisModel:
    """A hysteresis model by name; ``exponent`` is n of (3.14), for Bouc-Wen alone.

    Raises ModelError for an exponent below 1, at which dz/dt is not defined at z = 0.
    """
    if kind == "bouc-wen":
        return _bouc_wen(smooth, exponent)
    if exponent != 1.0:
        raise ModelError(f"an exponent ({exponent:g}) belongs to bouc-wen hysteresis, not {kind}")
    return _dahl(smooth) if kind == "dahl" else _lugre(smooth)


def _brake_torque(current: Any, omega: Any, z: Any, coefficients: Any) -> Any:
    """alpha(i) z + c(i) omega (3.15), (3.17) [N*m]; coefficients alpha0, alpha1, c0, c1."""
    alpha0, alpha1, c0, c1 = coefficients
    size = abs(current)
    return (alpha0 + alpha1 * size) * z + (c0 + c1 * size) * omega


def _torque_from(first: int) -> Torque:
    """``_brake_torque`` with its four coefficients at ``first`` and after among the parameters."""
    place = slice(first, first + 4)
    return lambda current, omega, z, z_rate, p: _brake_torque(current, omega, z, p[place])


_TORQUE_EQUATION = "tau_b = (alpha0 + alpha1*|i_b|)*z + (c0 + c1*|i_b|)*omega"


def _bouc_wen(smooth: bool, exponent: float) -> HysteresisModel:
    if not (math.isfinite(exponent) and exponent >= 1.0):
        raise ModelError(f"the Bouc-Wen exponent must be at least 1, not {exponent:g}")
    power, lower_power = _power(exponent), _power(exponent - 1.0)

    def exact_rate(omega: Any, z: Any, p: Any) -> Any:
        # (3.14), with |z|^(n-1) taken out of both terms
        gamma, beta, A = p[:3]
        return A * omega - lower_power(abs(z)) * (gamma * abs(omega) * z + beta * omega * abs(z))

    def smooth_rate(omega: Any, z: Any, p: Any) -> Any:
        # (3.26)
        gamma, beta, A = p[:3]
        rho = p[7]
        size = power(math.tanh(rho * z) * z)
        return omega * (A - size * (beta + gamma * math.tanh(rho * omega * z)))

    return HysteresisModel(
        (
            log_range("gamma", "1/rad", 40.0, 5.0, 500.0, "hysteresis shape"),
            log_range("beta", "1/rad", 30.0, 5.0, 500.0, "hysteresis shape"),
            log_range("A", "1/rad", 100.0, 10.0, 1000.0, "hysteresis stiffness"),
            *_BRAKE,
            *_SHARPNESS[smooth],
        ),
        smooth_rate if smooth else exact_rate,
        _torque_from(3),
        (
            ("gamma - beta >= 0 (Bouc-Wen class 1)", lambda p: p[1] - p[0]),
            ("gamma + beta >= 0 (Bouc-Wen class 1)", lambda p: -p[1] - p[0]),
            *_positive_torque(3),
        ),
        (_bouc_wen_equation(smooth, exponent), _TORQUE_EQUATION),
        (-10.0, 10.0),
    )


def _power(exponent: float) -> Callable[[Any], Any]:
    """a^n for a >= 0; 0, 1 and 2 avoid the power function, which is not vectorised."""
    if exponent == 0.0:
        return lambda a: 1.0
    if exponent == 1.0:
        return lambda a: a
    if exponent == 2.0:
        return lambda a: a * a
    return lambda a: a**exponent


def _bouc_wen_equation(smooth: bool, exponent: float) -> str:
    if smooth:
        power = "" if exponent == 1.0 else f"^{exponent:g}"
        rate = f"omega*(A - (z*tanh(rho*z)){power}*(beta + gamma*tanh(rho*omega*z)))"
    elif exponent == 1.0:
        rate = "A*omega - gamma*|omega|*z - beta*omega*|z|"
    else:
        rate = f"A*omega - |z|^{exponent - 1.0:g}*(gamma*|omega|*z + beta*omega*|z|)"
    return f"dz/dt = {rate}"


def _dahl(smooth: bool) -> HysteresisModel:
    def exact_rate(omega: Any, z: Any, p: Any) -> Any:
        return p[0] * (omega - abs(omega) * z)  # (3.16)

    def smooth_rate(omega: Any, z: Any, p: Any) -> Any:
        return p[0] * omega * (1.0 - z * math.tanh(p[5] * omega))  # (3.27)

    equation = "sigma*omega*(1 - z*tanh(rho*omega))" if smooth else "sigma*(omega - |omega|*z)"
    shape = log_range("sigma", "1/rad", 50.0, 5.0, 500.0, "hysteresis shape")
    return HysteresisModel(
        (shape, *_BRAKE, *_SHARPNESS[smooth]),
        smooth_rate if smooth else exact_rate,
        _torque_from(1),
        _positive_torque(1),
        (f"dz/dt = {equation}", _TORQUE_EQUATION),
        (-1.0, 1.0),
    )


def _lugre(smooth: bool) -> HysteresisModel:
    def exact_rate(omega: Any, z: Any, p: Any) -> Any:
        return omega - p[0] * abs(omega) * z  # (3.18)

    def smooth_rate(omega: Any, z: Any, p: Any) -> Any:
        return omega - p[0] * omega * math.tanh(p[7] * omega) * z  # (3.28)

    def torque(current: Any, omega: Any, z: Any, z_rate: Any, p: Any) -> Any:
        # (3.19)
        return _brake_torque(current, omega, z, p[1:5]) + (p[5] + p[6] * abs(current)) * z_rate

    sign = "omega*tanh(rho*omega)" if smooth else "|omega|"
    return HysteresisModel(
        (
            log_range("zeta", "1/rad", 50.0, 5.0, 500.0, "inverse of the largest deflection"),
            log_range("alpha0", "N*m/rad", 1.0, 0.1, 20.0, "stiffness at zero current"),
            log_range("alpha1", "N*m/(rad*A)", 200.0, 20.0, 2000.0, "stiffness per ampere"),
            *_VISCOUS,
            log_range("epsilon0", "N*m*s/rad", 2e-4, 1e-5, 1e-2, "damping of the deflection"),
            log_range("epsilon1", "N*m*s/(rad*A)", 2e-3, 1e-4, 5e-2, "the same per ampere"),
            *_SHARPNESS[smooth],
        ),
        smooth_rate if smooth else exact_rate,
        torque,
        (
            *_positive_torque(1),
            ("epsilon(i_b) >= 0 for every current", lambda p: _deficit(p[5], p[6])),
        ),
        (
            f"dz/dt = omega - zeta*{sign}*z",
            f"{_TORQUE_EQUATION} + (epsilon0 + epsilon1*|i_b|)*(dz/dt)",
        ),
        (-0.2, 0.2),
        "rad",
    )


_VISCOUS = (
    log_range("c0", "N*m*s/rad", 2e-4, 1e-5, 1e-2, "brake viscous damping at zero current"),
    log_range("c1", "N*m*s/(rad*A)", 2e-3, 1e-4, 5e-2, "brake viscous damping per ampere"),
)
_BRAKE = (
    log_range("alpha0", "N*m", 0.02, 2e-3, 0.5, "hysteretic torque at zero current"),
    log_range("alpha1", "N*m/A", 4.0, 0.5, 50.0, "hysteretic torque per ampere"),
    *_VISCOUS,
)
_SHARPNESS: dict[bool, tuple[Parameter, ...]] = {
    False: (),
    True: (fixed("rho", "1", 100.0, "sharpness of the smooth sign, tanh(rho x)"),),
}


def _deficit(constant: Any, per_ampere: Any) -> Any:
    """Largest -(constant + per_ampere |i|) up to the rated current: above 0 it is infeasible."""
    at_rated = -constant - per_ampere * _RATED_CURRENT
    # max of both ends, written so that it holds for columns of a population as well.
    return 0.5 * (-constant + at_rated + abs(constant + at_rated))


def _positive_torque(first: int) -> tuple[PartConstraint, ...]:
    """alpha(i) >= 0 and c(i) >= 0, with their coefficients at ``first`` and after."""
    return (
        ("alpha(i_b) >= 0 for every current", lambda p: _deficit(p[first], p[first + 1])),
        ("c(i_b) >= 0 for every current", lambda p: _deficit(p[first + 2], p[first + 3])),
    )
