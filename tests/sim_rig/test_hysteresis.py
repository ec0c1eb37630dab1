"""The three hysteresis models: their loops in closed form, passivity, bounds, constraints."""

from __future__ import annotations

import itertools
import math
import random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from sim_rig.physics.hysteresis import hysteresis
from sysid import ModelError, SearchSpace
from tests.sim_rig.support import HYSTERESES, Parts

# One brake in each of the models; rho for the smooth forms, which the exact ones do without.
VALUES = {
    "bouc-wen": {"gamma": 28.0, "beta": 20.0, "A": 60.0, "alpha0": 0.02, "alpha1": 3.0},
    "dahl": {"sigma": 48.0, "alpha0": 0.02, "alpha1": 3.0},
    "lugre": {
        "zeta": 48.0, "alpha0": 0.8, "alpha1": 150.0, "epsilon0": 1e-4, "epsilon1": 6e-4,
    },
}  # fmt: skip
COMMON = {"c0": 1.2e-4, "c1": 6e-4, "rho": 100.0}
FORMS = [(kind, n, smooth) for kind, n in HYSTERESES for smooth in (False, True)]


class Brake:
    """One hysteresis model at given values."""

    def __init__(self, kind, exponent=1.0, smooth=False, **changes):
        self.kind, self.n, self.smooth = kind, exponent, smooth
        self.parts = hysteresis(kind, smooth, exponent)
        self.values = VALUES[kind] | COMMON | changes
        self.p = tuple(self.values[parameter.name] for parameter in self.parts.parameters)

    def rate(self, omega, z):
        return self.parts.rate(omega, z, self.p)

    def torque(self, current, omega, z):
        return self.parts.torque(current, omega, z, self.rate(omega, z), self.p)

    @property
    def sliding(self):
        """z at which it slides (3.25)."""
        if self.kind == "bouc-wen":
            v = self.values
            return (v["A"] / (v["beta"] + v["gamma"])) ** (1.0 / self.n)
        return 1.0 / self.values.get("zeta", 1.0)

    def stored(self, current, z):
        """alpha z^2 / 2 over the slope of z at z = 0: what the bent bristles hold [J]."""
        alpha = self.values["alpha0"] + self.values["alpha1"] * abs(current)
        slope = self.values.get("A", self.values.get("sigma", 1.0))
        return alpha * z * z / (2.0 * slope)

    def lost(self, current, omega, z):
        """Power that goes in and is not stored [W], at constant current."""
        slope = self.stored(current, 1.0) * 2.0
        return self.torque(current, omega, z) * omega - slope * z * self.rate(omega, z)

    def turn(self, speed, duration, start=0.0, current=0.1, times=None, max_step=0.01):
        """z over time at a prescribed speed(t), and the work done on the brake."""

        def rhs(t, x):
            omega = speed(t)
            return [self.rate(omega, x[0]), self.torque(current, omega, x[0]) * omega]

        found = solve_ivp(
            rhs, (0.0, duration), [start, 0.0], rtol=1e-8, atol=1e-11, max_step=max_step,
            t_eval=times,
        )  # fmt: skip
        assert found.success
        return found


# --- by hand --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("brake", "rate", "torque"),
    [
        # 60*2 - 28*2*0.5 - 20*2*0.5; (0.02 + 3*0.1)*0.5 + (1.2e-4 + 6e-5)*2
        (Brake("bouc-wen"), 72.0, 0.16036),
        # 60*2 - 28*2*0.25 - 20*2*0.25
        (Brake("bouc-wen", 2.0), 96.0, 0.16036),
        # 48*2*(1 - 0.5)
        (Brake("dahl"), 48.0, 0.16036),
        # 2 - 48*2*0.5; (0.8 + 15)*0.5 + 1.8e-4*2 + (1e-4 + 6e-5)*(-46)
        (Brake("lugre"), -46.0, 7.9 + 3.6e-4 - 7.36e-3),
    ],
    ids=lambda value: value.kind if isinstance(value, Brake) else "",
)
def test_rate_and_torque_by_hand(brake, rate, torque):
    assert brake.rate(2.0, 0.5) == pytest.approx(rate, rel=1e-12)
    assert brake.torque(0.1, 2.0, 0.5) == pytest.approx(torque, rel=1e-12)


def test_the_smooth_rates_by_hand():
    values = {"rho": 0.5}
    # omega = 2, z = 0.5: tanh(rho z) = tanh 0.25, tanh(rho omega z) = tanh 0.5, tanh(rho omega)
    # = tanh 1.
    size = math.tanh(0.25) * 0.5
    expected = {
        ("bouc-wen", 1.0): 2.0 * (60.0 - size * (20.0 + 28.0 * math.tanh(0.5))),
        ("bouc-wen", 2.0): 2.0 * (60.0 - size**2 * (20.0 + 28.0 * math.tanh(0.5))),
        ("dahl", 1.0): 96.0 * (1.0 - 0.5 * math.tanh(1.0)),
        ("lugre", 1.0): 2.0 - 48.0 * 2.0 * math.tanh(1.0) * 0.5,
    }
    for (kind, n), rate in expected.items():
        assert Brake(kind, n, True, **values).rate(2.0, 0.5) == pytest.approx(rate, rel=1e-12)


@pytest.mark.parametrize(("kind", "n", "smooth"), FORMS)
@settings(max_examples=50)
@given(omega=st.floats(-30.0, 30.0), z=st.floats(-2.0, 2.0), current=st.floats(-0.3, 0.3))
def test_the_brake_is_the_same_in_both_directions_and_for_both_signs_of_the_current(
    kind, n, smooth, omega, z, current
):
    brake = Brake(kind, n, smooth)
    assert brake.rate(-omega, -z) == pytest.approx(-brake.rate(omega, z), rel=1e-12, abs=1e-300)
    torque = brake.torque(current, omega, z)
    assert brake.torque(current, -omega, -z) == pytest.approx(-torque, rel=1e-12, abs=1e-300)
    assert brake.torque(-current, omega, z) == torque


@pytest.mark.parametrize(("kind", "n"), HYSTERESES)
@settings(max_examples=50)
@given(omega=st.floats(-30.0, 30.0), z=st.floats(-2.0, 2.0), faster=st.floats(0.01, 100.0))
def test_the_exact_hysteresis_depends_on_the_path_and_not_on_the_rate(kind, n, omega, z, faster):
    brake = Brake(kind, n)
    expected = faster * brake.rate(omega, z)
    assert brake.rate(faster * omega, z) == pytest.approx(expected, rel=1e-9, abs=1e-12)


# --- loops in closed form -------------------------------------------------------------------


@pytest.mark.parametrize("direction", [1.0, -1.0])
@pytest.mark.parametrize(("kind", "n", "smooth"), FORMS)
def test_sliding_ends_at_the_yield_point_in_both_directions(kind, n, smooth, direction):
    brake = Brake(kind, n, smooth)
    end = brake.turn(lambda t: 3.0 * direction, 0.3).y[0, -1]
    assert end == pytest.approx(direction * brake.sliding, rel=1e-6)
    assert brake.rate(3.0 * direction, direction * brake.sliding) == pytest.approx(0.0, abs=1e-9)


ANGLES = np.linspace(0.0, 0.04, 40)


@pytest.mark.parametrize(("kind", "n"), [("bouc-wen", 1.0), ("dahl", 1.0), ("lugre", 1.0)])
def test_the_virgin_curve_is_an_exponential_of_the_angle(kind, n):
    brake = Brake(kind, n)
    # dz/dtheta = slope - slope/sliding z.
    slope = {"bouc-wen": 60.0, "dahl": 48.0, "lugre": 1.0}[kind]
    found = brake.turn(lambda t: 2.0, 0.02, times=ANGLES / 2.0).y[0]
    expected = brake.sliding * (1.0 - np.exp(-slope / brake.sliding * ANGLES))
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-9)


def test_the_virgin_curve_of_exponent_two_is_a_hyperbolic_tangent():
    found = Brake("bouc-wen", 2.0).turn(lambda t: 2.0, 0.02, times=ANGLES / 2.0).y[0]
    expected = math.sqrt(60.0 / 48.0) * np.tanh(math.sqrt(60.0 * 48.0) * ANGLES)
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(
    ("kind", "slope", "growth"),
    [("bouc-wen", 60.0, 8.0), ("dahl", 48.0, 48.0), ("lugre", 1.0, 48.0)],
)
def test_turning_back_from_sliding_unloads_along_its_own_exponential(kind, slope, growth):
    """dz/dphi = -(slope + growth z) while z is positive, growth = gamma - beta for Bouc-Wen."""
    brake = Brake(kind)
    angle = np.linspace(0.0, 0.9 / growth * math.log(1.0 + growth * brake.sliding / slope), 30)
    found = brake.turn(lambda t: -2.0, angle[-1] / 2.0, start=brake.sliding, times=angle / 2.0).y[0]
    expected = (brake.sliding + slope / growth) * np.exp(-growth * angle) - slope / growth
    assert expected[-1] > 0.0
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-9 * brake.sliding)


@given(omega=st.floats(-30.0, 30.0), z=st.floats(-2.0, 2.0), current=st.floats(-0.3, 0.3))
def test_dahl_is_bouc_wen_without_beta_and_lugre_without_epsilon_is_dahl_in_radians(
    omega, z, current
):
    dahl = Brake("dahl", sigma=50.0)
    bouc_wen = Brake("bouc-wen", gamma=50.0, beta=0.0, A=50.0)
    assert bouc_wen.rate(omega, z) == pytest.approx(dahl.rate(omega, z), rel=1e-9, abs=1e-9)
    assert bouc_wen.torque(current, omega, z) == dahl.torque(current, omega, z)
    for smooth in (False, True):
        dahl = Brake("dahl", smooth=smooth, sigma=64.0)
        scaled = {"zeta": 64.0, "alpha0": 64.0 * 0.02, "alpha1": 64.0 * 3.0}
        lugre = Brake("lugre", smooth=smooth, epsilon0=0.0, epsilon1=0.0, **scaled)
        rate = 64.0 * lugre.rate(omega, z / 64.0)
        assert rate == pytest.approx(dahl.rate(omega, z), rel=1e-9, abs=1e-9)
        torque = lugre.torque(current, omega, z / 64.0)
        assert torque == pytest.approx(dahl.torque(current, omega, z), rel=1e-9, abs=1e-12)


# --- passivity and bounds -------------------------------------------------------------------


@st.composite
def feasible(draw, kind, n, smooth):
    """A brake within the constraints of section 3.4.2."""
    positive = st.floats(0.1, 10.0)
    changes = {name: value * draw(positive) for name, value in (VALUES[kind] | COMMON).items()}
    if kind == "bouc-wen":
        changes["beta"] = changes["gamma"] * draw(st.floats(-1.0, 1.0))
    return Brake(kind, n, smooth, **changes)


@pytest.mark.parametrize(("kind", "n", "smooth"), FORMS)
@settings(max_examples=50)
@given(data=st.data())
def test_at_constant_current_the_brake_never_gives_more_than_it_stored(kind, n, smooth, data):
    """Bouc-Wen and Dahl for every z, LuGre for those it can reach: |z| <= 1/zeta.

    The smooth Bouc-Wen form turns with tanh(rho omega z), which is late by 1/rho: it may give
    back up to alpha/A |z|^n gamma/rho max x (1 - tanh x).
    """
    brake = data.draw(feasible(kind, n, smooth))
    omega, current = data.draw(st.floats(-40.0, 40.0)), data.draw(st.floats(-0.3, 0.3))
    share = data.draw(st.floats(-1.0, 1.0))
    z = share * (brake.sliding if kind == "lugre" else 3.0 * brake.sliding)
    allowance = 0.0
    if (kind, smooth) == ("bouc-wen", True):
        v = brake.values
        alpha_A = 2.0 * brake.stored(current, 1.0)
        allowance = 0.2785 * alpha_A * abs(z) ** n * v["gamma"] / v["rho"]
    rounding = 1e-12 * (
        abs(brake.torque(current, omega, z) * omega)
        + abs(2.0 * brake.stored(current, 1.0) * z * brake.rate(omega, z))
    )
    assert brake.lost(current, omega, z) >= -allowance - rounding


def test_the_smooth_bouc_wen_form_does_give_a_little_back_where_it_turns():
    """What the allowance above is for; the exact form does not."""
    given_back = [
        Brake("bouc-wen", smooth=smooth, c0=0.0, c1=0.0).lost(0.1, -0.005, 1.0)
        for smooth in (True, False)
    ]
    assert given_back[0] < -1e-5 < 0.0 <= given_back[1]


def motions(seed, count):
    """Random smooth speeds: a few sines."""
    rng = random.Random(seed)
    for _ in range(count):
        sines = [
            (rng.gauss(0.0, 4.0), 2 * math.pi * rng.uniform(0.2, 8.0), rng.uniform(0.0, 6.3))
            for _ in range(5)
        ]
        yield lambda t, sines=sines: sum(a * math.sin(w * t + phase) for a, w, phase in sines)


@pytest.mark.parametrize(("kind", "n", "smooth"), FORMS)
def test_along_a_motion_the_brake_is_passive_and_z_stays_bounded(kind, n, smooth):
    """From starts below and, for the two that are passive there, above the sliding z."""
    shares = [0.0, -0.8] if kind == "lugre" else [0.5, -1.5]
    for speed, share, current, beta in zip(
        motions(1, 2), shares, [0.05, 0.19], [20.0, -20.0], strict=True
    ):
        changes = {"beta": beta} if kind == "bouc-wen" else {}
        brake = Brake(kind, n, smooth, rho=1e4, **changes)
        start = share * brake.sliding
        found = brake.turn(speed, 0.5, start, current)
        z, work = found.y
        lost = work - (brake.stored(current, z) - brake.stored(current, start))
        assert np.all(np.diff(lost) >= -1e-7)
        assert lost[-1] > 1e-3
        largest = max(abs(start), brake.sliding)
        # The smooth forms get past it while their speed is about 1/rho.
        assert np.abs(z).max() <= largest * (1.0 + (2e-3 if smooth else 1e-6))
        assert np.ptp(z) > 0.2 * brake.sliding


def test_creeping_a_smooth_form_slides_further_than_the_exact_one():
    """Below a speed of 1/rho the smooth sign is small, and the bound of (3.25) with it."""
    speed = 0.5 / 100.0
    sign = math.tanh(0.5)
    for kind in ("dahl", "lugre"):
        brake = Brake(kind, smooth=True)
        end = brake.turn(lambda t: speed, 120.0, max_step=1.0).y[0, -1]
        assert end == pytest.approx(brake.sliding / sign, rel=1e-5)
        assert end > 2.0 * brake.sliding
    brake = Brake("bouc-wen", smooth=True)
    end = brake.turn(lambda t: speed, 120.0, max_step=1.0).y[0, -1]
    assert end * (20.0 + 28.0 * math.tanh(100.0 * speed * end)) == pytest.approx(60.0, rel=1e-5)
    assert end > 1.2 * brake.sliding


@pytest.mark.parametrize(("kind", "n"), HYSTERESES)
def test_the_smooth_forms_approach_the_exact_ones_as_rho_grows(kind, n):
    """Along one motion: each decade of rho by nearly two decades, until the solver's tolerance."""
    times = np.linspace(0.0, 0.5, 200)
    (speed,) = motions(3, 1)
    exact = Brake(kind, n).turn(speed, 0.5, times=times).y[0]
    distances = []
    for rho in (1.0, 10.0, 100.0):
        smooth = Brake(kind, n, smooth=True, rho=rho).turn(speed, 0.5, times=times).y[0]
        distances.append(np.sqrt(np.mean((smooth - exact) ** 2)) / np.sqrt(np.mean(exact**2)))
    assert all(after < before / 30.0 for before, after in itertools.pairwise(distances))
    assert distances[0] > 0.01


# --- constraints ----------------------------------------------------------------------------

NEGATIVE_TORQUE = [
    ("alpha", {"alpha0": -1e-6, "alpha1": 1.0}, 1e-6),
    ("alpha", {"alpha0": 0.019, "alpha1": -0.1 - 1e-5}, 0.19e-5),
    ("c(i_b)", {"c0": -2e-6, "c1": 0.0}, 2e-6),
    ("c(i_b)", {"c0": 1.9e-4, "c1": -1.001e-3}, 1.9e-7),
]
OUTSIDE = [
    ("bouc-wen", "gamma - beta", {"gamma": 20.0, "beta": 20.001}, 0.001),
    ("bouc-wen", "gamma + beta", {"gamma": 20.0, "beta": -20.001}, 0.001),
    *((kind, *case) for kind in ("bouc-wen", "dahl", "lugre") for case in NEGATIVE_TORQUE),
    ("lugre", "epsilon", {"epsilon0": -1e-6, "epsilon1": 1e-6}, 1e-6),
    ("lugre", "epsilon", {"epsilon0": 1.9e-5, "epsilon1": -1.01e-4}, 1.9e-7),
]
INSIDE = [
    ("bouc-wen", "gamma - beta", {"gamma": 20.001, "beta": 20.0}),
    ("bouc-wen", "gamma - beta", {"gamma": 20.0, "beta": 20.0}),
    ("bouc-wen", "gamma + beta", {"gamma": 20.001, "beta": -20.0}),
    *(
        (kind, *case)
        for kind in ("bouc-wen", "dahl", "lugre")
        for case in [
            ("alpha", {"alpha0": 1e-6, "alpha1": 0.0}),
            ("alpha", {"alpha0": 0.019, "alpha1": -0.1 + 1e-5}),
            ("c(i_b)", {"c0": 1.9e-4, "c1": -0.999e-3}),
        ]
    ),
    ("lugre", "epsilon", {"epsilon0": 1.9e-5, "epsilon1": -0.99e-4}),
]


def by_text(model, start):
    (found,) = [c for c in model.constraints if c.text.startswith(start)]
    return found


@pytest.mark.parametrize("smooth", [False, True])
@pytest.mark.parametrize(("kind", "text", "changes", "size"), OUTSIDE)
def test_just_outside_a_constraint_it_is_violated_by_how_much_it_is(
    kind, text, changes, size, smooth
):
    model = Parts(hysteresis=kind, smooth=smooth, friction="cyclic").build()
    violated = by_text(model, text)
    row = model.vector(changes)
    assert violated.function(tuple(row)) == pytest.approx(size, rel=1e-6)
    others = [c for c in model.constraints if c is not violated]
    assert all(constraint.function(tuple(row)) <= 0.0 for constraint in others)


@pytest.mark.parametrize("smooth", [False, True])
@pytest.mark.parametrize(("kind", "text", "changes"), INSIDE)
def test_just_inside_a_constraint_it_is_not(kind, text, changes, smooth):
    model = Parts(hysteresis=kind, smooth=smooth, friction="cyclic").build()
    value = by_text(model, text).function(tuple(model.vector(changes)))
    assert -0.02 < value <= 0.0


@given(
    constant=st.floats(-1.0, 1.0), per_ampere=st.floats(-10.0, 10.0), seed=st.integers(0, 2**32 - 1)
)
def test_a_torque_that_turns_negative_anywhere_up_to_the_rated_current_is_a_violation(
    constant, per_ampere, seed
):
    model = Parts(hysteresis="lugre").build()
    currents = np.linspace(0.0, 0.19, 50)
    for text, zero, slope in (
        ("alpha", "alpha0", "alpha1"),
        ("c(i_b)", "c0", "c1"),
        ("epsilon", "epsilon0", "epsilon1"),
    ):
        row = model.vector({zero: constant, slope: per_ampere})
        lowest = np.min(constant + per_ampere * currents)
        found = by_text(model, text).function(tuple(row))
        assert found == pytest.approx(-lowest, rel=1e-12, abs=1e-15)
    # A column of a population is as each of its rows.
    rng = np.random.default_rng(seed)
    rows = model.nominal * rng.uniform(-1.0, 2.0, (5, len(model.nominal)))
    for constraint in model.constraints:
        column = constraint.function(tuple(rows.T))
        assert column.shape == (5,)
        np.testing.assert_array_equal(column, [constraint.function(tuple(row)) for row in rows])


@pytest.mark.parametrize("kind", ["bouc-wen", "dahl", "lugre"])
def test_a_search_space_reports_the_violations(kind):
    model = Parts(hysteresis=kind, smooth=True, friction="stribeck").build()
    space = SearchSpace.of(model)
    cases = [(changes, size) for k, _text, changes, size in OUTSIDE if k == kind]
    rows = np.array([model.vector(changes)[list(space.index)] for changes, _size in cases])
    found = space.violations(rows)
    of_limits, of_model = np.split(found, [-len(model.constraints)], axis=1)
    np.testing.assert_allclose(of_model.sum(axis=1), [size for _changes, size in cases], rtol=1e-6)
    # A negative coefficient is by itself outside its physical limits.
    below = np.where(rows < 0.0, -rows, 0.0)
    np.testing.assert_allclose(of_limits, np.hstack([below, 0.0 * below]))
    nominal = model.nominal[list(space.index)]
    assert np.all(space.violations(nominal[None]) == 0.0)


# --- what there is not ----------------------------------------------------------------------


@pytest.mark.parametrize("exponent", [0.5, 0.999, -1.0, math.nan, math.inf])
def test_an_exponent_below_one_is_refused(exponent):
    with pytest.raises(ModelError, match="exponent must be at least 1"):
        hysteresis("bouc-wen", exponent=exponent)


@pytest.mark.parametrize("kind", ["dahl", "lugre"])
def test_an_exponent_belongs_to_bouc_wen(kind):
    with pytest.raises(ModelError, match=f"not {kind}"):
        hysteresis(kind, exponent=2.0)
