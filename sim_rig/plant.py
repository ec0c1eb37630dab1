"""The plant behind the simulated rig: actuator, amplifier limits, pulley load and hand."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np

from sim_rig.components import bouc_wen_rate, brake_torque, closed_loop_driver, winding
from sysid import Input, Output, Parameter, ProcessModel, State

GRAVITY = 9.80665  # m/s^2
SUPPLY = 24.0  # V, the amplifier's limit
MAX_CURRENT = 2.5  # A, the amplifier's limit

# Angle over which the cable changes sides of the pulley when it is wound off past its end:
# about the angle in which a cable leaves a small drum.
_CROSSOVER = 0.1  # rad


def saturate(value: float, limit: float) -> float:
    """``value`` kept within +-limit."""
    return min(max(value, -limit), limit)


def hanging_load(
    theta: float,
    omega: float,
    height: float,
    speed: float,
    mass: float,
    radius: float,
    stiffness: float,
    damping: float,
) -> tuple[float, float]:
    """Torque on the shaft [N*m] and acceleration of the mass [m/s^2] of a mass on a cable.

    The cable is a spring and damper that pulls and never pushes: beyond slack it carries
    nothing. height [m] is the mass's, zero where the wound-off cable would just be taut.
    """
    root = (theta * theta + _CROSSOVER * _CROSSOVER) ** 0.5
    lever = radius * theta / root
    stretch = radius * (root - _CROSSOVER) - height
    pull = stiffness * stretch + damping * (lever * omega - speed)
    tension = max(pull, 0.0) if stretch > 0.0 else 0.0
    return -tension * lever, tension / mass - GRAVITY


def hand_torque(
    theta: float, omega: float, hand_theta: float, hand_omega: float, K_u: float, B_u: float
) -> float:
    """Torque of a hand's impedance on the shaft (A.1) [N*m]."""
    return B_u * (hand_omega - omega) + K_u * (hand_theta - theta)


_RESPONSE_TIME = 0.237  # s, of a hand (A.2)
_HAND_INERTIA = 1e-3  # kg*m^2, an order of magnitude above the rotors, as (A.2) asks
_HAND_OMEGA = 3.0 / _RESPONSE_TIME


def _fixed(name: str, unit: str, value: float, why: str) -> Parameter:
    return Parameter(name, unit, value, value, value, fixed=True, minimum=-np.inf, description=why)


# Each value with the reason for it. "Assumed" ones stand in no data sheet of the rig.
PARAMETERS: tuple[Parameter, ...] = (
    _fixed("K_dm", "V/A", 120.0, "of the order of row C; leaves 0.99 of the 0.5 A/V at rest"),
    _fixed("omega_dm", "rad/s", 1828.0, "row C of table 4.1"),
    _fixed("K_db", "V/A", 13000.0, "assumed: leaves 0.99 of the 0.5 A/V into 126 ohm"),
    _fixed("omega_db", "rad/s", 30.5, "assumed: an integrator-like loop that stays below 24 V"),
    _fixed("R_m", "ohm", 1.18, "row A of table 4.1 (data sheet)"),
    _fixed("L_m", "H", 1.18e-3, "row C of table 4.1"),
    _fixed("K_m", "N*m/A", 0.353 / 2.5, "rating: 0.353 N*m at 2.5 A"),
    _fixed("R_b", "ohm", 24.0 / 0.19, "rating: 24 V coil at 0.19 A"),
    _fixed("L_b", "H", 0.1, "assumed: 0.8 ms, a small coil without a solid core"),
    _fixed("J_m", "kg*m^2", 7e-5, "assumed: rotor of a 57 mm motor"),
    _fixed("B_m", "N*m*s/rad", 8e-5, "assumed: bearings lose under 1 % of the rated torque"),
    _fixed("J_b", "kg*m^2", 3.2e-5, "assumed: half the motor's, a 70 mm disc in powder"),
    _fixed("gamma", "1/rad", 28.0, "assumed: with beta, class 1 and rate-independent"),
    _fixed("beta", "1/rad", 20.0, "assumed: see gamma"),
    _fixed("A", "1/rad", 60.0, "assumed: yields after about 20 mrad"),
    _fixed("alpha0", "N*m", 0.0112, "assumed: residual torque 2 % of the rated one"),
    _fixed("alpha1", "N*m/A", (0.6779 / 1.25 - 0.0112) / 0.19, "rating: 0.6779 N*m at 0.19 A"),
    _fixed("c0", "N*m*s/rad", 1.2e-4, "assumed: viscous part small against the hysteretic"),
    _fixed("c1", "N*m*s/(rad*A)", 6e-4, "assumed: see c0"),
    _fixed("K_v2i", "A/V", 0.5, "amplifier data sheet"),
    _fixed("n_c", "1", -1.0, "motor and brake on one shaft"),
    _fixed("mass", "kg", 0.25, "the lab's 250 g"),
    _fixed("radius", "m", 0.005, "assumed: the residual friction holds the wound load"),
    _fixed("J_p", "kg*m^2", 1e-6, "assumed: a small aluminium pulley"),
    _fixed("k_cable", "N/m", 5000.0, "assumed: thin braided cable, half a metre"),
    _fixed("d_cable", "N*s/m", 10.0, "assumed: a seventh of critical with the mass"),
    _fixed("K_u", "N*m/rad", _HAND_OMEGA**2 * _HAND_INERTIA, "(A.2)"),
    _fixed("B_u", "N*m*s/rad", 2 * 0.707 * _HAND_OMEGA * _HAND_INERTIA, "(A.2), xi = 0.707"),
)

STATES = (
    State("voltage_motor", "V"),
    State("voltage_brake", "V"),
    State("current_motor", "A"),
    State("current_brake", "A"),
    State("omega", "rad/s"),
    State("z", "1"),
    State("theta", "rad"),
    State("height", "m", -0.25 * GRAVITY / 5000.0, "of the hanging mass, cable stretched"),
    State("speed", "m/s", 0.0, "of the hanging mass"),
)

INPUTS = (
    Input("applied_voltage_motor", "V"),
    Input("applied_voltage_brake", "V"),
    Input("hand_grip", "1", "zoh", "1 while a hand holds the handle, else 0"),
    Input("hand_theta", "rad", "foh"),
    Input("hand_omega", "rad/s", "foh"),
)

_ROTOR = slice(0, 21)  # the actuator's own parameters


@functools.cache
def plant() -> ProcessModel:
    """Actuator with amplifier limits, hanging-mass pulley and a hand that may hold the shaft.

    Outputs are the true values of what the rig's sensors see: currents, shaft torque at the
    load side, angle and speed.
    """
    hysteresis = bouc_wen_rate()

    def shaft(x: Any, u: Any, p: Any) -> tuple[float, float, float]:
        """Angular acceleration, shaft torque from the load, acceleration of the mass."""
        _v_m, _v_b, i_m, i_b, omega, z, theta, height, speed = x
        _command_m, _command_b, grip, hand_theta, hand_omega = u
        (
            _K_dm, _omega_dm, _K_db, _omega_db, _R_m, _L_m, K_m, _R_b, _L_b, J_m, B_m, J_b,
            _gamma, _beta, _A, alpha0, alpha1, c0, c1, _K_v2i, n_c,
            mass, radius, J_p, k_cable, d_cable, K_u, B_u,
        ) = p  # fmt: skip
        cable, lift = hanging_load(theta, omega, height, speed, mass, radius, k_cable, d_cable)
        load = cable + grip * hand_torque(theta, omega, hand_theta, hand_omega, K_u, B_u)
        resisting = brake_torque(i_b, omega, z, alpha0, alpha1, c0, c1)
        driving = -n_c * K_m * i_m - n_c * n_c * B_m * omega - resisting
        acceleration = (driving + load) / (n_c * n_c * J_m + J_b + J_p)
        return acceleration, load - J_p * acceleration, lift

    def derivative(x: Any, u: Any, p: Any) -> tuple[Any, ...]:
        v_m, v_b, i_m, i_b, omega, z, _theta, _height, speed = x
        command_m, command_b, _grip, _hand_theta, _hand_omega = u
        (
            K_dm, omega_dm, K_db, omega_db, R_m, L_m, K_m, R_b, L_b, _J_m, _B_m, _J_b,
            gamma, beta, A, _alpha0, _alpha1, _c0, _c1, K_v2i, n_c,
            _mass, _radius, _J_p, _k_cable, _d_cable, _K_u, _B_u,
        ) = p  # fmt: skip
        acceleration, _torque, lift = shaft(x, u, p)
        # The amplifier limits the current it asks for and the voltage it can give.
        top = MAX_CURRENT / K_v2i
        return (
            closed_loop_driver(v_m, i_m, saturate(command_m, top), K_dm, omega_dm, K_v2i),
            closed_loop_driver(v_b, i_b, saturate(command_b, top), K_db, omega_db, K_v2i),
            winding(i_m, saturate(v_m, SUPPLY), -n_c * K_m * omega, R_m, L_m),
            winding(i_b, saturate(v_b, SUPPLY), 0.0, R_b, L_b),
            acceleration,
            hysteresis(omega, z, gamma, beta, A),
            omega,
            speed,
            lift,
        )

    def output(x: Any, u: Any, p: Any) -> tuple[Any, ...]:
        _acceleration, torque, _lift = shaft(x, u, p)
        return (x[2], x[3], torque, x[6], x[4])

    return ProcessModel(
        name="plant",
        description="the simulated rig's plant",
        states=STATES,
        inputs=INPUTS,
        outputs=(
            Output("current_motor", "A"),
            Output("current_brake", "A"),
            Output("torque", "N*m"),
            Output("theta", "rad"),
            Output("omega", "rad/s"),
        ),
        parameters=PARAMETERS,
        derivative=derivative,
        output=output,
    )


def actuator_truth() -> dict[str, float]:
    """The simulated plant's own values of the actuator's parameters, by name."""
    return {parameter.name: parameter.nominal for parameter in PARAMETERS[_ROTOR]}
