"""Every part's energy balance along trajectories of the whole plant.

The states are the model's; the powers beside them come from the equations written out once
more. A torque, voltage or force that acts on one side only, or with another size, opens the
balance of the part it belongs to.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.sim_rig import equations
from tests.sim_rig.support import Parts, follow

POWERS = (
    "motor supply", "motor heat", "back-EMF", "brake supply", "brake heat",
    "motor", "bearings", "brake", "brake lost", "brake current", "brushes",
    "hand", "wrist", "hand lost", "shaft to cable", "cable to mass", "cable lost",
    "mass to stop", "stop lost",
)  # fmt: skip


def powers(parts, q, x, u):
    """Powers [W] by name, at one instant."""
    n_c, omega, i_m, i_b = q["n_c"], x["omega"], x["current_motor"], x["current_brake"]
    limit = equations.SUPPLY if parts.limits else math.inf
    found = dict.fromkeys(POWERS, 0.0)
    found["motor supply"] = equations.within(x["voltage_motor"], limit) * i_m
    found["motor heat"] = q["R_m"] * i_m**2
    found["back-EMF"] = -n_c * q["K_m"] * omega * i_m
    found["brake supply"] = equations.within(x["voltage_brake"], limit) * i_b
    found["brake heat"] = q["R_b"] * i_b**2
    found["motor"] = -n_c * q["K_m"] * i_m * omega
    found["bearings"] = n_c**2 * q["B_m"] * omega**2
    found["brake"] = sum(equations.brake_torque(parts, q, x)) * omega
    # What bent bristles hold, alpha z^2 / (2 slope), changes with z and with the current.
    slope = bristle_slope(q)
    z_rate = sum(equations.hysteresis_rate(parts, q, omega, x["z"]))
    i_rate = sum(equations.electrical_rates(parts, q, x, u)["current_brake"])
    found["brake lost"] = found["brake"] - bristle_alpha(q, i_b) * x["z"] * z_rate / slope
    found["brake current"] = (
        q["alpha1"] * math.copysign(1.0, i_b) * i_rate * x["z"] ** 2 / (2.0 * slope)
    )
    found["brushes"] = sum(equations.brush_torque(parts, q, x)) * omega
    if "hand" in parts.load:
        stretch, closing = u["hand_theta"] - x["theta"], u["hand_omega"] - omega
        torque = u["hand_grip"] * (q["B_u"] * closing + q["K_u"] * stretch)
        found["hand"], found["wrist"] = torque * omega, torque * u["hand_omega"]
        found["hand lost"] = u["hand_grip"] * q["B_u"] * closing**2
    if "pulley" in parts.load:
        tension, stop = equations.cable_tension(q, x), equations.stop_force(q, x)
        wound = equations.cable_lever(q, x) * omega
        found["shaft to cable"] = tension * wound
        found["cable to mass"] = tension * x["speed"]
        stretching = q["k_cable"] * equations.cable_stretch(q, x) * (wound - x["speed"])
        found["cable lost"] = tension * (wound - x["speed"]) - stretching
        found["mass to stop"] = stop * x["speed"]
        pressing = q["k_cable"] * max(0.0, x["height"] - q["length"]) * x["speed"]
        found["stop lost"] = stop * x["speed"] - pressing
    return found


def bristle_slope(q):
    """dz/dtheta at z = 0."""
    return q.get("A", q.get("sigma", 1.0))


def bristle_alpha(q, i_b):
    return q["alpha0"] + q["alpha1"] * np.abs(i_b)


def stored(parts, q, x, u):
    """Energies [J] by what holds them; x and u hold whole trajectories."""
    height = x.get("height", 0.0)
    found = {
        "motor winding": 0.5 * q["L_m"] * x["current_motor"] ** 2,
        "coil": 0.5 * q["L_b"] * x["current_brake"] ** 2,
        "shaft": 0.5 * equations.total_inertia(parts, q) * x["omega"] ** 2,
        "bristles": bristle_alpha(q, x["current_brake"]) * x["z"] ** 2 / (2.0 * bristle_slope(q)),
        "mass": 0.0 * x["omega"],
        "cable": 0.0 * x["omega"],
        "stop": 0.0 * x["omega"],
        "hand": 0.0 * x["omega"],
    }
    if "pulley" in parts.load:
        path = q["radius"] * (np.hypot(x["theta"], equations.CROSSOVER) - equations.CROSSOVER)
        found["mass"] = 0.5 * q["mass"] * x["speed"] ** 2 + q["mass"] * equations.GRAVITY * height
        found["cable"] = 0.5 * q["k_cable"] * np.maximum(path - height, 0.0) ** 2
        found["stop"] = 0.5 * q["k_cable"] * np.maximum(height - q["length"], 0.0) ** 2
    if "hand" in parts.load:
        found["hand"] = 0.5 * u["hand_grip"] * q["K_u"] * (u["hand_theta"] - x["theta"]) ** 2
    return found


# What each part's energy changes by: what it takes from others, what it gives and loses.
BALANCES = {
    "motor winding": ("+motor supply", "-motor heat", "-back-EMF"),
    "coil": ("+brake supply", "-brake heat"),
    "shaft": (
        "+motor", "-bearings", "-brake", "-brushes", "+hand", "-shaft to cable",
    ),
    "bristles": ("+brake", "-brake lost", "+brake current"),
    "cable": ("+shaft to cable", "-cable to mass", "-cable lost"),
    "mass": ("+cable to mass", "-mass to stop"),
    "stop": ("+mass to stop", "-stop lost"),
    "hand": ("+wrist", "-hand", "-hand lost"),
}  # fmt: skip
NEVER_GIVE = (
    "motor heat", "brake heat", "bearings", "brake lost", "brushes", "hand lost", "cable lost",
    "stop lost",
)  # fmt: skip


def wave(motor, brake, grip=0.0, wrist=0.0):
    """Inputs over time by name: sines, and a wrist whose speed is its angle's."""

    def inputs(t):
        return {
            "applied_voltage_motor": motor * math.sin(40.0 * t) + motor * math.sin(130.0 * t),
            "applied_voltage_brake": brake * (1.0 - math.cos(60.0 * t)),
            "hand_grip": grip,
            "hand_theta": wrist * math.sin(25.0 * t),
            "hand_omega": 25.0 * wrist * math.cos(25.0 * t),
        }

    return inputs


# Parts, inputs, parameters, initial states, and what must have moved.
CASES = {
    "wound mass, limits": (
        Parts(exponent=2.0, friction="cyclic", load="pulley", sensor="between", limits=True),
        wave(6.0, 0.1),
        {},
        {"theta": 4.0, "height": 0.015, "speed": 0.5},
        ("motor", "brake", "brushes", "cable lost"),
    ),
    "winding into the stop": (
        Parts("open", "open", "dahl", load="pulley"),
        wave(3.0, 0.02),
        {"length": 0.016, "n_c": -2.0, "J_m": 2e-5},
        {"theta": 3.0, "omega": 60.0, "height": 0.014, "speed": 0.3},
        ("stop lost", "cable lost", "mass to stop"),
    ),
    "hand and mass, smooth": (
        Parts("closed", "open", "lugre", 1.0, True, "stribeck", "pulley+hand", limits=True),
        wave(2.0, 0.2, 1.0, 1.5),
        {"epsilon0": 2e-3, "length": 0.1},
        {"theta": 1.0, "height": 0.004, "z": 0.02},
        ("hand lost", "wrist", "brake lost", "brushes"),
    ),
    "hand, geared motor": (
        Parts("open", "closed", "bouc-wen", 1.5, friction="stribeck", load="hand"),
        wave(4.0, 0.1, 0.7, 1.0),
        {"n_c": 3.0, "J_m": 1e-5, "B_m": 2e-3},
        {"theta": 0.5, "omega": -20.0},
        ("bearings", "back-EMF", "hand lost"),
    ),
}


@pytest.mark.soak
@pytest.mark.parametrize("case", CASES)
def test_every_parts_energy_balance_closes(case):
    parts, inputs, changes, start, moved = CASES[case]
    model = parts.build(parameters="rig")
    names = model.state_names
    q = dict(zip(model.parameter_names, model.vector(changes), strict=True))

    def beside(t, x):
        at = dict(zip(names, x, strict=True))
        return list(powers(parts, q, at, inputs(t)).values())

    def given(t):
        return tuple(inputs(t)[name] for name in model.input_names)

    found = follow(
        model, given, 0.15, changes, start, beside, rtol=1e-9, atol=1e-12, max_step=1e-3,
        times=np.linspace(0.0, 0.15, 301),
    )  # fmt: skip
    x = {name: found[name] for name in names}
    rows = [inputs(t) for t in found.t]
    u = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    energy = stored(parts, q, x, u)
    work = dict(zip(POWERS, found.extra, strict=True))
    for part, terms in BALANCES.items():
        expected = sum(float(f"{term[0]}1") * work[term[1:]] for term in terms)
        change = energy[part] - energy[part][0]
        size = max(np.abs(work[term[1:]]).max() for term in terms) + np.ptp(energy[part])
        error = np.abs(change - expected).max()
        assert error <= 2e-6 * size, f"{part}: {error} of {size}"
    for name in NEVER_GIVE:
        assert np.all(np.diff(work[name]) >= -1e-9 * np.abs(work[name]).max()), name
    for name in moved:
        assert np.ptp(work[name]) > 1e-5, name
    # What goes in as electricity and by the wrist is stored, or lost as heat, or turned by the
    # changing current into the bristles' energy.
    into = work["motor supply"] + work["brake supply"] + work["wrist"] + work["brake current"]
    lost = sum(work[name] for name in NEVER_GIVE)
    whole = sum(energy.values())
    error = np.abs(whole - whole[0] - (into - lost)).max()
    assert error <= 2e-6 * (np.abs(into).max() + np.ptp(whole))
