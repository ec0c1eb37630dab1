"""Named sets of parameter values: table 4.1 of the thesis, and the simulated rig's own.

Each value of the rig has the reason for it beside it. "Assumed" ones stand in no data sheet.
Identification models have none of them unless a set is named.
"""

from sim_rig.physics.electrical import FOLDBACK
from sim_rig.physics.options import Design, ParameterSet

# Motor and its driver; what a row does not name stays as the rig has it.
TABLE_4_1 = {
    "A": {"K_dm": 10.0, "omega_dm": 400.0, "R_m": 1.18, "L_m": 4.80e-3, "K_m": 0.141},
    "B": {"K_dm": 29.6, "omega_dm": 1046.0, "R_m": 3.44, "L_m": 0.912e-3, "K_m": 0.373},
    "C": {"K_dm": 112.0, "omega_dm": 1828.0, "R_m": 6.61, "L_m": 1.18e-3, "K_m": 0.0597},
    "D": {"K_dm": 379.0, "omega_dm": 4517.0, "R_m": 0.255, "L_m": 0.768e-3, "K_m": 0.0985},
}

RIG = {
    "R_m": 1.18,  # row A of table 4.1 (data sheet)
    "L_m": 1.18e-3,  # row C of table 4.1
    "K_m": 0.353 / 2.5,  # rating: 0.353 N*m at 2.5 A
    "R_b": 24.0 / 0.19,  # rating: 24 V coil at 0.19 A
    "L_b": 0.1,  # assumed: 0.8 ms, a small coil without a solid core
    "J_m": 7e-5,  # assumed: rotor of a 57 mm motor
    "B_m": 8e-5,  # assumed: bearings lose under 1 % of the rated torque
    "J_b": 3.2e-5,  # assumed: half the motor's, a 70 mm disc in powder
    "F_c": 0.015,  # assumed: brushes that spoil a fit, as in figure 4.4; 2 % of the brake's torque
    "F_s": 0.022,  # assumed: half as much again, as for dry metal
    "omega_s": 3.0,  # assumed: of the order of a revolution in two seconds
    "B_f": 5e-5,  # assumed: less than the bearings
    "F_cos": 0.006,  # assumed: a worn ring, half of F_c in all
    "F_sin": 0.004,  # assumed: see F_cos
    "K_v2i": 0.5,  # amplifier data sheet
    "R_om": 0.1,  # amplifier data sheet: under 0.2 ohm
    "R_ob": 0.1,  # the same amplifier
    "n_c": -1.0,  # motor and brake on one shaft
}

_DRIVERS_MOTOR = {
    "closed": {
        "K_dm": 120.0,  # of the order of row C; leaves 0.99 of the 0.5 A/V at rest
        "omega_dm": 1828.0,  # row C of table 4.1
    },
    "open": {
        "G_dm": 0.5 * 1.18,  # assumed: at rest the same amperes per volt as the current amplifier
        "omega_dm": 1828.0,  # row C of table 4.1
    },
}

_DRIVERS_BRAKE = {
    "closed": {
        "K_db": 13000.0,  # assumed: leaves 0.99 of the 0.5 A/V into 126 ohm
        "omega_db": 30.5,  # assumed: an integrator-like loop that stays below 24 V
    },
    "open": {
        "G_db": 0.5 * 24.0 / 0.19,  # assumed: at rest the same amperes per volt
        "omega_db": 1828.0,  # assumed: the same amplifier as the motor's
    },
}

_RESIDUAL = 0.014  # N*m, assumed: residual torque 2 % of the rated one
_RATED = 0.6779  # N*m at 0.19 A: rating
_YIELD = 60.0 / 48.0  # z at which the Bouc-Wen brake slides, whatever its exponent

_PER_AMPERE = (_RATED - _RESIDUAL) / 0.19

# The same brake in each of the models: rated and residual torque, stiffness at rest, damping.
_VISCOUS = {
    "c0": 1.2e-4,  # assumed: viscous part small against the hysteretic
    "c1": 6e-4,  # assumed: see c0
}
_BRAKES = {
    "bouc-wen": _VISCOUS
    | {
        "gamma": 28.0,  # assumed: with beta, class 1 and rate-independent
        "beta": 20.0,  # assumed: see gamma
        "A": 60.0,  # assumed: yields after about 20 mrad
        "alpha0": _RESIDUAL / _YIELD,
        "alpha1": _PER_AMPERE / _YIELD,
    },
    "dahl": _VISCOUS | {"sigma": 48.0, "alpha0": _RESIDUAL, "alpha1": _PER_AMPERE},
    "lugre": _VISCOUS
    | {
        "zeta": 48.0,
        "alpha0": _RESIDUAL * 48.0,
        "alpha1": _PER_AMPERE * 48.0,
        "epsilon0": 1e-4,  # assumed: as small as the viscous part
        "epsilon1": 6e-4,  # assumed: see epsilon0
    },
}


_FURTHER = 3.0  # assumed: cutoffs of a higher order, in parts of the least that is stable


def _further_cutoffs(values: dict[str, float], index: str) -> dict[str, float]:
    """Cutoffs of a higher order at which an amplifier's loop with its winding is stable.

    With R, L of the winding, gain K and first cutoff w1, (R + L s)(1 + s/w1 + s^2/(w1 w2)) + K is
    stable, by Routh, above about w2 = (R + K) w1 / (L w1 + R).
    """
    K, cutoff = values.get(f"K_d{index}", FOLDBACK), values[f"omega_d{index}"]
    R, L = values[f"R_{index}"], values[f"L_{index}"]
    second = _FURTHER * (R + K) * cutoff / (L * cutoff + R)
    return {f"omega_d{index}2": second, f"omega_d{index}3": 2.0 * second}


def named(name: ParameterSet, design: Design) -> dict[str, float]:
    """Values of a named set for a design's parts, by parameter; "nominal" changes none."""
    if name == "nominal":
        return {}
    drivers = _DRIVERS_MOTOR[design.driver_motor] | _DRIVERS_BRAKE[design.driver_brake]
    rig = RIG | drivers | _BRAKES[design.hysteresis]
    for shape in {"gamma", "beta"} & set(rig):
        rig[shape] *= _YIELD ** (1.0 - design.exponent)
    rig |= TABLE_4_1.get(name, {})
    return rig | _further_cutoffs(rig, "m") | _further_cutoffs(rig, "b")
