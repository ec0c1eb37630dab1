"""Amplifiers and windings: the linear electrical half of the actuator, and its limits.

Equation numbers here and in the neighbouring files are those of the thesis this project began
as ("Hybrid Haptic Device Modeling and System Identification").
"""

from collections.abc import Callable
from typing import Any

from sim_rig.physics.options import DriverKind
from sim_rig.physics.parameters import log_range
from sysid import Parameter

SUPPLY = 24.0  # V, the amplifier's limit
MAX_CURRENT = 2.5  # A, the amplifier's limit
_FOLDBACK = 100.0  # V/A, how a voltage amplifier gives way beyond that; assumed: as a closed loop

# (voltage, current, command, K_v2i, p) -> dv/dt, p the driver's own parameters
DriverFunction = Callable[[Any, Any, Any, Any, Any], Any]


def saturate(value: Any, limit: Any) -> Any:
    """``value`` kept within +-limit."""
    return min(max(value, -limit), limit)


def excess(value: Any, limit: Any) -> Any:
    """By how much ``value`` is beyond +-limit."""
    return max(value - limit, 0.0) + min(value + limit, 0.0)


def closed_loop_driver(voltage: Any, current: Any, command: Any, K_v2i: Any, p: Any) -> Any:
    """dv/dt of an amplifier that controls its current (3.10) [V/s].

    p: gain K [V/A] and cutoff [rad/s]; K_v2i: amperes asked for per volt of command.
    """
    gain, cutoff = p
    return cutoff * (gain * (K_v2i * command - current) - voltage)


def open_loop_driver(voltage: Any, current: Any, command: Any, K_v2i: Any, p: Any) -> Any:
    """dv/dt of an amplifier that gives a voltage (3.7) [V/s]; p: gain [V/V], cutoff [rad/s]."""
    gain, cutoff = p
    return cutoff * (gain * command - voltage)


def limited_closed_loop_driver(voltage: Any, current: Any, command: Any, K_v2i: Any, p: Any) -> Any:
    """``closed_loop_driver`` that asks for no more than its rated current."""
    within_rating = saturate(command, MAX_CURRENT / K_v2i)
    return closed_loop_driver(voltage, current, within_rating, K_v2i, p)


def limited_open_loop_driver(voltage: Any, current: Any, command: Any, K_v2i: Any, p: Any) -> Any:
    """``open_loop_driver`` that gives way beyond its rated current."""
    _gain, cutoff = p
    free = open_loop_driver(voltage, current, command, K_v2i, p)
    return free - cutoff * _FOLDBACK * excess(current, MAX_CURRENT)


def winding(current: Any, voltage: Any, back_emf: Any, resistance: Any, inductance: Any) -> Any:
    """di/dt of a resistor-inductor winding, motor (3.1) or brake coil (3.3) [A/s]."""
    return (voltage - resistance * current - back_emf) / inductance


def limited_winding(
    current: Any, voltage: Any, back_emf: Any, resistance: Any, inductance: Any
) -> Any:
    """``winding`` across which an amplifier puts no more than its supply."""
    return winding(current, saturate(voltage, SUPPLY), back_emf, resistance, inductance)


def driver(kind: DriverKind, limits: bool) -> DriverFunction:
    """Equation of an amplifier; ``limits``: with the ends of its range."""
    if kind == "closed":
        return limited_closed_loop_driver if limits else closed_loop_driver
    return limited_open_loop_driver if limits else open_loop_driver


def driver_equation(kind: DriverKind, index: str) -> str:
    """The equation of an amplifier without limits as text; index: m (motor) or b (brake)."""
    drive = (
        f"K_d{index}*(K_v2i*u_{index} - i_{index})" if kind == "closed" else f"G_d{index}*u_{index}"
    )
    return f"dv_{index}/dt = omega_d{index}*({drive} - v_{index})"


_MOTOR_CUTOFF = log_range("omega_dm", "rad/s", 1000.0, 100.0, 5000.0, "motor driver cutoff")

# Gain and cutoff of the amplifiers.
MOTOR_DRIVERS: dict[DriverKind, tuple[Parameter, ...]] = {
    "closed": (log_range("K_dm", "V/A", 100.0, 5.0, 500.0, "motor driver gain"), _MOTOR_CUTOFF),
    "open": (log_range("G_dm", "V/V", 1.0, 0.1, 10.0, "motor driver gain"), _MOTOR_CUTOFF),
}
BRAKE_DRIVERS: dict[DriverKind, tuple[Parameter, ...]] = {
    "closed": (
        log_range("K_db", "V/A", 10000.0, 1000.0, 40000.0, "brake driver gain"),
        log_range("omega_db", "rad/s", 20.0, 5.0, 500.0, "brake driver cutoff"),
    ),
    "open": (
        log_range("G_db", "V/V", 50.0, 10.0, 200.0, "brake driver gain"),
        log_range("omega_db", "rad/s", 500.0, 50.0, 5000.0, "brake driver cutoff"),
    ),
}

WINDINGS = (
    log_range("R_m", "ohm", 1.0, 0.2, 8.0, "motor resistance"),
    log_range("L_m", "H", 1e-3, 2e-4, 6e-3, "motor inductance"),
    log_range("K_m", "N*m/A", 0.14, 0.03, 0.5, "motor constant"),
    log_range("R_b", "ohm", 120.0, 40.0, 200.0, "brake coil resistance"),
    log_range("L_b", "H", 0.15, 0.05, 1.0, "brake coil inductance"),
)
WINDING_EQUATIONS = ("L_m di_m/dt = v_m - R_m*i_m + n_c*K_m*omega", "L_b di_b/dt = v_b - R_b*i_b")
