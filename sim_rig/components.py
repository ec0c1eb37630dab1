"""Equations of the actuator's parts, each a small function of floats.

They are written to be called from a model's ``derivative``: plain arithmetic that reads like the
equation it cites and compiles to vector code. Equation numbers are those of the thesis this
project began as ("Hybrid Haptic Device Modeling and System Identification").
"""

from __future__ import annotations

from collections.abc import Callable

RateFunction = Callable[[float, float, float, float, float], float]


def closed_loop_driver(
    voltage: float, current: float, command: float, gain: float, cutoff: float, scale: float
) -> float:
    """dv/dt of a current-controlling amplifier (3.10) [V/s].

    gain K_cmd [V/A], cutoff omega_cmd [rad/s], scale K_v2i [A per volt of command].
    """
    return cutoff * (gain * (scale * command - current) - voltage)


def winding(
    current: float, voltage: float, back_emf: float, resistance: float, inductance: float
) -> float:
    """di/dt of a resistor-inductor winding, motor (3.1) or brake coil (3.3) [A/s]."""
    return (voltage - resistance * current - back_emf) / inductance


def bouc_wen_rate(exponent: float = 1.0) -> RateFunction:
    """dz/dt of the Bouc-Wen hysteresis (3.14) for a fixed exponent n.

    The returned function takes (omega, z, gamma, beta, A). Whole exponents avoid the power
    function, which does not compile to vector instructions.
    """
    if exponent == 1.0:

        def rate(omega: float, z: float, gamma: float, beta: float, A: float) -> float:
            return A * omega - gamma * abs(omega) * z - beta * omega * abs(z)

    elif exponent == 2.0:

        def rate(omega: float, z: float, gamma: float, beta: float, A: float) -> float:
            return A * omega - gamma * abs(omega) * z * abs(z) - beta * omega * z * z

    else:

        def rate(omega: float, z: float, gamma: float, beta: float, A: float) -> float:
            size: float = abs(z) ** (exponent - 1.0)
            return A * omega - size * (gamma * abs(omega) * z + beta * omega * abs(z))

    return rate


def brake_torque(
    current: float,
    omega: float,
    z: float,
    alpha0: float,
    alpha1: float,
    c0: float,
    c1: float,
) -> float:
    """Hysteretic torque alpha(i) z + c(i) omega (3.15) [N*m].

    It depends on |i|: with i itself an undershoot of the current below zero would make a
    passive brake deliver energy.
    """
    size = abs(current)
    return (alpha0 + alpha1 * size) * z + (c0 + c1 * size) * omega
