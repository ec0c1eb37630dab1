"""Structural identifiability: published answers, answers by hand, and simulations that agree."""

import itertools
import math
import re

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sim_rig.actuator import actuator
from sysid import (
    Input,
    ModelError,
    Output,
    Parameter,
    ProcessModel,
    SearchSpace,
    State,
    identifiability,
)
from sysid.identifiability import null_directions
from tests.soak import mostly_soak


def process(states, inputs, parameters, derivative, outputs, output=None, starts=None):
    """A dimensionless model; starts: known values by state, else all of them are unknown."""
    known = starts or {}
    return ProcessModel(
        "published",
        [
            State(name, "1", known[name], first_sample=False)
            if name in known
            else State(name, "1", 1.0, initial_range=(0.5, 2.0))
            for name in states.split()
        ],
        [Input(name, "1") for name in inputs.split()],
        [Output(name, "1") for name in outputs.split()],
        [Parameter(name, "1", 0.7, 0.2, 2.0, "log") for name in parameters.split()],
        derivative,
        output,
    )


@pytest.mark.parametrize(
    "derivative",
    [
        lambda x, u, p: ((p[0] * u[0] - x[0]) / 0.2,),
        lambda x, u, p: (p[0] * u[0] / 3.0 - 0.1 * x[0] * 0.7,),
        lambda x, u, p: (p[0] * ((u[0] ** 2 + 1.0) / 0.3) ** 0.3 - x[0] / 0.7,),
    ],
)
def test_constants_that_no_binary_fraction_is_part_nothing(derivative):
    model = process("x", "u", "a b", derivative, "y", lambda x, u, p: (p[1] * x[0],))
    directions = null_directions(model, model.nominal, ["a", "b"], ["x"])
    assert directions.shape == (1, 3)  # the product of both stays, their nominal values being alike
    assert directions[0, 0] == pytest.approx(-directions[0, 1])


def goodwin(x, u, p):
    b, c, alpha, beta, gama, delta, sigma = p
    rate = gama * x[1] - delta * x[2]
    return (
        -b * x[0] + 1.0 / (c + x[3]),
        alpha * x[0] - beta * x[1],
        rate,
        sigma * x[3] * rate / x[2],
    )


def hiv(x, u, p):
    lm, d, beta, a, k, virus, c, q, b, h = p
    T, y, v, w, z = x
    return (
        lm - d * T - beta * T * v,
        beta * T * v - a * y,
        k * y - virus * v,
        c * T * y * w - c * q * y * w - b * w,
        c * q * y * w - h * z,
    )


def pharmacokinetics(x, u, p):
    a1, a2, b1, b2, ka, kc, n = p
    bound = kc * ka + kc * x[2] + ka * x[0]
    return (
        a1 * (x[1] - x[0]) - ka * n * x[0] / bound,
        a2 * (x[0] - x[1]),
        b1 * (x[3] - x[2]) - kc * n * x[2] / bound,
        b2 * (x[2] - x[3]),
    )


def network(x, u, p):
    k1, k2, k3, k4, k5, k6 = p
    r1, r2 = k1 * x[0] * x[1], k6 * x[2] * x[4]
    return (
        -r1 + k2 * x[3] + k4 * x[5],
        -r1 + (k2 + k3) * x[3],
        k3 * x[3] + k5 * x[5] - r2,
        r1 - (k2 + k3) * x[3],
        (k4 + k5) * x[5] - r2,
        -(k4 + k5) * x[5] + r2,
    )


def mammillary(x, u, p):
    k01, k02, k03, k12, k21, k13, k31 = p
    return (
        u[0] + k12 * x[1] + k13 * x[2] - (k01 + k21 + k31) * x[0],
        k21 * x[0] - (k02 + k12) * x[1],
        k31 * x[0] - (k03 + k13) * x[2],
    )


def two_compartments(x, u, p):
    k01, k21, k12, k02 = p
    return u[0] + k12 * x[1] - (k01 + k21) * x[0], k21 * x[0] - (k02 + k12) * x[1]


AT_REST = {"x1": 0.0, "x2": 0.0, "x3": 0.0}

# What is identifiable by itself, and what of the rest, as the literature has it.
PUBLISHED = {
    # Tuncer & Le, "Structural and practical identifiability analysis of outbreak models", 2018.
    "SIR, a share of the infected": (
        process(
            "S I", "", "beta N K gamma",
            lambda x, u, p: (
                -p[0] * x[0] * x[1] / p[1],
                p[0] * x[0] * x[1] / p[1] - p[3] * x[1],
            ),
            "y", lambda x, u, p: (p[2] * x[1],),
        ),
        {"gamma"},
        {"K S(0)", "K I(0)", "beta / (N K)"},
    ),
    # A textbook case: the predators may be counted in any unit.
    "Lotka and Volterra, the prey": (
        process(
            "prey predator", "", "a b c d",
            lambda x, u, p: (p[0] * x[0] - p[1] * x[0] * x[1], p[3] * x[0] * x[1] - p[2] * x[1]),
            "prey",
        ),
        {"a", "c", "d", "prey(0)"},
        {"b predator(0)"},
    ),
    # StructuralIdentifiability.jl, benchmark "Goodwin oscillator".
    "Goodwin": (
        process("x1 x2 x3 x4", "", "b c alpha beta gama delta sigma", goodwin, "x1"),
        {"b", "c", "beta", "delta", "sigma", "x1(0)", "x4(0)"},
        {"alpha / x2(0)", "alpha gama / x3(0)"},
    ),
    # StructuralIdentifiability.jl, benchmark "HIV2" (Wodarz & Nowak 1999); outputs w and z.
    "HIV with an immune response": (
        process("T y v w z", "", "lm d beta a k virus c q b h", hiv, "w z"),
        {"a", "b", "d", "h", "virus", "w(0)", "z(0)"},
        {"lm / q", "beta v(0)", "lm^2 c", "lm / T(0)", "lm / y(0)", "lm beta k"},
    ),
    # Xia & Moog, "Identifiability of nonlinear systems with application to HIV/AIDS models", 2003.
    "HIV, the virus alone": (
        process(
            "T I V", "", "s d beta delta p c",
            lambda x, u, p: (
                p[0] - p[1] * x[0] - p[2] * x[0] * x[2],
                p[2] * x[0] * x[2] - p[3] * x[1],
                p[4] * x[1] - p[5] * x[2],
            ),
            "V",
        ),
        {"d", "beta", "delta", "c", "V(0)"},
        {"s p", "s / T(0)", "s / I(0)"},
    ),
    # Verdiere et al. 2005, benchmark "Pharm" of StructuralIdentifiability.jl: all of it.
    "pharmacokinetics": (
        process("x0 x1 x2 x3", "", "a1 a2 b1 b2 ka kc n", pharmacokinetics, "x0"),
        {"a1", "a2", "b1", "b2", "ka", "kc", "n", "x0(0)", "x1(0)", "x2(0)", "x3(0)"},
        set(),
    ),
    # Conradi & Shiu 2018, benchmark "CRN" of StructuralIdentifiability.jl: all of it.
    "chemical reaction network": (
        process("x1 x2 x3 x4 x5 x6", "", "k1 k2 k3 k4 k5 k6", network, "x2 x3"),
        {f"k{i}" for i in range(1, 7)} | {f"x{i}(0)" for i in range(1, 7)},
        set(),
    ),
    # Godfrey, "Compartmental Models and Their Application", 1983.
    "two compartments, both leaking": (
        process("x1 x2", "u", "k01 k21 k12 k02", two_compartments, "x1", starts=AT_REST),
        set(),
        {"k01 + k21", "k21 k12", "k12 + k02"},
    ),
    "two compartments, one leaking, volume unknown": (
        process(
            "x1 x2", "u", "k01 k21 k12 V",
            lambda x, u, p: (
                u[0] + p[2] * x[1] - (p[0] + p[1]) * x[0],
                p[1] * x[0] - p[2] * x[1],
            ),
            "y", lambda x, u, p: (x[0] / p[3],), AT_REST,
        ),
        {"k01", "k21", "k12", "V"},
        set(),
    ),
    # Cobelli & DiStefano, "Parameter and structural identifiability concepts and ambiguities",
    # 1980: of a mammillary model the exchanges' products and the sums of rates out.
    "three compartments, all leaking": (
        process("x1 x2 x3", "u", "k01 k02 k03 k12 k21 k13 k31", mammillary, "x1", starts=AT_REST),
        set(),
        {"k02 + k12", "k03 + k13", "k12 k21", "k13 k31", "k01 + k21 + k31"},
    ),
    # Chis et al., "Structural identifiability of systems biology models", 2011: the start, of a
    # drug that saturates its elimination, and its scale.
    "Michaelis and Menten": (
        process(
            "x", "", "V_m K_m c",
            lambda x, u, p: (-p[0] * x[0] / (p[1] + x[0]),),
            "y", lambda x, u, p: (p[2] * x[0],),
        ),
        set(),
        {"V_m / K_m", "V_m c", "V_m / x(0)"},
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", PUBLISHED)
def test_published_answers(name):
    model, identifiable, combinations = PUBLISHED[name]
    result = identifiability(model)
    assert set(result.identifiable) == identifiable
    assert {c.text for group in result.tied for c in group.combinations} == combinations
    assert all(len(group.combinations) == group.count for group in result.tied)
    assert not result.unseen
    assert result.gap > 200.0


def motor(sign):
    """A motor with R known and no inductance, voltage in, speed out, dry and viscous friction."""

    def derivative(x, u, p):
        R, K, J, B, Tc = p
        current = (u[0] - K * x[0]) / R
        return ((K * current - B * x[0] - Tc * sign(x[0])) / J,)

    return ProcessModel(
        "motor",
        [State("omega", "rad/s")],
        [Input("voltage", "V")],
        [Output("omega", "rad/s")],
        [
            Parameter("R", "ohm", 1.3, 1.3, 1.3, fixed=True),
            Parameter("K", "N*m/A", 0.05, 0.01, 0.2, "log"),
            Parameter("J", "kg*m^2", 1e-5, 1e-6, 1e-4, "log"),
            Parameter("B", "N*m*s/rad", 1e-5, 1e-7, 1e-3, "log"),
            Parameter("Tc", "N*m", 1e-2, 1e-3, 1e-1, "log"),
        ],
        derivative,
    )


SIGNS = {
    "jump": lambda omega: 1.0 if omega > 0.0 else -1.0,
    "NumPy's": np.sign,
    "smooth": lambda omega: math.tanh(omega / 0.1),
}


@pytest.mark.parametrize("sign", SIGNS.values(), ids=SIGNS)
def test_a_relation_that_is_neither_product_nor_sum(sign):
    model = motor(sign)
    (group,) = identifiability(model).tied
    texts = {c.text: c for c in group.combinations}
    assert set(texts) == {"K / J", "K / Tc", "K + R B / K"}
    feedback = texts["K + R B / K"]
    assert feedback.unit == "N*m/A"
    values = dict(zip(model.parameter_names, model.nominal, strict=True))
    assert feedback.value(values) == pytest.approx(0.05 + 1.3 * 1e-5 / 0.05)
    assert feedback.gradient(values) == pytest.approx(
        {"K": 1.0 - 1.3 * 1e-5 / 0.05**2, "B": 1.3 / 0.05}
    )
    assert group.fix == ("K",)


def test_equal_combinations_are_equal_simulations():
    """Other parameters with the same K / J, K / Tc and K + R B / K give the same speed."""
    model = motor(SIGNS["smooth"])
    (group,) = identifiability(model).tied
    before = dict(zip(model.parameter_names, model.nominal, strict=True))
    K = 0.0502  # and with it, by hand, all the others
    feedback = 0.05 + 1.3 * 1e-5 / 0.05
    ratio = K / 0.05
    after = {"R": 1.3, "K": K, "J": 1e-5 * ratio, "Tc": 1e-2 * ratio, "B": (feedback - K) * K / 1.3}
    for combination in group.combinations:
        assert combination.value(after) == pytest.approx(combination.value(before), rel=1e-12)

    def speed(values):
        p = tuple(values[name] for name in model.parameter_names)
        return solve_ivp(
            lambda t, x: model.derivative(x, (3.0 * math.sin(40.0 * t),), p),
            (0.0, 0.5), [0.2], method="LSODA", rtol=1e-10, atol=1e-10,
        ).y[0, -1]  # fmt: skip

    assert speed(after) == pytest.approx(speed(before), rel=1e-6)
    assert speed({**before, "K": K}) != pytest.approx(speed(before), rel=1e-4)


def expected(design):
    """Of an actuator with a measured load: what is identifiable, and the combinations of the rest.

    The coil's voltage is seen nowhere but at its limit. An output resistance is in series with the
    winding's, and further cutoffs of an amplifier are seen like the first. Inertias and dampings on
    one shaft add.
    Bouc-Wen's z has no unit of its own: with exponent n, z may be scaled by s, A by s, alpha by
    1/s, gamma and beta by s^(1-n), unless rho z is compared with one.
    """
    alone = {"K_dm" if design["driver_motor"] == "closed" else "G_dm", "omega_dm", "omega_db"}
    alone |= {"R_m", "L_m", "K_m", "c1"}
    together = {"J_m + J_b", "B_m + c0"}
    gain = "K_db" if design["driver_brake"] == "closed" else "G_db"
    alone |= {f"omega_dm{n}" for n in range(2, design["order_motor"] + 1)}
    alone |= {f"omega_db{n}" for n in range(2, design["order_brake"] + 1)}
    if design["output_resistance_motor"]:
        alone -= {"R_m"}
        together |= {"R_m + R_om"}
    coil = "R_b + R_ob" if design["output_resistance_brake"] else "R_b"
    if design["limits"]:
        alone |= {"L_b", gain} | ({coil} & {"R_b"})
        together |= {coil} - {"R_b"}
    else:
        together |= {f"({coil}) / L_b", f"L_b / {gain}"}
    if design["friction"] != "none":
        alone |= {"F_c", "F_s", "omega_s"}
    if design["friction"] == "cyclic":
        alone |= {"F_cos", "F_sin"}
    if design["hysteresis"] == "dahl":
        return alone | {"sigma", "alpha0", "alpha1", "z(0)"}, together
    if design["hysteresis"] == "lugre":
        stiffness = {"alpha0", "alpha1", "epsilon0", "epsilon1"}
        return alone | stiffness | {"zeta", "z(0)"}, together
    if design["smooth"]:
        return alone | {"gamma", "beta", "A", "alpha0", "alpha1", "z(0)"}, together
    together |= {"A alpha1", "alpha1 / alpha0", "alpha1 z(0)"}
    return alone | {"gamma", "beta"}, together


PARTS = {
    "driver_motor": ("closed", "open"),
    "driver_brake": ("closed", "open"),
    "hysteresis": ("bouc-wen", "dahl", "lugre"),
    "smooth": (False, True),
    "friction": ("none", "stribeck", "cyclic"),
    "limits": (False, True),
    "order_motor": (1, 2, 3),
    "order_brake": (1, 2, 3),
    "output_resistance_motor": (False, True),
    "output_resistance_brake": (False, True),
}
DESIGNS = [dict(zip(PARTS, parts, strict=True)) for parts in itertools.product(*PARTS.values())]
CHECKED = DESIGNS[::965]


@pytest.mark.soak
def test_the_actuator():
    """All that is said of it, in the words of a report."""
    result = identifiability(actuator())
    alone, _together = expected(DESIGNS[0])
    assert set(result.identifiable) == alone
    assert {c.text: c.unit for group in result.tied for c in group.combinations} == {
        "R_b / L_b": "1/s",
        "R_b / K_db": "1",
        "J_m + J_b": "kg*m^2",
        "B_m + c0": "N*m*s/rad",
        "A alpha1": "N*m/(rad*A)",
        "alpha1 / alpha0": "1/A",
        "alpha1 z(0)": "N*m/A",
    }
    assert {group.fix: dict(group.sensors) for group in result.tied} == {
        ("R_b",): {"voltage_brake": ("R_b", "L_b", "K_db")},
        ("J_m",): {},
        ("B_m",): {},
        ("alpha1",): {"z": ("alpha1", "A", "alpha0", "z(0)")},
    }


@pytest.mark.soak
def test_an_output_resistance_acts_only_with_the_windings():
    design = {"output_resistance_motor": True, "order_motor": 2}
    result = identifiability(actuator(**design))
    (group,) = (group for group in result.tied if "R_om" in group.parameters)
    assert group.parameters == ("R_m", "R_om")
    assert [(c.text, c.unit) for c in group.combinations] == [("R_m + R_om", "ohm")]
    assert not group.sensors  # no signal of the model separates them
    assert {"omega_dm", "omega_dm2", "K_dm", "L_m"} <= set(result.identifiable)


def gradient(text, values):
    """Of a combination in words, by central differences of the parameters' logarithms."""
    code = re.sub(r"(?<=\w) (?=\w)", "*", text.replace("z(0)", "z"))

    def moved(name, factor):
        return eval(code, {**values, name: values[name] * factor})

    return np.array([moved(name, 1 + 1e-6) - moved(name, 1 - 1e-6) for name in values])


def test_what_is_checked_has_each_choice_of_each_part():
    assert {item for d in CHECKED for item in d.items()} == {
        item for d in DESIGNS for item in d.items()
    }


# Of all 5184 these have each choice (see the test above).
@pytest.mark.parametrize(
    "design",
    mostly_soak(CHECKED),
    ids=lambda d: "-".join(map(str, d.values())),
)
def test_combinations_of_the_actuator(design):
    """As many directions as the hand says, along which no combination changes that it says."""
    model = actuator(**design)
    rng = np.random.default_rng(7)
    point = np.array([p.nominal * np.exp(rng.uniform(-0.5, 0.5)) for p in model.parameters])
    free = [p.name for p in model.parameters if not p.fixed]
    for i, p in enumerate(model.parameters):
        point[i] = p.nominal if p.fixed else point[i] or 0.01
    basis = null_directions(model, point, free, ["z"], np.array([[0.3]]))
    values = dict(
        zip([*free, "z"], [*point[[not p.fixed for p in model.parameters]], 0.3], strict=False)
    )
    alone, together = expected(design)
    unmoved = {name for name, column in zip(values, basis.T, strict=True) if not column.any()}
    assert unmoved == {name.removesuffix("(0)") for name in alone}
    assert len(basis) == len(values) - len(alone) - len(together)
    steps = basis / list(values.values())
    for text in together:
        slope = gradient(text, values)
        turn = np.abs(steps @ slope) / (np.linalg.norm(steps, axis=1) * np.linalg.norm(slope))
        assert np.all(turn < 1e-8)


def test_without_a_load_all_forces_scale():
    """No torque is measured then, so that twice the masses with twice the forces move alike.

    The motor constant is in both equations of the motor, so its voltage scales as well.
    """
    model = actuator(load="free").with_initial({"z": 0.0})
    groups = {frozenset(group.parameters): group for group in identifiability(model).tied}
    motor = groups.pop(
        frozenset(
            ["K_dm", "R_m", "L_m", "K_m", "J_m", "B_m", "J_b", "A", "alpha0", "alpha1", "c0", "c1"]
        )
    )
    assert set(groups) == {frozenset({"R_b", "L_b", "K_db"})}
    # Forces, the bristle, and two sums.
    assert len(motor.directions) == len(motor.fix) == 4
    assert {c.text for c in motor.combinations} >= {"R_m / L_m", "J_m / R_m + J_b / R_m"}
    assert len(motor.combinations) == motor.count == 8


def equation(rate, y=None, outputs="y", **start):
    """dy/dt = rate(y, u, k, g) of y > 0, with the start known or measured."""
    return ProcessModel(
        "equation",
        [State("y", "m", **start)],
        [Input("u", "V")],
        [Output(name, "m") for name in outputs.split()],
        [Parameter(name, "1", 0.8, 0.2, 2.0, "log") for name in ("k", "g")],
        lambda x, u, p: (rate(x[0], u[0], *p),),
        y,
    )


FUNCTIONS = {
    "power": (lambda y, u, k, g: u - k * abs(y) ** (1.5 + g), {"k", "g"}),
    "root": (lambda y, u, k, g: u - k * math.sqrt(1.0 + y * y) + g * math.exp(-y), {"k", "g"}),
    "angle": (lambda y, u, k, g: u - math.atan2(k * y, g) + math.sin(y), set()),
    "staircase": (lambda y, u, k, g: k + g * math.floor(0.1 * u), {"k", "g"}),
    "jump": (lambda y, u, k, g: k + g * math.copysign(1.0, u), {"k", "g"}),
    "saturation": (lambda y, u, k, g: min(max(k * u, -30.0), 30.0) + min(u, g), {"k", "g"}),
    "far away": (lambda y, u, k, g: u - k * y - (g * y if y > 200.0 else 0.0), {"k", "g"}),
    "nowhere": (lambda y, u, k, g: u - k * y + g * (y - y), {"k"}),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_functions_and_branches(name):
    rate, alone = FUNCTIONS[name]
    for seed in range(5):
        result = identifiability(equation(rate), seed=seed)
        assert set(result.identifiable) == alone
        assert set(result.unseen) == ({"g"} if name == "nowhere" else set())


def test_what_shows_only_where_two_signs_differ():
    """Bouc-Wen's gamma and beta: from a start at zero z follows the motion, later it may oppose."""

    def bristle(z, omega, gamma, beta):
        return omega - gamma * abs(omega) * z - beta * omega * abs(z)

    model = equation(bristle, first_sample=False)
    for seed in range(8):
        assert identifiability(model, seed=seed).identifiable == ("k", "g")


def test_a_start_that_is_known_may_tell_what_another_does_not():
    def decay(start):
        return ProcessModel(
            "decay",
            [start],
            [],
            [Output("reading", "V")],
            [Parameter(name, "1", 0.8, 0.2, 2.0, "log") for name in ("k", "gain")],
            lambda x, u, p: (-p[0] * x[0],),
            lambda x, u, p: (p[1] * x[0],),
        )

    assert identifiability(decay(State("x", "m", 1.0))).identifiable == ("k", "gain")
    (group,) = identifiability(decay(State("x", "m", 1.0, initial_range=(0.5, 2.0)))).tied
    assert group.parameters == ("gain", "x(0)")
    assert group.combinations[0].text == "gain x(0)"
    assert group.combinations[0].unit == "m"
    assert group.sensors == {"x": ("gain", "x(0)")}


def test_starts_of_several_records_have_columns_of_their_own():
    model = actuator()
    free = ["A", "alpha0", "alpha1", "K_m"]
    starts = np.array([[0.5], [-2.0]])
    (direction,) = null_directions(model, model.nominal, free, ["z"], starts)
    values = [100.0, 0.02, 4.0, 1.0, 0.5, -2.0]
    shares = direction / values / (direction[0] / 100.0)
    assert shares == pytest.approx([1.0, -1.0, -1.0, 0.0, 1.0, 1.0])


@pytest.mark.soak
def test_ties_of_a_search_count():
    """With alpha1 known the bristle would have its unit; in a ratio to alpha0 it has not."""
    space = SearchSpace.of(actuator(), fixed={"R_b": 120.0}, tied={"alpha1": "200 * alpha0"})
    result = identifiability(space.as_model())
    assert {"L_b", "K_db"} <= set(result.identifiable)
    assert {group.parameters for group in result.tied} == {
        ("J_m", "J_b"),
        ("B_m", "c0"),
        ("A", "alpha0", "z(0)"),
    }


@pytest.mark.parametrize(
    ("rate", "cause"),
    [
        (lambda y, u, k, g: u - k * (1.0, 2.0)[int(abs(y)) % 2] * g, "int() argument"),
        (lambda y, u, k, g: u - k * math.lgamma(1.0 + y * y) * g, "math.lgamma"),
    ],
)
def test_equations_that_cannot_be_followed_are_refused(rate, cause):
    with pytest.raises(ModelError, match="cannot be followed") as refusal:
        identifiability(equation(rate))
    assert cause in str(refusal.value)
    assert "functions of math" in str(refusal.value)


def test_nothing_free_is_a_mistake():
    model = actuator()
    fixed = model.with_parameters(**{name: {"fixed": True} for name in model.parameter_names})
    with pytest.raises(ModelError, match="free at least one"):
        identifiability(fixed.with_initial({"z": 0.0}))
