"""Intervals and ambiguities against dense covariances, closed forms and repeated experiments.

Most models here are formulas simulated by NumPy: the analysis sees nothing but outputs.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from scipy.linalg import block_diag, toeplitz
from scipy.optimize import brentq
from scipy.signal import lfilter

from benchmarks._common import simulated_logs
from sim_rig.actuator import actuator
from sysid import (
    GASSI,
    BatchSimulator,
    Dataset,
    Input,
    ModelError,
    Output,
    Parameter,
    ProcessModel,
    SearchSpace,
    State,
)
from sysid.fitting.descent import Restriction
from sysid.fitting.objective import Objective
from sysid.fitting.refinement import MOST_ITERATIONS, refine
from sysid.gassi.likelihood import fit_likelihood
from sysid.uncertainty import profile, uncertainty
from sysid.uncertainty.colour import Autoregression, colour, score_covariance
from sysid.uncertainty.covariance import covariance
from sysid.uncertainty.estimate import Z95
from sysid.uncertainty.quantities import Coordinate
from sysid.uncertainty.sensitivity import has_tangents, sensitivity
from sysid.uncertainty.ties import Ties, ties
from sysid.uncertainty.tracer import Fit, Tracer
from tests.sysid.support import Formula, lag, linear_response, prbs

Z = 1.959963984540054


# --- covariance of a score ----------------------------------------------------------------------

AR1 = np.array([[[0.8]]])
VAR2 = np.array([[[0.5, 0.2], [-0.3, 0.4]], [[-0.2, 0.1], [0.15, 0.1]]])


def dense_response(coefficients, n):
    """H of e = H eps for n samples behind rest, as one matrix."""
    q = coefficients.shape[1]
    system = np.eye(n * q)
    for k, matrix in enumerate(coefficients, start=1):
        system -= np.kron(np.eye(n, k=-k), matrix)
    return np.linalg.inv(system)


@pytest.mark.parametrize("lengths", [(40,), (25, 3, 30)])
@pytest.mark.parametrize("coefficients", [np.zeros((0, 2, 2)), AR1, VAR2], ids=len)
def test_score_covariance_is_that_of_the_dense_residuals(coefficients, lengths):
    rng = np.random.default_rng(1)
    q = coefficients.shape[1]
    mixing = rng.standard_normal((q, q))
    noise = mixing @ mixing.T
    slopes = rng.standard_normal((sum(lengths), q, 4))
    responses = [dense_response(coefficients, n) for n in lengths]
    covariance = block_diag(*(h @ np.kron(np.eye(n), noise) @ h.T
                              for h, n in zip(responses, lengths, strict=True)))  # fmt: skip
    rows = slopes.reshape(-1, 4)
    expected = rows.T @ covariance @ rows
    model = Autoregression(coefficients, noise)
    found = score_covariance(slopes, seen(len(slopes), q), lengths, model)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())


def test_of_a_long_record_it_is_the_stationary_one():
    n, a, sigma = 1500, 0.8, 0.3
    slopes = np.stack([np.ones(n), np.sin(np.arange(n) / 40.0)], axis=1)
    covariance = sigma**2 / (1.0 - a**2) * toeplitz(a ** np.arange(n))
    expected = slopes.T @ covariance @ slopes
    model = Autoregression(AR1, np.array([[sigma**2]]))
    found = score_covariance(slopes[:, None, :], seen(n), (n,), model)
    np.testing.assert_allclose(np.diag(found), np.diag(expected), rtol=0.02)


def seen(n, q=1):
    return np.ones((n, q), dtype=bool)


def simulated_noise(rng, n, coefficients, mixing):
    """A vector autoregression behind a run-in, (n, q)."""
    q = coefficients.shape[1]
    eps = rng.standard_normal((n + 200, q)) @ mixing.T
    e = np.zeros_like(eps)
    for t in range(len(e)):
        e[t] = eps[t] + sum(a @ e[t - k] for k, a in enumerate(coefficients, 1) if t >= k)
    return e[200:]


@pytest.mark.parametrize("coefficients", [np.zeros((0, 2, 2)), AR1, VAR2], ids=len)
def test_the_autoregression_of_simulated_noise_is_found(coefficients):
    q = coefficients.shape[1]
    mixing = np.array([[1.0, 0.0], [0.6, 0.5]])[:q, :q]
    orders = []
    for seed in range(12):
        parts = [simulated_noise(np.random.default_rng([seed, k]), 1000, coefficients, mixing)
                 for k in range(2)]  # fmt: skip
        found = colour(np.vstack(parts), seen(2000, q), (1000, 1000))
        orders.append(len(found.coefficients))
        if orders[-1] == len(coefficients):
            np.testing.assert_allclose(found.coefficients, coefficients, atol=0.1)
        np.testing.assert_allclose(found.noise, mixing @ mixing.T, atol=0.15)
    assert orders.count(len(coefficients)) >= 11


def test_a_record_does_not_continue_the_one_before():
    a, lengths = 0.9, (60, 80, 70)
    parts = [start * a ** np.arange(n) for start, n in zip((1.0, -50.0, 30.0), lengths,
                                                           strict=True)]  # fmt: skip
    noise = 1e-3 * np.random.default_rng(0).standard_normal(sum(lengths))
    found = colour((np.concatenate(parts) + noise)[:, None], seen(210), lengths)
    # The pairs across the joints would err by tens.
    assert found.noise[0, 0] < 1e-5


def test_residuals_that_grow_are_given_no_endless_memory():
    """Drift that ends with the record: least squares alone finds memory that grows without end."""
    residual = np.exp(0.02 * np.arange(2000))[:, None]
    found = colour(residual, seen(2000), (2000,))
    covariance = score_covariance(np.ones((2000, 1, 1)), seen(2000), (2000,), found)
    # No sum of these residuals exceeds as many of the largest.
    assert 0.0 < covariance[0, 0] <= (2000 * residual.max()) ** 2
    lone = colour(np.exp(0.5 * np.arange(500))[:, None], seen(500), (500,))
    assert len(lone.coefficients) > 0
    assert np.isfinite(score_covariance(np.ones((500, 1, 1)), seen(500), (500,), lone)).all()


@pytest.mark.parametrize("coefficients", [np.zeros((0, 2, 2)), 0.6 * np.eye(2)[None]])
def test_of_noise_that_is_larger_where_slopes_are_it_is_as_its_sums_scatter(coefficients):
    """Where slopes are largest noise is, too: a textbook's intervals are 1.6 times too narrow."""
    rng, n, repetitions = np.random.default_rng(0), 3000, 400
    slopes = rng.standard_normal((n, 2, 3)) * [1.0, 1e-3, 1e3]
    spread = 0.3 + np.abs(slopes[..., [0]])
    lengths, taps = (1800, 1200), np.append(1.0, -coefficients[:, 0, 0])
    sums = []
    for _ in range(repetitions):
        white = spread[..., 0] * rng.standard_normal((n, 2))
        noise = np.vstack([lfilter([1.0], taps, part, axis=0) for part in np.split(white, [1800])])
        sums.append(np.einsum("tip,ti->p", slopes, noise))
    model = colour(noise, seen(n, 2), lengths)
    found = score_covariance(slopes, seen(n, 2), lengths, model, noise)
    plain = score_covariance(slopes, seen(n, 2), lengths, model)
    ratios, even = (np.diag(c) / np.mean(np.square(sums), axis=0) for c in (found, plain))
    assert ratios == pytest.approx(1.0, rel=0.3)
    assert even[0] < 0.65
    # Of even noise nothing is added.
    even_noise = rng.standard_normal((n, 2))
    model = colour(even_noise, seen(n, 2), lengths)
    assert score_covariance(slopes, seen(n, 2), lengths, model, even_noise) == pytest.approx(
        score_covariance(slopes, seen(n, 2), lengths, model)
    )


def test_of_white_residuals_it_is_sigma_squared_s_s():
    rng = np.random.default_rng(3)
    residual = 0.2 * rng.standard_normal((500, 1))
    slopes = rng.standard_normal((500, 1, 3))
    found = score_covariance(slopes, seen(500), (300, 200), colour(residual, seen(500), (300, 200)))
    expected = np.mean(residual**2) * slopes[:, 0].T @ slopes[:, 0]
    np.testing.assert_allclose(found, expected, rtol=1e-9)


# --- models that are formulas -------------------------------------------------------------------


def unknown(name, nominal, scale="log", unit="1", lower=None, upper=None):
    span = (nominal / 10.0, nominal * 10.0) if scale == "log" else (nominal - 50.0, nominal + 50.0)
    lower = span[0] if lower is None else lower
    upper = span[1] if upper is None else upper
    return Parameter(name, unit, nominal, lower, upper, scale, minimum=-np.inf)


class Problem:
    """A formula, its parameters and records of it with white noise."""

    def __init__(self, formula, parameters, sigma=0.05, n=400, inputs=3, seed=0, records=1):
        self.formula, self.sigma, rng = formula, sigma, np.random.default_rng(seed)
        self.truth = {p.name: p.nominal for p in parameters}
        us = [1.0 + rng.standard_normal((n, inputs)) for _ in range(records)]
        clean = [formula(self.truth, u) for u in us]
        q = clean[0].shape[1]
        self.model = ProcessModel(
            name="formula",
            states=(State("x", "1"),),
            inputs=tuple(Input(f"u{i}", "1") for i in range(inputs)),
            outputs=tuple(Output(f"y{j}", "1") for j in range(q)),
            parameters=tuple(parameters),
            derivative=lambda x, u, p: (-x[0],),
            output=lambda x, u, p: (x[0],) * q,
        )
        self.records = [
            Dataset(u, y + sigma * rng.standard_normal(y.shape), 0.01)
            for u, y in zip(us, clean, strict=True)
        ]

    def objective(self, records=None, model=None, **space):
        model = model or self.model
        return Objective(
            Formula(model, self.formula), SearchSpace.of(model, **space), records or self.records
        )

    def tell(self, *combinations, records=None, **space):
        """The uncertainty at the minimum next to the truth, where only combinations of some act."""
        objective = self.objective(records, **space)
        start = np.array([self.truth[name] for name in objective.space.names])
        end = refine(objective, start).chromosome
        members = {name for combination in combinations for name in combination.names}
        structure = Ties.of(objective.space, end, combinations, members)
        return uncertainty(objective, end, structure=structure)


def columns(*outputs):
    return np.stack(outputs, axis=1)


def estimates(found):
    return {e.name: e for e in found.parameters}


def combinations(found):
    return {e.name: e for a in found.ambiguities for e in a.determined}


# --- intervals of a model that is linear in its parameters --------------------------------------

TRUTH = np.array([2.0, -0.7, 0.4])


def linear_formula(p, u):
    return columns(u @ np.array(list(p.values())))


LINEAR = Problem(linear_formula, [unknown(f"b{i}", v, "linear") for i, v in enumerate(TRUTH)])


def least_squares(records):
    X = np.vstack([r.inputs for r in records])
    y = np.vstack([r.outputs for r in records])[:, 0]
    return X, np.linalg.lstsq(X, y, rcond=None)[0]


def told_of(records):
    """Estimates of the linear model at the exact least-squares solution."""
    return uncertainty(LINEAR.objective(records), least_squares(records)[1]).parameters


def slow(rng, n, cutoff=0.97):
    """Inputs whose energy is at low frequencies, where coloured noise is."""
    white = rng.standard_normal((n + 300, 3))
    return (lfilter([1.0], [1.0, -cutoff], white, axis=0)[300:] + 1.0) / 3.0


def coverage(record_of, seeds=100):
    """Share of 95 % intervals that hold the truth, over fresh noise; one list of records a seed.

    And the share that intervals of white residuals would.
    """
    inside, naive = [], []
    for seed in range(seeds):
        records = record_of(np.random.default_rng([77, seed]))
        X, best = least_squares(records)
        inside += [e.low < v < e.high for e, v in zip(told_of(records), TRUTH, strict=True)]
        sigma = np.std(np.vstack([r.outputs for r in records])[:, 0] - X @ best)
        white = sigma * np.sqrt(np.diag(np.linalg.inv(X.T @ X)))
        naive += list(np.abs(best - TRUTH) < Z * white)
    return np.mean(inside), np.mean(naive)


def test_white_noise_gives_the_closed_form():
    X, best = least_squares(LINEAR.records)
    y = LINEAR.records[0].outputs[:, 0]
    variance = np.mean((y - X @ best) ** 2) * np.linalg.inv(X.T @ X)
    found = uncertainty(LINEAR.objective(), best)
    deviation = np.sqrt(np.diag(variance))
    for parameter, value, std in zip(found.parameters, best, deviation, strict=True):
        assert parameter.why == ""
        assert parameter.value == value
        assert parameter.std == pytest.approx(std, rel=1e-6)
        assert parameter.low == pytest.approx(value - Z * std, rel=1e-6)
        assert parameter.high == pytest.approx(value + Z * std, rel=1e-6)
    expected = variance / np.outer(deviation, deviation)
    np.testing.assert_allclose(found.correlation(), expected, atol=1e-6)
    assert found.rank == 3 and not found.ambiguities
    assert found.determined() == found.parameters


@pytest.mark.soak
def test_intervals_cover_under_white_noise():
    def record(rng):
        u = 1.0 + rng.standard_normal((150, 3))
        return [Dataset(u, u @ TRUTH + 0.1 * rng.standard_normal(150), 0.01)]

    assert 0.92 < coverage(record)[0] < 0.98


@pytest.mark.soak
def test_intervals_cover_under_coloured_noise_where_white_ones_would_not():
    def record(rng):
        u = slow(rng, 500)
        noise = lfilter([1.0], [1.0, -0.9], 0.05 * rng.standard_normal(700))[200:]
        return [Dataset(u, u @ TRUTH + noise, 0.01)]

    found, naive = coverage(record)
    assert 0.90 < found < 0.98
    assert naive < 0.7


@pytest.mark.soak
def test_a_zero_error_of_an_output_has_the_closed_form_and_covers():
    zero, sigma = 0.2, 0.05

    def record(rng):
        records = []
        for length in (120, 80):
            u = 1.0 + rng.standard_normal((length, 3))
            error = zero * rng.standard_normal()
            y = u @ TRUTH + error + sigma * rng.standard_normal(length)
            records.append(Dataset(u, y, 0.01, output_zero=np.array([zero])))
        return records

    # A zero that is known to err, but did not: what is left is exactly as white as the noise.
    rng = np.random.default_rng(5)
    us = [1.0 + rng.standard_normal((n, 3)) for n in (120, 80)]
    still = [Dataset(u, u @ TRUTH + sigma * rng.standard_normal(len(u)), 0.01,
                     output_zero=np.array([zero])) for u in us]  # fmt: skip
    X, best = least_squares(still)
    rest = np.vstack([r.outputs for r in still])[:, 0] - X @ best
    pushes = sum(np.outer(u.sum(axis=0), u.sum(axis=0)) for u in us)
    inverse = np.linalg.inv(X.T @ X)
    variance = inverse @ (np.mean(rest**2) * X.T @ X + zero**2 * pushes) @ inverse
    found = [e.std for e in told_of(still)]
    np.testing.assert_allclose(found, np.sqrt(np.diag(variance)), rtol=1e-5)

    share, naive = coverage(record)
    assert 0.92 < share < 0.99
    assert naive < 0.85


@pytest.mark.parametrize("side", ["input_zero", "output_zero"])
def test_parts_of_a_record_share_its_zeros(side):
    """A sensor's zero that was calibrated once is off by the same amount in all parts."""
    plain, n = LINEAR.records[0], LINEAR.records[0].n_samples
    zero = np.array([0.2, 0.0, 0.0] if side == "input_zero" else [0.2])
    whole = replace(plain, **{side: zero})
    parts = [whole.part(0, n // 2, "first"), whole.part(n // 2, n, "second")]
    cut = [replace(part, log=0) for part in parts]
    shared, apart = ([e.std for e in told_of(records)] for records in (cut, parts))
    np.testing.assert_allclose(shared, [e.std for e in told_of([whole])], rtol=1e-5)
    # Of two calibrations a part averages out.
    assert np.max(np.divide(apart, shared)) < 0.8


@pytest.mark.soak
def test_a_zero_error_of_an_input_has_the_closed_form_and_covers():
    zero = np.array([0.1, 0.0, 0.0])

    def record(rng):
        u = 1.0 + rng.standard_normal((150, 3))
        y = u @ TRUTH + 0.05 * rng.standard_normal(150)
        return [Dataset(u + zero * rng.standard_normal(), y, 0.01, input_zero=zero)]

    plain = LINEAR.records[0]
    known = Dataset(plain.inputs, plain.outputs, plain.dt, input_zero=zero)
    X, best = least_squares([known])
    rest = known.outputs[:, 0] - X @ best
    push = zero[0] * best[0] * X.sum(axis=0)
    inverse = np.linalg.inv(X.T @ X)
    variance = inverse @ (np.mean(rest**2) * X.T @ X + np.outer(push, push)) @ inverse
    found = [e.std for e in told_of([known])]
    np.testing.assert_allclose(found, np.sqrt(np.diag(variance)), rtol=1e-5)

    share, naive = coverage(record)
    assert 0.92 < share < 0.99
    assert naive < 0.85


# --- noise on measured inputs -------------------------------------------------------------------


def filtered(u):
    """The response of a known lag, from rest."""
    return lfilter([0.05], [1.0, -0.95], u)


def through_a_lag(p, u):
    return columns(p["k"] * filtered(u[:, 0]) + p["c"] * u[:, 1])


NOISY = Problem(through_a_lag, [unknown("k", 3.0), unknown("c", 1.0)], n=300, inputs=2)


def noisy_record(rng, sigma_in, sigma_out, n=300):
    u = columns(prbs(rng, n, -1.0, 1.0, hold=30), rng.standard_normal(n))
    y = 3.0 * filtered(u[:, 0]) + u[:, 1] + sigma_out * rng.standard_normal(n)
    measured = u + columns(sigma_in * rng.standard_normal(n), np.zeros(n))
    return Dataset(measured, y, 0.01, input_noise=np.array([sigma_in, 0.0]))


def test_noise_of_an_input_does_what_the_dense_filter_does():
    # Hardly any noise was seen, but the input is known to carry it.
    record = noisy_record(np.random.default_rng(2), 0.0, 1e-4)
    record = Dataset(record.inputs, record.outputs, record.dt, input_noise=np.array([0.3, 0.0]))
    G = toeplitz(filtered(np.eye(300)[0]), np.zeros(300))
    S = columns(3.0 * filtered(record.inputs[:, 0]), record.inputs[:, 1])
    back = np.linalg.inv(S.T @ S) @ S.T @ (3.0 * 0.3 * G)
    expected = np.sqrt(np.diag(back @ back.T))
    found = estimates(NOISY.tell(records=[record]))
    # 128 drawn errors: a standard deviation to 6 %.
    assert found["k"].std / found["k"].value == pytest.approx(expected[0], rel=0.25)
    assert found["c"].std / found["c"].value == pytest.approx(expected[1], rel=0.25)


def test_noise_of_an_input_that_the_residuals_show_is_not_counted_twice():
    record = noisy_record(np.random.default_rng(2), 0.0, 0.3)
    silent = Dataset(record.inputs, record.outputs, record.dt)
    little = Dataset(record.inputs, record.outputs, record.dt, input_noise=np.array([0.1, 0.1]))
    one, other = estimates(NOISY.tell(records=[silent])), estimates(NOISY.tell(records=[little]))
    for name in ("k", "c"):
        assert other[name].std == pytest.approx(one[name].std, rel=1e-6)


@pytest.mark.parametrize("seed", [2, 5])
def test_intervals_with_noise_on_an_input_are_as_wide_as_estimates_scatter(seed):
    """With the lag's answer to it taken for noise with a slow part they had no lower end."""
    record = noisy_record(np.random.default_rng([5, seed]), 0.3, 0.01)
    found = estimates(NOISY.tell(records=[record]))["k"]
    assert 3.0 < (found.high - found.low) / 0.12 < 6.0  # 0.12: deviation over 60 seeds


@pytest.mark.soak
def test_intervals_cover_with_noise_on_an_input():
    inside = []
    for seed in range(60):
        record = noisy_record(np.random.default_rng([5, seed]), 0.3, 0.01)
        found = estimates(NOISY.tell(records=[record]))
        inside += [found["k"].low < 3.0 < found["k"].high, found["c"].low < 1.0 < found["c"].high]
    assert 0.90 < np.mean(inside) <= 0.995


# --- a dynamic model through the compiled simulator ----------------------------------------------


def lag_record(rng, n=200, sigma=0.05):
    u = prbs(rng, n, -1.0, 1.0)
    y = linear_response(np.array([[-20.0]]), np.array([[40.0]]), u[:, None], 0.01, "zoh")
    return Dataset(u, y + sigma * rng.standard_normal(y.shape), 0.01)


@pytest.mark.soak
def test_intervals_of_a_lag_cover():
    simulator, space = BatchSimulator(lag(), accuracy=1e-6), SearchSpace.of(lag())
    inside = []
    for seed in range(50):
        objective = Objective(simulator, space, [lag_record(np.random.default_rng([9, seed]))])
        found = uncertainty(objective, refine(objective, np.array([2.0, 0.05])).chromosome)
        inside += [e.low < v < e.high for e, v in zip(found.parameters, (2.0, 0.05), strict=True)]
    assert 0.90 < np.mean(inside) < 0.99


def test_a_fitted_estimator_tells_its_own_uncertainty():
    record = lag_record(np.random.default_rng(4))
    estimator = GASSI(lag(), population=20, generations=3).fit(record)
    found = estimator.uncertainty(record)
    direct = uncertainty(
        Objective(BatchSimulator(lag()), estimator.space_, [record]), estimator.chromosome_
    )
    assert found.parameters == direct.parameters
    assert found.parameters == estimator.uncertainty(record).parameters
    assert estimates(found)["tau"].value == estimator.parameters_["tau"]
    timed = GASSI(lag(), population=20, generations=3, dt=record.dt)
    timed.fit(record.inputs, record.outputs)
    arrays = timed.uncertainty(record.inputs, record.outputs)
    assert arrays.parameters == found.parameters


def test_without_a_refined_minimum_there_are_no_intervals():
    record = lag_record(np.random.default_rng(4))
    small = {"population": 10, "generations": 2}
    thesis = GASSI(lag(), preset="thesis", **small).fit(record)
    with pytest.raises(ModelError, match="preset thesis has no local refinement"):
        thesis.uncertainty(record)

    def stop(step):
        if step.stage == "refine":
            raise KeyboardInterrupt

    interrupted = GASSI(lag(), **small).fit(record, on_progress=stop)
    with pytest.raises(ModelError, match="interrupted"):
        interrupted.uncertainty(record)


# --- what only acts together ---------------------------------------------------------------------


@dataclass(frozen=True)
class Formulated:
    """A combination as a formula of named parameters, its gradient by differences."""

    text: str
    names: tuple[str, ...]
    formula: Callable[..., float]
    unit: str = "1"

    def value(self, values):
        return self.formula(*(values[name] for name in self.names))

    def gradient(self, values):
        steps = {name: 1e-6 * abs(values[name]) for name in self.names}
        return {
            name: (self.value({**values, name: values[name] + h})
                   - self.value({**values, name: values[name] - h})) / (2.0 * h)
            for name, h in steps.items()
        }  # fmt: skip


@pytest.mark.parametrize(
    ("steep", "bend", "by_slopes"),
    [(0.05, 0.0, True), (50.0, 0.0, True), (0.05, 1.5e5, False), (50.0, 1.5e5, False)],
    ids=["straight", "in a valley that bends", "bent itself", "bent itself, in such a valley"],
)
def test_slopes_tell_an_interval_where_simulations_agree(steep, bend, by_slopes):
    """The interval of a is that of its own output: b follows it along a parabola."""

    def formula(p, u):
        own = p["a"] + bend * (p["a"] - 2.0) ** 5
        return columns(own * u[:, 0], steep * (p["b"] - p["a"] ** 2) * u[:, 1])

    problem = Problem(formula, [unknown("a", 2.0, "linear"), unknown("b", 4.0, "linear")], 0.5)
    a = estimates(problem.tell())["a"]
    assert (a.std is not None) is by_slopes
    (record,) = problem.records
    u, y = record.inputs[:, 0], record.outputs[:, 0]
    value = float(u @ y / (u @ u))
    half = Z95 * float(np.std(y - value * u)) / math.sqrt(float(u @ u))
    ends = [brentq(lambda t, at=at: 2.0 + t + bend * t**5 - at, -1.0, 1.0)
            for at in (value - half, value + half)]  # fmt: skip
    assert (a.low - 2.0, a.high - 2.0) == pytest.approx(ends, abs=0.1 * half)


@pytest.mark.parametrize("sigma", [2.0, 10.0], ids=["narrow", "wide"])
@pytest.mark.parametrize("names", ["a", "ab"])
def test_a_wide_interval_is_not_left_to_a_logarithm_s_slope(names, sigma):
    """That of a, or of a + b, is as wide below as above, which that of its logarithm is not."""
    problem = Problem(
        lambda p, u: columns(sum(p[name] for name in names) * u[:, 0]),
        [unknown(name, 2.0 / len(names)) for name in names],
        sigma=sigma,
    )
    total = Formulated("a + b", ("a", "b"), lambda a, b: a + b)
    found = problem.tell(total) if len(names) > 1 else problem.tell()
    (quantity,) = combinations(found).values() if len(names) > 1 else found.parameters
    (record,) = problem.records
    u, y = record.inputs[:, 0], record.outputs[:, 0]
    value = float(u @ y / (u @ u))
    half = Z95 * float(np.std(y - value * u)) / math.sqrt(float(u @ u))
    assert (half > 0.2 * value) is (quantity.std is None) is (sigma > 5.0)
    assert (quantity.low, quantity.high) == pytest.approx(
        (value - half, value + half), abs=0.08 * half
    )


def same_interval(one, other):
    assert one.value == pytest.approx(other.value, rel=1e-4)
    assert (one.low, one.high) == pytest.approx((other.low, other.high), rel=1e-4)


@pytest.mark.parametrize("scale", ["log", "linear"])
def test_a_product_has_an_interval_and_its_factors_none(scale):
    problem = Problem(
        lambda p, u: columns(p["a"] * p["b"] * u[:, 0] + p["c"] * u[:, 1]),
        [unknown("a", 3.0, scale, "m/s"), unknown("b", 0.5, scale, "kg"), unknown("c", 1.0)],
    )
    result = problem.tell(Formulated("a b", ("a", "b"), lambda a, b: a * b))
    parameters = estimates(result)
    assert [parameters[name].why for name in "abc"] == ["tied", "tied", ""]
    assert all(parameters[name].std is parameters[name].low is None for name in "ab")
    (ambiguity,) = result.ambiguities
    # A scale weighs what has kg; nothing measures m/s as easily.
    assert (ambiguity.kind, ambiguity.parameters) == ("tied", ("b", "a"))
    assert ambiguity.measure == ("b",)
    (combined,) = ambiguity.determined
    assert combined.name == "a b" and combined.at({"a": 2.0, "b": 5.0}) == 10.0
    assert result.rank == 2 and len(result.singular_values) == 2
    one = Problem(
        lambda p, u: columns(p["g"] * u[:, 0] + p["c"] * u[:, 1]),
        [unknown("g", 1.5), unknown("c", 1.0)],
    )
    instead = estimates(one.tell())
    same_interval(combined, instead["g"])
    same_interval(parameters["c"], instead["c"])


@pytest.mark.parametrize("scale", ["log", "linear"])
def test_a_sum_has_an_interval_and_its_terms_none(scale):
    problem = Problem(
        lambda p, u: columns((p["a"] + 2.0 * p["b"]) * u[:, 0] + p["c"] * u[:, 1]),
        [unknown("a", 2.0, scale), unknown("b", 0.5, scale), unknown("c", 1.0)],
    )
    result = problem.tell(Formulated("a + 2 b", ("a", "b"), lambda a, b: a + 2.0 * b))
    assert [estimates(result)[name].why for name in "abc"] == ["tied", "tied", ""]
    one = Problem(
        lambda p, u: columns(p["g"] * u[:, 0] + p["c"] * u[:, 1]),
        [unknown("g", 3.0, "linear"), unknown("c", 1.0)],
    )
    same_interval(combinations(result)["a + 2 b"], estimates(one.tell())["g"])


def test_groups_that_share_nothing_are_told_apart():
    problem = Problem(
        lambda p, u: columns(p["a"] * p["b"] * u[:, 0], (p["c"] + p["d"]) * u[:, 1]),
        [unknown(name, value) for name, value in zip("abcd", (2.0, 3.0, 0.4, 0.7), strict=True)],
    )
    result = problem.tell(
        Formulated("a b", ("a", "b"), lambda a, b: a * b),
        Formulated("c + d", ("c", "d"), lambda c, d: c + d),
    )
    groups = {frozenset(a.parameters): a for a in result.ambiguities}
    assert set(groups) == {frozenset("ab"), frozenset("cd")}
    assert all(len(a.measure) == len(a.determined) == 1 for a in result.ambiguities)


@pytest.mark.parametrize("seed", range(3))
def test_a_weak_combination_has_the_ends_that_its_slope_gives(seed):
    def formula(p, u):
        return columns(1e-3 * p["a"] * p["b"] * u[:, 0] + p["c"] * u[:, 1])

    parameters = [unknown("a", 2.0), unknown("b", 1.0), unknown("c", 1.0)]
    problem = Problem(formula, parameters, seed=seed)
    result = problem.tell(Formulated("a b", ("a", "b"), lambda a, b: a * b))
    (combined,) = result.ambiguities[0].determined
    X, y = problem.records[0].inputs[:, :2] * [1e-3, 1.0], problem.records[0].outputs[:, 0]
    best = np.linalg.lstsq(X, y, rcond=None)[0]
    half = Z * np.std(y - X @ best) * np.sqrt(np.linalg.inv(X.T @ X)[0, 0])
    # Of what the range keeps from its minimum the loss counts from where it stands.
    short = max(0.02 - best[0], 0.0)
    low, high = best[0] - half, best[0] + np.hypot(half, short)
    expected = [low if low > 0.02 else None, high]
    assert combined.std is None and combined.why == ""
    assert [combined.low, combined.high] == [end if end is None else pytest.approx(end, rel=0.05)
                                             for end in expected]  # fmt: skip


# --- the brushed motor whose speed alone is measured ----------------------------------------------

BRUSHED = {"K": 0.05, "J": 2e-4, "B": 1e-6, "Tc": 0.01}
RESISTANCE, INDUCTANCE = 1.0, 1e-3


def drag(omega, b, tc):
    return b * omega + tc * math.tanh(omega / 0.5)


def slow_winding(x, u, p):
    k, j, b, tc = p
    return ((k * (u[0] - k * x[0]) / RESISTANCE - drag(x[0], b, tc)) / j,)


def winding(x, u, p):
    k, j, b, tc = p
    current = (u[0] - RESISTANCE * x[1] - k * x[0]) / INDUCTANCE
    return ((k * x[1] - drag(x[0], b, tc)) / j, current)


def brushed(derivative):
    """What is said of a brushed motor, its viscous friction at the low end of its range."""
    units = ("N*m/A", "kg*m^2", "N*m*s/rad", "N*m")
    ranges = [(v if name == "B" else v / 20.0, v * 1e3) for name, v in BRUSHED.items()]
    states = (State("omega", "rad/s"), State("current", "A"))
    model = ProcessModel(
        name="brushed",
        states=states if derivative is winding else states[:1],
        inputs=(Input("voltage", "V"),),
        outputs=(Output("omega", "rad/s"),),
        parameters=tuple(
            Parameter(name, unit, value, *ends, "log")
            for (name, value), unit, ends in zip(BRUSHED.items(), units, ranges, strict=True)
        ),
        derivative=derivative,
    )
    rng = np.random.default_rng(0)
    inputs = prbs(rng, 300, -6.0, 6.0, hold=20)[:, None]
    empty = Dataset(inputs, np.full((300, 1), np.nan), 0.01)
    simulator = BatchSimulator(model)
    outputs = simulator.trajectories(model.nominal, empty)[0]
    record = Dataset(inputs, outputs + 0.3 * rng.standard_normal(outputs.shape), 0.01)
    objective = Objective(simulator, SearchSpace.of(model), [record])
    # Along a tie any value fits: here B stays at the end.
    held = Restriction(held=(2, math.log(BRUSHED["B"])))
    return uncertainty(objective, refine(objective, model.nominal, restriction=held).chromosome)


@pytest.mark.soak
def test_a_tie_holds_at_the_end_of_a_logarithmic_range():
    result = brushed(slow_winding)
    assert [e.why for e in result.parameters] == ["tied"] * 4
    assert [e.name for e in result.parameters if e.on_bound] == ["B"]
    (ambiguity,) = result.ambiguities
    assert set(ambiguity.parameters) == set(BRUSHED) and len(ambiguity.measure) == 1
    assert len(ambiguity.determined) == 3
    assert not any(e.excludes(BRUSHED) for e in ambiguity.determined)
    assert all(e.high / e.low < 1.2 for e in ambiguity.determined)


@pytest.mark.soak
def test_what_hardly_differs_from_a_tie_has_wide_intervals():
    """A winding's time constant below the sample time resolves the tie in the equations alone."""
    result = brushed(winding)
    j = estimates(result)["J"]
    assert j.why == "" and (j.low or 0.0) < 0.6 * BRUSHED["J"]
    assert not any(e.excludes(BRUSHED) for e in result.parameters)


def feedback(weight, seed):
    """Like a motor's K and B, of which K + B / K is known, and K by itself by a weight as small."""

    def formula(p, u):
        return columns((p["k"] + p["b"] / p["k"]) * u[:, 0] + weight * p["k"] * u[:, 1])

    parameters = [unknown("k", 1.0), unknown("b", 0.4)]
    return Problem(formula, parameters, sigma=0.1, inputs=2, seed=seed)


@pytest.mark.parametrize("begun", [(0.3, 0.33), (1.38, 0.05)], ids=["one side", "the other"])
@pytest.mark.parametrize("seed", [3, 6])
def test_a_valley_that_turns_back_is_followed_behind_its_turn(seed, begun):
    """b = k (1.4 - k) has two values of k for each below 0.49, and ends of its range at both."""
    objective = feedback(0.004, seed).objective()
    end = refine(objective, np.array(begun), max_iterations=300)
    result = uncertainty(objective, end.chromosome)
    b = estimates(result)["b"]
    assert (b.low, b.std) == (None, None)
    assert b.high == pytest.approx(0.49, rel=0.03)
    deviation = np.linalg.norm(result.factor[:, 1]) / b.value
    # A later stage is told of the whole way to where its range ends.
    assert Z * deviation > 0.95 * np.log(b.value / 0.04)


class Laddered(Formula):
    """One step a sample above a gain, two below it, whose own errors are like a fiftieth of noise.

    So they change twice the log-likelihood by n / 25 at once, but no slope.
    """

    def __init__(self, model, formula, above, noise):
        super().__init__(model, formula)
        self.above, self.noise = above, noise

    def steps_of_each(self, vectors, record):
        return np.where(vectors[:, 0] > self.above, 1, 2)

    def trajectories(self, vectors, record, n_steps=None, starts=None):
        outputs = super().trajectories(vectors, record, n_steps, starts)
        outputs[n_steps == 1] += 0.02 * self.noise
        return outputs


class Stiff(Laddered):
    """The same, but that nothing below the gain can be simulated by one step."""

    def trajectories(self, vectors, record, n_steps=None, starts=None):
        outputs = Formula.trajectories(self, vectors, record, n_steps, starts)
        outputs[self._fails(vectors, n_steps)] = np.inf
        return outputs

    def residuals(self, vectors, records, scales, n_steps, starts, *, keep=True):
        found = super().residuals(vectors, records, scales, n_steps, starts, keep=keep)
        excess = np.where(self._fails(vectors, n_steps[:, 0])[:, None], np.inf, found.excess)
        return replace(found, excess=excess)

    def _fails(self, vectors, n_steps):
        return (n_steps == 1) & (vectors[:, 0] <= self.above)


@pytest.mark.parametrize(
    ("kind", "share"), [(Laddered, -0.5), (Laddered, 0.5), (Stiff, 0.5)], ids=str
)
def test_errors_of_the_integration_steps_are_no_loss_of_likelihood(kind, share):
    """Nor is what a place gains by which the estimate would fail by its steps."""
    rng = np.random.default_rng(5)
    u = rng.standard_normal((400, 1))
    noise = rng.standard_normal((400, 1))
    noise -= u * (u.T @ noise) / (u.T @ u)
    model = lag(
        parameters=(unknown("gain", 2.0, "linear"),),
        derivative=lambda x, u, p: (p[0] * u[0] - x[0],),
    )
    deviation = float(np.sqrt(np.mean(noise**2) / np.sum(u**2)))
    simulator = kind(model, lambda p, u: p["gain"] * u, 2.0 + share * deviation, noise)
    record = Dataset(u, 2.0 * u + noise, 0.01)
    objective = Objective(simulator, SearchSpace.of(model), [record])
    ends = profile(objective, np.array([2.0]), "gain")
    expected = 2.0 + Z * deviation * np.array([-1, 1])
    np.testing.assert_allclose((ends.low, ends.high), expected, rtol=1e-3)


def test_a_worse_branch_of_a_valley_beyond_the_level_is_forgotten():
    """From within there is a better fit at its place: where the level is, is sought anew."""
    target = LINEAR.objective()
    local = sensitivity(target, least_squares(target.records)[1])
    spread = covariance(local, ties(local).directions)
    tracer = Tracer(local, spread, np.eye(3)[0], Coordinate(target.space, 0))

    def fit(place, statistic, **how):
        return Fit(place, statistic, tracer.start, 0.0, **how)

    search = tracer.bound(1.0)
    far = next(search)
    assert len(far.groups) == 1
    between = search.send(fit(far.place, 50.0))
    assert len(between.groups) == 2
    assert tracer.centre < between.place < far.place
    beyond = search.send(fit(between.place, 0.5, alone=True))
    assert len(beyond.groups) == 1
    reach = between.place - tracer.centre
    assert beyond.place == pytest.approx(tracer.centre + 1.5 * reach)
    with pytest.raises(StopIteration) as end:
        search.send(fit(beyond.place, 1.001 * Z95**2))
    assert end.value.value == pytest.approx(tracer.quantity.value(beyond.place), rel=1e-3)


def test_few_steps_lead_along_a_narrow_valley_that_bends():
    """b = k (1.4 - k), in which k is known to a hundredth; damped steps alone are 60."""
    formula = feedback(1e-3, 4).formula
    parameters = [unknown("k", 1.0), unknown("b", 0.4)]
    objective = Problem(formula, parameters, sigma=1e-4, inputs=2, seed=4).objective()
    end = refine(objective, np.array([0.3, 0.33]), max_iterations=200)
    np.testing.assert_allclose(end.chromosome, [1.0, 0.4], rtol=0.01)
    assert end.iterations < 40


@pytest.mark.parametrize("begun", [(0.3, 0.33), (0.15, 0.2)])
def test_where_a_descent_stops_in_a_bent_valley_matters_to_no_interval(begun):
    objective = feedback(0.02, 4).objective()
    minimum, stopped = (
        refine(objective, np.array(begun), max_iterations=most).chromosome for most in (300, 3)
    )
    k = estimates(uncertainty(objective, stopped))["k"]
    assert abs(stopped[0] - minimum[0]) > 0.1
    assert k.high == pytest.approx(profile(objective, minimum, "k").high, rel=0.02)


def test_a_descent_along_a_bent_valley_comes_to_its_end():
    objective = feedback(0.0005, 4).objective()
    begun = np.array([0.15, 0.2])
    end = refine(objective, begun, max_iterations=1000)
    assert end.iterations > MOST_ITERATIONS
    reached = fit_likelihood(objective, [begun], explored=True).optimum
    np.testing.assert_allclose(reached.chromosome, end.chromosome, rtol=1e-3)


@pytest.mark.parametrize("offset", [0.5, -2.0])
def test_a_better_minimum_in_what_is_hardly_felt_is_found(offset):
    """Two minima in w, at e and near 1 / e, apart by a few hundredths of the error.

    Beside an offset, which may have a range below zero.
    """

    def formula(p, u):
        w = np.log(p["w"])
        seen = 0.02 * (w**2 - 1.0) * u[:, 1] + 0.01 * w * u[:, 2]
        return columns(p["k"] * u[:, 0] + seen + p["f0"])

    w = unknown("w", math.e, lower=math.exp(-2.0), upper=math.exp(2.0))
    f0 = unknown("f0", offset, "linear", lower=offset - 1.0, upper=offset + 1.0)
    free = [unknown("k", 1.0), w, f0]
    objective = Problem(formula, free, sigma=0.1, n=2000, seed=1).objective()
    begun = refine(objective, np.array([1.0, 0.4, offset])).chromosome
    assert begun[1] < 0.6
    reached = fit_likelihood(objective, [begun], explored=True).optimum
    assert reached.chromosome[1] == pytest.approx(math.e, rel=0.15)


def test_what_the_data_feel_is_not_tied_whatever_the_equations_seem_to_say():
    """Of a model whose outputs are another formula than its equations."""
    model = lag(derivative=lambda x, u, p: (p[0] * p[1] * u[0] - x[0],))
    u = 1.0 + np.random.default_rng(0).standard_normal((200, 1))
    simulator = Formula(model, lambda p, u: p["gain"] * u[:, :1] + p["tau"])
    record = Dataset(u, 2.0 * u + 0.05 + 0.01 * np.random.default_rng(1).normal(size=u.shape), 0.01)
    objective = Objective(simulator, SearchSpace.of(model), [record])
    result = uncertainty(objective, refine(objective, np.array([2.0, 0.05])).chromosome)
    assert [e.why for e in result.parameters] == ["", ""] and not result.ambiguities


# --- what the data leave open --------------------------------------------------------------------


def test_the_width_of_a_range_matters_to_nothing_while_its_ends_are_far():
    def formula(p, u):
        return columns(p["k"] * u[:, 0] + p["f0"])

    def offset(half):
        parameters = [
            unknown("k", 2.0),
            unknown("f0", 0.0, "linear", lower=-half, upper=half),
        ]
        return estimates(Problem(formula, parameters, sigma=20.0).tell())["f0"]

    narrow, wide = offset(10.0), offset(200.0)
    assert narrow.why == wide.why == ""
    assert narrow.std == pytest.approx(wide.std, rel=1e-6)
    assert (narrow.low, narrow.high) == pytest.approx((wide.low, wide.high), rel=1e-3)


def test_a_parameter_pushed_against_its_bound_counts_as_fixed_and_has_one_end():
    def formula(p, u):
        return columns(p["a"] * u[:, 0] + p["b"] * u[:, 1])

    problem = Problem(formula, [unknown("a", 3.0), unknown("b", 0.5)])
    result = problem.tell(ranges={"b": (1.0, 2.0)})
    parameters = estimates(result)
    b = parameters["b"]
    assert (b.value, b.on_bound, b.pushed, b.low) == (1.0, True, True, None)
    assert 1.0 < b.high < 1.05
    assert not result.ambiguities
    same_interval(parameters["a"], estimates(problem.tell(fixed={"b": 1.0}))["a"])


@pytest.mark.parametrize("low, harmless", [(1e-4, True), (0.006, False)])
def test_an_end_beyond_which_nothing_changes_is_harmless(low, harmless):
    """Of b, which is next to nothing, and goes with a: at 0.006 it makes a another."""

    def formula(p, u):
        return columns((p["a"] + p["b"]) * u[:, 0] + 0.3 * p["b"] * u[:, 1])

    problem = Problem(formula, [unknown("a", 3.0), unknown("b", 1e-6, lower=1e-9, upper=10.0)])
    ended = estimates(problem.tell(ranges={"b": (low, 10.0)}))
    free = estimates(problem.tell(ranges={"b": (1e-3 * low, 10.0)}))
    assert ended["b"].on_bound and not ended["b"].pushed and not ended["a"].harmless
    assert ended["b"].harmless is harmless
    moved = abs(ended["a"].value - free["a"].value) / free["a"].deviation
    assert (moved < 0.5) is harmless


@pytest.mark.parametrize("lacking, harmless", [(0.0, True), (0.05, False)])
def test_an_end_near_nothing_is_harmless_where_data_push_beyond_it_by_chance(lacking, harmless):
    """Of noise 2 deviations, in one of forty; of what the model lacks many."""

    def formula(p, u):
        slip = p["b"] - p["lacking"]
        return columns((p["a"] + slip) * u[:, 0] + 0.3 * slip * u[:, 1])

    small = unknown("b", 1e-6, lower=1e-9, upper=10.0)
    lack = unknown("lacking", lacking, "linear", lower=-1.0, upper=1.0)
    problem = Problem(formula, [unknown("a", 3.0), small, lack], seed=14)
    told = estimates(problem.tell(ranges={"b": (1e-4, 10.0)}, fixed={"lacking": 0.0}))
    assert told["b"].on_bound and told["b"].pushed
    assert told["b"].harmless is harmless


@pytest.mark.parametrize("seed", [1, 2])
def test_an_end_at_which_the_interval_of_another_ends_is_not_harmless(seed):
    """Of b next to nothing is known, so that a is what the range of b lets it be."""

    def formula(p, u):
        return columns((p["a"] + p["b"]) * u[:, 0] + 0.003 * p["b"] * u[:, 1])

    problem = Problem(formula, [unknown("a", 3.0), unknown("b", 0.5)], seed=seed)
    ended = estimates(problem.tell(ranges={"b": (1.0, 2.0)}))
    a, b = ended["a"], ended["b"]
    assert a.high < 3.0, "an interval that excludes the truth"
    assert b.on_bound and not b.harmless


def test_ends_that_decide_something_together_are_not_harmless():
    """A tenfold of b or of c is nothing, of both a hundredfold, by which a is another."""

    def formula(p, u):
        return columns(p["a"] * u[:, 0] + 1.2e-3 * p["b"] * p["c"] * (u[:, 0] + 0.02 * u[:, 1]))

    parameters = [unknown(name, value) for name, value in (("a", 3.0), ("b", 10.0), ("c", 10.0))]
    problem, low = Problem(formula, parameters, seed=2), (0.1, 1.0)
    for ends, fixed in (({"b": low, "c": low}, {}), ({"b": low}, {"c": 1.0})):
        ended = estimates(problem.tell(ranges=ends, fixed=fixed))
        at_ends = [e for e in ended.values() if e.on_bound]
        assert [e.name for e in at_ends] == [*ends] and not any(e.pushed for e in at_ends)
        assert all(e.harmless is (len(ends) == 1) for e in at_ends)
    free = estimates(problem.tell(fixed={"b": 10.0, "c": 10.0}))
    assert abs(ended["a"].value - free["a"].value) > 1.0 * ended["a"].deviation


def test_where_ranges_of_tied_parameters_end_a_profile_there_is_no_end():
    """R / L is known, so with R / K it ends at the least L and the largest K."""

    def formula(p, u):
        return columns(p["R"] / p["L"] * u[:, 0], 3.0 * p["R"] / p["K"] * u[:, 1])

    parameters = [unknown("R", 1.0), unknown("L", 0.1), unknown("K", 300.0)]
    quotients = (
        Formulated("R / L", ("R", "L"), lambda r, inductance: r / inductance),
        Formulated("R / K", ("R", "K"), lambda r, k: r / k),
    )

    def within(sigma, least):
        problem = Problem(formula, parameters, sigma=sigma, seed=2)
        result = problem.tell(*quotients, ranges={"L": (least, 1.0), "K": (1.0, 200.0)})
        return result, combinations(result)

    (_, wide), (narrow, ended) = within(0.1, 0.001), within(0.1, 0.1)
    assert 0.0 < wide["R / K"].low < 1.0 / 300.0 < wide["R / K"].high
    assert ended["R / K"].low is None and ended["R / K"].high > 1.0 / 300.0
    assert ended["R / L"].low < 10.0 < ended["R / L"].high
    at_ends = [e for e in narrow.parameters if e.on_bound]
    assert [e.name for e in at_ends] == ["L", "K"] and all(e.harmless for e in at_ends)
    # Where the data tell that it is beyond, by many deviations, there is no interval.
    sure, ended = within(0.01, 0.1)
    assert {e.why for e in ended.values()} == {"end"}
    assert not any(e.harmless for e in sure.parameters)


@pytest.mark.parametrize(("ends", "why"), [((1.0, 2.0), ""), ((1.0, 1.2), "end")])
def test_a_combination_that_the_data_want_beyond_its_ranges_has_no_interval(ends, why):
    """The true product is 1.5; ranges of its factors end at 2 or at 1.2."""
    problem = Problem(
        lambda p, u: columns(p["a"] * p["b"] * u[:, 0] + p["c"] * u[:, 1]),
        [unknown("a", 3.0), unknown("b", 0.5), unknown("c", 1.0)],
    )
    product = Formulated("a b", ("a", "b"), lambda a, b: a * b)
    result = problem.tell(product, ranges={"a": ends, "b": (0.5, 1.0)})
    (ambiguity,) = result.ambiguities
    assert [e.why for e in ambiguity.determined] == [why]
    assert ("a b" in {e.name for e in result.determined()}) == (not why)


def test_of_some_coordinates_no_combination_with_others_is_left():
    problem = Problem(
        lambda p, u: columns(p["a"] * p["b"] * u[:, 0] + p["c"] * u[:, 1]),
        [unknown("a", 3.0), unknown("b", 0.5), unknown("c", 1.0)],
    )
    result = problem.tell(Formulated("a b", ("a", "b"), lambda a, b: a * b))
    names = [e.name for e in result.of([0, 1, 2], ["a", "b", "C"]).determined()]
    assert names == ["C", "a b"]
    assert [e.name for e in result.of([1, 2], ["b", "C"]).determined()] == ["C"]


def test_what_does_nothing_is_hardly_felt():
    problem = Problem(
        lambda p, u: columns(p["a"] * u[:, 0]), [unknown("a", 2.0), unknown("idle", 1.0)]
    )
    result = problem.tell()
    parameters = estimates(result)
    assert parameters["idle"].why == "vague" and not result.ambiguities
    same_interval(parameters["a"], estimates(problem.tell(fixed={"idle": 1.0}))["a"])
    of_each = np.linalg.norm(result.factor, axis=0)
    assert of_each == pytest.approx([parameters["a"].std, np.log(10.0) / Z], rel=1e-3)


def small_effect(p, u):
    return columns(p["a"] * u[:, 0] + 1e-2 * p["b"] * u[:, 1])


@pytest.mark.parametrize("seed", range(3))
def test_a_narrow_interval_whose_ends_lose_too_much_or_too_little_is_its_profiles(seed):
    """Of a^10 the ends are known exactly; those by slopes of ln a are a third too near and far."""
    problem = Problem(tenth_power, [unknown("a", 1.0)], sigma=8.5, inputs=1, seed=seed)
    u, y = problem.records[0].inputs[:, 0], problem.records[0].outputs[:, 0]
    best = float(u @ y) / float(u @ u)
    half = Z * np.std(y - u * best) / np.sqrt(float(u @ u))
    assert 0.4 < half / best < 0.9
    result = estimates(problem.tell())["a"]
    ends = np.log([result.low / result.value, result.high / result.value])
    assert ends == pytest.approx(np.log1p([-half / best, half / best]) / 10.0, rel=0.05)


def tenth_power(p, u):
    return columns(p["a"] ** 10 * u[:, 0])


@pytest.mark.parametrize("seed", range(4))
def test_a_weak_parameter_has_the_ends_that_its_slope_gives(seed):
    """Of a logarithm of what may as well be zero the ends are those of least squares."""
    parameters = [unknown("a", 2.0), unknown("b", 0.2)]
    problem = Problem(small_effect, parameters, inputs=2, seed=seed)
    X, y = problem.records[0].inputs * [1.0, 1e-2], problem.records[0].outputs[:, 0]
    best = np.linalg.lstsq(X, y, rcond=None)[0]
    half = Z * np.std(y - X @ best) * np.sqrt(np.linalg.inv(X.T @ X)[1, 1])
    result = problem.tell()
    b = estimates(result)["b"]
    assert (b.std, b.why) == (None, "")
    farther = max(np.log((b.high or 2.0) / b.value), np.log(b.value / (b.low or 0.02)))
    passed_on = np.linalg.norm(result.factor[:, 1]) / b.value
    assert Z * passed_on == pytest.approx(farther, rel=0.1)
    expected = [None if not 0.02 < end < 2.0 else end for end in (best[1] - half, best[1] + half)]
    assert [b.low, b.high] == [end if end is None else pytest.approx(end, rel=0.05)
                               for end in expected]  # fmt: skip


@pytest.mark.parametrize("seed", [2, 3, 8])
def test_a_weak_sum_is_passed_on_as_wide_as_its_one_end_and_the_range_say(seed):
    """Its lower end is that of the ranges, where it stands."""
    problem = Problem(
        lambda p, u: columns(p["a"] * u[:, 0] + 1e-2 * (p["b"] + p["d"]) * u[:, 1]),
        [unknown("a", 2.0), unknown("b", 0.1), unknown("d", 0.1)],
        inputs=2,
        sigma=0.1,
        seed=seed,
    )
    result = problem.tell(Formulated("b + d", ("b", "d"), lambda b, d: b + d))
    ((total,),) = (ambiguity.determined for ambiguity in result.ambiguities)
    assert (total.value, total.low) == (pytest.approx(0.02), None)
    passed_on = np.linalg.norm(result.factor[:, 1] + result.factor[:, 2])
    assert Z * passed_on == pytest.approx((total.high or 0.0) - total.value, rel=1e-3)


@pytest.mark.soak
def test_ends_of_a_weak_parameter_hold_the_truth():
    held = []
    for seed in range(50):
        problem = Problem(small_effect, [unknown("a", 2.0), unknown("b", 0.2)], inputs=2, seed=seed)
        b = estimates(problem.tell())["b"]
        held.append((b.low or 0.0) <= 0.2 <= (b.high or np.inf))
    assert 0.9 < np.mean(held) <= 1.0


def test_more_logs_never_determine_less():
    parameters = [unknown("a", 2.0), unknown("b", 0.2), unknown("c", 0.01)]

    def formula(p, u):
        return columns(p["a"] * u[:, 0] + 1e-2 * p["b"] * u[:, 1] + 1e-2 * p["c"] * u[:, 2])

    problem = Problem(formula, parameters, records=4)
    before: set[str] = set()
    for count in (1, 2, 4):
        determined = {e.name for e in problem.tell(records=problem.records[:count]).determined()}
        assert before <= determined
        before = determined


def test_where_simulations_fail_on_one_side_the_other_tells():
    def formula(p, u):
        with np.errstate(invalid="ignore"):
            return columns(np.sqrt(p["s"] - 1.0) * u[:, 0] + p["s"] * u[:, 1])

    problem = Problem(formula, [unknown("s", 1.0 + 1e-7, "linear", lower=0.0, upper=4.0)])
    (s,) = uncertainty(problem.objective(), np.array([1.0 + 1e-7])).parameters
    assert s.why == "" and s.failing == pytest.approx(0.25, abs=0.03)
    # The square root is steep there.
    assert 1.0 < s.high < 1.001 and s.low == pytest.approx(1.0, abs=1e-6)


# --- logs that disagree --------------------------------------------------------------------------


def logs_with(slopes, sigma=0.05, n=200, seed=0):
    """A record for each slope b of y = a u + b v."""
    rng = np.random.default_rng(seed)
    records = []
    for slope in slopes:
        u = 1.0 + rng.standard_normal((n, 2))
        y = 2.0 * u[:, 0] + slope * u[:, 1] + sigma * rng.standard_normal(n)
        records.append(Dataset(u, y, 0.01))
    return records


def slopes_problem():
    return Problem(
        lambda p, u: columns(p["a"] * u[:, 0] + p["b"] * u[:, 1]),
        [unknown("a", 2.0, "linear"), unknown("b", 1.0, "linear")], inputs=2,
    )  # fmt: skip


def test_logs_that_agree_change_nothing():
    records = logs_with([1.0] * 6)
    result = slopes_problem().tell(records=records)
    assert result.disagreement == 1.0
    X = np.vstack([record.inputs for record in records])
    std = 0.05 * np.sqrt(np.diag(np.linalg.inv(X.T @ X)))
    assert [e.std for e in result.parameters] == pytest.approx(list(std), rel=0.1)


def test_errors_of_the_simulation_are_no_disagreement():
    """Each log wants other parameters by what double precision rounds, and that is nothing."""
    slopes = 1.0 + 1e-12 * np.array([-2.0, 1.0, -1.0, 3.0, 0.0, -1.0])
    result = slopes_problem().tell(records=logs_with(slopes, sigma=1e-14))
    assert result.disagreement == 1.0


def test_logs_that_disagree_widen_to_the_spread_between_them():
    slopes = [0.8, 1.1, 0.9, 1.3, 1.0, 0.9]
    result = slopes_problem().tell(records=logs_with(slopes))
    b = estimates(result)["b"]
    expected = np.std(slopes, ddof=1) / np.sqrt(6)
    quantile = stats.t.ppf(0.975, 5) / Z
    assert result.disagreement > 20.0
    assert b.std == pytest.approx(quantile * expected, rel=0.15)


@pytest.mark.parametrize("seed", [5, 6])
def test_what_one_log_tells_nearly_alone_is_as_good_as_that_log(seed):
    """Not as what is left without it, where the logs disagree of something else."""
    slopes, sizes = [1.993, 2.003, 1.997, 2.01, 2.0, 1.99, 2.007, 2.0], [1.0, *[0.09] * 7]
    rng, records = np.random.default_rng(seed), []
    for slope, size in zip(slopes, sizes, strict=True):
        u = rng.standard_normal((200, 2)) * [1.0, size]
        y = slope * u[:, 0] + u[:, 1] + 0.05 * rng.standard_normal(200)
        records.append(Dataset(u, y, 0.01))
    result = slopes_problem().tell(records=records)
    b = estimates(result)["b"]
    alone = 0.05 / np.sqrt(np.sum(records[0].inputs[:, 1] ** 2))
    assert result.disagreement > 2.0
    assert alone < b.std < 6.0 * alone


def coverage_of_few(spread, n_logs, repeats=100):
    """Share of intervals of a and b that hold their means, where those of logs spread so."""
    rng, held = np.random.default_rng(1), []
    for seed in range(repeats):
        slopes = 1.0 + spread * rng.standard_normal(n_logs)
        result = slopes_problem().tell(records=logs_with(slopes, n=40, seed=seed))
        held += [e.low <= e.at({"a": 2.0, "b": 1.0}) <= e.high for e in result.parameters]
    return np.mean(held)


@pytest.mark.soak
@pytest.mark.parametrize("n_logs", [3, 5])
@pytest.mark.parametrize("spread", [0.0, 0.01, 0.1])  # a log tells b to 0.009
def test_intervals_of_few_logs_hold_whether_they_differ_or_not(spread, n_logs):
    # Of three logs that differ in one direction only their spread is known too badly.
    lowest = 0.88 if (n_logs, spread) == (3, 0.1) else 0.92
    assert lowest <= coverage_of_few(spread, n_logs) <= 0.99


@pytest.mark.soak
def test_half_of_the_logs_does_not_contradict_the_other_half():
    rng = np.random.default_rng(3)
    overlaps = []
    for seed in range(30):
        records = logs_with(1.0 + 0.2 * rng.standard_normal(12), seed=seed)
        one, other = (slopes_problem().tell(records=half) for half in (records[::2], records[1::2]))
        overlaps += [
            a.low < b.high and b.low < a.high
            for a, b in zip(one.parameters, other.parameters, strict=True)
        ]
    assert np.mean(overlaps) > 0.95


# --- all at once ---------------------------------------------------------------------------------


def test_all_intervals_together_hold_as_often_as_independent_ones():
    result = LINEAR.tell()
    # The inputs' means tie the three estimates a little.
    assert result.joint == pytest.approx(0.95**3, abs=0.015)
    quantile = stats.norm.ppf(0.5 + 0.5 * 0.95 ** (1.0 / 3.0))
    assert result.simultaneous == pytest.approx(quantile / Z, abs=0.02)


def test_intervals_that_nobody_asks_for_do_not_count_among_all():
    """Neither starts of parts of a log, nor what they are in."""
    objective = LINEAR.objective()
    end = refine(objective, TRUTH).chromosome
    result = uncertainty(objective, end, profiled=[0, 1])
    assert result.joint == pytest.approx(0.95**2, abs=0.015)
    assert all(e.std is not None for e in result.parameters)


def test_an_output_that_does_not_count_determines_nothing():
    problem = Problem(
        lambda p, u: columns(p["a"] * u[:, 0], p["b"] * u[:, 1]),
        [unknown("a", 3.0), unknown("b", 1.0)],
    )
    objective = Objective(
        Formula(problem.model, problem.formula), SearchSpace.of(problem.model), problem.records,
        weights=np.array([1.0, 0.0]),
    )  # fmt: skip
    result = uncertainty(objective, np.array([3.0, 1.0]))
    assert [e.why for e in result.parameters] == ["", "vague"]


# --- what must not matter, and how much what does -------------------------------------------------

UNITS = [
    unknown("a", 3.0),
    unknown("b", 0.5, "linear", lower=0.1, upper=2.0),
    unknown("c", 2.0),
]


def two_outputs(p, u, scale=1.0):
    return columns(
        p["a"] * u[:, 0] + p["b"] * u[:, 1], scale * p["c"] * (p["b"] * u[:, 1] + u[:, 2])
    )


def relative(found):
    return {e.name: (e.std / abs(e.value), e.why) for e in found.parameters}


@functools.cache
def plain_two():
    problem = Problem(two_outputs, UNITS, records=2)
    return problem, problem.tell()


@settings(max_examples=20)
@given(power=st.floats(-6.0, 6.0))
def test_the_unit_of_an_output_matters_to_nothing(power):
    problem, before = plain_two()
    scale = 10.0**power
    records = [Dataset(r.inputs, r.outputs * np.array([1.0, scale]), r.dt) for r in problem.records]
    objective = Objective(
        Formula(problem.model, functools.partial(two_outputs, scale=scale)),
        SearchSpace.of(problem.model), records,
    )  # fmt: skip
    at = np.array([e.value for e in before.parameters])
    after = uncertainty(objective, at)
    for one, other in zip(before.parameters, after.parameters, strict=True):
        same_interval(one, other)
    np.testing.assert_allclose(after.covariance, before.covariance, rtol=1e-4, atol=1e-12)


@settings(max_examples=20)
@given(order=st.permutations([0, 1, 2]), swap=st.booleans())
def test_the_order_of_parameters_and_records_matters_to_nothing(order, swap):
    problem, before = plain_two()
    model = ProcessModel(**{
        **{name: getattr(problem.model, name)
           for name in ("name", "states", "inputs", "outputs", "derivative", "output")},
        "parameters": [UNITS[i] for i in order],
    })  # fmt: skip
    records = problem.records[::-1] if swap else problem.records
    at = np.array([before.parameters[i].value for i in order])
    after = uncertainty(problem.objective(records, model), at)
    for place, i in enumerate(order):
        same_interval(after.parameters[place], before.parameters[i])
    np.testing.assert_allclose(
        after.correlation(), before.correlation()[np.ix_(order, order)], atol=1e-5
    )


def test_the_scale_of_the_search_hardly_matters_to_what_is_well_known():
    problem = Problem(two_outputs, UNITS)
    logarithmic = problem.tell(scale=dict.fromkeys("abc", "log"))
    linear = problem.tell(scale=dict.fromkeys("abc", "linear"))
    for one, other in zip(logarithmic.parameters, linear.parameters, strict=True):
        assert one.std == pytest.approx(other.std, rel=1e-3)
        assert one.low == pytest.approx(other.low, rel=1e-3)
    np.testing.assert_allclose(logarithmic.correlation(), linear.correlation(), atol=1e-3)


def test_an_interval_on_a_logarithmic_scale_is_one_of_factors():
    problem = Problem(two_outputs, UNITS, sigma=2.0)
    for estimate in problem.tell(scale=dict.fromkeys("abc", "log")).parameters:
        factor = np.exp(Z * estimate.std / estimate.value)
        assert factor > 1.02
        assert estimate.high / estimate.value == pytest.approx(factor, rel=1e-9)
        assert estimate.value / estimate.low == pytest.approx(factor, rel=1e-9)


def test_twice_the_data_shrink_deviations_by_the_root_of_two():
    problem = Problem(two_outputs, UNITS)
    at = np.array([e.value for e in problem.tell().parameters])
    once = uncertainty(problem.objective(), at)
    twice = uncertainty(problem.objective(problem.records * 2), at)
    for one, other in zip(once.parameters, twice.parameters, strict=True):
        assert one.std / other.std == pytest.approx(np.sqrt(2.0), rel=1e-6)


@pytest.mark.parametrize("lost", [0.1, 0.5])
def test_lost_samples_cost_what_they_would_have_told(lost):
    """Half of the samples at random: as good as a record of half the length."""
    problem = Problem(two_outputs, UNITS, n=4000)
    (record,) = problem.records
    outputs = record.outputs.copy()
    outputs[np.random.default_rng(1).random(len(outputs)) < lost] = np.nan
    at = np.array([p.nominal for p in UNITS])
    halved = [Dataset(record.inputs, outputs, record.dt)]
    whole, part = (
        uncertainty(objective, refine(objective, at).chromosome)
        for objective in (problem.objective(), problem.objective(halved))
    )
    for one, other in zip(whole.parameters, part.parameters, strict=True):
        assert other.std / one.std == pytest.approx(1.0 / np.sqrt(1.0 - lost), rel=0.05)


def test_the_same_question_has_the_same_answer():
    record = noisy_record(np.random.default_rng(2), 0.3, 0.01)
    one, other = NOISY.tell(records=[record]), NOISY.tell(records=[record])
    assert one.parameters == other.parameters
    np.testing.assert_array_equal(one.covariance, other.covariance)


# --- the actuator ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def rig_minimum():
    """Record of the shipped experiment on the simulated rig, and the minimum next to its values."""
    model, truth = actuator(), actuator(parameters="rig")
    record, _ = simulated_logs(model)
    values = dict(zip(truth.parameter_names, truth.nominal, strict=True))
    objective, start = rig_objective(record, values)
    found = dict(zip(objective.space.names, refine(objective, start).chromosome, strict=True))
    return record, values, found


def rig_objective(record, values, fixed=()):
    """The objective with some parameters fixed, and a chromosome of the values given."""
    model = actuator()
    space = SearchSpace.of(model, fixed={n: values[n] for n in fixed}).with_starts([record])
    at = np.array([values.get(name, 0.0) for name in space.names])
    return Objective(BatchSimulator(model), space, [record]), at


@pytest.fixture(scope="module")
def rig_result(rig_minimum):
    """What is known of all parameters there."""
    record, _, start = rig_minimum
    return uncertainty(*rig_objective(record, start))


@pytest.mark.soak
def test_the_redundancies_of_the_actuator_are_found(rig_minimum, rig_result):
    values, result = rig_minimum[1], rig_result
    groups = {frozenset(a.parameters): a for a in result.ambiguities}
    bristle = frozenset({"A", "alpha0", "alpha1", "z(0)"})
    coil = frozenset({"R_b", "L_b", "K_db"})
    inertia, damping = frozenset({"J_m", "J_b"}), frozenset({"B_m", "c0"})
    assert set(groups) == {bristle, coil, inertia, damping}
    assert all(len(group.measure) == 1 for group in groups.values())
    tied = bristle | coil | inertia | damping
    assert {e.name for e in result.parameters if e.why == "tied"} == tied
    true = {**values, "z(0)": -1.1}
    quantities = result.determined()
    assert {"K_m", "R_m", "gamma", "beta", "J_m + J_b", "B_m + c0"} <= {e.name for e in quantities}
    assert sum(e.excludes(true) for e in quantities) <= 1


@pytest.mark.soak
def test_what_to_measure_on_the_actuator_resolves_it(rig_minimum, rig_result):
    record, _, start = rig_minimum
    measure = [name for a in rig_result.ambiguities for name in a.measure]
    after = uncertainty(*rig_objective(record, start, fixed=measure))
    assert not after.ambiguities
    assert {e.why for e in after.parameters} <= {"", "vague"}


@pytest.mark.parametrize("size", [1e15, 1e200, np.inf])
def test_tangents_that_have_grown_without_bounds_are_no_slopes(monkeypatch, size):
    """As those of a stiff friction do, around which a simulation chatters in small bounds."""
    space, nominal = SearchSpace.of(lag()), lag().nominal
    objective = Objective(BatchSimulator(lag()), space, [lag_record(np.random.default_rng(4))])
    expected = sensitivity(objective, nominal).slopes
    exact = objective.with_exact_slopes()
    assert has_tangents(exact, nominal)
    grown = SimpleNamespace(dense=np.full(expected.shape, size))
    monkeypatch.setattr(Objective, "tangents", lambda *_: [grown])
    assert not has_tangents(exact, nominal)
    assert sensitivity(exact, nominal).slopes == pytest.approx(expected, rel=1e-5)
