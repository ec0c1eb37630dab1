"""The actuator's equations as text, for people: one line each, in the parameters' names.

They say again what the functions of the parts compute; a test evaluates them against those.
Currents, voltages and commands have the symbols of the thesis, i, v and u with an index m (motor)
or b (brake).
"""

from __future__ import annotations

from sim_rig.options import DriverKind, FrictionKind, HysteresisKind, LoadKind


def equations(
    driver_motor: DriverKind,
    driver_brake: DriverKind,
    hysteresis: HysteresisKind,
    smooth: bool,
    exponent: float,
    friction: FrictionKind,
    load: LoadKind,
) -> tuple[str, ...]:
    """Equations of the actuator with these parts, between the limits of its amplifiers."""
    rubs = () if friction == "none" else (f"tau_f = {_friction(friction)}",)
    rate = _rate(hysteresis, smooth, exponent)
    resisting = _SHARED if hysteresis != "lugre" else f"{_SHARED} + {_DEFLECTION}"
    return (
        _driver(driver_motor, "m"),
        _driver(driver_brake, "b"),
        "L_m di_m/dt = v_m - R_m*i_m + n_c*K_m*omega",
        "L_b di_b/dt = v_b - R_b*i_b",
        f"dz/dt = {rate}",
        f"tau_b = {resisting}",
        *rubs,
        _shaft(load, bool(rubs)),
        "dtheta/dt = omega",
        _WHERE,
        *([_OF_LOAD] if load not in ("measured", "free", "locked") else []),
    )


_WHERE = (
    "u: commands, v: voltages and i: currents of motor (m) and brake (b); z: hysteresis; "
    "theta: angle"
)
_OF_LOAD = "tau_load and J_load: torque and inertia of the load"
_SHARED = "(alpha0 + alpha1*|i_b|)*z + (c0 + c1*|i_b|)*omega"
_DEFLECTION = "(epsilon0 + epsilon1*|i_b|)*(dz/dt)"


def _driver(kind: DriverKind, index: str) -> str:
    if kind == "closed":
        return (
            f"dv_{index}/dt = omega_d{index}*(K_d{index}*(K_v2i*u_{index} - i_{index}) - v_{index})"
        )
    return f"dv_{index}/dt = omega_d{index}*(G_d{index}*u_{index} - v_{index})"


def _rate(kind: HysteresisKind, smooth: bool, exponent: float) -> str:
    """What dz/dt is."""
    if kind == "bouc-wen":
        return _smooth_bouc_wen(exponent) if smooth else _bouc_wen(exponent)
    exact, smoothed = {
        "dahl": ("sigma*(omega - |omega|*z)", "sigma*omega*(1 - z*tanh(rho*omega))"),
        "lugre": ("omega - zeta*|omega|*z", "omega - zeta*omega*tanh(rho*omega)*z"),
    }[kind]
    return smoothed if smooth else exact


def _bouc_wen(exponent: float) -> str:
    if exponent == 1.0:
        return "A*omega - gamma*|omega|*z - beta*omega*|z|"
    return f"A*omega - |z|^{exponent - 1.0:g}*(gamma*|omega|*z + beta*omega*|z|)"


def _smooth_bouc_wen(exponent: float) -> str:
    power = "" if exponent == 1.0 else f"^{exponent:g}"
    return f"omega*(A - (z*tanh(rho*z)){power}*(beta + gamma*tanh(rho*omega*z)))"


def _friction(kind: FrictionKind) -> str:
    level = "F_c + (F_s - F_c)*exp(-(omega/omega_s)^2)"
    if kind == "cyclic":
        level += " + F_cos*cos(cycles*theta) + F_sin*sin(cycles*theta)"
    return f"({level})*tanh(omega/omega_r) + B_f*omega"


def _shaft(kind: LoadKind, rubs: bool) -> str:
    if kind == "locked":
        return "domega/dt = 0"
    inertia = "n_c^2*J_m + J_b"
    torque = "-n_c*K_m*i_m - n_c^2*B_m*omega - tau_b" + " - tau_f" * rubs
    if kind == "measured":
        torque += " + torque"
    elif kind != "free":
        inertia, torque = f"{inertia} + J_load", f"{torque} + tau_load"
    return f"({inertia}) domega/dt = {torque}"
