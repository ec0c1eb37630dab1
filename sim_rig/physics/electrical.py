"""Amplifiers and windings: the linear electrical half of the actuator, and its limits.

Equation numbers here and in the neighbouring files are those of the thesis this project began
as ("Hybrid Haptic Device Modeling and System Identification").
"""

import itertools
from collections.abc import Callable
from typing import Any, Literal

from sim_rig.physics.options import DriverKind
from sim_rig.physics.parameters import log_range
from sysid import ModelError, Parameter, State

Channel = Literal["motor", "brake"]

SUPPLY = 24.0  # V, the amplifier's limit
MAX_CURRENT = 2.5  # A, the amplifier's limit
FOLDBACK = 100.0  # V/A, how a voltage amplifier gives way beyond that; assumed: as a closed loop

HIGHEST_ORDER = 3  # of an amplifier

# (current, command, K_v2i, gain) -> the voltage that an amplifier settles at
Drive = Callable[[Any, Any, Any, Any], Any]


def saturate(value: Any, limit: Any) -> Any:
    """``value`` kept within +-limit."""
    return min(max(value, -limit), limit)


def excess(value: Any, limit: Any) -> Any:
    """By how much ``value`` is beyond +-limit."""
    return max(value - limit, 0.0) + min(value + limit, 0.0)


def closed_loop_drive(current: Any, command: Any, K_v2i: Any, gain: Any) -> Any:
    """What an amplifier that controls its current settles at (3.10) [V].

    K_v2i: amperes asked for per volt of command; gain [V/A].
    """
    return gain * (K_v2i * command - current)


def open_loop_drive(current: Any, command: Any, K_v2i: Any, gain: Any) -> Any:
    """What an amplifier that gives a voltage settles at (3.7) [V]; gain [V/V]."""
    return gain * command


def limited_closed_loop_drive(current: Any, command: Any, K_v2i: Any, gain: Any) -> Any:
    """``closed_loop_drive`` that asks for no more than its rated current."""
    return closed_loop_drive(current, saturate(command, MAX_CURRENT / K_v2i), K_v2i, gain)


def limited_open_loop_drive(current: Any, command: Any, K_v2i: Any, gain: Any) -> Any:
    """``open_loop_drive`` that gives way beyond its rated current."""
    free = open_loop_drive(current, command, K_v2i, gain)
    return free - FOLDBACK * excess(current, MAX_CURRENT)


def drive(kind: DriverKind, limits: bool) -> Drive:
    """What an amplifier settles at; ``limits``: with the ends of its range."""
    if kind == "closed":
        return limited_closed_loop_drive if limits else closed_loop_drive
    return limited_open_loop_drive if limits else open_loop_drive


def amplifier(voltages: Any, settled: Any, cutoffs: Any) -> tuple[Any, ...]:
    """Rates of an amplifier's voltages, the first its output, towards ``settled`` [V/s].

    cutoffs [rad/s]: as many as the order. From settled to output it is

        1 / (1 + s/w1 + s^2/(w1 w2) + s^3/(w1 w2 w3)),

    (3.7) and (3.10) at order 1, which the others approach where their further cutoffs are high:
    poles may be complex, and the mean delay is 1/w1 whatever the order.
    """
    slower = zip(cutoffs, voltages[1:], strict=False)
    rest = settled - sum(voltages[1:], voltages[0])
    return (*[cutoff * voltage for cutoff, voltage in slower], cutoffs[-1] * rest)


def winding(current: Any, voltage: Any, back_emf: Any, resistance: Any, inductance: Any) -> Any:
    """di/dt of a resistor-inductor winding, motor (3.1) or brake coil (3.3) [A/s]."""
    return (voltage - resistance * current - back_emf) / inductance


def limited_winding(
    current: Any, voltage: Any, back_emf: Any, resistance: Any, inductance: Any
) -> Any:
    """``winding`` across which an amplifier puts no more than its supply."""
    return winding(current, saturate(voltage, SUPPLY), back_emf, resistance, inductance)


def driver_equations(kind: DriverKind, order: int, index: str, limits: bool) -> tuple[str, ...]:
    """Equations of an amplifier as text, sat as in ``limit_equations``.

    index: m (motor) or b (brake); limits: whether its range has ends.
    """
    i, u = f"i_{index}", f"u_{index}"
    if kind == "closed":
        current = f"sat(K_v2i*{u}, {MAX_CURRENT:g})" if limits else f"K_v2i*{u}"
        drive = f"K_d{index}*({current} - {i})"
    else:
        back = f" - {FOLDBACK:g}*({i} - sat({i}, {MAX_CURRENT:g}))" if limits else ""
        drive = f"G_d{index}*{u}{back}"
    numbers = _numbers(order)
    slower = [
        f"dv_{index}{k}/dt = omega_d{index}{k}*v_{index}{following}"
        for k, following in itertools.pairwise(numbers)
    ]
    voltages = " - ".join(f"v_{index}{k}" for k in numbers)
    last = f"{index}{numbers[-1]}"
    return (*slower, f"dv_{last}/dt = omega_d{last}*({drive} - {voltages})")


def winding_equations(motor_output: bool, brake_output: bool, limits: bool) -> tuple[str, str]:
    """Equations of motor and brake as text, sat as in ``limit_equations``.

    Whether their amplifiers have an output resistance, and whether their range has ends.
    """
    v_m, v_b = (f"sat({v}, {SUPPLY:g})" if limits else v for v in ("v_m", "v_b"))
    R_m = "(R_m + R_om)" if motor_output else "R_m"
    R_b = "(R_b + R_ob)" if brake_output else "R_b"
    return (
        f"L_m di_m/dt = {v_m} - {R_m}*i_m + n_c*K_m*omega",
        f"L_b di_b/dt = {v_b} - {R_b}*i_b",
    )


def limit_equations(limits: bool) -> tuple[str, ...]:
    """What ``sat`` means in the equations, where amplifiers have ends of their range."""
    return ("sat(x, a): x kept within -a .. a",) if limits else ()


def limit_assumptions(limits: bool, kind: DriverKind, output: bool) -> tuple[str, ...]:
    """What rests on the ends of the amplifiers' range, in a sentence.

    kind, output: of the brake's amplifier, and whether it has an output resistance.
    """
    gain, resistance = "K_db" if kind == "closed" else "G_db", "R_b + R_ob" if output else "R_b"
    text = (
        f"The ends of the amplifiers' range, {SUPPLY:g} V and {MAX_CURRENT:g} A, are assumed and "
        f"not estimated: what is told apart by them alone, such as {gain}, {resistance} and L_b, "
        "holds for these ends, and is off as much as they are."
    )
    return (text,) if limits else ()


def voltages(channel: Channel, order: int) -> tuple[State, ...]:
    """States of an amplifier: its output, and how far it has yet to go by each further order."""
    name, place = f"voltage_{channel}", "motor" if channel == "motor" else "brake coil"
    further = [
        State(f"{name}_{k}", "V", description=f"amplifier's state {k} at the {place}")
        for k in _numbers(order)[1:]
    ]
    return (State(name, "V", description=f"amplifier output at the {place}"), *further)


def driver_parameters(channel: Channel, kind: DriverKind, order: int) -> tuple[Parameter, ...]:
    """Gain and cutoffs of an amplifier. Raises ModelError for an order that it cannot have."""
    if order not in range(1, HIGHEST_ORDER + 1):
        raise ModelError(f"order_{channel} {order}: write 1 to {HIGHEST_ORDER}")
    # A closed loop of the nominal values rings up below 5e4 (motor) and 1.6e3 rad/s (brake).
    lowest = 1e4 if channel == "motor" else 1e3
    further = [
        log_range(
            f"omega_d{channel[0]}{k}", "rad/s", 10.0 * lowest, lowest, 100.0 * lowest,
            f"{channel} driver cutoff {k}",
        )
        for k in _numbers(order)[1:]
    ]  # fmt: skip
    return (*_DRIVERS[channel][kind], *further)


def output_resistance(channel: Channel, present: bool) -> tuple[Parameter, ...]:
    """Of an amplifier, in series with the winding's; none where it is not modelled."""
    text = f"{channel} driver output resistance"
    return (log_range(f"R_o{channel[0]}", "ohm", 0.1, 0.01, 1.0, text),) if present else ()


def _numbers(order: int) -> list[str]:
    """What stands behind the names of an amplifier's states and cutoffs: nothing, 2, 3."""
    return ["", *map(str, range(2, order + 1))]


_MOTOR_CUTOFF = log_range("omega_dm", "rad/s", 1000.0, 100.0, 5000.0, "motor driver cutoff")

# Gain and first cutoff of the amplifiers.
_DRIVERS: dict[Channel, dict[DriverKind, tuple[Parameter, ...]]] = {
    "motor": {
        "closed": (log_range("K_dm", "V/A", 100.0, 5.0, 500.0, "motor driver gain"), _MOTOR_CUTOFF),
        "open": (log_range("G_dm", "V/V", 1.0, 0.1, 10.0, "motor driver gain"), _MOTOR_CUTOFF),
    },
    "brake": {
        "closed": (
            log_range("K_db", "V/A", 10000.0, 1000.0, 40000.0, "brake driver gain"),
            log_range("omega_db", "rad/s", 20.0, 5.0, 500.0, "brake driver cutoff"),
        ),
        "open": (
            log_range("G_db", "V/V", 50.0, 10.0, 200.0, "brake driver gain"),
            log_range("omega_db", "rad/s", 500.0, 50.0, 5000.0, "brake driver cutoff"),
        ),
    },
}

WINDINGS = (
    log_range("R_m", "ohm", 1.0, 0.2, 8.0, "motor resistance"),
    log_range("L_m", "H", 1e-3, 2e-4, 6e-3, "motor inductance"),
    log_range("K_m", "N*m/A", 0.14, 0.03, 0.5, "motor constant"),
    log_range("R_b", "ohm", 120.0, 40.0, 200.0, "brake coil resistance"),
    log_range("L_b", "H", 0.15, 0.05, 1.0, "brake coil inductance"),
)
