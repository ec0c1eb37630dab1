"""Dry friction of the torque sensor's brushes: Coulomb, Stribeck, viscous, and with the angle.

The sign of the speed is tanh(omega / omega_r), so that the equations stay smooth; below omega_r
the shaft creeps where it would stick. The Stribeck curve is the usual exponential one
(Armstrong-Helouvry, Dupont & Canudas de Wit, "A survey of models, analysis tools and
compensation methods for the control of machines with friction", Automatica 30, 1994). Worn
brushes press unevenly along a turn: that part is a harmonic of the shaft angle.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from sim_rig.physics.options import Friction
from sim_rig.physics.parameters import PartConstraint, fixed, log_range
from sysid import Parameter


@dataclass(frozen=True)
class FrictionModel:
    """Parameters and equation of a friction model.

    name: as it stands in a list of parts, empty where there is no friction. torque:
    (theta, omega, p) -> torque that resists the motion [N*m]. equation: the same as text.
    """

    name: str
    parameters: tuple[Parameter, ...]
    torque: Callable[[Any, Any, Any], Any]
    constraints: tuple[PartConstraint, ...] = ()
    equation: str = ""


def stribeck_torque(theta: Any, omega: Any, p: Any) -> Any:
    """Coulomb, Stribeck and viscous friction [N*m], whatever the angle."""
    F_c, F_s, omega_s, B_f, omega_r = p
    return _level(omega, F_c, F_s, omega_s) * math.tanh(omega / omega_r) + B_f * omega


def cyclic_torque(theta: Any, omega: Any, p: Any) -> Any:
    """``stribeck_torque`` with a level that follows the shaft angle."""
    F_c, F_s, omega_s, B_f, omega_r, F_cos, F_sin, cycles = p
    around = F_cos * math.cos(cycles * theta) + F_sin * math.sin(cycles * theta)
    level = _level(omega, F_c, F_s, omega_s) + around
    return level * math.tanh(omega / omega_r) + B_f * omega


def _level(omega: Any, F_c: Any, F_s: Any, omega_s: Any) -> Any:
    share = omega / omega_s
    return F_c + (F_s - F_c) * math.exp(-share * share)


_STRIBECK = (
    log_range("F_c", "N*m", 0.02, 1e-3, 0.2, "Coulomb friction"),
    log_range("F_s", "N*m", 0.03, 1e-3, 0.3, "friction at the moment of breaking away"),
    log_range("omega_s", "rad/s", 2.0, 0.2, 20.0, "Stribeck speed"),
    # Exactly what c0 does: searched only where somebody frees it.
    fixed("B_f", "N*m*s/rad", 0.0, "viscous friction of the brushes"),
    fixed("omega_r", "rad/s", 0.1, "speed within which the sign of the speed is smoothed"),
)


def _harmonic(name: str, wave: str) -> Parameter:
    meaning = f"friction that follows the {wave} of the angle"
    return Parameter(name, "N*m", 0.0, -0.05, 0.05, minimum=-math.inf, description=meaning)


_CYCLIC = (
    _harmonic("F_cos", "cosine"),
    _harmonic("F_sin", "sine"),
    fixed("cycles", "1", 2.0, "periods of the cyclic friction in a turn"),
)

_RISING = ("F_s >= F_c (friction falls with speed)", lambda p: p[0] - p[1])
_PRESSED = (
    "F_c >= (F_cos^2 + F_sin^2)^(1/2) (friction resists everywhere)",
    lambda p: (p[5] ** 2 + p[6] ** 2) ** 0.5 - p[0],
)
_LEVEL = "F_c + (F_s - F_c)*exp(-(omega/omega_s)^2)"
_TEXT = "tau_f = ({})*tanh(omega/omega_r) + B_f*omega"

FRICTIONS: dict[Friction, FrictionModel] = {
    "none": FrictionModel("", (), lambda theta, omega, p: 0.0),
    "stribeck": FrictionModel(
        "brush friction", _STRIBECK, stribeck_torque, (_RISING,), _TEXT.format(_LEVEL)
    ),
    "cyclic": FrictionModel(
        "cyclic brush friction",
        _STRIBECK + _CYCLIC,
        cyclic_torque,
        (_RISING, _PRESSED),
        _TEXT.format(f"{_LEVEL} + F_cos*cos(cycles*theta) + F_sin*sin(cycles*theta)"),
    ),
}
