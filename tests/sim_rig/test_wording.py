"""The actuator's equations as people read them are those that are computed."""

import itertools
import math
import re

import numpy as np
import pytest

from sim_rig.actuator import actuator

FUNCTIONS = {"abs": abs, "tanh": math.tanh, "exp": math.exp, "cos": math.cos, "sin": math.sin}
FUNCTIONS["sat"] = lambda value, limit: min(max(value, -limit), limit)
SYMBOLS = {"voltage_motor": "v_m", "voltage_brake": "v_b", "current_motor": "i_m"}
SYMBOLS |= {"current_brake": "i_b"}
SIZES = {"voltage": 5.0, "current_motor": 1.0, "current_brake": 0.1, "omega": 3.0, "z": 0.5}


def symbol(state):
    """``voltage_motor_2`` is v_m2 in the text."""
    name, _, number = state.rpartition("_") if state[-1].isdigit() else (state, "", "")
    return SYMBOLS.get(name, name) + number


def evaluated(text, known):
    python = re.sub(r"\|([^|]*)\|", r"abs(\1)", text.replace("^", "**"))
    python = python.replace("dz/dt", "dz_dt")
    return eval(python, {"__builtins__": {}}, FUNCTIONS | known)


def derivative(model, x, u):
    """The text's own: definitions first, then each dX/dt."""
    symbols = [symbol(name) for name in model.state_names]
    known = dict(zip(symbols, x, strict=True))
    known |= dict(zip(("u_m", "u_b", "torque"), u, strict=False))
    known |= dict(zip(model.parameter_names, model.nominal, strict=True))
    pairs = [line.split(" = ") for line in model.equations if " = " in line]
    slopes = {}
    # The rate of z stands in LuGre's torque, the torques in the shaft's equation.
    order = sorted(pairs, key=lambda pair: (pair[0] != "dz/dt", "/dt" in pair[0]))
    for left, right in order:
        found = re.fullmatch(r"(?:(.+) )?d(\w+)/dt", left)
        if found is None:
            known[left] = evaluated(right, known)
            continue
        slope = evaluated(right, known) / (evaluated(found[1], known) if found[1] else 1.0)
        slopes[found[2]] = slope
        known[f"d{found[2]}_dt"] = slope
    return np.array([slopes[name] for name in symbols])


CASES = [
    *(
        {"hysteresis": kind, "smooth": smooth, "friction": friction}
        for kind, smooth, friction in itertools.product(
            ("bouc-wen", "dahl", "lugre"), (False, True), ("none", "stribeck", "cyclic")
        )
    ),
    {"exponent": 1.5},
    {"exponent": 2.0, "smooth": True},
    {"driver_motor": "open"},
    {"driver_brake": "open", "load": "free"},
    {"order_motor": 2, "output_resistance_brake": True},
    {"driver_motor": "open", "order_motor": 3, "order_brake": 2, "output_resistance_motor": True},
    {"limits": True},
    {"limits": True, "driver_motor": "open", "driver_brake": "open", "order_brake": 2},
]


@pytest.mark.parametrize("options", CASES, ids=str)
def test_the_text_says_what_is_computed(options):
    model = actuator(**options)
    if "F_cos" in model.parameter_names:
        model = model.with_parameters(F_cos={"nominal": 0.01}, F_sin={"nominal": -0.004})
    rng = np.random.default_rng(1)
    for scale in (1.0, 1.0, 1.0, 20.0, 20.0):  # also beyond the ends of amplifiers
        sizes = [SIZES.get(name, SIZES.get(name[:7], 2.0)) for name in model.state_names]
        x = scale * rng.normal(size=len(sizes)) * sizes
        u = scale * rng.normal(size=len(model.inputs))
        computed = model.derivative(tuple(x.tolist()), tuple(u.tolist()), tuple(model.nominal))
        assert derivative(model, x.tolist(), u.tolist()) == pytest.approx(computed, rel=1e-9)


def test_ends_of_amplifiers_are_told_with_what_rests_on_them():
    plain, limited = actuator(), actuator(limits=True, driver_brake="open")
    assert plain.assumptions == () and not any("sat" in line for line in plain.equations)
    (sentence,) = limited.assumptions
    assert all(part in sentence for part in ("24 V", "2.5 A", "G_db", "R_b", "L_b"))
    assert "24 V and 2.5 A" in limited.description


def test_loads_of_their_own_are_named():
    assert any("tau_load" in line for line in actuator(load="pulley").equations)
    assert "domega/dt = 0" in actuator(load="locked").equations
