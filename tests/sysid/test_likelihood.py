"""Where identifications end: weights by the outputs' own errors, and minima that look alike."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq, minimize_scalar

from benchmarks.coverage import _exact_record
from sim_rig.actuator import actuator
from sysid import GASSI, BatchSimulator, Dataset, Input, Output, Parameter, ProcessModel, State
from sysid.fitting.descent import Restriction
from sysid.fitting.objective import Objective
from sysid.fitting.refinement import refine
from sysid.gassi.likelihood import fit_likelihood
from sysid.gassi.lookalikes import lookalikes
from sysid.gassi.slide import centred, slid
from sysid.problem.space import SearchSpace
from sysid.response.linearization import jacobian
from sysid.uncertainty import uncertainty
from sysid.uncertainty.sensitivity import sensitivity
from sysid.uncertainty.ties import ties
from tests.sysid.support import Formula, prbs


def oscillator_derivative(x, u, p):
    frequency, damping, gain = p
    return (x[1], frequency * frequency * (gain * u[0] - x[0]) - 2.0 * damping * x[1])


def oscillator(frequency, low, high):
    return ProcessModel(
        name="oscillator",
        states=(State("x", "m"), State("v", "m/s")),
        inputs=(Input("u", "N"),),
        outputs=(Output("x", "m"),),
        parameters=(
            Parameter("frequency", "rad/s", frequency, low, high, "log"),
            Parameter("damping", "1/s", 60.0, 10.0, 300.0, "log"),
            Parameter("gain", "m/N", 1.0, 0.2, 5.0, "log"),
        ),
        derivative=oscillator_derivative,
    )


def lags_derivative(x, u, p):
    first, second = p
    return ((u[0] - x[0]) / first, (x[0] - x[1]) / second)


def lags(first=0.03, second=0.12):
    """Two lags in a row, of which only the end is seen: which is which cannot be told."""
    return ProcessModel(
        name="lags",
        states=(State("inside", "1"), State("end", "1")),
        inputs=(Input("u", "1"),),
        outputs=(Output("end", "1"),),
        parameters=(
            Parameter("first", "s", first, 0.005, 1.0, "log"),
            Parameter("second", "s", second, 0.005, 1.0, "log"),
        ),
        derivative=lags_derivative,
    )


def record_of(model, dt, n=400, noise=0.0, seed=0):
    rng = np.random.default_rng(seed)
    inputs = prbs(rng, n, -1.0, 1.0)[:, None]
    blank = Dataset(inputs, np.full((n, len(model.outputs)), np.nan), dt)
    outputs = BatchSimulator(model, accuracy=1e-6).trajectories(model.nominal, blank)[0]
    return Dataset(inputs, outputs + noise * rng.normal(size=outputs.shape), dt)


def objective_of(model, record):
    return Objective(BatchSimulator(model), SearchSpace.of(model), [record])


# --- lookalikes -----------------------------------------------------------------------------


def test_aliases_have_the_same_multiplier_over_a_sample():
    dt, frequency = 0.01, 900.0  # rings at 143 Hz, sampled at 100 Hz
    model = oscillator(frequency, 100.0, 5000.0)
    target = objective_of(model, record_of(model, dt))
    here = np.array([frequency, 60.0, 1.0])
    chromosomes = lookalikes(target, here)
    expected = np.exp(np.linalg.eigvals(jacobian(model, np.zeros(2), np.zeros(1), here)) * dt)
    frequencies = []
    for chromosome in chromosomes:
        values = np.linalg.eigvals(jacobian(model, np.zeros(2), np.zeros(1), chromosome))
        frequencies.append(round(float(np.abs(values.imag).max())))
        multipliers = np.exp(values * dt)
        np.testing.assert_allclose(
            np.sort_complex(multipliers), np.sort_complex(expected), atol=0.1 * abs(expected[0])
        )
    folded = 2.0 * np.pi / dt - np.sqrt(frequency**2 - 60.0**2)
    assert min(abs(np.array(frequencies) - abs(folded))) < 0.03 * frequency or folded < 450.0
    assert len(set(frequencies)) >= 2


def test_a_mode_that_nothing_free_acts_on_has_no_aliases():
    model = oscillator(900.0, 100.0, 5000.0)
    space = SearchSpace.of(model, fixed={"frequency": 900.0, "damping": 60.0})
    target = Objective(BatchSimulator(model), space, [record_of(model, 0.01)])
    assert lookalikes(target, np.array([1.0])) == []


def test_every_mode_that_sampling_hardly_sees_has_aliases():
    def derivative(x, u, p):
        return (
            x[1],
            p[0] ** 2 * (u[0] - x[0]) - 120.0 * x[1],
            x[3],
            p[1] ** 2 * (u[0] - x[2]) - 120.0 * x[3],
        )

    model = ProcessModel(
        name="two oscillators",
        states=tuple(State(name, "1", first_sample=False) for name in ("x", "v", "y", "w")),
        inputs=(Input("u", "1"),),
        outputs=(Output("x", "1"), Output("y", "1")),
        parameters=tuple(
            Parameter(name, "rad/s", value, 100.0, 5000.0, "log")
            for name, value in (("fast", 900.0), ("slow", 700.0))
        ),
        derivative=derivative,
    )
    starts = lookalikes(objective_of(model, record_of(model, 0.01)), model.nominal)
    rings, here = (np.sqrt(np.square(c) - 60.0**2) for c in (starts, model.nominal))
    moved = np.abs(rings / here - 1.0) > 0.1
    for place in (0, 1):
        aliases = rings[moved[:, place] & ~moved[:, 1 - place], place]
        assert len(aliases) >= 2
        assert np.cos(0.01 * aliases) == pytest.approx(np.cos(0.01 * here[place]), abs=0.02)


@pytest.mark.parametrize("resistance", [50.0, 95.0, 190.0])
def test_what_trades_places_beyond_a_tie_is_found_wherever_on_it_the_minimum_stands(resistance):
    """A driver of 60 rad/s behind which a coil decays at 500 1/s: gain, R and L act in proportion.

    With the rates swapped R may be 60 at most, for L has an end of its range at 1.
    """

    def derivative(x, u, p):
        rate, gain, r, inductance = p
        return (rate * (u[0] - x[0]), (gain * x[0] - r * x[1]) / inductance)

    model = ProcessModel(
        name="coil",
        states=(State("v", "V"), State("i", "A")),
        inputs=(Input("u", "V"),),
        outputs=(Output("i", "A"),),
        parameters=(
            Parameter("rate", "rad/s", 60.0, 5.0, 1000.0, "log"),
            Parameter("gain", "1", resistance, 1.0, 1000.0, "log"),
            Parameter("R", "ohm", resistance, 40.0, 200.0, "log"),
            Parameter("L", "H", resistance / 500.0, 0.05, 1.0, "log"),
        ),
        derivative=derivative,
    )
    target = objective_of(model, record_of(model, 1e-3, noise=0.01))
    starts = np.array(lookalikes(target, model.nominal))
    swapped = starts[starts[:, 0] > 300.0]
    assert len(swapped) >= 1
    for rate, gain, r, inductance in swapped:
        # The same transfer function: gain rate / ((s + rate) (L s + R)).
        assert (rate, r / inductance) == pytest.approx((500.0, 60.0), rel=1e-3)
        assert gain * rate / inductance == pytest.approx(60.0 * 500.0, rel=1e-3)


def test_an_amplifier_and_the_winding_in_its_loop_trade_their_rates():
    """With w for R/L and R/L for w a loop for the current is s^2 + (w + R/L) s + w (R + K)/L still.

    All but what the motor's speed takes out of it, which outputs of the actuator hardly tell.
    """
    model, rng, n = actuator(), np.random.default_rng(0), 400
    rig = actuator(parameters="rig")
    motor, brake = prbs(rng, n, -3.0, 3.0), prbs(rng, n, 0.0, 0.1)
    inputs = np.column_stack([motor, brake, 0.01 * rng.standard_normal(n)])
    simulator = BatchSimulator(model)
    blank = Dataset(inputs, np.full((n, 3), np.nan), 1.0 / 800.0)
    outputs = simulator.trajectories(rig.nominal, blank)[0]
    noise = 0.01 * np.abs(outputs).max(axis=0) * rng.standard_normal(outputs.shape)
    target = objective_of(model, replace(blank, outputs=outputs + noise))
    truth = dict(zip(rig.parameter_names, rig.nominal.tolist(), strict=True))
    parameters = [truth[name] for name in target.space.names[: len(target.space.index)]]
    here = target.space.with_nominal_starts(np.array(parameters))
    traded, place = here.copy(), target.space.names.index
    traded[place("omega_dm")] = truth["R_m"] / truth["L_m"]
    traded[place("L_m")] = truth["R_m"] / truth["omega_dm"]
    errors = target.evaluate(np.array([here, traded]))[0]
    assert errors[1] == pytest.approx(errors[0], rel=1e-2)
    starts = lookalikes(target, here)
    assert any(start == pytest.approx(traded, rel=1e-4) for start in starts)
    # Without noise a valley is narrow: only there is a start worth a try whatever its error.
    exact = objective_of(model, replace(blank, outputs=outputs))
    for narrow in (False, True):
        starts = lookalikes(exact, here, narrow=narrow)
        assert any(start == pytest.approx(traded, rel=1e-4) for start in starts) == narrow


def test_slow_models_have_no_aliases():
    model = oscillator(50.0, 5.0, 500.0)
    here = np.array([50.0, 20.0, 1.0])
    chromosomes = lookalikes(objective_of(model, record_of(model, 0.01)), here)
    mode = np.sqrt(50.0**2 - 20.0**2)
    for chromosome in chromosomes:
        values = np.linalg.eigvals(jacobian(model, np.zeros(2), np.zeros(1), chromosome))
        assert np.abs(values.imag).max() == pytest.approx(mode, rel=0.03)


@pytest.mark.parametrize("seed", range(3))
def test_a_minimum_among_aliases_is_found_from_any_other(seed):
    dt = 0.01
    model = oscillator(900.0, 300.0, 2000.0)
    record = record_of(model, dt, noise=0.002, seed=seed)
    target = objective_of(model, record)
    start = lookalikes(target, model.nominal)
    wrong = max(start, key=lambda c: float(target.evaluate(c[None])[0][0]))
    result = fit_likelihood(target, [wrong])
    # Under the noise an alias may explain the record as well; the truth is never left out.
    ends = [result.optimum.chromosome, *result.rivals]
    assert any(chromosome == pytest.approx(model.nominal, rel=0.1) for chromosome in ends)


# --- rivals ---------------------------------------------------------------------------------


def test_lags_change_places_through_parameters_of_unlike_units():
    """Of a motor by its speed alone: L J, R J + L B and R B + K^2 are all that it shows.

    With R and K known, L and R J / B, J and L B / R may change places.
    """
    R, K, L, J, B = 1.2, 0.1, 6e-3, 1.5e-4, 7.5e-3

    def range_of(name, unit, value):
        return Parameter(name, unit, 2.0 * value, value / 10.0, 10.0 * value, "log")

    motor = ProcessModel(
        name="motor",
        states=(State("current", "A"), State("omega", "rad/s")),
        inputs=(Input("voltage", "V"),),
        outputs=(Output("omega", "rad/s"),),
        parameters=(
            range_of("L", "H", L),
            range_of("J", "kg*m^2", J),
            range_of("B", "N*m*s/rad", B),
        ),
        derivative=lambda x, u, p: (
            (u[0] - R * x[0] - K * x[1]) / p[0],
            (K * x[0] - p[2] * x[1]) / p[1],
        ),
    )
    target = objective_of(motor, record_of(motor, 2e-3))
    exchanged = [R * J / B, L * B / R, B]
    starts = lookalikes(target, np.array([L, J, B]))
    assert any(start == pytest.approx(exchanged, rel=1e-2) for start in starts)


@pytest.mark.parametrize(("true", "stuck"), [(0.6, 1.02), (2.0, 0.7)], ids=["inside", "cut off"])
def test_ends_of_a_range_are_looked_beyond(true, stuck):
    """Where the amplifier ends at 1 V tells a scale of gain, R and L that nothing else does."""
    nominal = true * np.array([1.0, 1.0, 0.05])
    model = ProcessModel(
        name="coil",
        states=(State("current", "A"),),
        inputs=(Input("u", "1"),),
        outputs=(Output("current", "A"),),
        parameters=tuple(
            Parameter(name, unit, value, value / 10.0, 10.0 * value, "log")
            for name, unit, value in zip(
                ("gain", "R", "L"), ("V", "ohm", "H"), nominal, strict=True
            )
        ),
        derivative=lambda x, u, p: ((min(max(p[0] * u[0], -1.0), 1.0) - p[1] * x[0]) / p[2],),
    )
    target = objective_of(model, record_of(model, 0.01))
    here = nominal * stuck / true
    starts = np.array(lookalikes(target, here))
    scales = starts / here
    (start,) = starts[np.ptp(scales, axis=1) < 1e-3 * scales[:, 0]]
    assert target.evaluate(start[None])[0] < 0.8 * target.evaluate(here[None])[0]


@pytest.mark.soak
def test_lags_that_may_change_places_have_an_interval_for_each_answer():
    record = record_of(lags(), 0.01, noise=0.02)
    fitted = GASSI(lags(), population=40, generations=8).fit(record)
    here = sorted(fitted.parameters_[name] for name in ("first", "second"))
    assert here == pytest.approx([0.03, 0.12], rel=0.1)
    (rival,) = fitted.rivals_
    assert rival["first"] == pytest.approx(fitted.parameters_["second"], rel=1e-2)
    assert rival["second"] == pytest.approx(fitted.parameters_["first"], rel=1e-2)
    intervals = fitted.uncertainty(record)
    assert [estimate.why for estimate in intervals.parameters] == ["rival", "rival"]
    assert intervals.determined() == ()
    (other,) = intervals.rivals
    second = intervals.parameters[1]
    assert other.intervals["first"] == pytest.approx((second.low, second.high), rel=0.1)
    (ambiguity,) = intervals.ambiguities
    assert ambiguity.kind == "rival" and set(ambiguity.parameters) == {"first", "second"}


def test_an_excerpt_leads_to_the_rivals_of_all_samples():
    record = record_of(lags(), 0.01, n=6000, noise=0.1)
    fitted = GASSI(lags(), population=30, generations=6, search_samples=1024).fit(record)
    assert fitted.excerpt_ is not None
    (rival,) = fitted.rivals_
    assert rival["first"] == pytest.approx(fitted.parameters_["second"], rel=1e-2)
    assert rival["second"] == pytest.approx(fitted.parameters_["first"], rel=1e-2)


@pytest.mark.soak
def test_a_measured_one_tells_them_apart():
    record = record_of(lags(), 0.01, noise=0.02)
    fitted = GASSI(lags(), population=40, generations=8, fixed={"first": 0.03}).fit(record)
    (second,) = fitted.uncertainty(record).parameters
    assert fitted.rivals_ == [] and second.why == ""
    assert second.low < 0.12 < second.high


BOTH = {"a": 2.0, "b": 2.0}


def formula_objective(formula, truth, low, high, seed=0):
    """The objective of y = formula(p, u), its parameters searched linearly, and noise."""
    model = ProcessModel(
        name="formula",
        states=(State("x", "1"),),
        inputs=(Input("u0", "1"), Input("u1", "1")),
        outputs=(Output("x", "1"),),
        parameters=tuple(Parameter(name, "1", 2.0, low, high, minimum=-np.inf) for name in truth),
        derivative=twice_derivative,
    )

    def outputs(p, u):
        return formula(p, u)[:, None]

    rng = np.random.default_rng(seed)
    u = rng.standard_normal((300, 2))
    y = outputs(truth, u) + 0.1 * rng.standard_normal((300, 1))
    return Objective(Formula(model, outputs), SearchSpace.of(model), [Dataset(u, y, 0.01)])


def test_a_curved_valley_is_one_answer_and_its_hull_the_interval():
    target = formula_objective(lambda p, u: p["a"] * p["b"] * u[:, 0], BOTH, 0.5, 10.0)
    ends = [np.array([1.0, 4.0]), np.array([4.0, 1.0])]
    result = fit_likelihood(target, ends)
    assert result.rivals == () and len(result.ridge) == 1
    intervals = uncertainty(result.optimum.objective, result.optimum.chromosome, (), result.ridge)
    for j, estimate in enumerate(intervals.parameters):
        assert estimate.why in ("", "vague")
        assert (estimate.low or 0.5) <= min(end[j] for end in ends) + 0.1
        assert (estimate.high or 10.0) >= max(end[j] for end in ends) - 0.1


def bent(p, u):
    """Alike on both sides of a low wall but for what is hardly felt."""
    return 0.018 * ((p["a"] - 2.0) ** 2 - 1.0) * u[:, 0] + 0.0058 * p["a"] * u[:, 1]


@pytest.mark.parametrize("seed", [21, 28])  # of whose bottoms one is 6.5 and 3.9 behind
def test_every_bottom_of_a_valley_has_its_own_interval_within_the_whole(seed):
    target = formula_objective(bent, {"a": 3.0}, -5.0, 10.0, seed)
    result = fit_likelihood(target, [np.array([3.0]), np.array([1.0])])
    assert result.rivals == () and len(result.ridge) == 1
    best, (behind,) = result.optimum.chromosome, result.ridge
    (a,) = uncertainty(result.optimum.objective, best, (), result.ridge).parameters

    def beyond(place, bottom):  # twice the log-likelihood that is lost from there, above 3.84
        rms = target.rms(np.array([[place], bottom]))[:, 0]
        return 600.0 * np.log(rms[0] / rms[1]) - 3.84

    low, high = sorted([best, behind], key=lambda bottom: bottom[0])
    assert a.low == pytest.approx(brentq(beyond, low[0] - 2.0, low[0], (low,)), abs=0.1)
    assert a.high == pytest.approx(brentq(beyond, high[0], high[0] + 2.0, (high,)), abs=0.1)


def flatter(p, u):
    """As ``bent``, and beside it what is felt four times less at the other bottom."""
    share = 0.25 + 0.375 * (p["a"] - 1.0)
    return bent(p, u) + 0.1 * share * (p["k"] - 2.0) * u[:, 0] * u[:, 1]


def test_what_is_passed_on_of_a_valley_reaches_as_far_as_its_other_bottom_lets():
    target = formula_objective(flatter, {"a": 3.0, "k": 2.0}, -5.0, 10.0, 21)
    result = fit_likelihood(target, [np.array([3.0, 2.0]), np.array([1.0, 2.0])])
    assert len(result.ridge) == 1
    best = result.optimum.chromosome
    alone, whole = (uncertainty(target, best, (), ridge) for ridge in ([], result.ridge))
    (_, k), deviations = whole.parameters, [np.linalg.norm(r.factor[:, 1]) for r in (alone, whole)]
    farther = max(k.value - k.low, k.high - k.value)
    assert farther > 3.0 * 1.96 * deviations[0]
    assert 0.7 * farther < 1.96 * deviations[1] < 1.05 * farther


def test_minima_with_a_wall_between_them_are_rivals_each_with_an_interval():
    target = formula_objective(lambda p, u: p["a"] ** 2 * u[:, 0], BOTH, -5.0, 5.0)
    result = fit_likelihood(target, [np.array([2.0, 1.0]), np.array([-2.0, 1.0])])
    assert len(result.rivals) == 1 and result.ridge == ()
    intervals = uncertainty(result.optimum.objective, result.optimum.chromosome, result.rivals)
    a = intervals.parameters[0]
    (rival,) = intervals.rivals
    assert a.why == "rival" and a.low < abs(a.value) * np.sign(a.value) < a.high
    low, high = rival.intervals["a"]
    assert (low, high) == pytest.approx((-a.high, -a.low), rel=1e-3)
    # A minimum beside it, within its interval, is no further answer.
    beside = result.rivals[0] + [0.2 * (high - low), 0.0]
    both = [*result.rivals, beside]
    assert uncertainty(result.optimum.objective, result.optimum.chromosome, both).rivals == (rival,)


@pytest.mark.parametrize(("short", "why"), [(0.0, ""), (1.0, ""), (4.0, "rival")])
def test_a_rival_near_its_minimum_tells_how_far_a_quantity_of_both_may_be(short, why):
    """Of k the minima are two deviations apart; a descent stopped so many short of the second."""

    def formula(p, u):
        return p["a"] ** 2 * u[:, 0] + (p["k"] + 0.0029 * p["a"]) * u[:, 1]

    target, deviation = formula_objective(formula, {"a": 2.0, "k": 1.0}, -5.0, 5.0), 0.0058
    best, rival = (refine(target, np.array([a, 1.0])).chromosome for a in (2.0, -2.0))
    assert rival[1] - best[1] == pytest.approx(2.0 * deviation, rel=0.01)
    rival[1] += short * deviation
    a, k = uncertainty(target, best, [rival]).parameters
    assert (a.why, k.why) == ("rival", why)
    if not why:
        assert k.low == pytest.approx(best[1] - 1.96 * deviation, abs=0.2 * deviation)
        assert k.high == pytest.approx(rival[1] + 1.96 * deviation, abs=0.2 * deviation)


def test_what_the_data_tell_apart_is_no_rival():
    model = oscillator(900.0, 300.0, 2000.0)
    fitted = GASSI(model, population=40, generations=10).fit(record_of(model, 0.01, noise=0.001))
    assert fitted.rivals_ == []
    assert fitted.parameters_["frequency"] == pytest.approx(900.0, rel=0.01)


# --- weights --------------------------------------------------------------------------------


def twice_derivative(x, u, p):
    return (-x[0],)


def product_lag_derivative(x, u, p):
    a, b, tau = p
    return ((a * b * u[0] - x[0]) / tau,)


PRODUCT_LAG = ProcessModel(
    name="product lag",
    states=(State("x", "1"),),
    inputs=(Input("u", "1"),),
    outputs=(Output("x", "1"),),
    parameters=(
        Parameter("a", "1", 1.0, 0.1, 10.0, "log"),
        Parameter("b", "1", 2.0, 0.1, 10.0, "log"),
        Parameter("tau", "s", 0.05, 0.01, 1.0, "log"),
    ),
    derivative=product_lag_derivative,
)


def sum_lag_derivative(x, u, p):
    a, b = p
    return ((u[0] - x[0]) / (a + b),)


def test_along_a_tie_there_is_no_minimum_but_one():
    """However far: of the sum of two time constants both are known to a hundredth."""
    parameters = tuple(Parameter(name, "s", 0.1, 0.001, 1.0, "log") for name in ("a", "b"))
    model = replace(PRODUCT_LAG, parameters=parameters, derivative=sum_lag_derivative)
    target = objective_of(model, record_of(model, 0.01, noise=0.02))
    ends = [refine(target, np.array(start)).chromosome for start in ([0.19, 0.01], [0.02, 0.18])]
    assert abs(ends[0][0] - ends[1][0]) > 0.1
    result = fit_likelihood(target, ends)
    assert result.rivals == () and result.ridge == ()


@pytest.mark.soak
def test_a_tied_value_is_moved_from_an_end_on_which_only_the_tie_has_left_it():
    target = objective_of(PRODUCT_LAG, record_of(PRODUCT_LAG, 0.01, noise=0.02))
    held = Restriction(held=(0, np.log(10.0)))
    at_the_end = refine(target, np.array([10.0, 0.2, 0.05]), restriction=held)
    assert target.space.on_bound(at_the_end.chromosome).tolist() == [True, False, False]
    optimum = fit_likelihood(target, [at_the_end.chromosome]).optimum
    a, b, tau = optimum.chromosome
    assert not target.space.on_bound(optimum.chromosome).any()
    product = at_the_end.chromosome[0] * at_the_end.chromosome[1]
    assert (a * b, tau) == pytest.approx((product, at_the_end.chromosome[2]), rel=1e-3)


def test_a_minimum_is_moved_to_the_middle_of_its_tie_and_stays_one():
    target = objective_of(PRODUCT_LAG, record_of(PRODUCT_LAG, 0.01, noise=0.02))
    minimum = refine(target, np.array([8.0, 0.25, 0.05]))
    a, b, tau = centred(target, minimum.chromosome)
    assert a == pytest.approx(b, rel=1e-2)  # both may be 0.1 to 10
    product = minimum.chromosome[0] * minimum.chromosome[1]
    assert (a * b, tau) == pytest.approx((product, minimum.chromosome[2]), rel=1e-3)
    alone = objective_of(lags(), record_of(lags(), 0.01, noise=0.02))
    assert centred(alone, np.array([0.03, 0.12])) is None


SUM_LAG = replace(
    PRODUCT_LAG,
    name="sum lag",
    derivative=lambda x, u, p: (u[0] - (p[0] + p[1]) * x[0] * p[2],),
)


def test_along_a_tie_that_bends_its_sum_is_kept_and_no_descent_is_needed():
    """a + b on logarithmic scales: far along it a straight way is no tie any more."""
    target = objective_of(SUM_LAG, record_of(SUM_LAG, 0.01, noise=0.02))
    end = refine(target, np.array([9.9, 0.4, 0.05])).chromosome
    before = target.simulations
    moved = centred(target, end)
    assert target.simulations - before < 30
    assert abs(np.log(moved[0] / end[0])) > 0.3
    assert (moved[0] + moved[1]) * moved[2] == pytest.approx((end[0] + end[1]) * end[2], rel=1e-9)
    assert target.evaluate(moved[None])[0] == pytest.approx(target.evaluate(end[None])[0], rel=1e-6)


def test_a_way_from_which_nothing_leads_back_onto_a_tie_is_left(monkeypatch):
    """Of a z(0) below zero steps from where a is next to nothing pass what numbers can be."""
    model = ProcessModel(
        name="decay",
        states=(State("z", "1", initial_range=(-1.0, 1.0)),),
        inputs=(Input("u", "1"),),
        outputs=(Output("y", "1"),),
        parameters=(
            Parameter("a", "1", 1.0, 1e-12, 10.0, "log"),
            Parameter("tau", "s", 1.0, 0.1, 10.0, "log"),
        ),
        derivative=lambda x, u, p: (-x[0] / p[1],),
        output=lambda x, u, p: (p[0] * x[0],),
    )
    record = Dataset(np.zeros(40), -10.0 * np.exp(-0.05 * np.arange(40)), 0.05)
    space = SearchSpace.of(model).with_starts([record])
    target = Objective(BatchSimulator(model), space, [record])
    end = np.array([10.0, 1.0, -1.0])
    alone = replace(ties(sensitivity(target, end)), directions=np.array([[1.0, 0.0, 0.0]]))
    monkeypatch.setattr("sysid.gassi.slide.ties", lambda local: alone)
    moved = centred(target, end)
    assert moved is None or target.evaluate(moved[None])[0] < 1e-4


def test_a_tied_value_stays_on_an_end_that_the_data_want_it_beyond():
    """All of the valley is beyond the corner of the ranges, so that one of them is on an end."""
    record = record_of(PRODUCT_LAG, 0.01, noise=0.02)
    ranges = {"a": (0.1, 1.0), "b": (0.1, 1.0)}
    space = SearchSpace.of(PRODUCT_LAG, ranges)
    target = Objective(BatchSimulator(PRODUCT_LAG), space, [record])
    end = refine(target, np.array([0.5, 0.5, 0.05]))
    assert end.chromosome[:2] == pytest.approx([1.0, 1.0])
    assert slid(target, end.chromosome) is None


@pytest.mark.soak
@pytest.mark.parametrize("noise", [0.02, 2e-5])
def test_the_likelihood_weighs_each_output_by_its_own_error(noise):
    rng = np.random.default_rng(3)
    u = rng.uniform(-1.0, 1.0, (300, 1))
    # Seen twice: well through one sensor, badly and on a wrong scale through the other.
    outputs = np.column_stack(
        [u[:, 0] + noise * rng.normal(size=300), 1.4 * u[:, 0] + 0.2 * rng.normal(size=300)]
    )
    model = ProcessModel(
        name="twice",
        states=(State("s", "1"),),
        inputs=(Input("u", "1"),),
        outputs=(Output("a", "1"), Output("b", "1")),
        parameters=(Parameter("gain", "1", 1.0, 0.5, 2.0),),
        derivative=twice_derivative,
        output=lambda x, u, p: (p[0] * u[0], p[0] * u[0]),
    )
    target = objective_of(model, Dataset(u, outputs, 0.01))

    def product(gain):
        return float(np.prod(np.sqrt(np.mean((gain * u - outputs) ** 2, axis=0))))

    near = 1.0 - noise, 1.0 + noise
    exact = minimize_scalar(product, bounds=near, method="bounded", options={"xatol": 1e-12})
    likeliest = fit_likelihood(target, [np.array([1.2])]).optimum
    assert likeliest.chromosome[0] == pytest.approx(exact.x, abs=5e-3 * noise)
    ratio = likeliest.objective.weights[0] / likeliest.objective.weights[1]
    assert ratio == pytest.approx(likeliest.rms[1] / likeliest.rms[0], rel=1e-2)


# --- the same answer for every seed ---------------------------------------------------------


def saturating_derivative(x, u, p):
    rate, half = p
    return (u[0] - rate * x[0] / (half + x[0]),)


@pytest.fixture(scope="module")
def far_below_half():
    """Uptake that saturates, at concentrations where only rate / half is well known."""
    model = ProcessModel(
        name="uptake",
        states=(State("x", "g/l"),),
        inputs=(Input("u", "g/(l*s)"),),
        outputs=(Output("x", "g/l"),),
        parameters=(
            Parameter("rate", "g/(l*s)", 10.0, 0.5, 500.0, "log"),
            Parameter("half", "g/l", 5.0, 0.25, 250.0, "log"),
        ),
        derivative=saturating_derivative,
    )
    rng = np.random.default_rng(2)
    inputs = prbs(rng, 200, 0.0, 0.8)[:, None]
    blank = Dataset(inputs, np.full((200, 1), np.nan), 0.1)
    outputs = BatchSimulator(model, accuracy=1e-6).trajectories(model.nominal, blank)[0]
    return model, Dataset(inputs, outputs + 0.03 * rng.normal(size=outputs.shape), 0.1)


def answer(model, record, seed):
    fitted = GASSI(model, population=20, generations=6, random_state=seed).fit(record)
    assert fitted.rivals_ == []
    return fitted.uncertainty(record).parameters


@pytest.mark.soak
def test_a_ridge_is_told_alike_by_every_seed(far_below_half):
    first, *others = (answer(*far_below_half, seed) for seed in range(3))
    assert all(estimate.std is None for estimate in first)  # by the profile, not the curvature
    for other in others:
        for one, same in zip(first, other, strict=True):
            assert one.why == same.why
            ends = [[e.low or 0.0, np.inf if e.high is None else e.high] for e in (one, same)]
            np.testing.assert_allclose(ends[0], ends[1], rtol=1e-2)


def test_an_output_measured_far_better_than_a_search_simulates_has_all_the_steps_it_wants():
    """The angle of a pendulum by an encoder; the truth by SciPy."""
    truth, dt, n, noise = {"stiffness": 40.0, "friction": 0.5, "gain": 30.0}, 0.02, 250, 1e-6

    def derivative(x, u, p):
        return (x[1], p[2] * u[0] - p[0] * math.sin(x[0]) - p[1] * math.tanh(x[1] / 0.5))

    model = ProcessModel(
        name="pendulum",
        states=(State("angle", "rad"), State("speed", "rad/s")),
        inputs=(Input("u", "N*m"),),
        outputs=(Output("angle", "rad"),),
        parameters=tuple(
            Parameter(name, "1", 1.3 * value, 0.1 * value, 10.0 * value, "log")
            for name, value in truth.items()
        ),
        derivative=derivative,
    )
    rng = np.random.default_rng(0)
    u, rows = prbs(rng, n, -1.0, 1.0), [np.zeros(2)]
    for given in u[:-1]:
        rows.append(
            solve_ivp(
                lambda t, x, given=given: derivative(x, (given,), tuple(truth.values())),
                (0.0, dt), rows[-1], method="DOP853", rtol=1e-11, atol=1e-12,
            ).y[:, -1]
        )  # fmt: skip
    angle = np.array(rows)[:, 0]
    angle[1:] += noise * rng.standard_normal(n - 1)
    record = Dataset(u, angle, dt)
    minimum = np.array(list(truth.values()))
    end = fit_likelihood(objective_of(model, record), [minimum], explored=True).optimum
    estimates = uncertainty(end.objective, end.chromosome).parameters
    known = {e.name: e.std for e in estimates if e.std is not None and e.std < 1e-5 * e.value}
    assert known.keys() == truth.keys()
    errors = {e.name: (e.value - truth[e.name]) / known[e.name] for e in estimates}
    assert max(map(abs, errors.values())) < 3.5, errors


@pytest.mark.soak
def test_a_poor_minimum_of_a_log_without_noise_is_left():
    """There by chance an output errs a thousandth of another, and still tells nothing alone."""
    model = actuator()
    record = _exact_record(model)
    assert GASSI(model, random_state=1).fit(record).error_ < 1e-6
