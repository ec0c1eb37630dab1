"""The hybrid actuator as a process model for identification (3.23), (3.24)."""

from __future__ import annotations

from typing import Any

from sim_rig.components import bouc_wen_rate, brake_torque, closed_loop_driver, winding
from sysid import Constraint, Input, Output, Parameter, ProcessModel, State

STATES = (
    State("voltage_motor", "V", description="amplifier output at the motor"),
    State("voltage_brake", "V", description="amplifier output at the brake coil"),
    State("current_motor", "A"),
    State("current_brake", "A"),
    State("omega", "rad/s", description="shaft speed"),
    State("z", "1", description="hysteresis variable"),
    State("theta", "rad", description="shaft angle"),
)

INPUTS = (
    Input("applied_voltage_motor", "V", "zoh", "command at the motor amplifier's input"),
    Input("applied_voltage_brake", "V", "zoh", "command at the brake amplifier's input"),
    Input("torque", "N*m", "foh", "load torque on the shaft, as measured"),
)


def _log(
    name: str, unit: str, nominal: float, lower: float, upper: float, description: str
) -> Parameter:
    return Parameter(name, unit, nominal, lower, upper, "log", description=description)


# Nominal values are what data sheets or the order of magnitude of such parts say; the ranges
# around them are what a lab can bound without a measurement. They know nothing of the plant
# that sim_rig simulates.
PARAMETERS = (
    _log("K_dm", "V/A", 100.0, 10.0, 500.0, "motor driver gain"),
    _log("omega_dm", "rad/s", 1000.0, 100.0, 5000.0, "motor driver cutoff"),
    _log("K_db", "V/A", 10000.0, 1000.0, 40000.0, "brake driver gain"),
    _log("omega_db", "rad/s", 20.0, 5.0, 500.0, "brake driver cutoff"),
    _log("R_m", "ohm", 1.0, 0.5, 8.0, "motor resistance"),
    _log("L_m", "H", 1e-3, 2e-4, 3e-3, "motor inductance"),
    _log("K_m", "N*m/A", 0.14, 0.03, 0.25, "motor constant"),
    _log("R_b", "ohm", 120.0, 40.0, 200.0, "brake coil resistance"),
    _log("L_b", "H", 0.15, 0.05, 1.0, "brake coil inductance"),
    _log("J_m", "kg*m^2", 5e-5, 1e-5, 2e-4, "motor inertia"),
    _log("B_m", "N*m*s/rad", 1e-4, 1e-5, 3e-3, "motor viscous damping"),
    _log("J_b", "kg*m^2", 2e-5, 3e-6, 1e-4, "brake inertia"),
    _log("gamma", "1/rad", 40.0, 5.0, 500.0, "hysteresis shape"),
    _log("beta", "1/rad", 30.0, 5.0, 500.0, "hysteresis shape"),
    _log("A", "1/rad", 100.0, 10.0, 1000.0, "hysteresis stiffness"),
    _log("alpha0", "N*m", 0.02, 2e-3, 0.5, "hysteretic torque at zero current"),
    _log("alpha1", "N*m/A", 4.0, 0.5, 50.0, "hysteretic torque per ampere"),
    _log("c0", "N*m*s/rad", 2e-4, 1e-5, 1e-2, "brake viscous damping at zero current"),
    _log("c1", "N*m*s/(rad*A)", 2e-3, 1e-4, 5e-2, "brake viscous damping per ampere"),
    Parameter("K_v2i", "A/V", 0.5, 0.4, 0.6, fixed=True, description="amplifier gain"),
    Parameter(
        "n_c", "1", -1.0, -2.0, 2.0, fixed=True, minimum=-100.0, maximum=100.0,
        description="transmission ratio of the motor; -1 is a direct coupling",
    ),
)  # fmt: skip


def _at(name: str) -> int:
    return [parameter.name for parameter in PARAMETERS].index(name)


_GAMMA, _BETA = _at("gamma"), _at("beta")

CONSTRAINTS = (
    Constraint("gamma - beta >= 0 (Bouc-Wen class 1)", lambda p: p[_BETA] - p[_GAMMA]),
    Constraint("gamma + beta >= 0 (Bouc-Wen class 1)", lambda p: -p[_BETA] - p[_GAMMA]),
)


def actuator(exponent: float = 1.0) -> ProcessModel:
    """Seven-state actuator: closed-loop drivers, motor, brake coil, Bouc-Wen hysteresis.

    Inputs are the applied commands and the measured load torque; outputs the two currents and
    the shaft speed. exponent: n of (3.14).
    """
    hysteresis = bouc_wen_rate(exponent)

    def derivative(x: Any, u: Any, p: Any) -> tuple[Any, ...]:
        v_m, v_b, i_m, i_b, omega, z, _theta = x
        command_m, command_b, torque = u
        (
            K_dm, omega_dm, K_db, omega_db, R_m, L_m, K_m, R_b, L_b, J_m, B_m, J_b,
            gamma, beta, A, alpha0, alpha1, c0, c1, K_v2i, n_c,
        ) = p  # fmt: skip
        inertia = n_c * n_c * J_m + J_b
        resisting = brake_torque(i_b, omega, z, alpha0, alpha1, c0, c1)
        return (
            closed_loop_driver(v_m, i_m, command_m, K_dm, omega_dm, K_v2i),
            closed_loop_driver(v_b, i_b, command_b, K_db, omega_db, K_v2i),
            winding(i_m, v_m, -n_c * K_m * omega, R_m, L_m),
            winding(i_b, v_b, 0.0, R_b, L_b),
            (-n_c * K_m * i_m - n_c * n_c * B_m * omega - resisting + torque) / inertia,
            hysteresis(omega, z, gamma, beta, A),
            omega,
        )

    return ProcessModel(
        name="actuator",
        description="closed-loop drivers, DC motor, MR brake with Bouc-Wen hysteresis",
        states=STATES,
        inputs=INPUTS,
        outputs=(
            Output("current_motor", "A"),
            Output("current_brake", "A"),
            Output("omega", "rad/s"),
        ),
        parameters=PARAMETERS,
        derivative=derivative,
        constraints=CONSTRAINTS,
    )
